"""A law, or its friction levels, may imitate what it lacks: the effect must be found, and the next run, in spite of it.

The runs are integrated by SciPy (`runs.integrate`).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from runs import Slider, integrate, measured
from scipy.integrate import solve_ivp

from frictrack import effects, samples
from frictrack.diagnose import MAX_BIC_EQUAL, diagnose
from frictrack.diagnose.examination import examine
from frictrack.diagnose.experiments import next_run
from frictrack.diagnose.experiments.proposals import Question, Weighted, _rival_questions, list_explanations
from frictrack.diagnose.formulas import (
    FormulaSearch,
    _log_prior_odds,
    _probability,
    effects_of_terms,
    unexplained_force,
)
from frictrack.diagnose.power import detection_limits, find_undetermined, mean_friction
from frictrack.diagnose.search import MAX_PIECES, subsample_pieces
from frictrack.effects.ranges import Span
from frictrack.fit import add_effect, cut_into_pieces, fit
from frictrack.fit.least_squares import fit_with_scatter
from frictrack.fit.linearised import linearise, measured_series
from frictrack.fit.penalties import jacobian_basis
from frictrack.fit.pieces import cycle_of
from frictrack.fit.stepwise import deepen_trials, refine_to_end, scan_effects, try_effects, with_likely_levels
from frictrack.fit.uncertainty import linear_estimates
from frictrack.settings.costs import Costs

COURSE = (0.05, 0.65)  # m
SIGMA = 1e-5  # m
MIN_SPEED = 0.02  # m/s


def slide(values, mass, speed, level, rng, *, name, shake=lambda t: 0.0):
    """A slide over the course, from one end or the other, until it stops or leaves the course, seen by a camera."""
    t = np.arange(1000) / 4000.0
    x = integrate(values, Slider(mass=mass, load=level), t, (COURSE[0] if speed > 0 else COURSE[1], speed))
    slow = np.abs(np.gradient(x, t)) < MIN_SPEED
    out = (x < COURSE[0] - 1e-9) | (x > COURSE[1] + 1e-9) | slow
    end = int(np.argmax(out)) if out.any() else len(t)
    return measured(t[:end], x[:end] + shake(t[:end]), sigma=SIGMA, mass=mass, rng=rng, name=name)


def two_runs(values, mass, speeds, levels, seed):
    rng = np.random.default_rng(seed)
    return [slide(values, mass, v, q, rng, name=f"r{i}") for i, (v, q) in enumerate(zip(speeds, levels, strict=True))]


def test_an_effect_that_friction_levels_imitate_is_fitted_where_they_are_near_one():
    """Slow one way, fast the other: with levels 14 % apart drift has a second, false minimum of the other sign."""
    law = {"coulomb": {"F_c": 16.2}, "viscous": {"F_v": 1.25}}
    runs = two_runs(law | {"drift": {"k": 46.2}}, 0.853, (4.06, -7.0), (0.98, 1.02), 1)
    found = refine_to_end(add_effect(fit(list(law), runs).solution, effects.get("drift")))
    values = dict(zip(found.problem.layout.names, found.p, strict=True))
    assert values["drift.k"] == pytest.approx(46.2, rel=0.1)
    assert values["level.level[r0]"] == pytest.approx(0.98, abs=0.01)
    assert found.chi2 < found.problem.n_frames + 4 * math.sqrt(2 * found.problem.n_frames)


STRIBECK = {"coulomb": {"F_c": 2.91}, "stribeck": {"F_s": 0.63, "v_s": 0.113, "delta": 1.0}, "viscous": {"F_v": 0.295}}
DRAG = {"c": 0.0062}


@pytest.fixture(scope="module")
def wide_stribeck():
    """Hidden drag in two runs, which the law imitates by a Stribeck velocity of 2 m/s and more."""
    runs = two_runs(STRIBECK | {"drag": DRAG}, 0.325, (2.79, -7.0), (0.98, 1.02), 8)
    made = fit(list(STRIBECK), runs)
    return made, diagnose(made, quick=True).summary()


def test_a_cube_of_the_speed_is_found_from_a_stribeck_velocity_that_imitates_it():
    def braking(t, state):
        v = state[1]
        return [v, -(3.58 + 0.93 * np.exp(-v / 0.489) + 0.214 * v + 0.243 * v**3)]

    rng, runs, t = np.random.default_rng(3), [], np.arange(400) / 2000
    for k, speed in enumerate((0.85, 1.81)):
        x = solve_ivp(braking, (0, t[-1]), [0.0, speed], t_eval=t, rtol=1e-10, atol=1e-13, max_step=1e-3).y[0]
        runs.append(measured(t, x, sigma=1.5e-6, mass=0.2, rng=rng, name=f"r{k}"))
    assert diagnose(fit("tustin", runs), quick=True).missing == ["power_law_viscosity"]


def coast(forces, rows, sigma, t, seed):
    """Slides under given forces until they stop; rows of masses over the first one, levels, speeds and phases."""
    rng, runs = np.random.default_rng(seed), []
    for k, (q, level, speed, phase) in enumerate(rows):

        def motion(t, state, q=q, level=level, phase=phase):
            return [state[1], -forces(t, *state, q, level, phase) / (MASS_OF_ONE * q)]

        def stops(t, state):
            return state[1] - 0.025

        stops.terminal = True
        made = solve_ivp(
            motion, (0, t[-1]), [0.0, speed], t_eval=t, rtol=1e-10, atol=1e-13, max_step=2e-3, events=stops
        )
        x = made.y[0]
        runs.append(measured(t[: len(x)], x, sigma=sigma, mass=MASS_OF_ONE * q, rng=rng, name=f"r{k}"))
    return runs


MASS_OF_ONE = 0.191


def test_the_first_formula_has_the_levels_that_are_likely_beside_it():
    """A lift that the friction levels do not multiply: with them, a wave of five coefficients explained more."""

    def forces(t, x, v, q, level, phase):
        return level * 0.324 * q + 0.01 * v - 0.0168 * q * v**2

    rows = [(1.4, 0.9875, 1.25, 0), (1.0, 1.007, 1.9, 0), (1.0, 0.9934, 1.4, 0), (1.0, 1.012, 1.65, 0)]
    made = fit(["coulomb", "viscous"], coast(forces, rows, 1.4e-6, np.arange(400) / 500, 0))
    first = unexplained_force(FormulaSearch.of(made.solution)).formulas[0].entry
    assert first["form"] == "F * L * s * abs(v)^2"


def test_levels_that_do_not_multiply_an_effect_are_found_from_those_that_do():
    """The law takes up the difference first: only a refinement of all its parameters shows which levels are right."""

    def forces(t, x, v, q, level, phase):
        ripple = 0.00195 * np.sin(2 * np.pi * 135 * t + phase)
        dry = level * 0.2617 * q * (1 + 0.409 * np.exp(-v / 0.652))
        return dry + 0.00322 * v + 0.0418 * q * np.exp(-(((x - 0.207) / 0.014) ** 2) / 2) + ripple

    rows = [(0.8, 1.0013, 2.4, 0.3), (1.0, 0.9917, 2.0, -0.6), (1.4, 0.9854, 2.8, 0.5), (1.0, 1.0209, 1.8, 2.0)]
    law = linearise(fit("tustin", coast(forces, rows, 1.3e-6, np.arange(600) / 2000, 2)).solution)
    series = measured_series(law)
    scanned = scan_effects(law, [effects.get("patch")], series)
    patch = deepen_trials(law, try_effects(law, scanned, series.coordinates[:, 0]))[0]
    likely = with_likely_levels(law, patch)
    assert [e.name for e in likely.layout.model.effects if e.level_is_chosen] == ["patch"]
    assert likely.misfit < patch.misfit - 30


@pytest.mark.slow
def test_a_shape_of_the_law_that_imitates_an_effect_does_not_hide_it(wide_stribeck):
    made, found = wide_stribeck
    imitated = dict(zip(made.solution.problem.layout.names, made.solution.p, strict=True))
    assert imitated["stribeck.v_s"] > 1.0  # true: 0.113
    listed = {c["effect"]: c for c in found["candidates"]}
    assert listed["drag"]["passes"]
    assert "drag" in {*found["missing"], *listed[found["missing"][0]]["indistinguishable_from"]}


@pytest.mark.slow
def test_no_effect_is_named_without_a_rival_that_explains_as_much(wide_stribeck):
    _, found = wide_stribeck
    best, *others = found["candidates"]
    near = [
        c["effect"]
        for c in others
        if c["delta_bic"] > best["delta_bic"] - MAX_BIC_EQUAL and not c["implausible"]
        if best["effect"] not in effects.get(c["effect"]).special_cases
    ]
    assert near
    assert set(near) <= set(best["indistinguishable_from"])
    assert found["verdict"] == "ambiguous"


COSTS = Costs(camera=math.inf, speeds=(2.0, 8.0), masses=(0.325, 0.65))


@pytest.mark.slow
def test_a_next_run_is_named_where_nothing_explains_the_misfit(wide_stribeck):
    made, _ = wide_stribeck
    named = next_run(made, {"verdict": "unexplained"}, COSTS)
    assert named["cost"] == 1.0
    assert set(named["separates"]) <= {"place", "time since release", "speed"}
    assert all(p["now"] < 100 for p in named["predictions"])  # both explain these runs


@pytest.mark.slow
def test_a_next_run_separates_an_effect_from_a_formula():
    """In one run place, speed and time change together: a rough patch may be a peak of the friction over speed."""
    made = fit(["coulomb", "viscous"], samples.runs()[:1])
    found = diagnose(made, quick=True).summary()
    assert found["unexplained"]["rival"] == "a formula of speed"
    named = next_run(made, found, COSTS)
    assert {"patch", "formula:1"} <= set(named["separates"])
    assert named["expected_delta_bic"] > 10
    without_rival = [c | {"indistinguishable_from": []} for c in found["candidates"]]
    assert next_run(made, found | {"candidates": without_rival}, COSTS)["separates"]
    sure = {"verdict": "missing", "candidates": without_rival, "unexplained": None}
    assert next_run(made, found | sure, COSTS) is None  # nothing is open


@pytest.mark.few(1)
@pytest.mark.parametrize(("unlike", "own"), [(0.055, False), (0.2, True)])
def test_runs_get_amplitudes_of_their_own_only_if_that_lowers_the_bic(unlike, own):
    """A gain of 18 by three amplitudes more is unlikely by chance, but it is no evidence: the BIC asks for 23."""
    rng, law = np.random.default_rng(4), {"coulomb": {"F_c": 1.5}, "viscous": {"F_v": 0.14}}
    sizes = 2.3e-5 * (1 + unlike * np.array([1.0, -1.0, 1.0, -1.0]))
    runs = [
        slide(law, 0.12, v, 1.0, rng, name=f"r{i}", shake=lambda t, a=a, i=i: a * np.sin(527.0 * t + i))
        for i, (v, a) in enumerate(zip((3.4, -7.0, 5.0, -5.0), sizes, strict=True))
    ]
    bare = fit(list(law), runs).solution
    found = refine_to_end(add_effect(bare, effects.get("camera_shake")))
    assert ("camera_shake.amplitude[r0]" in found.problem.layout.names) == own
    if not own:
        each = effects.get("camera_shake").adjusted(amplitude={"per_run": True})
        gain = found.objective - refine_to_end(add_effect(bare, each)).objective
        assert 11.3 < gain < 3 * math.log(found.problem.n_frames)  # 11.3: what chance exceeds in 1 %


def test_a_level_that_the_data_do_not_see_changes_nothing():
    """At a bound of the law the friction of a fast run may be no more than a rounding error of its level."""
    rng = np.random.default_rng(2)
    jac = rng.standard_normal((200, 5))
    jac[:, 4] *= 1e-13
    seen, whole = jacobian_basis(jac[:, :4], [3]), jacobian_basis(jac, [3, 4])
    for tau in (0.01, 0.3):
        shrunk = [b.u @ b.shrink(tau) @ b.u.T for b in (seen, whole)]
        assert np.isfinite(shrunk[1]).all()
        assert np.linalg.eigvalsh(shrunk[1]).max() < 1 + 1e-9


def test_shrinkage_is_the_inverse_of_the_precisions():
    rng = np.random.default_rng(3)
    jac, known = rng.standard_normal((60, 6)), np.array([[0.0, 2.0, 0.0, 0.0, 0.0, 0.0]])
    levels, tau = [2, 3, 4, 5], 0.2  # so many levels are random
    basis = jacobian_basis(jac, levels, known)
    penalty = np.zeros((6, 6))
    penalty[levels, levels] = 1 / tau**2
    wanted = jac @ np.linalg.inv(jac.T @ jac + penalty + known.T @ known) @ jac.T
    np.testing.assert_allclose(basis.u @ basis.shrink(tau) @ basis.u.T, wanted, atol=1e-10)
    own = np.linalg.slogdet(jac.T @ jac + penalty + known.T @ known)[1] - np.linalg.slogdet(jac.T @ jac)[1]
    assert basis.logdet(tau) == pytest.approx(own + 2 * 4 * math.log(tau), rel=1e-9)


@pytest.fixture(scope="module")
def four_runs():
    law, rng = {"coulomb": {"F_c": 3.0}, "viscous": {"F_v": 0.3}}, np.random.default_rng(3)
    speeds = (2.5, -7.0, 4.0, -3.0)
    return fit(list(law), [slide(law, 0.3, v, 1.0, rng, name=f"r{i}") for i, v in enumerate(speeds)])


@pytest.mark.slow
def test_a_coefficient_that_an_effect_found_replaces_is_not_open(four_runs):
    """Flash weakening far above all speeds is a force in proportion to the speed, as viscous friction is."""
    first = examine(four_runs.solution, (), np.random.default_rng(0), 0.005)
    replaced = effects.get("flash_weakening").adjusted(v_w={"fixed": 6000.0}, dF={"bounds": (-1e6, 1e6)})
    grown = add_effect(four_runs.solution, replaced)
    _, curves = detection_limits(first)
    known = linear_estimates(grown).parameters["viscous.F_v"]
    assert known.std * 5.0 > 0.1 * mean_friction(first)  # at 5 m/s
    assert not [u.what for u in find_undetermined(four_runs, first, curves, grown) if u.uncertainty is not None]


def test_a_short_record_is_searched_in_all_its_segments(four_runs):
    problem = four_runs.solution.problem
    pieces = [part for p in problem.pieces for part in cut_into_pieces([p], len(p.t) // 10)]
    assert len(pieces) > MAX_PIECES
    divided = problem.rebuild(problem.layout, pieces)
    cut = fit_with_scatter(divided, four_runs.solution.p, divided.first_starts())
    kept, remark = subsample_pieces(cut)
    assert kept is cut
    assert not remark


def test_several_effects_are_a_less_likely_cause_than_one():
    odds = [_log_prior_odds(6, count) for count in (1, 2, 3)]
    assert odds[0] < math.log(0.1) < 0 < odds[2]  # one effect is likelier than one form, three are not
    assert odds == sorted(odds)


def test_all_listed_forms_count_for_the_probability_of_a_formula():
    """The likeliest form may be the one of a wide bend, whose BIC is far below that of a straight one."""
    advantages, shares = np.array([-6.8, 5.8, 1.2]), np.array([0.21, 0.20, 0.10])
    whole = _probability(advantages, shares, -4.0)
    assert whole == pytest.approx(_probability(advantages[::-1], shares[::-1], -4.0))
    odds = np.exp(advantages / 2).sum() / shares.sum() * math.exp(-4.0)
    assert whole == pytest.approx(odds / (1 + odds))
    assert _probability(advantages[:1], shares[:1], -4.0) < 0.01
    assert whole > 0.3


@pytest.mark.parametrize(
    ("effect", "formula", "is_same"),
    [
        ("spring", "F * x", True),
        ("spring", "F * tanh(x / 0.5)", False),
        ("power_law_viscosity", "F * s * abs(v)^1.5", True),
        ("power_law_viscosity", "F * s * log(1 + abs(v))", False),
        ("drift", "F * L * s * x", False),
    ],
)
def test_a_formula_that_an_effect_can_be_is_no_other_cause(four_runs, effect, formula, is_same):
    """The second parameter of the effect is free, that of the formula is not: with less of them its BIC is better."""
    law = four_runs.solution
    written = refine_to_end(add_effect(law, effects.formula("unexplained", formula)))
    known = add_effect(law, effects.get(effect))
    assert effects_of_terms(written, [known]) == [effect if is_same else ""]


@pytest.mark.slow
def test_a_sum_of_two_waves_is_the_texture_and_the_vibration_that_it_contains():
    """The formula has one phase where the vibration has one of each run, so that its BIC is better."""
    law, rng = {"coulomb": {"F_c": 3.0}}, np.random.default_rng(3)
    waves = {
        "texture": {"amplitude": 0.3, "period": 0.031, "phase": 0.4},
        "vibration": {"amplitude": 0.3, "frequency": 90.0, "phase": 0.7},
    }
    runs = [slide(law | waves, 0.3, v, 1.0, rng, name=f"r{i}") for i, v in enumerate((3.0, -2.5))]
    bare = fit(list(law), runs).solution
    known = add_effect(add_effect(bare, effects.get("texture")), effects.get("vibration"))
    place, time = (
        f"F_1 * {of} * sin(2*pi*f*{u}) + F_2 * {of} * cos(2*pi*f*{u})" for of, u in (("L * s", "x"), ("1", "t"))
    )
    written = add_effect(bare, effects.formula("unexplained", place, bounds={"f": (31.0, 33.5)}))
    written = add_effect(written, effects.formula("unexplained_2", time, bounds={"f": (88.0, 92.0)}))
    written, known = refine_to_end(written), refine_to_end(known)
    assert effects_of_terms(written, [known]) == ["texture", "vibration"]
    assert effects_of_terms(written, [add_effect(bare, effects.get("spring"))]) == ["", ""]


@pytest.mark.slow
def test_friction_that_grows_along_the_course_competes_with_an_inclined_course():
    """Either explains chi-squared of half a million to the noise; m x'' = -s (F_c + k x) in closed form."""
    level, mass, rng = 90.0, 0.7, np.random.default_rng(0)  # F_c/k, m
    t, w = np.arange(230) / 169.0, math.sqrt(0.031)  # k/m, 1/s^2
    there = level * (np.cos(w * t) - 1) + 5.5 / w * np.sin(w * t)
    back = (8.2 + level) * np.cosh(w * t) - 5.5 / w * np.sinh(w * t) - level
    runs = [measured(t, x, sigma=1e-5, mass=mass, rng=rng, name=f"r{i}") for i, x in enumerate((there, back))]
    found = diagnose(fit(["coulomb", "viscous"], runs), quick=True)
    assert found.verdict in ("ambiguous", "unexplained")
    assert found.unexplained["formulas"][0]["form"] == "F * L * s * x"


@pytest.mark.slow
def test_a_slope_that_levels_hide_is_sought_by_runs_back_and_more_of_them():
    """Three runs forth and one back: their levels differ, yet three degrees of freedom are too few to be sure."""
    law = {"coulomb": {"F_c": 3.0}, "viscous": {"F_v": 0.1}}
    there = {"slope": {"F": 0.25}}
    rng = np.random.default_rng(3)
    runs = [
        slide(law | there, 0.3, v, 1 + 0.01 * rng.standard_normal(), rng, name=f"r{i}")
        for i, v in enumerate((3.0, 4.5, 4.0, -3.5))
    ]
    made = fit(list(law), runs)
    found = diagnose(made, quick=True, alpha=0.001).summary()
    assert found["verdict"] in {"complete", "undetermined"}
    slope = next(c for c in found["candidates"] if c["effect"] == "slope")
    assert slope["delta_bic"] > MAX_BIC_EQUAL
    named = next_run(made, found, Costs(camera=math.inf))
    assert named["separates"][0] == "slope"
    assert named["settings"]["speed"] < 0  # the direction of which there is one run only
    told = named["predictions"][0]
    assert slope["delta_bic"] / 3 < told["now"] < told["expected"] < told["decisive"]


@pytest.mark.slow
def test_misfit_that_is_not_explained_yet_wants_another_run_though_its_axis_is_known(four_runs):
    """Evidence that was decisive must be found once more in a further run."""
    explained = list_explanations(four_runs.solution, {"verdict": "unexplained"})
    first, second = explained[0].explanation, explained[1].explanation
    sure = [Weighted(replace(first, gain=second.gain + 50.0), 1.0), Weighted(second, 0.0)]
    for further in (False, True):
        questions, _ = _rival_questions(sure, Costs(), further=further)
        assert (questions[0].now < questions[0].decisive) is further


def test_a_run_is_worth_filming_just_before_evidence_is_decisive():
    nearly = Question("camera_shake", "vibration", 0.99, 10.0, 9.99)
    assert nearly.progress(18.0) < 0.01
    assert nearly.gain(18.0) > 0.5
    assert nearly.gain(9.99) == 0.0


def test_a_line_that_strokes_repeat_is_no_vibration() -> None:
    t = np.arange(3100) / 200.0
    to_and_fro = np.abs((t + 0.4) % 4.0 - 2.0)
    assert cycle_of(t, to_and_fro) == pytest.approx(4.0, abs=1e-3)
    assert cycle_of(t, t) == cycle_of(t, np.abs((1.2 * t + 0.03 * t**2) % 4.0 - 2.0)) == 0.0
    span = Span(t[-1], 0.0, 2.0, 1.0, 1.0, 200.0, cycle=cycle_of(t, to_and_fro))
    assert "the strokes repeat every 4 s, and 8 periods" in effects.get("vibration").plausible(
        {"frequency": 2.002}, span
    )
    assert effects.get("vibration").plausible({"frequency": 2.1}, span) == ""
