"""Simulate a motion under friction with memory, independently of the library's integrator.

The state is integrated together with the motion by `DOP853` (Hairer, Norsett & Wanner 1993, Solving Ordinary
Differential Equations I), from rest, in one direction, up to the stop:

    friction lag   du/dt = (c(v) - u)/tau,                 dry friction s u instead of s c(v)
    presliding     dw/dt = (v/length)(1 - w s),            dry friction w c(v)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.integrate import DOP853
from scipy.optimize import brentq

from frictrack.effects import Path
from frictrack.errors import FrictrackError
from frictrack.models import Model, Values
from frictrack.records import Array
from frictrack.simulate import Conditions, Trajectory, image_shift

RTOL, ATOL = 1e-10, 1e-12


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
    way = _WaySoFar(conditions, start, s)
    parts_along = _friction_parts(model - name, values)

    def friction_parts(x: float, v: float, now: float) -> tuple[float, float]:
        size, rest = parts_along(way.path(x, v, now))
        return float(s * size[0]), float(rest[0])

    def motion(now: float, y: Array) -> Array:
        size, rest = friction_parts(y[0], y[1], now)
        a = (float(push(np.array([now]))[0]) - (s * y[2] if lag else y[2] * size) - rest) / conditions.mass
        return np.array([y[1], a, (size - y[2]) / scale if lag else y[1] / scale * (1 - s * y[2])])

    size = friction_parts(start[0], start[1], float(t[0]))[0]
    state = np.array([*start, size if lag else s * float(start[1] != 0)])
    departure = float(t[0]) if start[1] or not lag else _departure_time(t, lambda now: s * push(now) - size)
    first_moving = int(np.searchsorted(t, departure))
    moving = _followed(motion, departure, state, t[first_moving:], way)
    y = np.hstack([np.tile(state[:, None], first_moving), moving])
    stopped = np.flatnonzero((s * y[1] <= 0) & (np.arange(len(t)) > first_moving + 1))
    if len(stopped):  # at rest from here on
        y[:, stopped[0] :] = y[:, stopped[:1]]
        y[1, stopped[0] :] = 0.0
    path = conditions.path(y[0], y[1], t, s)
    size_along, rest_along = parts_along(path)
    force = (s * y[2] if lag else y[2] * s * size_along) + rest_along
    return Trajectory(t, y[0], y[1], (push(t) - force) / conditions.mass, force, image_shift(model, values, path))


class _WaySoFar:
    """The motion from release to the last step of the integration, for effects that depend on it."""

    def __init__(self, conditions: Conditions, start: tuple[float, float], s: float) -> None:
        self._conditions, self._start_x, self._s = conditions, start[0], s
        self._before: Array | None = None  # (3, k)

    def add(self, t: float, x: float, v: float) -> None:
        """Append a step."""
        step = np.array([[t], [x], [v]])
        self._before = step if self._before is None else np.hstack([self._before, step])

    def path(self, x: float, v: float, t: float) -> Path:
        """The path that consists of the present moment, with the way before it."""
        path = self._conditions.path(np.array([x]), np.array([v]), np.array([t]), self._s)
        return replace(path, begins=self._start_x, before=self._before)


def _followed(motion: Callable[[float, Array], Array], begin: float, state: Array, t: Array, way: _WaySoFar) -> Array:
    """States (3, n) at times t (n,) of a motion that begins at time `begin` in `state`."""
    solver = DOP853(motion, begin, state, float(t[-1]), rtol=RTOL, atol=ATOL)
    out, done = np.empty((3, len(t))), int(np.searchsorted(t, begin, side="right"))
    out[:, :done] = state[:, None]
    while done < len(t):
        way.add(solver.t, solver.y[0], solver.y[1])
        message = solver.step()
        if message is not None:
            raise FrictrackError(f"expected a motion that can be followed but got none: {message}")
        reached = int(np.searchsorted(t, solver.t, side="right"))
        out[:, done:reached] = solver.dense_output()(t[done:reached])
        done = reached
    return out


def _departure_time(t: Array, excess: Callable[[Array], Array]) -> float:
    """Time at which the drive overcomes friction at rest, s."""
    over = np.flatnonzero(excess(t) > 0)
    if not len(over):
        raise FrictrackError("expected a drive that overcomes friction but got a weaker one")
    first = int(over[0])
    if first == 0:
        return float(t[0])
    return float(brentq(lambda now: float(excess(np.array([now]))[0]), float(t[first - 1]), float(t[first])))


def _friction_parts(model: Model, values: Values) -> Callable[[Path], tuple[Array, Array]]:
    """Function of a path that returns dry friction and all other force along it, (n,) each, N."""

    def parts(path: Path) -> tuple[Array, Array]:
        zero = np.zeros(len(path.t))
        dry, rest = [zero], [zero]
        for name, block in model.force_columns(path, values).items():
            (dry if name in ("coulomb", "stribeck") else rest).append(block @ model.coefficients(name, values))
        return np.sum(dry, axis=0), np.sum(rest, axis=0)

    return parts
