"""A wrong clock of one run: found with its factor, by the fit and by the diagnosis; right clocks are not doubted."""

from __future__ import annotations

from dataclasses import replace
from math import exp, log

import numpy as np
import pytest
from runs import BASE, FPS, MASS, SIX, Slider, Spec, integrate, measured

from frictrack.diagnose import diagnose
from frictrack.diagnose.model_selection import expected_separation
from frictrack.effects import LIBRARY, Path, Span, models
from frictrack.fit import bootstrap, fit, predict_run, reference_of, restore, state
from frictrack.fit.cutting import pieces_of
from frictrack.flow.plausibility_checks import withhold_verdict
from frictrack.measure.plausibility import Finding
from frictrack.simulate import Conditions, Start, simulate, simulate_displacement

CLOCK = LIBRARY["clock_rate"]
LAW = {name: BASE[name] for name in ("coulomb", "viscous")}
TRUE_OVER_RECORDED = [1.012, 0.95, 1.3]


def recorded(factors: dict[int, float], *, sigma: float = 1e-6, specs=SIX, push=None):
    """Runs of one law by an independent integrator; those named have time stamps that are too short by a factor."""
    runs = []
    for i, spec in enumerate(specs):
        t = np.arange(round(spec.duration * FPS)) / FPS
        slider = Slider(mass=MASS * spec.ratio, load=spec.ratio, push=push or (lambda tau: 0.0))
        x = integrate(LAW, slider, t, (0.0 if spec.speed > 0 else 0.6, spec.speed))
        rng = np.random.default_rng(i)
        made = measured(t / factors.get(i, 1.0), x, sigma=sigma, mass=slider.mass, name=f"r{i}", rng=rng)
        runs.append(made if push is None else replace(made, drive=np.array([push(tau) for tau in t])))
    return runs


@pytest.mark.few(1)
@pytest.mark.parametrize("factor", TRUE_OVER_RECORDED)
def test_the_factor_of_a_wrong_clock_comes_back_with_the_law(factor, tmp_path):
    runs = recorded({2: factor})
    wrong, found = fit("coulomb,viscous", runs), fit("coulomb,viscous,clock_rate", runs)
    assert wrong.reduced_chi2 > 2.0
    assert found.reduced_chi2 == pytest.approx(1.0, abs=0.15)
    own = found.parameters["clock_rate.rate[r2]"]
    assert abs(own.value - log(factor)) < 4 * own.std < 0.2 * log(1.012)
    assert [name for name in found.parameters if name.startswith("clock_rate")] == ["clock_rate.rate[r2]"]
    for address, truth in (("coulomb.F_c", 8.0), ("viscous.F_v", 1.2)):
        estimate = found.parameters[address]
        assert abs(estimate.value - truth) < 4 * estimate.std
    again = restore(runs, state(found))
    assert again.parameters["clock_rate.rate[r2]"].value == pytest.approx(own.value, rel=1e-9)


@pytest.mark.slow
def test_the_deviation_of_a_clock_is_the_scatter_of_drawn_runs():
    found = fit("coulomb,viscous,clock_rate", recorded({2: 1.05}, sigma=1e-5))
    drawn = bootstrap(found, draws=24).summary()["parameters"]["clock_rate.rate[r2]"]
    assert drawn["std"] == pytest.approx(found.parameters["clock_rate.rate[r2]"].std, rel=0.5)  # 15 % by chance


@pytest.mark.slow
def test_a_run_that_is_foretold_has_a_right_clock():
    runs = recorded({2: 1.05})
    foretold = replace(runs[3], name="later", role="validation")
    found = fit("coulomb,viscous,clock_rate", [*runs[:3], *runs[4:], foretold])
    told = predict_run(found.solution, foretold, reference_of(runs))
    assert np.sqrt(np.mean(told.residual**2)) == pytest.approx(1.0, abs=0.2)
    assert not any(name.startswith("clock_rate") for name in told.problem.layout.names)


@pytest.mark.slow
def test_a_wrong_clock_is_named_and_the_error_falls():
    runs = recorded({1: 1.02}, sigma=1e-5)
    said = diagnose(fit("coulomb,viscous", runs), quick=True)
    assert (said.verdict, said.missing) == ("missing", ["clock_rate"])
    best = said.candidates[0]
    assert best.heldout_after < 1.02e-5  # the noise is 10 um
    assert best.heldout_before > 1.05e-5
    assert "n run r1, whose true times would be its recorded ones times 1.02" in best.words["here"]


@pytest.mark.slow
def test_right_clocks_are_not_doubted():
    said = diagnose(fit("coulomb,viscous", recorded({}, sigma=1e-5)))
    assert said.verdict in ("complete", "undetermined")
    assert said.missing == []


def test_a_law_with_a_clock_is_held_against_one_without():
    runs = recorded({2: 1.05})
    timed, plain = (fit(law, runs).solution for law in ("coulomb,viscous,clock_rate", "coulomb,viscous"))
    assert expected_separation(timed, plain) > 100.0
    assert abs(expected_separation(timed, timed)) < 1e-3


@pytest.mark.slow
def test_a_clock_that_is_wrong_in_all_runs_is_absorbed_by_the_law():
    said = diagnose(fit("coulomb,viscous", recorded(dict.fromkeys(range(6), 1.1), sigma=1e-5)), quick=True)
    assert said.missing == []


@pytest.mark.slow
def test_a_push_comes_at_the_times_of_the_frames_by_the_wrong_clock_too():
    def push(tau):
        return 300.0 * np.sin(np.pi * tau / 0.012) ** 2 if 0 < tau < 0.012 else 0.0

    specs = [Spec(0.3, ratio, 0.1) for ratio in (1.0, 1.0, 2.0, 1.5, 1.0)]
    runs = recorded({3: 0.97}, specs=specs, push=push)
    found = fit("coulomb,viscous,clock_rate", runs)
    own = found.parameters["clock_rate.rate[r3]"]
    assert own.value == pytest.approx(log(0.97), abs=max(4 * own.std, 3e-4))
    assert found.reduced_chi2 == pytest.approx(1.0, abs=0.3)


def test_columns_are_the_change_of_the_picture_by_a_small_change_of_the_clock():
    t = np.linspace(0.0, 0.1, 201)

    def push(tau):
        return 6.0 * (1 - np.cos(2 * np.pi * 25.0 * tau))

    def seen(factor):  # the drive stands at the frames, whatever their times
        slider = Slider(push=lambda tau: push(tau / factor))
        return integrate({"coulomb": {"F_c": 1.0}}, slider, factor * t, (0.0, 2.0))

    x, h = seen(1.0), 1e-4
    v = np.gradient(x, t, edge_order=2)
    path = Path(t, x, v, np.ones(201), mass=MASS, drive=push(t))
    slope = (seen(exp(h)) - seen(exp(-h))) / (2 * h)
    np.testing.assert_allclose(CLOCK.columns(path, {})[:, 0], slope, atol=1e-3 * np.max(np.abs(slope)))
    two = Path(*(np.tile(q, 2) for q in (t, x, v, np.ones(201))), mass=MASS, drive=np.tile(push(t), 2), starts=(0, 201))
    np.testing.assert_allclose(CLOCK.columns(two, {})[:, 0], np.tile(CLOCK.columns(path, {})[:, 0], 2), rtol=1e-9)


def test_the_simulator_moves_the_mass_in_true_time():
    t = np.arange(200) / FPS
    values = LAW | {"clock_rate": {"rate": log(1.1)}}
    slide = simulate(models.of(values), values, Conditions(MASS), t, (0.0, 4.0))
    truth = integrate(LAW, Slider(), 1.1 * t, (0.0, 4.0))
    np.testing.assert_allclose(slide.x + slide.shift, truth, atol=1e-11)
    np.testing.assert_array_equal(slide.t, t)


def test_a_long_motion_is_simulated_in_true_time_too():
    """Viscous friction alone: x = v m/c (1 - exp(-c t/m)) at the true time t = 1.3 times the recorded one."""
    t, c, speed = np.arange(60) / FPS, 2.0, 3.0
    values = {"viscous": {"F_v": c}, "clock_rate": {"rate": log(1.3)}}
    made = simulate_displacement(models.of(values), values, Conditions(MASS), t, Start(0.0, speed), 1e-9)
    np.testing.assert_allclose(made, speed * MASS / c * -np.expm1(-c * 1.3 * t / MASS), rtol=0, atol=1e-8)


def test_a_piece_has_one_clock_at_a_time():
    (run, *_) = recorded({})
    ((piece,),) = pieces_of([run], reference_of([run]))
    twice = piece.with_clock(1.5).with_clock(1.2)
    np.testing.assert_allclose(twice.t, 1.2 * piece.t)
    np.testing.assert_allclose(twice.a_hat, piece.a_hat / 1.44)
    np.testing.assert_allclose(twice.with_clock(1.0).path.t, piece.path.t)
    assert piece.with_clock(1.0) is piece


def test_a_clock_off_by_more_than_a_step_of_frame_rates_is_not_plausible():
    span = Span(0.1, 0.0, 0.3, 0.1, 4.0, FPS)
    assert CLOCK.plausible({"rate": log(1.9)}, span) == ""
    assert "wrong by a factor of 3, expected at most 2" in CLOCK.plausible({"rate": -log(3.0)}, span)


def test_a_verdict_stays_open_while_what_was_typed_is_contradicted():
    said = {"verdict": "missing", "missing": ["collision"], "model": ["coulomb"], "undetermined": []}
    finding = Finding("fps", "the time stamps say 1 Hz", "fps = 1", "a", contradicts=True)
    open_now = withhold_verdict(said, [finding])
    assert (open_now["verdict"], open_now["missing"]) == ("undetermined", [])
    assert open_now["undetermined"][0]["settled_by"] == "fps = 1"
    for same in ({"missing": ["clock_rate"]}, {"model": ["coulomb", "clock_rate:2"]}):
        assert withhold_verdict(said | same, [finding])["verdict"] == "missing"
    assert withhold_verdict(said, [replace(finding, contradicts=False)]) == said
