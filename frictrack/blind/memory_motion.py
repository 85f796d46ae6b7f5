"""Motion under friction with a memory, its state integrated beside the motion by an adaptive method of order 8.

Slower laws of the library (a lag, a contact that bends) are followed from rest, in one direction, up to the stop:

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
Law = Callable[[float, float, float], tuple[float, float]]  # x, v, t -> dry friction (size) and the rest, N


def simulate_memory(
    model: Model, values: Values, conditions: Conditions, t: Array, start: tuple[float, float]
) -> Trajectory:
    """The motion from rest (or in motion) at start = (x m, v m/s) through the frame times t (n,), s.

    One effect of the model has a memory: friction_lag or presliding. Raises FrictrackError where it does not move.
    """
    lag = "friction_lag" in model
    name = "friction_lag" if lag else "presliding"
    scale = float(values[name]["tau" if lag else "stiffness"])
    push = conditions.drive or np.zeros_like
    s = float(np.sign(start[1] or push(t[:: len(t) // 50])[np.argmax(np.abs(push(t[:: len(t) // 50])))]))
    law = _friction_parts(model - name, values, conditions, s)

    def friction(at: float, y: Array) -> float:
        size, rest = law(y[0], y[1], at)
        return (s * y[2] if lag else y[2] * size) + rest

    def motion(at: float, y: Array) -> list[float]:
        a = (float(push(np.array([at]))[0]) - friction(at, y)) / conditions.mass
        late = (law(y[0], y[1], at)[0] - y[2]) / scale if lag else y[1] / scale * (1 - s * y[2])
        return [y[1], a, late]

    size = law(start[0], start[1], float(t[0]))[0]
    state = np.array([*start, size if lag else s * float(start[1] != 0)])
    departure = float(t[0]) if start[1] or not lag else _departure_time(t, lambda at: s * push(at) - size)
    first_moving = int(np.searchsorted(t, departure))
    found = solve_ivp(motion, (departure, t[-1]), state, "DOP853", t[first_moving:], rtol=RTOL, atol=ATOL)
    if not found.success:
        raise FrictrackError(f"expected a motion that can be followed but got none: {found.message}")
    y = np.hstack([np.tile(state[:, None], first_moving), found.y])
    stopped = np.flatnonzero((s * y[1] <= 0) & (np.arange(len(t)) > first_moving + 1))
    if len(stopped):  # from here on it rests
        y[:, stopped[0] :] = y[:, stopped[:1]]
        y[1, stopped[0] :] = 0.0
    force = np.array([friction(float(at), state) for at, state in zip(t, y.T, strict=True)])
    shift = image_shift(model, values, conditions.path(y[0], y[1], t, s))
    return Trajectory(t, y[0], y[1], (push(t) - force) / conditions.mass, force, shift)


def _departure_time(t: Array, excess: Callable[[Array], Array]) -> float:
    """When the drive overcomes friction at rest, s."""
    over = np.flatnonzero(excess(t) > 0)
    if not len(over):
        raise FrictrackError("expected a drive that overcomes friction but got a weaker one")
    first = int(over[0])
    if first == 0:
        return float(t[0])
    return float(brentq(lambda at: float(excess(np.array([at]))[0]), float(t[first - 1]), float(t[first])))


def _friction_parts(model: Model, values: Values, conditions: Conditions, s: float) -> Law:
    """Size of the dry friction and all other force, at one moment."""

    def at(x: float, v: float, t: float) -> tuple[float, float]:
        path = conditions.path(np.array([x]), np.array([v]), np.array([t]), s)
        forces = {
            name: float((block @ model.coefficients(name, values))[0])
            for name, block in model.force_columns(path, values).items()
        }
        dry = sum(f for name, f in forces.items() if name in ("coulomb", "stribeck"))
        return s * dry, sum(forces.values()) - dry

    return at
