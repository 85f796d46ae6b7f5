"""Simulate a motion under friction with memory, independently of the library's integrator.

The state is integrated together with the motion by `DOP853` (Hairer, Norsett & Wanner 1993, Solving Ordinary
Differential Equations I), from rest, in one direction, up to the stop:

    friction lag   du/dt = (c(v) - u)/tau,                 dry friction s u instead of s c(v)
    presliding     dw/dt = (v/length)(1 - w s),            dry friction w c(v)
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from frictrack.errors import FrictrackError
from frictrack.models import Model, Values
from frictrack.records import Array
from frictrack.simulate import Conditions, Trajectory, image_shift

RTOL, ATOL = 1e-10, 1e-12
FrictionParts = Callable[[float, float, float], tuple[float, float]]  # x, v, t -> size of dry friction, other force; N


def simulate_memory(
    model: Model, values: Values, conditions: Conditions, t: Array, start: tuple[float, float]
) -> Trajectory:
    """Simulate a run under a model with one effect with memory, friction_lag or presliding.

    Parameters
    ----------
    model, values, conditions
        As in `frictrack.simulate.simulate`.
    t
        Times of the frames, s, shape (n,).
    start
        Position (m) and velocity (m/s) at t[0].

    Returns
    -------
    Trajectory
        Motion at the frames.

    Raises
    ------
    FrictrackError
        If the mass does not start, or the integration fails.

    """
    lag = "friction_lag" in model
    name = "friction_lag" if lag else "presliding"
    scale = float(values[name]["tau" if lag else "stiffness"])
    push = conditions.drive or np.zeros_like
    s = float(np.sign(start[1] or push(t[:: len(t) // 50])[np.argmax(np.abs(push(t[:: len(t) // 50])))]))
    friction_parts = _friction_parts(model - name, values, conditions, s)

    def friction(now: float, y: Array) -> float:
        size, rest = friction_parts(y[0], y[1], now)
        return (s * y[2] if lag else y[2] * size) + rest

    def motion(now: float, y: Array) -> list[float]:
        a = (float(push(np.array([now]))[0]) - friction(now, y)) / conditions.mass
        state_rate = (friction_parts(y[0], y[1], now)[0] - y[2]) / scale if lag else y[1] / scale * (1 - s * y[2])
        return [y[1], a, state_rate]

    size = friction_parts(start[0], start[1], float(t[0]))[0]
    state = np.array([*start, size if lag else s * float(start[1] != 0)])
    departure = float(t[0]) if start[1] or not lag else _departure_time(t, lambda now: s * push(now) - size)
    first_moving = int(np.searchsorted(t, departure))
    found = solve_ivp(motion, (departure, t[-1]), state, "DOP853", t[first_moving:], rtol=RTOL, atol=ATOL)
    if not found.success:
        raise FrictrackError(f"expected a motion that can be followed but got none: {found.message}")
    y = np.hstack([np.tile(state[:, None], first_moving), found.y])
    stopped = np.flatnonzero((s * y[1] <= 0) & (np.arange(len(t)) > first_moving + 1))
    if len(stopped):  # at rest from here on
        y[:, stopped[0] :] = y[:, stopped[:1]]
        y[1, stopped[0] :] = 0.0
    force = np.array([friction(float(now), state) for now, state in zip(t, y.T, strict=True)])
    shift = image_shift(model, values, conditions.path(y[0], y[1], t, s))
    return Trajectory(t, y[0], y[1], (push(t) - force) / conditions.mass, force, shift)


def _departure_time(t: Array, excess: Callable[[Array], Array]) -> float:
    """Time at which the drive overcomes friction at rest, s."""
    over = np.flatnonzero(excess(t) > 0)
    if not len(over):
        raise FrictrackError("expected a drive that overcomes friction but got a weaker one")
    first = int(over[0])
    if first == 0:
        return float(t[0])
    return float(brentq(lambda now: float(excess(np.array([now]))[0]), float(t[first - 1]), float(t[first])))


def _friction_parts(model: Model, values: Values, conditions: Conditions, s: float) -> FrictionParts:
    """Function of x, v, t that returns the size of dry friction and all other force, N."""

    def now(x: float, v: float, t: float) -> tuple[float, float]:
        path = conditions.path(np.array([x]), np.array([v]), np.array([t]), s)
        forces = {
            name: float((block @ model.coefficients(name, values))[0])
            for name, block in model.force_columns(path, values).items()
        }
        dry = sum(f for name, f in forces.items() if name in ("coulomb", "stribeck"))
        return s * dry, sum(forces.values()) - dry

    return now
