"""Causes that the library does not know: over which axis they repeat, and the formula that they are.

The motions are integrated by scipy; nothing of frictrack's laws or integrator is in them.
"""

from __future__ import annotations

import tomllib
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from runs import MASS, measured
from scipy.integrate import solve_ivp

from frictrack import effects
from frictrack.diagnose import diagnose
from frictrack.diagnose.compressed import candidate_axes, compress_residual
from frictrack.diagnose.explanations import Explanation
from frictrack.diagnose.formula_terms import SHAPES
from frictrack.diagnose.formulas import (
    MIN_CHI2_FALL,
    FormulaSearch,
    are_left_out,
    compare_with_formulas,
    unexplained_force,
)
from frictrack.diagnose.model_selection import information_criterion
from frictrack.diagnose.repeatability import AxisRepeatability, Repeatability
from frictrack.diagnose.search import _explains_more
from frictrack.effects import definitions, read_settings
from frictrack.fit import add_effect, fit, refine

LAW = ["coulomb", "viscous"]
PLAN = ((3.4, 1), (4.0, 1), (6.0, 1), (4.5, 2), (-4.0, 1), (-5.5, 1))  # start speed m/s, mass over the reference
FRAMES, FPS = 280, 4000.0  # before the slowest stops

CAUSES = {  # what is hidden: axis, force at x, v, t, s and load
    "magnet": ("x", lambda x, v, t, s, load: 1.5 * ((x - 0.3) / 0.03) / (1 + ((x - 0.3) / 0.03) ** 2) ** 2),
    "joint": ("x", lambda x, v, t, s, load: 0.4 * load * s * np.tanh((x - 0.31) / 4e-3)),
    "saw": ("x", lambda x, v, t, s, load: 0.8 * load * s * (2 * ((x / 0.07) % 1.0) - 1)),
    "rate_and_state": ("v", lambda x, v, t, s, load: 0.5 * load * s * np.log((abs(v) + 1e-3) / 0.01)),
    "flash_weakening": ("v", lambda x, v, t, s, load: 4.0 * load * s / (1 + abs(v) / 1.2)),
    "speed_resonance": ("v", lambda x, v, t, s, load: 0.7 * load * s * np.exp(-(((abs(v) - 3) / 0.45) ** 2) / 2)),
    "chirp": ("t", lambda x, v, t, s, load: 0.8 * np.sin(2 * np.pi * 35 * (1 + 4 * t) * t)),
}
# shapes that are the cause, or cannot be told from it by such runs
EQUAL = {
    "magnet": {"pair"},
    "joint": {"step"},
    "saw": {"teeth"},
    "rate_and_state": {"logarithm", "decay", "fraction", "root"},
    "flash_weakening": {"fraction", "decay"},
    "speed_resonance": {"bump"},
    "chirp": {"chirp"},
}
LOOKS = {  # a piece of text by which a shape is known in a formula
    "pair": "^2)^2",
    "step": "tanh(",
    "teeth": "atan(",
    "logarithm": "log(1 + |v|",
    "decay": "exp(-|v|",
    "fraction": "1/(1 + |v|/",
    "root": "sqrt(",
    "bump": "exp(-((|v|",
    "chirp": "1/s^2 t) t",
}


def slides(cause, *, sigma=1e-5, seed=0, plan=PLAN):
    """Runs under Coulomb and viscous friction, 2 % scatter of the level, and one cause more."""
    rng = np.random.default_rng(seed)
    hidden = cause if callable(cause) else CAUSES[cause][1] if cause else lambda *_: 0.0
    out = []
    for i, (speed, load) in enumerate(plan):
        level, s = load * (1 + 0.02 * rng.standard_normal()), np.sign(speed)

        def moves(t, z, level=level, s=s, load=load):
            return [z[1], -(8.0 * level * s + 1.2 * z[1] + hidden(z[0], z[1], t, s, level)) / (MASS * load)]

        t = np.arange(FRAMES) / FPS
        start = [0.05 if s > 0 else 0.6, speed]
        x = solve_ivp(moves, (0, t[-1]), start, t_eval=t, rtol=1e-10, atol=1e-12, max_step=2.5e-4).y[0]
        out.append(measured(t, x, sigma=sigma, mass=MASS * load, name=f"r{i}", rng=rng))
    return out


@pytest.fixture(scope="module")
def fits():
    return cache(lambda cause: fit(LAW, slides(cause)))


@pytest.fixture(scope="module")
def searches(fits):
    """The search for the formulas of a cause, which finds them once."""
    return cache(lambda cause: FormulaSearch.of(fits(cause).solution))


@pytest.fixture(scope="module")
def firsts(searches):
    """The first formula of a cause."""
    return lambda cause: searches(cause).found()[0].entry


@pytest.mark.few(1)
@pytest.mark.parametrize("cause", CAUSES)
def test_the_axis_of_a_cause_outside_the_library_is_found(fits, cause):
    best, second, *_ = compress_residual(fits(cause).solution).smooth
    assert best.axis.name == CAUSES[cause][0]
    assert best.share > 0.9
    assert best.gain > second.gain


def test_the_curve_is_the_force_within_its_band(fits):
    smooth = compress_residual(fits("magnet").solution).smooth[0]
    assert smooth.axis.factor == ""  # it pulls whichever way the mass goes
    truth = CAUSES["magnet"][1](smooth.at, 0, 0, 0, 0)
    away = smooth.force - truth
    assert np.mean(np.abs(away - away.mean()) < 3 * smooth.sigma + 0.05) > 0.95
    assert np.corrcoef(smooth.force, truth)[0, 1] > 0.8  # the law takes up what is slow


def test_pure_noise_has_no_axis():
    smooth = compress_residual(fit(LAW, slides(None)).solution).smooth
    assert smooth[0].gain < 12  # of six to nine axes; a cause has hundreds


@pytest.mark.parametrize(
    "cause",
    [c if c == "magnet" else pytest.param(c, marks=pytest.mark.slow) for c in CAUSES],
)
def test_the_formula_is_the_cause_or_its_equal_and_leaves_the_noise(firsts, cause):
    first = firsts(cause)
    assert any(LOOKS[shape] in first["formula"] for shape in EQUAL[cause]), first["formula"]
    assert first["axis"] == CAUSES[cause][0]
    assert first["delta_bic"] > 50
    assert first["share"] > 0.9
    assert 0.9 < first["reduced_chi2"] < 1.1


@pytest.mark.slow
@pytest.mark.parametrize("cause", ["rate_and_state", "magnet"])
def test_formulas_are_ordered_by_probability_and_the_group_holds_the_cause(fits, cause):
    found = [one.entry for one in FormulaSearch.of(fits(cause).solution).found()]
    probabilities = [f["probability"] for f in found]
    assert probabilities == sorted(probabilities, reverse=True)
    assert 0.5 < sum(probabilities) < 1.0
    right = {"rate_and_state": "F * L * s * log(1 + abs(v)/w)", "magnet": "F * ((x - c)/w)/(1 + ((x - c)/w)^2)^2"}[
        cause
    ]
    assert right in [found[0]["form"], *found[0]["equivalents"]]
    assert found[0]["form"] not in found[0]["equivalents"]


def test_numbers_are_those_of_the_cause(firsts):
    magnet = firsts("magnet")["formula"]
    size, place, width = (float(magnet.split(part)[i].split()[0]) for part, i in ((" N ", 0), ("(x - ", 1), (")/", 1)))
    assert size == pytest.approx(1.5, rel=0.05)
    assert place == pytest.approx(0.3, abs=1e-3)
    assert width == pytest.approx(0.03, rel=0.05)
    chirp = firsts("chirp")["formula"]
    start, rate = (float(chirp.split("(2 pi (")[1].split()[i]) for i in (0, 3))
    assert start == pytest.approx(35.0, abs=1.0)
    assert rate == pytest.approx(140.0, abs=10.0)


@pytest.mark.few(1)
@pytest.mark.parametrize("cause", ["magnet", "flash_weakening"])
def test_the_snippet_is_an_effect_that_makes_the_error_fall_to_the_noise(fits, firsts, cause):
    first = firsts(cause)
    tables = [read_settings(table) for table in tomllib.loads(first["toml"])["effect"]]
    (effect,) = definitions(tables)
    assert effect.name == "unexplained"
    before = fits(cause)
    after = fit(before.model + effect, before.runs)
    assert before.reduced_chi2 > 1.15
    assert after.reduced_chi2 == pytest.approx(1.0, abs=0.1)
    assert after.errors["heldout_rms_um"] == pytest.approx(10.0, rel=0.06)


def test_the_json_has_what_the_report_shows(searches):
    found = unexplained_force(searches("magnet")).summary
    assert {"axis", "factor", "curve", "band", "share", "formulas"} <= found.keys()
    assert np.shape(found["curve"]) == (len(found["band"]), 2)
    assert {"formula", "axis", "share", "delta_bic", "toml"} <= found["formulas"][0].keys()


def test_no_formulas_are_added_to_effects_with_memory():
    runs = slides(None)[:2]
    bare, grown = (fit([*LAW, *more], runs).solution for more in ([], ["friction_lag"]))
    assert are_left_out(FormulaSearch.of(bare), grown)
    assert not are_left_out(FormulaSearch.of(grown), grown)


def repeated(axis):
    return Repeatability([AxisRepeatability(axis, share=0.9, p=0.005, runs=6, of=6, evidence=50.0)])


@pytest.mark.slow
def test_a_plain_force_of_velocity_beats_numbers_of_its_own_in_every_run(fits):
    """The library's best imitation swings the load, with an amplitude and a phase in every run."""
    start = fits("rate_and_state")
    imitation = fit([*LAW, "load_modulation"], start.runs)
    told = compare_with_formulas(FormulaSearch.of(start.solution), imitation.solution, lambda: repeated("v"))
    assert told.summary["decisive"]
    assert told.summary["words"].startswith("a force that depends only on speed explains more with ")
    assert told.summary["formulas"][0]["axis"] == "v"
    worth = information_criterion(start.solution) - information_criterion(imitation.solution)
    assert told.summary["formulas"][0]["delta_bic"] > 10 + worth


@pytest.mark.slow
def test_the_first_formula_is_a_candidate_with_the_name_that_adds_it(fits):
    found = unexplained_force(FormulaSearch.of(fits("joint").solution))
    name, law, delta_bic = found.as_candidate()
    assert name == "formula:1"
    assert delta_bic == found.summary["formulas"][0]["delta_bic"]
    assert law.problem.model.names == [*LAW, "formula:1"]
    assert refine(law.problem, law.p, law.starts, tau=law.tau).objective == pytest.approx(
        law.objective, abs=MIN_CHI2_FALL
    )


@pytest.mark.slow
def test_one_formula_may_explain_far_more_than_a_set_of_effects(fits):
    """A magnet: a few waves in every run imitate it, and any other set of so many effects can only do the same."""
    start = fits("magnet").solution
    formulas, waves = FormulaSearch.of(start), start
    for name in ("vibration", "drift", "spring"):
        waves = add_effect(waves, effects.get(name))
    assert waves.objective < start.objective - 1000  # they explain most of it
    imitation = Explanation((), information_criterion(waves))
    assert _explains_more(formulas, imitation)
    best = formulas.found()[0].solution
    assert not _explains_more(formulas, replace(imitation, criterion=information_criterion(best)))


@pytest.mark.slow
def test_effects_that_one_formula_beats_are_not_named(fits):
    """The search ends with one patch that leaves misfit: two and three would only be better imitations of a magnet."""
    heard = []
    found = diagnose(fits("magnet"), quick=True, progress=lambda done, total, what: heard.append(what))
    assert any("trying sets of 1" in what for what in heard)
    assert not any("trying sets of 2" in what for what in heard)
    assert (found.verdict, found.missing) == ("unexplained", [])
    assert found.unexplained["formulas"][0]["axis"] == "x"


@pytest.mark.slow
def test_runs_are_proposed_that_separate_an_effect_from_a_formula_that_is_as_likely():
    """A joint where few frames see it: a step in the friction, or a patch."""
    small = slides(lambda x, v, t, s, load: 0.08 * load * s * np.tanh((x - 0.31) / 0.02), seed=4)
    found = diagnose(fit(LAW, small))
    assert found.verdict == "ambiguous"
    assert found.unexplained["rival"] == "a formula of place"
    first = found.next_experiment[0]
    assert {found.missing[0], "formula:1"} <= set(first["separates"])
    assert first["expected_delta_bic"] > 10
    assert "the formula depends on place alone" in first["what"]


def test_an_effect_of_the_library_wins_ties():
    """A formula with the very shape of a patch is no better than the patch."""
    runs = slides(lambda x, v, t, s, load: 0.8 * load * s * np.exp(-(((x - 0.3) / 0.015) ** 2) / 2))
    start, found = fit(LAW, runs), fit([*LAW, "patch"], runs)
    assert found.reduced_chi2 == pytest.approx(1.0, abs=0.1)
    told = compare_with_formulas(FormulaSearch.of(start.solution), found.solution, lambda: repeated("x"))
    assert told is None or not told.summary["decisive"]


def test_fewer_numbers_say_the_same_as_all_frames(fits):
    """The traces of a force in few numbers against the motion itself, moved by that force."""
    solution = fits("magnet").solution
    left = compress_residual(solution)
    push = [1e-3 * np.sin(2 * np.pi * p.x / 0.1)[:, None] for p in left.paths]
    told = left.traces_of(np.concatenate(push))[:, 0]
    whole = []
    for r in solution.responses:
        g = -1e-3 * np.sin(2 * np.pi * r.motion.x / 0.1)[:, None] / r.piece.mass
        moved = r.linear.respond(g, np.zeros((2, 1)))[1][r.piece.at, 0, 0] / r.piece.sigma
        whole.append(moved - r.q @ (r.q.T @ moved))
    basis = solution.basis
    full = np.concatenate(whole)
    full = full @ full - (basis.u.T @ full) @ basis.shrink(solution.tau) @ (basis.u.T @ full)
    assert told @ told == pytest.approx(full, rel=0.01)


def test_shapes_are_written_as_they_are_evaluated():
    u = np.linspace(0.1, 2.0, 7)
    by_name = {s.name: s for s in SHAPES}
    assert by_name["logarithm"].columns_at(u, [0.3])[:, 0] == pytest.approx(np.log(1 + u / 0.3))
    assert by_name["pair"].columns_at(u, [1.0, 0.5])[:, 0] == pytest.approx(
        (u - 1) / 0.5 / (1 + ((u - 1) / 0.5) ** 2) ** 2
    )
    many = by_name["wave"].columns_at(u[:, None], [np.array([1.0, 2.5])])
    assert many[:, 1, 1] == pytest.approx(np.cos(5 * np.pi * u))


def test_one_direction_alone_has_no_second_factor():
    left = compress_residual(fit(LAW, slides("joint", plan=PLAN[:3])).solution)
    assert {axis.factor for axis in candidate_axes(left)} == {"L * s"}


def test_the_law_is_taken_out_of_every_trace(fits):
    """What the law could make by itself leaves nothing beside it."""
    solution = fits("joint").solution
    left = compress_residual(solution)
    assert np.linalg.norm(
        left.traces_of(left.concatenate(lambda p: np.sign(p.v)[:, None] * p.load))
    ) < 1e-2 * np.linalg.norm(
        np.concatenate([m @ (np.sign(p.v) * p.load) for m, p in zip(left.force_maps, left.paths, strict=True)])
    )
    assert refine(solution.problem, solution.p, solution.starts, tau=solution.tau).chi2 == pytest.approx(
        solution.chi2, rel=1e-3
    )
