"""A part of the mass on a spring: held against two masses that SciPy integrates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from runs import MASS, measured, study
from scipy.integrate import solve_ivp

from frictrack.diagnose import diagnose
from frictrack.effects import Path, direction_of_motion, get, models
from frictrack.fit import fit
from frictrack.simulate import Conditions, simulate

FPS, F_C, F_V = 4000.0, 2.0, 0.3
SPEEDS = ((2.5, 1.0), (4.0, 1.0), (6.0, 1.0), (4.5, 2.0), (-5.0, 1.0))  # m/s at release, mass ratio
LAW = ("coulomb", "viscous")


def speed(t):
    return 3.0 * np.exp(-2.0 * t) * np.cos(25.0 * t)


def path_of(n):
    t = np.linspace(0.0, 0.5, n)
    return Path(t, np.zeros(n), speed(t), direction_of_motion(speed(t)))


def acceleration_of_part(t, omega, damping, begin):
    def rate(now, y):
        return [y[1] - speed(now), -(omega**2) * y[0] - 2 * damping * omega * (y[1] - speed(now))]

    z, u = solve_ivp(rate, (t[0], t[-1]), begin, "DOP853", t, rtol=1e-11, atol=1e-13).y
    return -(omega**2) * z - 2 * damping * omega * (u - speed(t))


@pytest.mark.few(3)
@pytest.mark.parametrize(("n", "tolerance"), [(400, 2e-4), (1600, 1e-6), (6400, 1e-8)])
@pytest.mark.parametrize(("frequency", "damping"), [(83.0, 0.03), (200.0, 0.01), (20.0, 0.9), (600.0, 0.05)])
def test_the_part_swings_as_scipy_integrates_it(n, tolerance, frequency, damping):
    path = path_of(n)
    truth = acceleration_of_part(path.t, 2 * np.pi * frequency, damping, [0.0, 0.0])
    found = get("elastic_joint").columns(path, {"frequency": frequency, "damping": damping})[:, 0]
    np.testing.assert_allclose(found, truth, atol=tolerance * np.max(np.abs(truth)))


def test_before_the_first_sample_the_mass_has_kept_its_velocity_since_release():
    later = np.linspace(0.013, 0.1, 500)
    steady = Path(later, 4.0 * later, np.full(500, 4.0), np.ones(500))
    omega, damping = 2 * np.pi * 70.0, 0.04
    found = get("elastic_joint").columns(steady, {"frequency": 70.0, "damping": damping})[:, 0]
    own = np.sqrt(1 - damping**2) * omega  # step response of an oscillator: its acceleration in closed form
    wave = np.cos(own * later) * 2 * damping * omega + np.sin(own * later) * omega**2 * (1 - 2 * damping**2) / own
    np.testing.assert_allclose(found, 4.0 * np.exp(-damping * omega * later) * wave, atol=1e-9 * np.max(np.abs(wave)))


def test_a_path_goes_on_from_what_was_remembered_and_a_population_is_the_same_as_one_by_one():
    whole, joint, cut = path_of(1600), get("elastic_joint"), 700
    first, rest = (
        replace(whole, **{key: getattr(whole, key)[rows] for key in ("t", "x", "v", "s")})
        for rows in (slice(None, cut + 1), slice(cut, None))
    )
    q = {"frequency": 83.0, "damping": 0.03}
    truth = joint.columns(whole, q)
    found = joint.columns(replace(rest, begin=joint.state(first, q)[-1:]), q)
    np.testing.assert_allclose(found, truth[cut:], atol=1e-5 * np.max(np.abs(truth)))
    found = joint.columns(replace(rest, before=np.array([first.t, first.x, first.v])[:, -400:]), q)
    assert np.max(np.abs(found - truth[cut:])) < 0.1 * np.max(np.abs(truth))  # what came before has mostly died away
    others = {"frequency": np.array([83.0, 40.0, 300.0]), "damping": np.array([0.03, 0.5, 0.1])}
    singles = [joint.columns(whole, {k: v[i] for k, v in others.items()}) for i in range(3)]
    long = Path(*(np.tile(a, 3) for a in (whole.t, whole.x, whole.v, whole.s)), starts=(0, 1600, 3200))
    together = joint.columns(long, {k: np.repeat(v, 1600) for k, v in others.items()})
    np.testing.assert_allclose(together, np.concatenate(singles), rtol=1e-10, atol=1e-9 * np.max(np.abs(together)))


def two_masses(v_0, seed, ratio=1.0, *, part=1e-3, frequency=90.0, damping=0.03, drive=None, sigma=1e-5, duration=0.12):
    """A mass that is struck (or pushed) and carries a part on a spring."""
    t = np.arange(round(duration * FPS)) / FPS
    omega, mass = 2 * np.pi * frequency, MASS * ratio

    def rate(now, y):
        _, v, z, u = y
        pull = -(omega**2) * z - 2 * damping * omega * (u - v)
        push = drive(now) if drive else 0.0
        return [v, (push - F_C * ratio * np.sign(v or 1.0) - F_V * v - part * pull) / mass, u - v, pull]

    found = solve_ivp(rate, (0, t[-1]), [0, v_0, 0, 0], "DOP853", t, rtol=1e-10, atol=1e-12, max_step=1e-3).y
    slow = np.flatnonzero(found[1] * np.sign(v_0 or 1.0) < 0.05)
    n = slow[0] if len(slow) and not drive else len(t)
    known = {"drive": drive(t)} if drive else {}
    rng = np.random.default_rng(seed)
    return measured(t[:n], found[0][:n], sigma=sigma, mass=mass, name=f"r{seed}", rng=rng, **known)


def test_a_simulated_mass_swings_with_its_part_as_two_masses_do():
    values = {"coulomb": {"F_c": F_C}, "viscous": {"F_v": F_V}}
    values["elastic_joint"] = {"mass": 5e-3, "frequency": 90.0, "damping": 0.03}
    truth = two_masses(3.0, 0, part=5e-3, sigma=0.0).displacement
    found = simulate(models.of(list(values)), values, Conditions(MASS), truth.t, (0.0, 3.0))
    np.testing.assert_allclose(found.x, truth.x, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(
    "joint",
    [
        {"part": 1e-3, "frequency": 90.0, "damping": 0.03},
        {"part": 3e-3, "frequency": 30.0, "damping": 0.05},
        {"part": 5e-3, "frequency": 140.0, "damping": 0.2},
    ],
)
def test_a_joint_is_named_and_its_values_are_found(joint):
    runs = [two_masses(v, i, ratio, **joint) for i, (v, ratio) in enumerate(SPEEDS)]
    found = diagnose(fit(list(LAW), runs), quick=True)
    assert (found.verdict, found.missing) == ("missing", ["elastic_joint"])
    assert "decaying_vibration" in [c.effect for c in found.candidates]
    fitted = fit([*LAW, "elastic_joint"], runs)
    assert fitted.reduced_chi2 == pytest.approx(1.0, abs=0.1)
    for own, value in zip(("mass", "frequency", "damping"), joint.values(), strict=True):
        estimate = fitted.parameters[f"elastic_joint.{own}"]
        assert abs(estimate.value - value) < 4 * estimate.std
        assert estimate.std < 0.1 * value


@pytest.mark.slow
def test_a_vibration_with_a_phase_of_its_own_in_every_run_is_no_joint():
    law = {"coulomb": {"F_c": F_C}, "viscous": {"F_v": F_V}}
    law["decaying_vibration"] = {"amplitude": 1.0, "frequency": 90.0, "tau": 0.06, "phase": 0.0}
    runs, _ = study(models.of(list(law)), law, sigma=1e-5)
    found = diagnose(fit(list(LAW), runs), quick=True)
    assert (found.verdict, found.missing) == ("missing", ["decaying_vibration"])


@pytest.mark.slow
def test_a_joint_that_a_drive_shakes_is_found():
    def drive(t):
        return 3.0 + 6.0 * np.sin(2 * np.pi * 60.0 * t) * (1 - np.exp(-np.asarray(t) / 0.02))

    runs = [two_masses(v, i, drive=drive, part=5e-3) for i, v in enumerate((1.5, 3.0, 2.0))]
    fitted = fit([*LAW, "elastic_joint"], runs)
    assert fitted.reduced_chi2 == pytest.approx(1.0, abs=0.15)
    assert fitted.parameters["elastic_joint.mass"].value == pytest.approx(5e-3, rel=0.05)
    assert fitted.parameters["elastic_joint.frequency"].value == pytest.approx(90.0, rel=0.02)


@pytest.mark.slow
def test_nothing_is_named_where_no_part_swings():
    runs = [two_masses(v, i, ratio, part=0.0) for i, (v, ratio) in enumerate(SPEEDS)]
    assert diagnose(fit(list(LAW), runs), quick=True).verdict == "complete"
