"""What is missing is named, what is not missing is not, and what the runs cannot tell apart is said to be so.

The runs are short and the law is Coulomb + viscous, so that a diagnosis takes a second.
"""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from few_effects import use_few_effects
from runs import BASE, FPS, HIDDEN, MASS, Spec, measured, study

from frictrack import effects
from frictrack.base.errors import FrictrackError
from frictrack.diagnose import diagnose, examination
from frictrack.diagnose.examination import MIN_P_CLEAR, N_DRAWS, N_DRAWS_FEW, draw_null_ensemble, examine, examine_again
from frictrack.diagnose.explanations import Explanation, find_rivals
from frictrack.effects import models
from frictrack.fit import fit
from frictrack.fit.stepwise import scan_effects
from frictrack.results import to_builtins

FOUR = (Spec(3.0, 1, 0.05), Spec(5.0, 1, 0.05), Spec(4.0, 2, 0.05), Spec(-4.0, 1, 0.05))
LAW = ["coulomb", "viscous"]
KEYS = {
    *("model", "verdict", "missing", "noise_um", "reduced_chi2", "p_lack_of_fit", "fails_at", "candidates"),
    *("unexplained", "next_experiment", "detection_limits"),
}
CANDIDATE = {
    *("effect", "acts_on", "parameters", "p", "delta_bic", "heldout_rms_before_um", "heldout_rms_after_um"),
    *("heldout", "indistinguishable_from"),
}


def runs_with(hidden=None, values=None, *, specs=FOUR, seed=1, sigma=1e-5):
    """Runs of Coulomb + viscous friction and one hidden effect, 3 % scatter where runs can tell it."""
    law = {name: BASE[name] for name in LAW}
    if hidden:
        law[hidden] = values or HIDDEN[hidden]
    scatter = 0.03 if len(specs) > 3 else 0.0
    return study(models.of(law), law, specs=specs, sigma=sigma, scatter=scatter, rng=np.random.default_rng(seed))[0]


@pytest.fixture(scope="module")
def nothing_missing():
    return diagnose(fit(LAW, runs_with()))


@pytest.fixture(scope="module")
def texture_missing():
    fitted = fit(LAW, runs_with("texture"))
    return fitted, diagnose(fitted)


def test_a_later_examination_takes_few_draws_where_these_decide(texture_missing):
    start = texture_missing[0].solution
    first = examine(start, [], np.random.default_rng(0), 0.005)
    assert first.p["texture"] == 1 / (1 + N_DRAWS)

    def examined(solution):
        return examine_again(solution, [], np.random.default_rng(1), first)

    done = examined(fit([*LAW, "texture"], texture_missing[0].runs).solution)
    assert done.draws.series.coordinates.shape[1] == 1 + N_DRAWS_FEW
    assert not done.leaves_misfit
    assert not done.something_is_missing
    assert min(done.p.values()) >= MIN_P_CLEAR
    going_on = examined(start)
    assert going_on.draws.series.coordinates.shape[1] == 1 + N_DRAWS_FEW
    assert going_on.leaves_misfit
    assert going_on.scanned == []  # the best set with one effect more is judged by its own gain
    assert going_on.p_of_excess("texture", 1000.0) == 1 / (1 + N_DRAWS)
    assert going_on.p_of_excess("texture", 0.0) > 0.5


def test_a_later_examination_takes_all_draws_where_few_do_not_decide(monkeypatch):
    solution = fit(LAW, runs_with()).solution
    first = examine(solution, [], np.random.default_rng(0), 0.005)
    monkeypatch.setattr(examination, "MIN_P_CLEAR", 2.0)  # no p-value is clear
    again = examine_again(solution, [], np.random.default_rng(1), first)
    assert again.draws.series.coordinates.shape[1] == 1 + N_DRAWS
    assert again.level == first.level


def test_few_draws_decide_a_first_examination_or_all_are_taken(texture_missing, monkeypatch):
    start = texture_missing[0].solution
    few = examine(start, [], np.random.default_rng(0), 0.005)
    assert len(few.null) == N_DRAWS_FEW
    monkeypatch.setattr(examination, "MIN_CHI2_CLEAR", np.inf)  # no effect is clear
    whole = examine(start, [], np.random.default_rng(0), 0.005)
    assert len(whole.null) == N_DRAWS
    assert few.gains == whole.gains
    assert few.p_lack_of_fit == whole.p_lack_of_fit
    for some, every in zip(few.scanned, whole.scanned, strict=True):
        np.testing.assert_array_equal(every.statistic[: 1 + N_DRAWS_FEW], some.statistic)
    draws = draw_null_ensemble(start, np.random.default_rng(0))
    at_once = scan_effects(draws.law, [s.effect for s in whole.scanned[:3]], draws.series)
    for every, (_, scans) in zip(whole.scanned, at_once, strict=False):
        np.testing.assert_allclose(np.sort(every.statistic), np.sort(scans[0].max_gains), rtol=1e-3, atol=1e-3)


def test_draws_are_divided_evenly_between_their_groups(texture_missing):
    series = draw_null_ensemble(texture_missing[0].solution, np.random.default_rng(0)).series
    some, others = series.divided(N_DRAWS_FEW)
    assert some.residuals.shape[1] - 1 == N_DRAWS_FEW
    assert some.residuals.shape[1] + others.residuals.shape[1] == 1 + series.residuals.shape[1]
    for group, own in zip(series.groups, some.groups, strict=True):
        size = group.stop - group.start
        assert own.stop - own.start == pytest.approx(size * N_DRAWS_FEW / N_DRAWS, abs=2)
    np.testing.assert_array_equal(some.residuals[:, 0], others.residuals[:, 0])


@pytest.mark.slow
def test_a_stricter_level_demands_a_larger_effect(nothing_missing):
    fitted = fit(LAW, runs_with())
    strict = diagnose(fitted, alpha=0.002, quick=True)
    assert (nothing_missing.alpha, strict.alpha) == (0.01, 0.002)
    assert strict.summary()["alpha"] == 0.002
    for name in ("texture", "drag"):
        assert strict.detection_limits[name]["value"] > nothing_missing.detection_limits[name]["value"]
    with pytest.raises(FrictrackError, match="between 0 and 1 but got alpha = 0"):
        diagnose(fitted, alpha=0.0)


def solution_that_leaves(chi2_per_frame):
    """A fit of 200 frames whose residual is white."""
    response = SimpleNamespace(r=np.sqrt(chi2_per_frame) * np.tile([1.0, -1.0], 100))
    chi2 = chi2_per_frame * (200 - 2 - 2)  # two parameters and a start
    return SimpleNamespace(problem=SimpleNamespace(n_frames=200), p=np.zeros(2), responses=[response], chi2=chi2)


@pytest.mark.parametrize(("chi2_per_frame", "unit"), [(1.0, 1.0), (4.0, 4.0)])
def test_evidence_that_makes_a_rival_is_counted_in_units_of_the_misfit_that_is_left(chi2_per_frame, unit):
    """BIC within 6 of the best one, and four times that while chi-squared is four times what noise leaves."""

    def beside_texture(name, behind, **more):
        return Explanation((effects.LIBRARY["texture"], effects.LIBRARY[name]), behind * unit, **more)

    best = beside_texture("drag", 0.0, solution=solution_that_leaves(chi2_per_frame))
    others = [
        best,
        beside_texture("drift", 5.9),
        beside_texture("spring", 6.1),
        beside_texture("thermal", -1.0),
        beside_texture("slope", 0.0, objection="more than the weight"),
        beside_texture("power_law_viscosity", 0.0),  # drag is a special case of it
        beside_texture("adhesion", 50.0, is_unrefined=True),
    ]
    assert [one.last.name for one in find_rivals(best, others)] == ["drift", "thermal", "adhesion"]


def test_anything_but_a_fit_is_refused():
    with pytest.raises(FrictrackError, match=r"expected fit to be a fit \(from ft\.fit\) but got \[\]"):
        diagnose([])


def test_a_law_that_is_the_whole_truth_is_complete(nothing_missing):
    found = nothing_missing
    assert (found.verdict, found.missing, found.fails_at, found.unexplained) == ("complete", [], [], None)
    assert found.p_lack_of_fit > 0.005
    assert all(c.p > 0.005 for c in found.candidates)
    assert found.reduced_chi2 == pytest.approx(1.0, abs=0.1)
    assert found.noise_um == pytest.approx(10.0, rel=0.05)


def test_the_hidden_effect_is_named_first_and_its_addition_leaves_the_noise(texture_missing):
    fitted, found = texture_missing
    assert (found.verdict, found.missing) == ("missing", ["texture"])
    best = found.best
    assert best.effect == "texture"
    assert best.p == 0.001  # 999 draws
    assert best.delta_bic > 100
    assert best.indistinguishable_from == ()
    assert best.heldout_after == pytest.approx(10e-6, rel=0.1)
    assert best.heldout_before > 1.1 * best.heldout_after
    truth = HIDDEN["texture"]
    for name in ("amplitude", "period", "phase"):
        known = best.parameters[name]
        assert abs(known["value"] - truth[name]) < 4 * known["std"]
    assert {s["run"] for s in found.fails_at} <= {r.name for r in fitted.runs}
    assert found.fails_at
    again = fit(fitted.model + best.effect, fitted.runs)
    assert again.errors["heldout_rms_um"] == pytest.approx(1e6 * best.heldout_after, rel=0.02)


def test_summary_is_the_json_of_the_contract(nothing_missing, texture_missing):
    for found in (nothing_missing, texture_missing[1]):
        summary = json.loads(json.dumps(to_builtins(found.summary()), allow_nan=False))
        assert summary.keys() >= KEYS
        assert summary["model"] == LAW
        for c in summary["candidates"]:
            assert c.keys() >= CANDIDATE
            for p in c["parameters"].values():
                assert p.keys() >= {"value", "std", "unit"}
        for span in summary["fails_at"]:
            assert span.keys() >= {"run", "t", "x", "v", "share_of_error"}
            assert span["t"][0] <= span["t"][1]
        assert summary["detection_limits"].keys() <= {
            *effects.LIBRARY,
            *(f"{n}:2" for n in effects.LIBRARY),
            "viscous.F_v",
        }
        for limit in summary["detection_limits"].values():
            assert limit.keys() >= {"value", "unit", "at", "power"}
            assert limit["power"] == 0.95
            assert limit["value"] is None or limit["value"] > 0


@pytest.mark.usefixtures("no_formulas")
def test_an_effect_at_its_detection_limit_is_found_and_one_far_below_is_not(nothing_missing, monkeypatch):
    use_few_effects(monkeypatch)
    limit = nothing_missing.detection_limits["drag"]
    assert limit["unit"] == "N s^2/m^2"
    large = diagnose(fit(LAW, runs_with("drag", {"c": 1.5 * limit["value"]})), quick=True)
    assert large.verdict != "complete"
    small = diagnose(fit(LAW, runs_with("drag", {"c": 0.1 * limit["value"]})), quick=True)
    assert small.verdict == "complete"


@pytest.mark.few(1)
@pytest.mark.parametrize("hidden", ["vibration", "camera_shake"])
def test_one_run_names_a_group_where_it_cannot_single_out(hidden):
    found = diagnose(fit(LAW, runs_with(hidden, specs=FOUR[:1])))
    assert found.verdict == "ambiguous"
    group = {found.best.effect, *found.best.indistinguishable_from}
    assert group - {"viscous_modulation"} == {"vibration", "camera_shake", "load_modulation"}  # at a speed that lasts
    assert any("single run:" in remark for remark in found.remarks)


def test_one_run_in_one_direction_cannot_miss_a_slope():
    found = diagnose(fit(LAW, runs_with("slope", {"F": 2.0}, specs=FOUR[:1])))
    assert (found.verdict, found.missing) == ("undetermined", [])
    assert found.undetermined[0].what == "drag"  # one short run would not show a tenth of the friction
    limit = found.detection_limits["slope"]
    assert limit["value"] is None
    assert limit["reason"] == "the fitted model absorbs it whatever its size"


@pytest.mark.slow
def test_what_may_be_left_of_a_camera_shake_that_was_subtracted_is_no_force():
    shaken = runs_with("camera_shake", {"amplitude": 2e-5, "frequency": 160.0, "phase": 0.4})
    told = [replace(r, displacement=replace(r.displacement, shake=(160.0, 2e-5 / np.sqrt(2)))) for r in shaken]
    assert diagnose(fit(LAW, shaken), quick=True).verdict != "complete"
    found = diagnose(fit(LAW, told))
    assert (found.verdict, found.missing) == ("undetermined", [])  # what is left of the shake could hide a vibration
    assert "vibration" in {gap.what for gap in found.undetermined}


@pytest.mark.slow
def test_the_noise_of_an_angle_that_rests_is_no_rotation():
    rng = np.random.default_rng(8)
    runs = runs_with("texture")
    angles = [0.01 + 3e-4 * rng.standard_normal(len(r.displacement)) for r in runs]
    filmed = [replace(r, displacement=replace(r.displacement, angle=a)) for r, a in zip(runs, angles, strict=True)]
    found = diagnose(fit(LAW, filmed))
    assert found.missing == ["texture"]
    assert found.detection_limits["target_rotation"]["value"] is None


@pytest.mark.slow
def test_the_same_seed_gives_the_same_p_values():
    fitted = fit(LAW, runs_with("patch", {"F": 0.8, "x_c": 0.05, "w": 0.01}, specs=FOUR[:1]))
    first, second, other = (diagnose(fitted, rng=s) for s in (3, 3, 4))
    assert to_builtins(first.summary()) == to_builtins(second.summary())
    assert first.p_lack_of_fit == pytest.approx(other.p_lack_of_fit, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("repeats", [8, 20])
def test_false_alarms_are_as_rare_as_stated_and_the_lack_of_fit_is_calibrated(repeats):
    found = [diagnose(fit(LAW, runs_with(specs=FOUR[:1], seed=s)), quick=True) for s in range(repeats)]
    assert sum(d.verdict in ("complete", "undetermined") for d in found) >= repeats - 1  # alpha = 0.01
    p = np.array([d.p_lack_of_fit for d in found])
    assert abs(p.mean() - 0.5) < 0.9 / np.sqrt(repeats)  # three deviations of a mean of uniform numbers
    assert p.min() < 0.3
    assert p.max() > 0.7


def test_what_needs_the_pixel_pitch_is_not_tried_without_it_and_this_is_said():
    run = runs_with(specs=FOUR[:1])[0]
    blind = replace(run, displacement=replace(run.displacement, pixel_pitch=None))
    found = diagnose(fit(LAW, [blind]))
    assert "peak_locking" not in found.detection_limits
    assert "peak_locking needs the pixel pitch of every run; give scale in [camera]" in found.remarks[0]
    assert found.remarks[0].startswith("not tried: ")
    assert "gravity" not in found.remarks[0]
    assert "peak_locking" in diagnose(fit(LAW, [run])).detection_limits


def test_validation_runs_are_not_looked_at():
    run, other = runs_with(specs=FOUR[:2])
    broken = replace(other, role="validation", mass=5 * MASS)
    alone, beside = diagnose(fit(LAW, [run])), diagnose(fit(LAW, [run, broken]))
    assert to_builtins(alone.summary()) == to_builtins(beside.summary())


def test_progress_is_told():
    heard = []
    diagnose(fit(LAW, runs_with(specs=FOUR[:1])), progress=lambda done, total, what: heard.append((done, total, what)))
    assert all(0 <= done <= total for done, total, _ in heard)
    assert heard[-1][0] == heard[-1][1]
    assert all(what for *_, what in heard)


@pytest.mark.slow
def test_structure_that_no_effect_explains_is_shown_and_not_named():
    t = np.arange(240) / FPS
    rng = np.random.default_rng(0)
    jolts = np.cumsum(np.cumsum(np.repeat(rng.choice([-1.0, 1.0], 60), 4))) / FPS**2  # a random force of 1 m/s^2 x 60
    x = 4 * t - 8 / MASS * t**2 / 2 + 60 * jolts
    found = diagnose(fit(LAW, [measured(t, x, sigma=2e-6)]))
    assert found.p_lack_of_fit < 0.005
    assert found.verdict in ("unexplained", "ambiguous")
    if found.verdict == "unexplained":
        assert found.unexplained["axis"] in ("x", "t", "v")
        assert np.shape(found.unexplained["curve"])[1] == 2


@pytest.mark.usefixtures("no_formulas")
def test_two_effects_are_found_one_after_the_other_and_nothing_more(monkeypatch):
    use_few_effects(monkeypatch)
    law = {name: BASE[name] for name in LAW} | {"texture": HIDDEN["texture"], "drag": {"c": 0.3}}
    rng = np.random.default_rng(4)
    runs = study(models.of(law), law, specs=FOUR, sigma=1e-5, scatter=0.03, rng=rng)[0]
    found = diagnose(fit(LAW, runs), quick=True)
    assert sorted(found.missing) == ["drag", "texture"]
    assert {c.effect for c in found.candidates[:2]} == {"drag", "texture"}
    assert all(c.p == 0.001 for c in found.candidates[:2])


@pytest.mark.slow
def test_two_plain_effects_are_not_taken_for_one_wave_that_imitates_their_sum():
    law = {
        "coulomb": {"F_c": 8.2},
        "drag": {"c": 0.2},
        "viscous": {"F_v": 0.052},
        "thermal": {"dF": 0.27, "length": 0.24},
    }
    specs = [Spec(v, ratio, 0.15) for v, ratio in ((4.0, 1), (4.7, 1), (5.4, 1), (4.7, 0.5), (-5.4, 1))]
    runs = study(models.of(law), law, specs=specs, sigma=3e-5, scatter=0.03, rng=np.random.default_rng(4))[0]
    found = diagnose(fit(["coulomb", "drag"], runs))
    assert found.missing == ["viscous", "thermal"]


@pytest.mark.slow
def test_an_effect_of_your_own_is_tried_and_named():
    magnet = effects.formula(
        "magnet", "F*exp(-((x - x_c)/w)**2)", units={"F": "N", "x_c": "m", "w": "m"}, bounds={"w": (0.005, 0.05)}
    )
    law = {name: BASE[name] for name in LAW} | {"magnet": {"F": 1.5, "x_c": 0.12, "w": 0.012}}
    rng = np.random.default_rng(5)
    runs = study(models.of([*LAW, magnet]), law, specs=FOUR, sigma=1e-5, scatter=0.03, rng=rng)[0]
    found = diagnose(fit(LAW, runs), own=[magnet])
    assert found.best.effect == "magnet"
    assert "magnet" in found.detection_limits


@pytest.mark.slow
def test_twenty_studies_with_nothing_hidden_are_complete():
    complete = sum(diagnose(fit(LAW, runs_with(seed=100 + s))).verdict == "complete" for s in range(20))
    assert complete >= 19
