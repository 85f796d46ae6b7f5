"""Free runs of a law over whole records, against motions that scipy integrates."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
import pytest
from runs import BASE, MASS, measured
from scipy.integrate import solve_ivp

from frictrack.diagnose import diagnose
from frictrack.diagnose.compare import compare
from frictrack.effects import models
from frictrack.fit import fit
from frictrack.simulate import Conditions, Start, is_smooth_at_rest, simulate, simulate_displacement

sys.path.insert(0, str(Path(__file__).parents[1] / "pipelines" / "benchmarks"))

from published import hysteresis

FS = 750.0
M, C, K, ALPHA, GAMMA, RATIO = 2.0, 10.0, 5e4, 5e4, 800.0, -1.375  # Noel & Schoukens 2016: the published oscillator
BOUC_WEN = {
    "viscous": {"F_v": C},
    "spring": {"k": K, "x_0": 0.0},
    "bouc_wen": {"alpha": ALPHA, "gamma": GAMMA, "delta": RATIO},
}
LAW = models.of(["viscous", "spring", "bouc_wen"])
TONES = np.array([7.0, 13.0, 22.0, 31.0, 43.0, 58.0])  # Hz


def push(t, seed=0):
    """A multisine of 20 N rms, under which the oscillator swings by about a millimetre."""
    phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, len(TONES))
    return 20 * np.sqrt(2 / len(TONES)) * np.sum(np.sin(2 * np.pi * TONES * np.atleast_1d(t)[:, None] + phases), axis=1)


def oscillator(t, seed=0, start=(0.0, 0.0, 0.0)):
    """The same by scipy, z the hysteretic force: x (n,), v (n,), z (n,)."""

    def rate(tau, q):
        x, v, z = q
        bend = ALPHA * v - GAMMA * (abs(v) * z + RATIO * v * abs(z))
        return [v, (push(tau, seed)[0] - C * v - K * x - z) / M, bend]

    return solve_ivp(rate, (t[0], t[-1]), start, method="LSODA", rtol=1e-9, atol=1e-12, max_step=1e-3, t_eval=t).y


def swinging(n=1500, *, seed=0, sigma=2e-6, lead=0, **known):
    """A run of the oscillator from rest, or, with a `lead` of frames, one that swings already as the record begins."""
    t = np.arange(n + lead) / FS
    x = oscillator(t, seed)[0][lead:]
    own = {"rng": np.random.default_rng(seed), **known}
    return measured(t[:n], x, sigma=sigma, mass=M, drive=push(t[lead:], seed), sigma_drive=0.0, **own)


@pytest.mark.slow
def test_a_free_run_of_hysteresis_is_the_motion_that_scipy_integrates():
    t = np.arange(800) / FS
    x, v, z = oscillator(t)
    conditions = Conditions(M, drive=push)
    assert is_smooth_at_rest(LAW, BOUC_WEN, conditions)
    made = simulate_displacement(LAW, BOUC_WEN, conditions, t, Start(0.0, 0.0), 1e-8)
    assert np.max(np.abs(made - x)) < 2e-8  # of 1.5 mm
    late = Start(x[500], v[500], {"bouc_wen": np.array([[z[500] / ALPHA]])})
    made = simulate_displacement(LAW, BOUC_WEN, conditions, t[500:], late, 1e-8)
    assert np.max(np.abs(made - x[500:])) < 2e-8


def test_the_motion_of_the_published_benchmark_is_the_same():
    t = np.arange(150) / FS
    made = hysteresis.published_motion(push, len(t))
    np.testing.assert_allclose(made, oscillator(t)[0], rtol=0, atol=2e-7)  # 20 steps per sample, of 1.5 mm


@pytest.mark.parametrize(
    ("values", "smooth"),
    [
        (BASE, False),
        (BASE | {"friction_lag": {"tau": 3e-3}}, False),
        (BASE | {"presliding": {"stiffness": 1e-4, "exponent": 1.0}}, True),
        ({"viscous": {"F_v": 1.0}, "texture": {"amplitude": 0.5, "period": 0.03, "phase": 0.0}}, False),
    ],
    ids=["dry", "lag", "presliding", "texture"],
)
def test_what_leaps_at_rest_is_told_from_what_does_not(values, smooth):
    assert is_smooth_at_rest(models.of(list(values)), values, Conditions(MASS)) is smooth


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "more",
    [{}, {"presliding": {"stiffness": 1e-4, "exponent": 1.0}}, {"friction_lag": {"tau": 3e-3}}],
    ids=["dry", "presliding", "lag"],
)
def test_a_long_motion_sticks_and_reverses_as_the_exact_one_does(more):
    values = BASE | more
    law, t = models.of(list(values)), np.arange(500) / 4000
    conditions = Conditions(MASS, drive=lambda t: 22 * np.sin(2 * np.pi * 20 * t))
    exact = simulate(law, values, conditions, t, (0.0, 0.0))
    assert np.sum(np.abs(np.diff(np.sign(exact.v))) > 0) >= 3
    made = simulate_displacement(law, values, conditions, t, Start(0.0, 0.0), 1e-8)
    assert np.max(np.abs(made - exact.x)) < 1e-8 + 1e-5 * np.max(np.abs(exact.x))


@pytest.mark.slow
def test_the_free_run_of_a_record_that_swings_already_finds_its_first_state():
    found = fit(LAW, [swinging(1500, lead=400)])
    assert found.errors["free_run"] == "fit"
    assert found.errors["free_run_rms_um"] == pytest.approx(2.0, rel=0.05)


@pytest.mark.slow
def test_what_a_law_lacks_shows_in_the_free_run_more_than_in_its_segments():
    runs = [swinging(700), swinging(700, seed=1, name="other", role="validation", sigma=1e-8)]
    bare, full = fit("viscous,spring", runs), fit(LAW, runs)
    for name, truth in (("viscous.F_v", C), ("spring.k", K), ("bouc_wen.alpha", ALPHA), ("bouc_wen.gamma", GAMMA)):
        estimate = full.parameters[name]
        assert abs(estimate.value - truth) < 4 * estimate.std + 1e-3 * truth
    assert full.parameters["bouc_wen.delta"].value == pytest.approx(RATIO * GAMMA, rel=0.02)
    assert full.errors["free_run"] == "validation"
    assert full.errors["free_run_rms_um"] < 1.0
    assert bare.errors["free_run_rms_um"] > 50.0
    row = bare.summary()["per_run"][1]
    assert row["role"] == "validation"
    assert row["errors"]["free_run_rms_um"] == bare.errors["free_run_rms_um"]
    assert row["errors"]["free_run_rms_um"] > 3 * row["errors"]["rms_displacement_um"]  # its segments begin afresh
    assert "free_run_rms_um" not in bare.summary()["per_run"][0]["errors"]
    shown = compare([bare, full]).summary()["models"]
    assert [m["errors"]["free_run_relative"] for m in shown] == [
        pytest.approx(1e-6 * m["errors"]["free_run_rms_um"] / np.std(runs[1].displacement.x)) for m in shown
    ]


def test_without_a_drive_the_free_run_is_the_simulation_from_the_release():
    t = np.arange(400) / 4000
    slide = simulate(models.tustin(), BASE, Conditions(MASS), t, (0.0, 5.0))
    found = fit("tustin", [measured(t, slide.x, sigma=1e-5)])
    assert found.errors["free_run_rms_um"] == pytest.approx(found.errors["rms_displacement_um"])


@pytest.mark.slow
def test_forty_thousand_frames_are_followed_in_seconds():
    t = np.arange(40_000) / FS
    begin = time.process_time()
    made = simulate_displacement(LAW, BOUC_WEN, Conditions(M, drive=push), t, Start(0.0, 0.0), 1e-6)
    assert time.process_time() - begin < 60  # 10 s on a processor of 2024
    n = 3000
    np.testing.assert_allclose(made[:n], oscillator(t[:n])[0], atol=1e-6)


@pytest.mark.release
@pytest.mark.slow
def test_what_a_swinging_spring_lacks_is_named_as_hysteresis():
    found = diagnose(fit("viscous,spring", [swinging(1500, sigma=8e-6, lead=300)]))
    assert found.missing == ["bouc_wen"]  # what it remembers as the record begins is no further effect
    assert found.best.parameters["alpha"]["value"] == pytest.approx(ALPHA, rel=0.1)
