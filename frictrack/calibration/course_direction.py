"""The direction of the course: image right, as given, or that of the path itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frictrack.calibration.plane import PlaneMap
from frictrack.errors import FrictrackError
from frictrack.records import Array

Axis = Sequence[float] | str | None

STEEP_ANGLE = np.radians(60)  # a steeper path in the picture has +x downward, a flatter one +x to the right
MIN_REPORTED_ANGLE = np.radians(1)  # between course and axis
MIN_ANGLE_SIGMAS = 3.0  # standard deviations of the angle from which it is reported
MAX_ROUNDS = 8  # of robust reweighting
MIN_FRAMES = 8
MIN_TRAVEL_SIGMAS = 20.0  # standard deviations a target must travel for its path to have a direction


@dataclass(frozen=True, eq=False)
class PathLine:
    """The direction of a path in the plane: a unit vector, the angle's deviation and the bend over its length, rad."""

    direction: Array
    std: float
    bend: float
    bend_std: float


def directions(axis: Axis) -> tuple[Array, Array]:
    """Unit vectors in the picture along the course and across it, the second pointing up (y is down)."""
    wrong = FrictrackError(f'expected the course axis as [dx, dy] px or "track" but got {axis!r}')
    if isinstance(axis, str) and axis != "track":
        raise wrong
    try:
        direction = np.asarray([1.0, 0.0] if axis is None or isinstance(axis, str) else axis, dtype=np.float64)
    except (TypeError, ValueError) as e:
        raise wrong from e
    if direction.shape != (2,) or not np.all(np.isfinite(direction)) or not np.any(direction):
        raise wrong
    direction = direction / np.hypot(*direction)
    across = np.array([direction[1], -direction[0]])
    return direction, -across if across[1] > 0 else across


def axes_in_plane(plane: PlaneMap, direction: Array, across: Array) -> tuple[Array, Array]:
    """The same in the plane of the course: `direction` as the map turns it, the other at a right angle to it."""
    jacobian = plane.jacobian(np.array([plane.centre]))[0]
    if not np.all(np.isfinite(jacobian)):
        raise FrictrackError("the calibration gives no direction at its own middle; check its points")
    x = jacobian @ direction
    x = x / np.hypot(*x)
    y = np.array([-x[1], x[0]])
    return x, y if y @ jacobian @ across >= 0 else -y


def fit_path(at: Array, sigma: Array) -> PathLine | None:
    """Robust line through places (n, 2) m with standard deviations (n,); None where nothing travels far enough."""
    if len(at) < MIN_FRAMES:
        return None
    middle = np.median(at, axis=0)
    offsets = at - middle
    direction = np.linalg.svd(offsets, full_matrices=False)[2][0]
    weight = np.ones(len(at))
    for _ in range(MAX_ROUNDS):
        middle = np.average(at, axis=0, weights=weight)
        offsets = at - middle
        direction = np.linalg.svd(offsets * np.sqrt(weight)[:, None], full_matrices=False)[2][0]
        deviation = offsets @ [-direction[1], direction[0]]
        scale = max(1.4826 * float(np.median(np.abs(deviation))), float(np.median(sigma)))
        weight = np.minimum(1.0, 2.0 * scale / np.maximum(np.abs(deviation), 1e-30))
    s = offsets @ direction
    if np.ptp(s) < MIN_TRAVEL_SIGMAS * float(np.median(sigma)):
        return None
    noise = float(np.median(sigma))
    return _fit_bend(direction, np.stack([s, offsets @ [-direction[1], direction[0]]]), weight, noise)


def _fit_bend(direction: Array, place: Array, weight: Array, noise: float) -> PathLine:
    """Angle and bend from a parabola across the path; neighbours that are wrong together count as fewer."""
    s, deviation = place
    half = float(np.ptp(s)) / 2
    u = (s - (s.min() + s.max()) / 2) / half
    root = np.sqrt(weight)
    design = np.stack([np.ones_like(u), u, u**2], axis=1) * root[:, None]
    shape = np.linalg.lstsq(design, deviation * root, rcond=None)[0]
    residual = deviation - np.stack([np.ones_like(u), u, u**2], axis=1) @ shape
    spread = 1.4826 * float(np.median(np.abs(residual)))
    std = (
        max(spread, noise)
        * np.sqrt(frames_per_independent(residual))
        * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    )
    return PathLine(direction, float(std[1] / half), float(4 * shape[2] / half), float(4 * std[2] / half))


def frames_per_independent(residual: Array) -> float:
    """How many residuals (n,) count as one, by the correlation of neighbours; 1 at the least."""
    correlation = float(np.sum(residual[1:] * residual[:-1]) / max(float(np.sum(residual**2)), 1e-300))
    return max((1 + correlation) / max(1 - correlation, 1e-3), 1.0)


def orient_forward(direction: Array, jacobian: Array) -> Array:
    """The direction with the sign that all runs of a camera share; `jacobian` (2, 2) m/px leads from the picture."""
    in_picture = np.linalg.solve(jacobian, direction)
    steep = abs(in_picture[1]) > np.tan(STEEP_ANGLE) * abs(in_picture[0])
    return direction if (in_picture[1] if steep else in_picture[0]) > 0 else -direction


def direction_notes(line: PathLine | None, x: Array, axis: Axis) -> tuple[str, ...]:
    """What the path's direction has against the axis, in words, with what it costs."""
    if line is None:
        return ()
    notes = []
    angle = float(np.arccos(min(abs(float(line.direction @ x)), 1.0)))
    if axis is None and angle > MIN_REPORTED_ANGLE and angle > MIN_ANGLE_SIGMAS * line.std:
        notes.append(
            f"the path runs {np.degrees(angle):.1f}° ± {np.degrees(line.std):.2g}° off the picture's axis, so that "
            f"displacement and force come out {100 * (1 - np.cos(angle)):.2g} % too small (1 - cos); "
            'axis = "track" follows the path'
        )
    if isinstance(axis, str):
        notes.append(
            f"x runs along the path itself, which is {np.degrees(line.std):.2g}° sure "
            f"({50 * line.std**2:.1g} % of a length)"
        )
    bend = abs(line.bend)
    if bend > MIN_REPORTED_ANGLE and bend > MIN_ANGLE_SIGMAS * line.bend_std:
        notes.append(
            f"the path bends by {np.degrees(bend):.1f}° from end to end: along a straight axis displacement comes "
            f"out up to {100 * (1 - np.cos(bend / 2)):.2g} % too small at the ends (1 - cos); correct the lens, or "
            "film a straighter course"
        )
    return tuple(notes)
