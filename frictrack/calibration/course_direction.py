"""The direction of the course: image right, as given, or that of the path itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frictrack.calibration.plane import PlaneMap
from frictrack.errors import FrictrackError
from frictrack.records import Array

Axis = Sequence[float] | str | None

STEEP = np.radians(60)  # a path steeper than this in the picture has +x downward, a flatter one +x to the right
OFF = np.radians(1)  # between course and axis that is worth a word
SURE = 3.0  # standard deviations of the angle from which it is said
ROUNDS = 8
LEAST = 8  # frames
TRAVEL = 20.0  # standard deviations a target must travel for its path to have a direction


@dataclass(frozen=True, eq=False)
class Line:
    """The direction of a path in the plane: a unit vector, the angle's deviation and the bend over its length, rad."""

    along: Array
    std: float
    bend: float
    bend_std: float


def directions(axis: Axis) -> tuple[Array, Array]:
    """Unit vectors in the picture along the course and across it, the second pointing up (y is down)."""
    wrong = FrictrackError(f'expected the course axis as [dx, dy] px or "track" but got {axis!r}')
    if isinstance(axis, str) and axis != "track":
        raise wrong
    try:
        along = np.asarray([1.0, 0.0] if axis is None or isinstance(axis, str) else axis, dtype=np.float64)
    except (TypeError, ValueError) as e:
        raise wrong from e
    if along.shape != (2,) or not np.all(np.isfinite(along)) or not np.any(along):
        raise wrong
    along = along / np.hypot(*along)
    across = np.array([along[1], -along[0]])
    return along, -across if across[1] > 0 else across


def in_plane(plane: PlaneMap, along: Array, across: Array) -> tuple[Array, Array]:
    """The same in the plane of the course: `along` as the map turns it, the other at a right angle to it."""
    turn = plane.jacobian(np.array([plane.centre]))[0]
    if not np.all(np.isfinite(turn)):
        raise FrictrackError("the calibration gives no direction at its own middle; check its points")
    x = turn @ along
    x = x / np.hypot(*x)
    y = np.array([-x[1], x[0]])
    return x, y if y @ turn @ across >= 0 else -y


def path(at: Array, sigma: Array) -> Line | None:
    """Robust line through places (n, 2) m with standard deviations (n,); None where nothing travels far enough."""
    if len(at) < LEAST:
        return None
    middle = np.median(at, axis=0)
    away = at - middle
    along = np.linalg.svd(away, full_matrices=False)[2][0]
    weight = np.ones(len(at))
    for _ in range(ROUNDS):
        middle = np.average(at, axis=0, weights=weight)
        away = at - middle
        along = np.linalg.svd(away * np.sqrt(weight)[:, None], full_matrices=False)[2][0]
        off = away @ [-along[1], along[0]]
        scale = max(1.4826 * float(np.median(np.abs(off))), float(np.median(sigma)))
        weight = np.minimum(1.0, 2.0 * scale / np.maximum(np.abs(off), 1e-30))
    s = away @ along
    if np.ptp(s) < TRAVEL * float(np.median(sigma)):
        return None
    noise = float(np.median(sigma))
    return _line(along, np.stack([s, away @ [-along[1], along[0]]]), weight, noise)


def _line(along: Array, place: Array, weight: Array, noise: float) -> Line:
    """Angle and bend from a parabola across the path; neighbours that are wrong together count as fewer."""
    s, off = place
    half = float(np.ptp(s)) / 2
    u = (s - (s.min() + s.max()) / 2) / half
    root = np.sqrt(weight)
    design = np.stack([np.ones_like(u), u, u**2], axis=1) * root[:, None]
    shape = np.linalg.lstsq(design, off * root, rcond=None)[0]
    left = off - np.stack([np.ones_like(u), u, u**2], axis=1) @ shape
    spread = 1.4826 * float(np.median(np.abs(left)))
    std = (
        max(spread, noise) * np.sqrt(frames_per_independent(left)) * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    )
    return Line(along, float(std[1] / half), float(4 * shape[2] / half), float(4 * std[2] / half))


def frames_per_independent(left: Array) -> float:
    """How many residuals (n,) count as one, by the correlation of neighbours; 1 at the least."""
    correlation = float(np.sum(left[1:] * left[:-1]) / max(float(np.sum(left**2)), 1e-300))
    return max((1 + correlation) / max(1 - correlation, 1e-3), 1.0)


def forward(along: Array, turn: Array) -> Array:
    """The direction with the sign that all runs of a camera share; `turn` (2, 2) m/px leads from the picture."""
    seen = np.linalg.solve(turn, along)
    steep = abs(seen[1]) > np.tan(STEEP) * abs(seen[0])
    return along if (seen[1] if steep else seen[0]) > 0 else -along


def remarks(line: Line | None, x: Array, axis: Axis) -> tuple[str, ...]:
    """What the path's direction has against the axis, in words, with what it costs."""
    if line is None:
        return ()
    notes = []
    angle = float(np.arccos(min(abs(float(line.along @ x)), 1.0)))
    if axis is None and angle > OFF and angle > SURE * line.std:
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
    if bend > OFF and bend > SURE * line.bend_std:
        notes.append(
            f"the path bends by {np.degrees(bend):.1f}° from end to end: along a straight axis displacement comes "
            f"out up to {100 * (1 - np.cos(bend / 2)):.2g} % too small at the ends (1 - cos); correct the lens, or "
            "film a straighter course"
        )
    return tuple(notes)
