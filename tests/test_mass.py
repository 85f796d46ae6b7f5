"""A mass that was not weighed, found from a measured drive: against scipy's integrator and the noise that made it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from frictrack.base.errors import FrictrackError
from frictrack.fit import fit, restore, state
from frictrack.flow.stages import _with_fitted_mass
from frictrack.records import GRAVITY, Displacement, Motion, Run
from frictrack.results import to_builtins

MASS, F_C, F_V = 3.0, 6.0, 15.0
LAW = "coulomb,viscous"
RATE = 1000.0


def drive(t):
    """A motor that turns round: two sines, N."""
    return 25.0 * np.sin(2 * np.pi * 1.3 * t) + 12.0 * np.sin(2 * np.pi * 3.1 * t + 0.7)


def slide(*, push=drive, unknown=lambda t: 0.0, duration=2.0, incline=0.0, mass=MASS):
    """x and v (n,) of a Coulomb and viscous slider that turns round, by scipy's Runge-Kutta from turn to turn."""
    t = np.arange(round(duration * RATE)) / RATE
    x, v = np.full(len(t), np.nan), np.full(len(t), np.nan)
    now, place, speed, s = 0.0, 0.0, 0.4, 1.0

    def acceleration(tau, velocity, s):
        return (push(tau) + unknown(tau) - F_C * s - F_V * velocity) / mass - GRAVITY * np.sin(incline)

    while now < t[-1]:

        def turns(tau, z):
            return z[1]

        turns.terminal, turns.direction = True, -s
        start = speed if speed else s * 1e-12
        solved = solve_ivp(
            lambda tau, z, s=s: [z[1], acceleration(tau, z[1], s)],
            (now, t[-1]),
            [place, start],
            "DOP853",
            dense_output=True,
            events=turns,
            rtol=1e-11,
            atol=1e-13,
            max_step=0.02,
        )
        here = (t >= now) & (t <= solved.t[-1])
        x[here], v[here] = solved.sol(t[here])
        now, place, speed = solved.t[-1], solved.y[0, -1], 0.0
        grid = np.arange(now, t[-1] + 1e-4, 1e-4)  # stuck until the push beats the friction
        free = next(((g, d) for g in grid for d in (1.0, -1.0) if d * acceleration(g, 0.0, d) > 0), None)
        until, s = free or (t[-1], s)
        still = (t > now) & (t <= until)
        x[still], v[still] = place, 0.0
        now = until + 1e-9
    return t, x, v


def seen(t, x, v, sigma, seed, *, push=drive, name="run", **known):
    """The run as a camera of white noise saw it; its motion is the true one, its noise the camera's."""
    nan, one = np.full(len(t), np.nan), np.ones(len(t))
    y = x + sigma * np.random.default_rng(seed).standard_normal(len(t))
    disp = Displacement(t, y, nan, nan, sigma * one, nan, np.ones(len(t), bool), pixel_pitch=5e-4)
    motion = Motion(t, x, v, np.gradient(v, t), nan, sigma * one, 5e-3 * one, one, nan, guard=5, cutoff=50.0)
    return Run(disp, motion, mass=known.pop("mass", None), name=name, drive=push(t), **known)


@pytest.fixture(scope="module")
def course():
    return slide()


def z_of(found, **truth):
    return {k: (found.parameters[k].value - v) / found.parameters[k].std for k, v in truth.items()}


TRUTH = {"mass.m": MASS, "coulomb.F_c": F_C, "viscous.F_v": F_V}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("repeats", "margin"),
    [(18, 0.5), (120, 0.1)],  # margin over deviation: 3 and 1.5
)
def test_the_mass_comes_back_within_its_deviation(course, repeats, margin):
    sigmas, z = (2e-6, 10e-6, 50e-6), {k: [] for k in TRUTH}
    for seed in range(100, 100 + repeats):
        found = fit(LAW, [seen(*course, sigmas[seed % 3], seed)])
        assert found.lengths == (0,)  # the law is right: nothing to forget, followed through in one piece
        for k, value in z_of(found, **TRUTH).items():
            z[k].append(value)
    rms = {k: np.sqrt(np.mean(np.square(values))) for k, values in z.items()}
    assert 1 - margin < rms["mass.m"] < 1 + margin, rms
    assert all(1 - 2 * margin < value < 1 + 2 * margin for value in rms.values()), rms


def test_the_weighed_slider_has_the_same_friction(course):
    sought, known = (fit(LAW, [seen(*course, 1e-5, 3, mass=mass)]) for mass in (None, MASS))
    for k in ("coulomb.F_c", "viscous.F_v"):
        assert sought.parameters[k].value == pytest.approx(known.parameters[k].value, abs=3 * sought.parameters[k].std)
        assert sought.parameters[k].std > known.parameters[k].std
    assert sought.model.names == known.model.names == ["coulomb", "viscous"]
    assert sought.parameters["mass.m"].unit == "kg"
    assert "mass.m" not in known.parameters


def test_errors_and_curves_are_in_newtons_of_the_fitted_mass(course):
    run = seen(*course, 1e-5, 4)
    found = fit(LAW, [run])
    mass = found.parameters["mass.m"].value
    for curve in found.curves:
        pushed = np.interp(curve.t, run.displacement.t, run.drive)
        np.testing.assert_allclose(curve.F_model, pushed - mass * curve.a_model, atol=1e-2)  # N of some 20 N
        np.testing.assert_allclose(sum(curve.parts.values()), curve.F_model, rtol=1e-12)
        assert set(curve.parts) == {"coulomb", "viscous"}
    assert found.errors["relative_force_error"] < 0.02
    assert to_builtins(found.summary())["model"] == ["coulomb", "viscous"]
    assert found.runs[0].mass is None  # so that a further fit seeks it again


def test_gravity_along_the_course_does_not_depend_on_the_mass():
    tilted = slide(incline=0.05, duration=1.2)
    found = fit(LAW, [seen(*tilted, 1e-5, 5, incline=0.05, has_incline=True)])
    assert all(abs(z) < 3.5 for z in z_of(found, **TRUTH).values())


def test_several_runs_share_one_mass(course):
    runs = [seen(*course, 1e-5, seed, name=f"r{seed}") for seed in (1, 2)]
    one, both = fit(LAW, runs[:1]), fit(LAW, runs)
    assert both.parameters["mass.m"].value == pytest.approx(MASS, abs=3.5 * both.parameters["mass.m"].std)
    assert both.parameters["mass.m"].std < 0.8 * one.parameters["mass.m"].std


def test_a_validation_run_is_predicted_with_the_fitted_mass(course):
    runs = [seen(*course, 1e-5, 1, name="a"), seen(*course, 1e-5, 2, name="b", role="validation")]
    rows = fit(LAW, runs).summary()["per_run"]
    assert rows[1]["errors"]["rms_displacement_um"] == pytest.approx(10.0, rel=0.1)
    assert rows[1]["errors"]["relative_force_error"] == pytest.approx(
        rows[0]["errors"]["relative_force_error"], rel=0.2
    )


def test_the_force_of_a_validation_run_is_measured_with_the_mass_that_its_drive_determines(course):
    weighed, _ = _with_fitted_mass(seen(*course, 1e-5, 2, name="b", role="validation"))
    assert (weighed.mass, weighed.role) == (pytest.approx(MASS, rel=0.01), "validation")


@pytest.mark.parametrize("domain", ["displacement", "force"])
def test_a_stored_fit_is_rebuilt_with_its_mass(course, domain):
    runs = [seen(*course, 1e-5, 6)]
    found = fit(LAW, runs, domain=domain)
    again = restore(runs, state(found))
    assert again.parameters["mass.m"].value == pytest.approx(found.parameters["mass.m"].value, rel=1e-9)
    for k, e in found.parameters.items():
        assert again.parameters[k].value == pytest.approx(e.value, rel=1e-6)
        assert again.parameters[k].std == pytest.approx(e.std, rel=1e-3)


def test_the_force_domain_finds_the_mass_too(course):
    found = fit(LAW, [seen(*course, 1e-5, 7)], domain="force")
    assert found.parameters["mass.m"].value == pytest.approx(MASS, rel=0.02)
    assert found.parameters["mass.m"].std > 0


def test_a_search_finds_the_mass_too(course):
    found = fit(LAW, [seen(*course, 1e-5, 8)], search="de", rng=1)
    assert found.parameters["mass.m"].value == pytest.approx(MASS, rel=0.01)
    assert found.parameters["coulomb.F_c"].value == pytest.approx(F_C, rel=0.02)


def test_a_constant_push_one_way_tells_no_mass():
    def push(t):
        return 14.0 + 0.0 * t

    t, x, v = slide(push=push, duration=0.6)
    found = fit("coulomb,viscous", [seen(t, x, v, 1e-5, 9, push=push)])
    for address in ("mass.m", "coulomb.F_c", "viscous.F_v"):
        assert found.parameters[address].value is None
        assert found.parameters[address].reason


# ---------------------------------------------------------------- refused


def test_without_a_measured_drive_a_run_needs_a_mass(course):
    t, x, v = course
    with pytest.raises(FrictrackError, match=r"friction \(friction_N\), or with a measured drive") as caught:
        replace(seen(t, x, v, 1e-5, 0), drive=None)
    assert "expected a mass but got none" in str(caught.value)
    undriven = replace(seen(t, x, v, 1e-5, 0, name="slow"), drive=None, friction_N=np.full(len(t), F_C))
    with pytest.raises(FrictrackError, match=r'run "slow": expected a mass .* and give mass, or measure'):
        fit(LAW, [undriven], domain="displacement")


def test_one_mass_is_sought_for_all_runs_or_for_none(course):
    runs = [seen(*course, 1e-5, 1, name="a"), seen(*course, 1e-5, 2, name="b", mass=MASS)]
    with pytest.raises(FrictrackError, match="one mass to be fitted for all runs but only a of 2 runs leave it"):
        fit(LAW, runs)
