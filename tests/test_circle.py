"""A circular course: x along it, the load of m v^2/R, and gravity along a circle that stands upright."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

import frictrack as ft
from frictrack.measure.calibration.circle import fit_circle, on_circle
from frictrack.measure.plausibility import missing_incline

G, NOISE = 9.80665, 1e-5  # m/s^2, m


def slide(acceleration, start, duration, fps):
    """Arc length of a bead under an acceleration of arc length and velocity, by SciPy, until it is slow."""

    def slow(t, y):
        return abs(y[1]) - 0.02

    slow.terminal, slow.direction = True, -1
    y = solve_ivp(
        lambda t, y: [y[1], acceleration(*y)], (0, duration), start, events=slow, rtol=1e-10, atol=1e-12,
        dense_output=True, max_step=0.01,
    )  # fmt: skip
    t = np.arange(0, y.t[-1], 1 / fps)
    return t, y.sol(t)[0]


def run_on_circle(t, arc, radius, rng, **settings):
    """A run of tracked x, y on a circle about a centre that is no origin."""
    angle = arc / radius
    x, y = 0.3 + radius * np.sin(angle), 1.1 - radius * np.cos(angle)
    columns = {"t_s": t, "x_m": x + NOISE * rng.standard_normal(len(t)), "y_m": y + NOISE * rng.standard_normal(len(t))}
    return ft.Run.from_dataframe(pd.DataFrame(columns), **settings)


def on_ring(friction, mass, radius, rng):
    """Three slides on a ring that lies flat."""

    def acceleration(x, v):
        return -friction * np.hypot(G, v * v / radius) * np.sign(v)

    for v in (1.8, 1.2, 2.3):
        yield run_on_circle(*slide(acceleration, (0.0, v), 5.0, 500), radius, rng, mass=mass, name=f"v{v}")


def in_loop(friction, mass, radius, rng):
    """Three slides in an upright loop, one the other way; the camera leans by 2 degrees."""
    lean = np.radians(2.0)

    def acceleration(x, v):
        return -G * np.sin(x / radius) - friction * abs(G * np.cos(x / radius) + v * v / radius) * np.sign(v)

    for x, v in ((-0.05, 4.0), (0.3, -4.2), (0.1, 4.3)):
        t, arc = slide(acceleration, (x, v), 0.6, 1000)
        yield run_on_circle(t, arc + radius * lean, radius, rng, mass=mass, name=f"v{v}", incline=-lean)


@pytest.mark.parametrize("course", [on_ring, in_loop])
def test_the_load_on_a_circle_follows_the_speed(course):
    """Coulomb friction with mu N comes out right although N is more than twice m g; nothing else is found."""
    friction, mass = 0.12, 0.2
    runs = list(course(friction, mass, 0.25, np.random.default_rng(4)))
    fit = ft.fit(["coulomb"], runs)
    level = fit.parameters["coulomb.F_c"]
    assert abs(level.value / (mass * G) - friction) < 4 * level.std / (mass * G) < 2e-4 * friction
    assert fit.reduced_chi2 < 1.15
    assert ft.diagnose(fit).verdict == "complete"


def test_a_pendulum_of_stated_radius():
    """An arc length without y: with radius and incline gravity is a sine of the place, here far beyond small angles."""
    radius, mass, viscous = 0.5, 0.2, 0.02
    t = np.arange(0, 6.0, 1 / 200)
    swing = solve_ivp(
        lambda t, y: [y[1], -G * np.sin(y[0] / radius) - viscous / mass * y[1]], (0, 6), (1.0, 0.0), t_eval=t,
        rtol=1e-11, atol=1e-13,
    )  # fmt: skip
    x = swing.y[0] + NOISE * np.random.default_rng(5).standard_normal(len(t))
    run = ft.Run.from_arrays(t, x, mass=mass, radius=radius, incline=0.0, noise=NOISE)
    fit = ft.fit(["viscous"], [run])
    assert fit.model.names == ["viscous", "gravity"]
    found = fit.parameters["viscous.F_v"]
    assert abs(found.value - viscous) < 4 * found.std < 0.01 * viscous
    assert fit.reduced_chi2 < 1.15


def test_what_is_a_circle():
    """A lens bends a straight path by less, a thrown ball's parabola is no circle."""
    x = np.linspace(-1, 1, 200)
    assert fit_circle(np.column_stack([x, 0.01 * x**2])) is None
    assert fit_circle(np.column_stack([x, 2 - 2 * x**2])) is None
    assert fit_circle(np.column_stack([np.cos(3 * x), np.sin(3 * x)])).radius == pytest.approx(1.0)


def test_a_pendulum_without_an_incline_is_told_what_to_write():
    """A bob that speeds up on a circle needs the word that the circle stands upright."""
    t = np.arange(0, 0.3, 1 / 500)
    y = solve_ivp(lambda t, y: [y[1], -G * np.sin(y[0] / 0.5)], (0, 0.3), (-0.4, 0.0), t_eval=t, rtol=1e-9).y[0]
    run = run_on_circle(t, y, 0.5, np.random.default_rng(6), mass=0.2)
    assert missing_incline(run).correction == 'incline = "0 deg"'
    with pytest.raises(ft.FrictrackError, match="no normal load, of a run on a circle"):
        ft.Run(run.displacement, run.motion, mass=0.2, normal_load=2.0, has_incline=True)


def test_the_load_follows_the_gravity_that_is_fitted():
    """A tracked point off the centre of mass has another radius and lowest place: g and slope take both up."""
    friction, mass, radius, rng = 0.12, 0.2, 0.25, np.random.default_rng(7)

    def acceleration(x, v):
        return -G * np.sin(x / radius) - friction * abs(G * np.cos(x / radius) + v * v / radius) * np.sign(v)

    runs = []
    for start, (off, lean) in {(-0.05, 4.0): (-1e-3, 3e-3), (0.3, -4.2): (5e-4, -4e-3)}.items():
        t, arc = slide(acceleration, start, 0.6, 1000)
        x = (radius + off) * (arc / radius + lean) + NOISE * rng.standard_normal(len(t))
        known = {"radius": radius + off, "sigma_radius": 1e-3, "incline": 0.0, "noise": NOISE}
        runs.append(ft.Run.from_arrays(t, x, mass=mass, name=f"v{start[1]}", **known))
    fit = ft.fit(["coulomb"], runs)
    level = fit.parameters["coulomb.F_c"]
    assert abs(level.value / (mass * G) - friction) < 4 * level.std / (mass * G) < 1e-3 * friction
    assert fit.parameters["gravity.g[v4.0]"].value == pytest.approx(G * (1 - 1e-3 / radius), rel=5e-4)
    assert fit.reduced_chi2 < 1.15
    assert ft.diagnose(fit).verdict == "complete"


def test_what_leaves_the_circle_is_an_error_along_it():
    """A tracker's error that depends on the angle shows in y, and x is as uncertain; white noise alone does not."""
    angle = np.linspace(-1.0, 1.2, 400)
    for rms in (0.0, 2e-5):
        run = run_on_circle(angle / 4, 0.25 * angle, 0.25, np.random.default_rng(8), mass=0.2)
        off = run.displacement.y + np.sqrt(2) * rms * np.sin(25 * angle)
        seen = replace(
            run.displacement, x=(0.25 + off) * np.sin(angle), y=-(0.25 + off) * np.cos(angle), radius=None, notes=()
        )
        assert on_circle(seen).systematic == pytest.approx(rms, abs=5e-6)
        assert on_circle(seen, 0.05).x - on_circle(seen).x == pytest.approx(0.05)


@pytest.mark.usefixtures("no_formulas")
def test_air_drag_of_a_pendulum_that_swings_far():
    """Swings of 1.6 rad: g is one unknown, and the drag that the first model lacks is named and fitted."""
    radius, law = 0.153, {"coulomb.F_c": 0.002, "viscous.F_v": 0.02, "drag.c": 0.02}
    friction, viscous, drag = law.values()

    def rates(t, y):
        load = abs(np.cos(y[0] / radius) + y[1] ** 2 / radius / G)
        pull = -G * np.sin(y[0] / radius)
        return y[1], pull - viscous * y[1] - drag * y[1] * abs(y[1]) - friction * load * np.tanh(y[1] / 1e-5)

    t, runs = np.arange(0, 9.2, 0.005), []
    for i, x0 in enumerate((-1.6, 1.5, -1.0)):
        x = solve_ivp(rates, (0, 9.2), (x0 * radius, 0), t_eval=t, rtol=1e-9, atol=1e-12).y[0]
        x += 5e-6 * np.random.default_rng(i).standard_normal(len(t))
        known = {"radius": f"{radius} +/- 0.0005 m", "incline": "0 +/- 0.2 deg"}
        runs.append(ft.Run.from_arrays(t, x, mass=1.0, name=f"r{i}", **known))
    assert ft.diagnose(ft.fit(["coulomb", "viscous"], runs), quick=True).missing == ["drag"]
    fit = ft.fit(["coulomb", "viscous", "drag"], runs)
    assert fit.reduced_chi2 < 1.1
    for name, right in law.items():
        assert abs(fit.parameters[name].value - right) < 3 * fit.parameters[name].std < 0.1 * right
