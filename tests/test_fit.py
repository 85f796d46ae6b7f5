"""Fits against the parameters that made the runs, and their deviations against many repeats of the noise."""

from __future__ import annotations

import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from repeats import few_or_many
from runs import (
    BASE,
    FOUR,
    FPS,
    HIDDEN,
    MASS,
    PER_RUN_PHASE,
    SIX,
    Slider,
    Spec,
    integrate,
    measured,
    study,
    with_hidden,
)
from scipy.integrate import solve_ivp

from frictrack import samples
from frictrack.base.errors import FrictrackError
from frictrack.effects import models
from frictrack.fit import fit, refine, restore, state
from frictrack.fit.least_squares import heldout_rms
from frictrack.records import Displacement, Motion, Run
from frictrack.results import to_builtins
from frictrack.simulate import Conditions, simulate

NEVER_SLOW = (Spec(7.0, 1, 0.05), Spec(8.0, 1, 0.05))
SLOWS_TO_A_STOP = (Spec(2.2, 1, 0.09),)


def truth_of(values):
    """Parameters as they are quoted, by address, for values as columns take them."""
    flat = {f"{effect}.{name}": value for effect, q in values.items() for name, value in q.items()}
    if "stribeck.F_s" in flat:
        flat["stribeck.F_s"] += flat["coulomb.F_c"]
    if "spring.k" in flat:
        flat["spring.x_0"] /= flat["spring.k"]
    return flat


def parabola(seed, *, level=1.0, speed=4.0, name="run", sigma=10e-6, duration=0.06, F_c=8.0):
    """A Coulomb slider in closed form, seen with white noise."""
    t = np.arange(round(duration * FPS)) / FPS
    x = speed * t - np.sign(speed) * level * F_c / MASS * t**2 / 2
    return measured(t, x, sigma=sigma, name=name, rng=np.random.default_rng(seed))


# ---------------------------------------------------------------- parameters come back


@pytest.mark.few(4)
@pytest.mark.parametrize("name", ["", *HIDDEN])
def test_the_parameters_of_every_effect_come_back(name):
    model, values = with_hidden(name) if name else (models.tustin(), BASE)
    runs, _ = study(model, values, FOUR, sigma=1e-7)
    fitted, truth = fit(model, runs), truth_of(values)
    for address, estimate in fitted.parameters.items():
        plain_address = address.split("[")[0]
        if plain_address.endswith("phase") and name in PER_RUN_PHASE:
            continue  # redrawn in every run
        tolerance = max(1e-3 * abs(truth[plain_address]), 4 * estimate.std)
        assert abs(estimate.value - truth[plain_address]) <= tolerance, address
        assert estimate.std < 0.02 * max(abs(truth[plain_address]), 1.0 if estimate.unit == "rad" else 0.0), address
        assert estimate.unit


@pytest.mark.parametrize("how", ["tustin", "atm1:1", "coulomb,viscous"])
def test_model_may_be_given_by_name(how):
    runs, _ = study(specs=(Spec(4.0), Spec(-4.0)), sigma=1e-5)
    assert fit(how, runs).model.names == models.parse(how).names


@pytest.mark.slow
def test_a_mirrored_course_has_the_same_friction():
    runs, _ = study(sigma=1e-5, scatter=0.03)
    mirrored = [
        replace(
            r,
            displacement=replace(r.displacement, x=0.6 - r.displacement.x),
            motion=replace(r.motion, x=0.6 - r.motion.x, v=-r.motion.v, a=-r.motion.a),
        )
        for r in runs
    ]
    there, back = fit("tustin", runs).parameters, fit("tustin", mirrored).parameters
    for address, estimate in there.items():
        assert back[address].value == pytest.approx(estimate.value, rel=1e-5)
        assert back[address].std == pytest.approx(estimate.std, rel=1e-3, abs=1e-12)


def test_missing_frames_are_bridged():
    runs, _ = study(sigma=1e-7, gap=slice(100, 125))
    fitted = fit("tustin", runs)
    for piece in fitted.solution.problem.pieces:
        assert not np.any((piece.frames >= 100) & (piece.frames < 125))
        assert {99, 125} <= set(piece.frames)
    for address, value in truth_of(BASE).items():
        assert fitted.parameters[address].value == pytest.approx(value, rel=1e-3)


def test_newtons_are_quoted_at_the_reference_mass():
    runs, _ = study(specs=(Spec(4.0), Spec(5.0)), sigma=1e-6)
    once, twice = fit("coulomb,viscous", runs), fit("coulomb,viscous", runs, reference_mass=2 * MASS)
    assert twice.parameters["coulomb.F_c"].value == pytest.approx(2 * once.parameters["coulomb.F_c"].value, rel=1e-6)
    assert twice.parameters["viscous.F_v"].value == pytest.approx(once.parameters["viscous.F_v"].value, rel=1e-6)


# ---------------------------------------------------------------- deviations are honest


def bound(values, start, t, sigma):
    """Cramer-Rao bound of F_c, rise, v_s, F_v by differences of scipy's Runge-Kutta, start position and speed free."""
    theta = np.array([*start, 8.0, 6.0, 0.4, 1.2])

    def x_of(q):
        law = {"coulomb": {"F_c": q[2]}, "stribeck": {"F_s": q[3], "v_s": q[4], "delta": 1.0}}
        return integrate(law | {"viscous": {"F_v": q[5]}}, Slider(), t, (q[0], q[1]))

    steps = 1e-5 * np.maximum(np.abs(theta), 0.1)
    moved = [(x_of(theta + h) - x_of(theta - h)) / (2 * s) for s, h in zip(steps, np.diag(steps), strict=True)]
    jac = np.column_stack(moved)
    return sigma**2 * np.linalg.inv(jac.T @ jac)[2:, 2:]


@pytest.mark.slow
@pytest.mark.parametrize(("repeats", "room"), few_or_many((10, 0.5), (40, 0.3)))  # 40 repeats: 11 % deviation
def test_one_run_reaches_the_cramer_rao_bound(repeats, room):
    sigma, t = 2e-6, np.arange(260) / FPS
    x = integrate(BASE, Slider(), t, (0.0, 2.2))
    least = bound(BASE, (0.0, 2.2), t, sigma)
    least_std = np.sqrt([least[0, 0], least[2, 2], least[3, 3]])
    names, truth = ("coulomb.F_c", "stribeck.v_s", "viscous.F_v"), np.array([8.0, 0.4, 1.2])
    values, stds = [], []
    for seed in range(repeats):
        found = fit("tustin", [measured(t, x, sigma=sigma, rng=np.random.default_rng(seed))]).estimates.parameters
        values.append([found[n].value for n in names])
        stds.append([found[n].std for n in names])
    rmse = np.sqrt(np.mean((np.array(values) - truth) ** 2, axis=0))
    np.testing.assert_allclose(rmse / least_std, 1.0, atol=room)
    np.testing.assert_allclose(np.mean(stds, axis=0) / least_std, 1.0, atol=0.1)


def z_scores(seeds):
    """(value - truth)/std of every shared parameter, by address, noise, scatter and phases redrawn."""
    model, values = with_hidden("vibration")
    truth, out = truth_of(values), {}
    for seed in seeds:
        runs, _ = study(model, values, sigma=1e-5, scatter=0.03, rng=np.random.default_rng(seed))
        for address, e in fit(model, runs).parameters.items():
            if address in truth and e.std:
                out.setdefault(address, []).append((e.value - truth[address]) / e.std)
    return {address: np.array(z) for address, z in out.items()}


@pytest.mark.release
@pytest.mark.slow
def test_stated_intervals_cover_the_truth_over_200_seeds():
    z = z_scores(range(200))
    cover = {address: np.mean(np.abs(v) < 1.96) for address, v in z.items()}
    assert 0.91 <= np.mean(np.abs(np.concatenate(list(z.values()))) < 1.96) <= 0.98
    assert all(0.91 <= c <= 0.98 for c in cover.values()), cover


@pytest.mark.slow
@pytest.mark.parametrize(("repeats", "rel"), few_or_many((4, 0.6), (40, 0.2)))
def test_stated_intervals_cover_a_scattering_level_and_the_scatter_is_found(repeats, rel):
    taus, z, levels = [], [], []
    for seed in range(repeats):
        level = 1 + 0.03 * np.random.default_rng(1000 + seed).standard_normal(6)
        runs = [parabola(10 * seed + i, level=level[i], name=f"r{i}", duration=0.04) for i in range(6)]
        fitted = fit("coulomb", runs)
        estimate = fitted.estimates.parameters["coulomb.F_c"]
        taus.append(fitted.solution.tau)
        z.append((estimate.value - 8.0) / estimate.std)
        levels.append(fitted.solution.p[fitted.solution.problem.layout.levels] * estimate.value / 8.0 / level - 1)
    assert np.sqrt(np.mean(np.square(taus))) == pytest.approx(0.03, rel=rel)  # 4 x 5 degrees of freedom: 16 %; 40: 5 %
    assert 0.85 <= np.mean(np.abs(z) < 1.96) <= 1.0
    assert np.std(levels) < 1e-3  # each run's own level, which its parabola gives to 4e-4


@pytest.mark.slow
def test_a_constant_force_does_not_take_the_place_of_scattering_levels():
    """In one direction Coulomb friction and a spring's constant force are nearly one; the levels scatter anyway."""
    values = {
        "coulomb": {"F_c": 1.0},
        "stribeck": {"F_s": 0.35, "v_s": 0.3, "delta": 1.0},
        "viscous": {"F_v": 0.05},
        "spring": {"k": 0.6, "x_0": 0.0},
    }
    specs = tuple(Spec(speed, 1, 0.5 / speed) for speed in (2.0, 3.0, 4.0, 5.0, 6.5, 8.0))
    runs, levels = study("tustin,spring", values, specs, sigma=3e-6, scatter=0.01, rng=np.random.default_rng(1))
    found = fit("tustin,spring", runs)
    force = found.parameters["coulomb.F_c"].value
    assert 0.0 < force < 10.0  # it was 871 N, the levels equal
    scatter = found.solution.tau * (force + 0.35)
    assert scatter == pytest.approx(1.35 * np.std(levels, ddof=1), rel=0.5)
    assert found.reduced_chi2 < 1.1


def test_four_runs_make_the_level_a_random_effect_and_three_leave_it_free():
    runs = [parabola(i, level=1 + 0.05 * (i - 1), name=f"r{i}", duration=0.04) for i in range(3)]
    three = fit("coulomb", runs)
    assert three.summary()["friction_scatter"] is None
    assert three.parameters["coulomb.F_c"].value == pytest.approx(8.0, rel=5e-3)
    assert [row["level"] for row in three.summary()["per_run"]] == pytest.approx([0.95, 1.0, 1.05], abs=5e-3)
    four = fit("coulomb", [*runs, parabola(3, name="r3", duration=0.04)]).summary()["friction_scatter"]
    assert 0.02 < four["value"] < 0.08
    assert four["std"] == pytest.approx(four["value"] / np.sqrt(6))


# ---------------------------------------------------------------- what the data do not say


def test_static_friction_is_null_with_a_reason_where_no_run_slows():
    runs, _ = study(specs=NEVER_SLOW, sigma=1e-5)
    slowest = (7.0 + 8.0 / 1.2) * np.exp(-1.2 / MASS * 0.05) - 8.0 / 1.2  # closed form: Coulomb and viscous only
    found = fit("tustin", runs).parameters
    for name in ("stribeck.F_s", "stribeck.v_s"):
        assert found[name].value is None
        assert found[name].std is None
        assert "film a run that slows to a stop" in found[name].reason
        said = re.search(r"the slowest speed seen is ([\d.]+) m/s", found[name].reason)
        assert float(said[1]) == pytest.approx(slowest, rel=0.03)
    assert found["coulomb.F_c"].value is not None


def test_static_friction_is_given_where_a_run_slows_to_a_stop():
    runs, _ = study(specs=SLOWS_TO_A_STOP, sigma=2e-6)
    found = fit("tustin", runs).parameters
    for name, value in (("stribeck.F_s", 14.0), ("stribeck.v_s", 0.4), ("coulomb.F_c", 8.0)):
        assert abs(found[name].value - value) < 4 * found[name].std
        assert found[name].reason is None


def test_a_slope_and_coulomb_friction_are_one_in_a_single_direction():
    found = fit("coulomb,slope", [parabola(0)]).parameters
    assert found["slope.F"].value is None
    assert found["slope.F"].reason.startswith(
        "these runs cannot tell it from coulomb.F_c; film the same course in both"
    )


def test_a_fixed_parameter_says_so_and_a_bound_is_reported():
    runs, _ = study(specs=SLOWS_TO_A_STOP, sigma=2e-6)
    delta = fit("tustin", runs).parameters["stribeck.delta"]
    assert (delta.value, delta.std, delta.reason) == (1.0, 0.0, "fixed")
    pushed = replace(parabola(0, F_c=-3.0, speed=1.0), free=(0.0, 0.06))
    pushed = fit("coulomb", [pushed]).parameters["coulomb.F_c"]
    assert pushed.value == pytest.approx(0.0, abs=1e-6)
    assert pushed.at_bound


# ---------------------------------------------------------------- the best law is found, not one on the way

FOUR_SHORT = (Spec(2.2, 1, 0.07), Spec(4.0, 1, 0.07), Spec(5.0, 2, 0.07), Spec(-4.0, 1, 0.07))


@pytest.mark.parametrize("name", ["texture", "patch"])
def test_a_law_fitted_from_nothing_is_as_good_as_one_started_from_the_truth(name):
    model, values = with_hidden(name)
    runs, _ = study(model, values, specs=FOUR_SHORT, sigma=1e-5, scatter=0.03, rng=np.random.default_rng(0))
    found = fit(model, runs).solution
    truth = {f"{effect}.{q}": value for effect, own in values.items() for q, value in own.items()}
    start = np.array([truth.get(n, 1.0) for n in found.problem.layout.names])
    best = refine(found.problem, start, found.starts, tau=found.tau)
    assert found.objective < best.objective + 1.0


# ---------------------------------------------------------------- bookkeeping


def test_validation_runs_are_predicted_and_never_fitted():
    runs, _ = study(sigma=1e-5)
    checked = replace(runs[1], role="validation")
    mixed = fit("tustin", [checked if r is runs[1] else r for r in runs])
    without = fit("tustin", [r for r in runs if r is not runs[1]])
    assert {k: e.value for k, e in mixed.parameters.items()} == {k: e.value for k, e in without.parameters.items()}
    fitted = [k for k in mixed.errors if not k.startswith("free_run")]  # the free run is scored over validation runs
    assert {k: mixed.errors[k] for k in fitted} == {k: without.errors[k] for k in fitted}
    assert (mixed.errors["free_run"], without.errors["free_run"]) == ("validation", "fit")
    (row,) = [r for r in mixed.summary()["per_run"] if r["role"] == "validation"]
    assert (row["run"], row["level"]) == ("r1", 1.0)
    assert row["errors"]["rms_displacement_um"] == pytest.approx(10.0, rel=0.1)
    assert [c.run for c in mixed.curves if c.role == "validation"] == ["r1"]


def test_restore_gives_the_same_numbers_without_a_search():
    model, values = with_hidden("collision")
    runs, _ = study(model, values, specs=(Spec(4.0), Spec(5.0), Spec(-4.0), Spec(6.0)), sigma=1e-5, scatter=0.03)
    made = fit(model, runs)
    again = restore(runs, state(made))
    for address, e in made.parameters.items():
        assert again.parameters[address].value == pytest.approx(e.value, rel=1e-6)
        assert again.parameters[address].std == pytest.approx(e.std, rel=1e-4)
    assert again.solution.tau == made.solution.tau
    assert again.errors["heldout_rms_um"] == pytest.approx(made.errors["heldout_rms_um"], rel=1e-4)
    assert again.model.names == made.model.names


def test_held_out_error_of_the_true_law_is_the_noise():
    runs, _ = study(sigma=1e-5, scatter=0.03)
    rms, how = fit("tustin", runs).heldout
    assert how == "run"
    assert rms == pytest.approx(10e-6, rel=0.05)


def test_frames_are_held_out_where_the_other_runs_cannot_predict():
    alone, _ = study(specs=(Spec(2.2, 1, 0.075),), sigma=1e-5)
    assert fit("tustin", alone).heldout[1] == "frames"
    # Only one of two runs slows: the other knows nothing of F_s and v_s.
    pair, _ = study(specs=(Spec(2.2, 1, 0.075), Spec(6.0)), sigma=1e-5)
    fitted = fit("tustin", pair)
    rms, how = fitted.heldout
    assert how == "frames"
    assert rms == pytest.approx(10e-6, rel=0.1)
    assert heldout_rms(fitted.solution, "frames")[1] == "frames"


def test_held_out_error_shows_what_a_law_lacks():
    model, values = with_hidden("texture")
    runs, _ = study(model, values, sigma=1e-5)
    poor, rich = fit("tustin", runs), fit(model, runs)
    assert poor.errors["heldout_rms_um"] > 2 * rich.errors["heldout_rms_um"]
    assert rich.errors["heldout_rms_um"] == pytest.approx(10.0, rel=0.05)
    assert poor.errors["reduced_chi2"] > 4
    assert 0.9 < rich.errors["reduced_chi2"] < 1.1


def test_errors_and_curves_are_those_of_the_residual():
    runs, _ = study(specs=(Spec(4.0), Spec(5.0)), sigma=1e-5)
    fitted = fit("coulomb,viscous", runs)
    residual = np.concatenate([c.residual for c in fitted.curves])
    assert fitted.errors["rms_displacement_um"] == pytest.approx(1e6 * np.sqrt(np.mean(residual**2)))
    for curve in fitted.curves:
        np.testing.assert_allclose(sum(curve.parts.values()), curve.F_model, rtol=1e-12)
        np.testing.assert_allclose(curve.F_model, -MASS * curve.a_model, rtol=1e-9)
        a = np.gradient(np.gradient(curve.x_model, curve.t), curve.t)[3:-3]
        np.testing.assert_allclose(a, curve.a_model[3:-3], rtol=1e-3)


def test_summary_has_the_keys_of_the_contract_and_is_json():
    runs, _ = study(sigma=1e-5, scatter=0.03)
    summary = to_builtins(fit("tustin", runs).summary())
    keys = {"model", "domain", "search", "parameters", "friction_scatter", "correlations", "errors", "per_run"}
    assert keys <= summary.keys()
    assert {"value", "std", "unit", "at_bound", "reason"} <= summary["parameters"]["coulomb.F_c"].keys()
    errors = {"rms_displacement_um", "rms_acceleration", "sse_acceleration", "relative_force_error", "reduced_chi2"}
    assert errors | {"heldout_rms_um", "heldout_rms_N", "heldout"} <= summary["errors"].keys()
    assert {"run", "role", "level", "noise_um", "segments", "errors"} <= summary["per_run"][0].keys()
    for a, b, r in summary["correlations"]:
        assert a != b
        assert 0.95 < abs(r) <= 1


# ---------------------------------------------------------------- bad input


def without_mass():
    t = np.arange(100) / FPS
    nan = np.full(100, np.nan)
    disp = Displacement(t, 4 * t, nan, nan, nan, nan, np.ones(100, bool))
    zero = np.full(100, 1e-6)
    motion = Motion(t, 4 * t, np.full(100, 4.0), 0 * t, nan, zero, zero, zero, nan)
    return replace(parabola(0), displacement=disp, motion=motion, mass=None, friction_N=np.full(100, 8.0))


@pytest.mark.parametrize(
    ("runs", "said"),
    [
        (lambda: [parabola(0), parabola(1)], "expected every run to have its own name but got run twice"),
        (lambda: [replace(parabola(0), role="validation")], "expected at least one run to fit but all have role"),
        (lambda: [], "expected a list of runs, such as ft.samples.runs(), but got none"),
        (
            lambda: parabola(0),
            "to be a list of runs (from ft.Run.from_arrays) but got a Run; write [runs]",
        ),
        (lambda: "r1", 'to be a list of runs (from ft.Run.from_arrays) but got "r1"'),
        (lambda: None, "to be a list of runs (from ft.Run.from_arrays) but got None"),
        (lambda: [without_mass()], 'run "run": expected a mass for a fit of the displacement but got none'),
        (lambda: [replace(parabola(0), free=(0.01, 0.011))], 'run "run": expected at least 8 free frames but got 5'),
    ],
    ids=["same name", "validation only", "no run", "one run", "a name", "nothing", "no mass", "too few frames"],
)
def test_runs_that_cannot_be_fitted_are_refused_in_one_sentence(runs, said):
    with pytest.raises(FrictrackError) as caught:
        fit("coulomb", runs(), domain="displacement")
    assert said in str(caught.value)


def test_an_effect_whose_need_the_runs_lack_is_refused():
    blind = parabola(0)
    blind = replace(blind, displacement=replace(blind.displacement, pixel_pitch=None))
    with pytest.raises(FrictrackError, match="peak_locking needs the pixel pitch of every run; give scale in"):
        fit("coulomb,peak_locking", [blind])


# ---------------------------------------------------------------- levels of several runs


@pytest.mark.parametrize("runs", [2, 3])
def test_levels_of_few_runs_are_free_about_a_mean_of_one(runs):
    made, levels = study(specs=(Spec(4.0), Spec(5.0), Spec(-4.5))[:runs], sigma=1e-5, scatter=0.2)
    solution = fit("tustin", made).solution
    found = solution.p[solution.problem.layout.levels]
    assert found == pytest.approx(levels / levels.mean(), rel=2e-3)
    assert solution.objective == pytest.approx(solution.chi2, rel=1e-6)  # what holds their mean costs nothing
    assert solution.chi2 < 1.2 * solution.problem.n_frames


@pytest.mark.parametrize("name", ["texture", "patch"])
@pytest.mark.parametrize("seed", [0, *(pytest.param(s, marks=pytest.mark.slow) for s in (1, 2))])
def test_scatter_of_the_levels_hides_no_effect(name, seed, monkeypatch):
    """Where scans take the levels as they stand, what these scatter by looks like an effect at a wrong place."""
    monkeypatch.setattr(
        sys.modules["frictrack.fit.stepwise.growth"], "GOOD_CHI2_PER_FRAME", np.inf
    )  # the first way alone
    law, values = with_hidden(name)
    small = values | {name: {k: 0.3 * v if k in ("amplitude", "F") else v for k, v in values[name].items()}}
    made, _ = study(law, small, SIX[1:5], sigma=5e-6, scatter=0.1, rng=np.random.default_rng(seed))
    fitted = fit(law, made)
    assert fitted.solution.chi2 < 1.15 * fitted.solution.problem.n_frames
    place = {"texture": "texture.period", "patch": "patch.x_c"}[name]
    assert abs(fitted.parameters[place].value - truth_of(small)[place]) < 4 * fitted.parameters[place].std


def test_a_law_too_wild_along_the_measured_motion_is_fitted_all_the_same():
    """A strong swing that the law lacks, down to a slow end: the best static law of it runs away at first."""
    from frictrack.validation.reproduce import laws, papers_method  # noqa: PLC0415

    known = laws.to_effects("atm1:2", laws.read_printed(laws.ATM1["low"], "sample"))
    t = np.arange(468) / FPS
    slide = simulate(*known, Conditions(2.0), t, (0.0, 3.0))
    run = measured(t, slide.x, sigma=papers_method.TRACKING_NOISE, mass=2.0)
    plain_law, one_line, whole = (fit(law, [run]).solution for law in ("tustin", "atm1:1", "atm1:2"))
    assert whole.chi2 < 1.15 * whole.problem.n_frames
    assert one_line.chi2 < plain_law.chi2


@pytest.mark.slow
def test_a_rejected_model_is_fitted_through_a_stop():
    """Its motion up to the stop is found again when the effects are put into the order of the model."""
    values = {"coulomb": {"F_c": 1.0}, "stribeck": {"F_s": 0.5, "v_s": 0.3, "delta": 1.0}, "viscous": {"F_v": 0.1}}
    values["patch"] = {"F": 0.5, "x_c": 0.25, "w": 0.02}
    law, rng, runs = models.of(list(values)), np.random.default_rng(22), []
    for name, v, ratio, n in (
        ("slow", 1.8, 1.0, 530),
        ("fast", 3.0, 1.0, 235),
        ("heavy", 2.6, 2.0, 282),
        ("back", -2.6, 1.0, 289),
    ):
        t = np.arange(n) * 1e-3
        motion = simulate(law, values, Conditions(0.35 * ratio, ratio, ratio, 5e-4), t, (0.0 if v > 0 else 0.6, v))
        x = motion.x + 1e-6 * rng.standard_normal(n)
        runs.append(Run.from_arrays(t, x, mass=0.35 * ratio, name=name))
    fitted = fit("tustin", runs)
    assert fitted.model.names == ["coulomb", "stribeck", "viscous"]
    assert fitted.reduced_chi2 > 100


@pytest.mark.few(1)
@pytest.mark.parametrize("effect", ["out_of_plane", "timebase", "rolling_shutter"])
def test_a_model_that_lacks_much_is_fitted_no_worse_with_one_effect_more(effect):
    runs = samples.runs()  # a patch is missing
    law = ["coulomb", "stribeck", "viscous"]
    assert fit([*law, effect], runs).solution.objective < 1.001 * fit(law, runs).solution.objective


def test_a_law_beside_a_hidden_magnet_explains_no_less_than_a_part_of_it() -> None:
    rng, runs = np.random.default_rng(8), []
    for m, x0, v0 in ((0.35, 0.0, 2.0), (0.35, 0.0, 1.0), (0.35, 0.5, -1.5), (0.7, 0.0, 1.5)):

        def slowed(_: float, y: np.ndarray, m: float = m) -> list[float]:
            along = (y[0] - 0.2) / 0.03
            return [y[1], -(2.0 * m * np.sign(y[1]) + 0.1 * y[1] + 1.5 * along * np.exp(-(along**2))) / m]

        def stands(_: float, y: np.ndarray) -> float:
            return abs(float(y[1])) - 1e-2

        stands.terminal = True  # type: ignore[attr-defined]
        s = solve_ivp(
            slowed, (0, 0.4), (x0, v0), events=stands, dense_output=True, max_step=1e-3, rtol=1e-9, atol=1e-12
        )
        t = np.arange(0, s.t[-1], 1e-3)
        x = s.sol(t)[0] + 2e-6 * rng.standard_normal(len(t))
        runs.append(Run.from_arrays(t, x, mass=m, name=f"r{len(runs)}"))
    whole, part = (fit(law, runs).solution for law in ("tustin", "coulomb, viscous"))
    assert whole.chi2 < part.chi2
    assert whole.p[whole.problem.layout.index("stribeck", "F_s")] < 1000.0
