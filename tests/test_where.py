"""Where a law fails, the force it lacks and whether that repeats, against runs whose missing force is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from runs import BASE, FPS, MASS, Spec, measured, study

from frictrack import effects, samples
from frictrack.diagnose.compare import failing_spans, find_local_forces
from frictrack.diagnose.compare.local_forces import GlobalSignificance
from frictrack.diagnose.compressed import compress_residual
from frictrack.diagnose.repeatability import AxisRepeatability, WaveScan, assess_repeatability, describe_axes
from frictrack.diagnose.residual_curves import deconvolve_force, find_failure_pattern, mean_curve, residual_figures
from frictrack.effects import models
from frictrack.fit import add_effect, fit
from frictrack.fit.linearised import linearise
from frictrack.fit.separable.varpro import ScanGains, ScanGrid
from frictrack.fit.smooth_functions import linear_interpolation_matrix, matern_covariance
from frictrack.present import plots
from frictrack.present.plots import style

DRY = {"coulomb": BASE["coulomb"], "viscous": BASE["viscous"]}
LAW = "coulomb,viscous"
PATCH = {"F": 2.0, "x_c": 0.2, "w": 0.008}
BLOW = {"J": 0.02, "width": 4e-4}
FOUR = (Spec(3.6, 1, 0.11), Spec(4.4, 2, 0.1), Spec(5.0, 1, 0.09), Spec(-5.6, 1, 0.12))
MOMENTS = (0.031, 0.062, 0.045, 0.052)  # s, of a blow in each run


def repeatability_of(solution):
    """Over which axis the misfit of a fit repeats."""
    compressed = compress_residual(solution, about_measurement=True)
    return assess_repeatability(compressed, WaveScan(linearise(solution)), np.random.default_rng(0))


def deconvolved(solution):
    """The force that a fit lacks, and the strongest line."""
    found = find_local_forces(solution)
    return deconvolve_force(found, WaveScan(found.model), compress_residual(found.solution, about_measurement=True))


def lacking(effect, values, specs=FOUR, sigma=5e-6, seed=1):
    return study(models.of(LAW.split(",")) + effect, DRY | {effect: values}, specs=specs, sigma=sigma,
                 rng=np.random.default_rng(seed))[0]  # fmt: skip


@pytest.fixture(scope="module")
def patched():
    runs = lacking("patch", PATCH)
    return runs, fit(LAW, runs).solution


@pytest.fixture(scope="module")
def blown():
    """Runs that are each struck once, at a moment of their own."""
    runs = []
    for i, (spec, when) in enumerate(zip(FOUR, MOMENTS, strict=True)):
        own = BLOW | {"J": np.sign(spec.speed) * BLOW["J"], "time": when}
        one = lacking("collision", own, specs=(spec,), seed=10 + i)[0]
        runs.append(replace(one, name=f"r{i}"))
    return runs, fit(LAW, runs).solution


def overlap(spans, runs, acts):
    """F1 in frames of the named spans against where a force acts, `acts(run) -> (n,)`."""
    hit = said = true = 0
    for run in runs:
        t, mask = run.displacement.t, acts(run)
        named = np.zeros(len(t), bool)
        for s in (s for s in spans if s["run"] == run.name):
            named |= (t >= s["t"][0]) & (t <= s["t"][1])
        hit, said, true = hit + np.sum(named & mask), said + np.sum(named), true + np.sum(mask)
    return 2 * hit / (said + true)


def on_patch(run):
    return np.abs(run.motion.x - PATCH["x_c"]) <= 2 * PATCH["w"]


def test_the_bound_on_chance_is_one_and_a_close_one():
    """Noise seen through a sliding Gaussian window: how often its highest look passes a level, against the bound."""
    rng, n, width = np.random.default_rng(3), 400, 6.0
    looks = np.exp(-(((np.arange(n)[:, None] - np.arange(n)) / width) ** 2) / 2)
    z = looks.T @ rng.standard_normal((n, 4000)) / np.linalg.norm(looks, axis=0)[:, None]
    grid = ScanGrid(("centre", "width"), (np.arange(n), np.ones(1)))
    scans = [ScanGains(grid, own**2) for own in z.T[:200]]
    for level in (3.0, 3.5, 4.0):
        seen = np.mean(np.max(np.abs(z), axis=0) > level)
        chance = np.mean([GlobalSignificance.of_scans([scan], 1e6)(level) for scan in scans])
        assert seen < 1.1 * chance + 2 * np.sqrt(seen / 4000)
        assert chance < 2 * seen + 0.002


def test_an_estimated_noise_makes_a_high_look_less_sure():
    assert GlobalSignificance(100.0, 3, 50.0)(5.0) > 10 * GlobalSignificance(100.0, 3, 1e6)(5.0)


def test_a_place_that_rubs_is_named_in_every_run_from_the_bare_law_alone(patched):
    runs, solution = patched
    spans = failing_spans(solution, runs)
    assert overlap(spans, runs, on_patch) > 0.9
    assert {s["run"] for s in spans} == {r.name for r in runs if np.sum(on_patch(r)) > 5}
    assert all(s["p"] < 0.01 for s in spans)
    excess = {runs[r.piece.run].name: float(r.r @ r.r) - len(r.r) for r in solution.responses}
    for span in spans:  # the share of a run is that of its own misfit
        assert span["share_of_error"] == pytest.approx(excess[span["run"]] / sum(excess.values()), abs=0.03)


def test_one_common_place_is_found_and_not_a_moment_of_each_run(patched):
    found = find_local_forces(patched[1])
    assert [b.at_place for b in found.bumps] == [True]
    assert found.bumps[0].centre == pytest.approx(PATCH["x_c"], abs=0.3 * PATCH["w"])
    assert found.complete


def test_a_blow_is_named_as_far_as_the_low_pass_smears_it(blown):
    runs, solution = blown
    spans = sorted(failing_spans(solution, runs), key=lambda s: s["run"])
    assert [s["run"] for s in spans] == [r.name for r in runs]
    for run, s, when in zip(runs, spans, MOMENTS, strict=True):
        smear = 0.5 / run.motion.cutoff
        low, high = (max(when - smear, run.displacement.t[0]), min(when + smear, run.displacement.t[-1]))
        assert s["t"] == pytest.approx([low, high], abs=0.25 * smear + 2e-3)


def test_a_known_blow_is_named_only_in_the_runs_that_were_struck(blown):
    quiet = lacking("collision", BLOW | {"J": 0.0, "time": 0.05}, specs=FOUR[1:2], seed=21)[0]
    runs = [*blown[0], replace(quiet, name="quiet")]
    grown = add_effect(fit(LAW, runs).solution, effects.get("collision"))
    named = {s["run"] for s in failing_spans(grown, runs, missing="collision")}
    assert named == {r.name for r in blown[0]}


def test_nothing_is_named_where_nothing_is_missing():
    rng = np.random.default_rng(7)
    named = [failing_spans(fit(LAW, runs).solution, runs) for runs in
             (study(LAW, DRY, specs=FOUR[:2], sigma=1e-5, rng=rng)[0] for _ in range(4))]  # fmt: skip
    assert named == [[], [], [], []]


def test_the_missing_force_lies_within_its_band(patched):
    runs, solution = patched
    pieces, _ = deconvolved(solution)
    z, size = [], []
    for p in pieces:
        true = np.sign(p.v) * PATCH["F"] * (runs[p.run].mass / MASS) * np.exp(
            -(((p.x - PATCH["x_c"]) / PATCH["w"]) ** 2) / 2)  # fmt: skip
        z.append((p.F - true) / p.sigma_F)
        size.append(np.abs(p.F - true).max() / np.abs(true).max())
    assert np.mean(np.abs(np.concatenate(z)) < 2) > 0.9
    assert np.median(size) < 0.35


def test_a_fine_ripple_lies_within_the_band_and_not_under_it():
    texture = {"amplitude": 0.3, "period": 0.012, "phase": 0.4}
    runs = lacking("texture", texture, sigma=2e-6)
    pieces, _ = deconvolved(fit(LAW, runs).solution)
    z = []
    for p in pieces:
        wave = texture["amplitude"] * np.sin(2 * np.pi * p.x / texture["period"] + texture["phase"])
        z.append((p.F - np.sign(p.v) * (runs[p.run].mass / MASS) * wave) / p.sigma_F)
    assert np.mean(np.abs(np.concatenate(z)) < 2) > 0.7  # without the wave it was a twentieth


@pytest.mark.slow
def test_the_missing_force_of_a_line_is_told_with_its_phase():
    vibration = {"amplitude": 1.0, "frequency": 61.3, "phase": 0.7}
    solution = fit(LAW, lacking("vibration", vibration)).solution
    pieces, line = deconvolved(solution)
    assert line.frequency == pytest.approx(61.3, abs=1.5)
    assert WaveScan(find_local_forces(solution).model).in_time.p < 1e-6
    size = np.sqrt(2 * np.mean(np.concatenate([p.F for p in pieces]) ** 2))
    assert size == pytest.approx(1.0, abs=0.3)
    curve = residual_figures(pieces, line)["common_phase"]  # one period: up first, then down
    assert curve["F"][np.argmin(np.abs(curve["at"] - 0.25))] > 0.5
    assert curve["F"][np.argmin(np.abs(curve["at"] - 0.75))] < -0.5
    assert repeatability_of(solution).best.axis == "phase"


def test_a_patch_repeats_with_the_place_whatever_mass_and_direction(patched):
    found = repeatability_of(patched[1])
    assert found.best.axis == "x"
    assert found.best.of == 4
    assert found.words.startswith("The misfit repeats at the same place in ")
    assert found.summary()[0].keys() == {"axis", "share", "p", "runs", "of", "evidence", "holds", "mostly"}
    assert {a["axis"] for a in found.summary()} == {"x", "t", "v", "phase"}


def test_blows_at_moments_of_their_own_do_not_repeat(blown):
    found = repeatability_of(blown[1])
    assert found.best is None
    assert found.words.startswith("The misfit does not repeat from run to run")


def test_one_run_cannot_tell_whether_a_failure_repeats():
    runs = lacking("patch", PATCH, specs=FOUR[:1])
    found = repeatability_of(fit(LAW, runs).solution)
    assert found.summary() == []
    assert found.words.startswith("One run cannot show")


def test_a_place_that_only_one_run_reaches_shows_no_repetition():
    specs = (Spec(3.6, 1, 0.11), Spec(4.4, 1, 0.035), Spec(5.0, 2, 0.03))
    found = repeatability_of(fit(LAW, lacking("patch", PATCH, specs=specs)).solution)
    assert found.best is None
    assert found.words.startswith("Only run r0 shows the misfit")


def test_words_say_which_axes_these_runs_hardly_part():
    axes = [
        AxisRepeatability("x", 0.8, 0.005, 5, 6, evidence=40.0),
        AxisRepeatability("t", 0.75, 0.005, 4, 6, evidence=33.0),
        AxisRepeatability("v", 0.1, 0.5, 0, 6, evidence=20.0),
    ]
    assert describe_axes(axes) == (
        "The misfit repeats at the same place in 5 of 6 runs: it depends on the position along the course. "
        "These runs hardly distinguish it from the same time since release; a run at another speed would."
    )


def test_what_the_runs_show_too_little_of_is_left_open():
    axes = [
        AxisRepeatability("v", 0.2, 0.01, 1, 6, evidence=9.0),
        AxisRepeatability("x", 0.1, 0.5, 0, 6, evidence=-5.0),
    ]
    assert describe_axes(axes).startswith("These runs do not determine whether the misfit repeats")
    assert describe_axes([replace(a, evidence=-40.0) for a in axes]).startswith("The misfit does not repeat")
    most = describe_axes([replace(a, evidence=-40.0, explained=0.995) for a in axes])
    assert "alone explains 99.5 % of what a force of its own in every run explains" in most


def test_what_the_other_runs_predict_repeats_however_narrow_it_is():
    axes = [
        AxisRepeatability("x", 0.84, 0.005, 5, 5, evidence=-60.0),
        AxisRepeatability("t", 0.3, 0.2, 1, 5, evidence=-90.0),
    ]
    assert axes[0].holds
    assert (
        describe_axes(axes)
        == "The misfit repeats at the same place in 5 of 5 runs: it depends on the position along the course."
    )


@pytest.mark.slow
def test_a_slow_force_of_speed_is_told_from_one_of_every_run():
    specs = tuple(Spec(v, 1, 0.1) for v in (2.5, 3.5, 5.0, -6.5))
    found = repeatability_of(fit(LAW, lacking("drag", {"c": 0.02}, specs=specs)).solution)
    assert found.best.axis == "v"
    assert found.best.evidence > 10


@pytest.mark.slow
def test_a_fine_wave_over_the_place_repeats_there():
    texture = {"amplitude": 0.3, "period": 0.012, "phase": 0.4}
    found = repeatability_of(fit(LAW, lacking("texture", texture, sigma=2e-6)).solution)
    assert found.best.axis == "x"


def test_spans_of_a_measured_friction_force():
    t = np.arange(600) / FPS
    x = 3 * t - 10 * t**2
    v = 3 - 20 * t
    rng = np.random.default_rng(2)
    force = 8 + 1.2 * v + 0.8 * np.exp(-(((x - 0.2) / 0.01) ** 2) / 2) + 0.05 * rng.standard_normal(len(t))
    runs = [measured(t, x, sigma=1e-6, friction_N=force)]
    spans = failing_spans(fit(LAW, runs).solution, runs)
    assert len(spans) == 1
    assert spans[0]["x"] == pytest.approx([0.18, 0.22], abs=0.006)


def test_linear_interpolation_between_knots_holds_its_ends():
    knots = np.array([0.0, 1.0, 3.0])
    made = linear_interpolation_matrix(np.array([-1.0, 0.5, 2.0, 9.0]), knots)
    np.testing.assert_allclose(made @ np.array([2.0, 4.0, 8.0]), [2.0, 3.0, 6.0, 8.0])
    assert np.all(np.linalg.eigvalsh(matern_covariance(np.linspace(0, 1, 30), 0.2)) > 0)


def test_the_common_curve_is_the_mean_of_runs_and_its_band_knows_their_scatter():
    axis = np.tile(np.linspace(0.0, 1.0, 400), 3)
    run = np.repeat([0.0, 1.0, 2.0], 400)
    shape = np.sin(2 * np.pi * axis)
    alike = mean_curve(run, axis, shape, np.full(1200, 0.01))
    np.testing.assert_allclose(alike["F"][5:-5], np.sin(2 * np.pi * alike["at"][5:-5]), atol=0.02)
    apart = mean_curve(run, axis, shape + run - 1, np.full(1200, 0.01))
    assert np.median(apart["sigma_F"]) == pytest.approx(1 / np.sqrt(3), rel=0.1)  # a spread of one, over three runs
    half = mean_curve(run[:400], axis[:400] / 2, shape[:400], np.full(400, 0.01))
    assert half["at"][-1] == 0.5


def test_every_span_is_marked_in_its_runs_colour(patched):
    runs, solution = patched
    pieces, line = deconvolved(solution)
    spans = failing_spans(solution, runs)
    looks = style.run_styles(runs)
    found = [{"axis": "x", "share": 0.8, "p": 0.005, "runs": 3, "of": 4, "holds": True}]
    figure = plots.missing_force(residual_figures(pieces, line), spans, looks, found)
    assert figure.get_suptitle() == "The missing force repeats with place"
    place = next(ax for ax in figure.axes if "displacement x" in ax.get_xlabel())
    bars = {tuple(np.round(b.get_xdata(), 3)): b.get_color() for b in place.lines if b.get_linewidth() == 3.0}
    for s in spans:
        ends = next(e for e, c in bars.items() if c == looks[s["run"]]["color"])
        assert ends == pytest.approx(s["x"], abs=0.003)


def test_a_piece_of_a_few_frames_has_one_look():
    slides = (Spec(3.0, 1, 0.06), Spec(4.0, 1, 9 / FPS))
    runs, _ = study(models.of(LAW.split(",")), DRY, specs=slides, sigma=1e-5, rng=np.random.default_rng(2))
    solution = fit(LAW, runs).solution
    assert find_local_forces(solution).bumps == []


def test_a_blow_in_a_piece_too_short_for_another_width_is_found():
    """Twelve frames leave no range between the narrowest and the widest bump of the scan."""
    long, when = Spec(3.0, 1, 0.06), 5 / FPS
    plain = lacking("collision", {"J": 0.0, "time": when, "width": 4e-4}, specs=(long,), sigma=1e-6)[0]
    struck = lacking("collision", {"J": 0.05, "time": when, "width": 4e-4}, specs=(Spec(4.0, 1, 11 / FPS),), sigma=1e-6)
    runs = [plain, replace(struck[0], name="struck")]
    solution = fit(LAW, runs).solution
    found = find_local_forces(solution)
    assert "struck" in {s["run"] for s in failing_spans(solution, runs)}
    (blow,) = found.bumps
    assert blow.run == 1
    assert blow.centre == pytest.approx(when, abs=1 / FPS)
    assert blow.size > 0


@pytest.mark.slow
def test_levels_that_absorb_misfit_do_not_hide_a_common_place():
    """Without the patch the fit gives one run a twentieth of its friction; a place then seems to act in few runs."""
    solution = fit("tustin", samples.runs()).solution
    levels = [
        value for slot, value in zip(solution.problem.layout.slots, solution.p, strict=True) if slot.run is not None
    ]
    assert min(levels) < 0.5
    found = find_local_forces(solution)
    (patch,) = found.bumps
    assert found.complete
    assert patch.at_place
    assert (patch.size, patch.centre, patch.width) == pytest.approx((0.4, 0.1, 0.008), rel=0.1)
    pattern = find_failure_pattern(solution, np.random.default_rng(0))
    assert pattern.repeats.best.axis == "x"
    assert "repeats at the same place in 3 of 4 runs" in pattern.repeats.words
    assert pattern.local.solution.chi2 > 2 * solution.chi2  # refitted with the patch, without it
    assert pattern.fit.chi2 == pytest.approx(solution.chi2, rel=1e-6)


def test_a_run_counts_only_where_it_has_been():
    """The second run is short, at rest in the end; its zero force does not reach to places that only the first saw."""
    axis = np.concatenate([np.linspace(0, 1, 400), np.linspace(0, 0.2, 400)])
    run, force = np.repeat([0.0, 1.0], 400), np.repeat([1.0, 0.0], 400)
    curve = mean_curve(run, axis, force, np.full(800, 0.01))
    alone = curve["at"] > 0.26
    assert curve["F"][alone] == pytest.approx(1.0)
    assert curve["sigma_F"][alone] == pytest.approx(0.01)


@pytest.mark.slow
def test_runs_of_other_mass_agree_in_the_force_over_the_load():
    found = find_failure_pattern(fit("tustin", samples.runs()).solution, np.random.default_rng(0)).figures
    load = found["residual_force"]["load"]
    assert sorted(set(np.round(load, 6))) == [1.0, 2.0]
    curve = found["common_x"]
    k = np.nanargmax(curve["F"])
    assert curve["at"][k] == pytest.approx(0.1, abs=0.003)
    assert curve["F"][k] == pytest.approx(0.4, abs=max(3 * curve["sigma_F"][k], 0.04))
