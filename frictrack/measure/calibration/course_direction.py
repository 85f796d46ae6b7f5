"""Determine the direction of the course: image right, a given axis, or the direction of the path.

Follow the point of a rotating target that moves along a straight course: its centre of mass, as far as visible.

A point at (a, b) from the tracked one, in the target's own axes, is at p + R(angle) (a, b). Across the course nothing
drives the mass: its own path is smooth there, and any part proportional to the rotation is due to the arm (a, b). A
target that rocks by a few degrees rotates about its contact instead and is not changed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictrack.base.distributions import robust_std
from frictrack.base.errors import FrictrackError
from frictrack.measure.calibration.scale import PlaneMap
from frictrack.records import Array, Track

Axis = Sequence[float] | str | None

STEEP_ANGLE = np.radians(60)  # a steeper path in the picture has +x downward, a flatter one +x to the right
MIN_REPORTED_ANGLE = np.radians(1)  # between course and axis
MIN_ANGLE_SIGMAS = 3.0  # standard deviations of the angle from which it is reported
MAX_ROUNDS = 8  # of robust reweighting
MIN_FRAMES = 8
MIN_TRAVEL_SIGMAS = 20.0  # standard deviations a target must travel for its path to have a direction


@dataclass(frozen=True, eq=False)
class PathLine:
    """Direction of a path in the plane.

    Attributes
    ----------
    direction : array (2,)
        Unit vector.
    std : float
        Standard deviation of its angle, rad.
    bend, bend_std : float
        Change of direction over the path and its standard deviation, rad.

    """

    direction: Array
    std: float
    bend: float
    bend_std: float


def directions(axis: Axis) -> tuple[Array, Array]:
    """Compute unit vectors in the picture along and across the course.

    Parameters
    ----------
    axis : sequence of float, "track" or None
        Direction [dx, dy] px with y down; "track" and None stand for image right.

    Returns
    -------
    along, across : array (2,)
        The second points up (y is down).

    Raises
    ------
    FrictrackError
        For anything else.

    Examples
    --------
    >>> along, across = directions([0, 2])
    >>> along.tolist(), abs(across).tolist()
    ([0.0, 1.0], [1.0, 0.0])

    """
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
    """Transform the directions along and across the course to the plane.

    Parameters
    ----------
    plane : PlaneMap
        Map from the picture to the plane.
    direction, across : array (2,)
        Directions in the picture.

    Returns
    -------
    x, y : array (2,)
        Orthogonal unit vectors in the plane.

    Raises
    ------
    FrictrackError
        Where the map has no direction at its centre.

    """
    jacobian = plane.jacobian(np.array([plane.centre]))[0]
    if not np.all(np.isfinite(jacobian)):
        raise FrictrackError("the calibration gives no direction at its own middle; check its points")
    x = jacobian @ direction
    x = x / np.hypot(*x)
    y = np.array([-x[1], x[0]])
    return x, y if y @ jacobian @ across >= 0 else -y


def fit_path(at: Array, sigma: Array) -> PathLine | None:
    """Fit a robust line to the path of a target.

    The weights are those of Huber (1964, Ann. Math. Stat. 35:73), iterated.

    Parameters
    ----------
    at : array (n, 2)
        Positions, m.
    sigma : array (n,)
        Standard deviations across the path, m.

    Returns
    -------
    PathLine or None
        None where the target does not travel far enough.

    """
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
        scale = max(float(robust_std(deviation)), float(np.median(sigma)))
        weight = np.minimum(1.0, 2.0 * scale / np.maximum(np.abs(deviation), 1e-30))
    s = offsets @ direction
    if np.ptp(s) < MIN_TRAVEL_SIGMAS * float(np.median(sigma)):
        return None
    noise = float(np.median(sigma))
    return _fit_bend(direction, np.stack([s, offsets @ [-direction[1], direction[0]]]), weight, noise)


def _fit_bend(direction: Array, place: Array, weight: Array, noise: float) -> PathLine:
    """Fit angle and bend by a parabola across the path; correlated residuals reduce the number of frames that count."""
    s, deviation = place
    half = float(np.ptp(s)) / 2
    u = (s - (s.min() + s.max()) / 2) / half
    root = np.sqrt(weight)
    design = np.stack([np.ones_like(u), u, u**2], axis=1) * root[:, None]
    shape = np.linalg.lstsq(design, deviation * root, rcond=None)[0]
    residual = deviation - np.stack([np.ones_like(u), u, u**2], axis=1) @ shape
    spread = float(robust_std(residual))
    std = (
        max(spread, noise)
        * np.sqrt(frames_per_independent(residual))
        * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    )
    return PathLine(direction, float(std[1] / half), float(4 * shape[2] / half), float(4 * std[2] / half))


def frames_per_independent(residual: Array) -> float:
    """Compute how many correlated residuals count as one independent one.

    Parameters
    ----------
    residual : array (n,)
        Residuals in order.

    Returns
    -------
    float
        (1 + r) / (1 - r) with r the correlation of neighbours; at least 1.

    Examples
    --------
    >>> frames_per_independent(np.array([1.0, -1.0, 1.0, -1.0]))
    1.0

    """
    correlation = float(np.sum(residual[1:] * residual[:-1]) / max(float(np.sum(residual**2)), 1e-300))
    return max((1 + correlation) / max(1 - correlation, 1e-3), 1.0)


def orient_forward(direction: Array, jacobian: Array) -> Array:
    """Choose the sign of a direction that all runs of a camera share.

    Parameters
    ----------
    direction : array (2,)
        Unit vector in the plane.
    jacobian : array (2, 2)
        Derivative of the plane by the picture, m/px.

    Returns
    -------
    array (2,)
        Pointing right in the picture, or down where it is steeper than `STEEP_ANGLE`.

    """
    in_picture = np.linalg.solve(jacobian, direction)
    steep = abs(in_picture[1]) > np.tan(STEEP_ANGLE) * abs(in_picture[0])
    return direction if (in_picture[1] if steep else in_picture[0]) > 0 else -direction


def direction_notes(line: PathLine | None, x: Array, axis: Axis) -> tuple[str, ...]:
    """Describe how the direction of the path differs from the axis, and the resulting error.

    Parameters
    ----------
    line : PathLine or None
        Direction of the path.
    x : array (2,)
        Axis in the plane.
    axis : sequence of float, "track" or None
        Axis as it was given.

    Returns
    -------
    tuple of str
        Notes for the user.

    """
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
            f"x follows the path, whose direction is known to {np.degrees(line.std):.2g}° "
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


MIN_ROTATION = np.pi / 2  # rad; a target that turns farther is seen along its axis, and does not rock on its course
MIN_ROTATING_FRAMES = 24
MIN_ARM_SIGMAS = 5.0  # standard deviations of the arm from which the point is moved
MAX_ARM_ERROR = 0.2  # of the arm, that its standard deviation may be
N_ROUNDS = 4  # of the direction of the course and the arm; two are enough where the path is long


def follow_straight_point(track: Track) -> tuple[Track, tuple[str, ...]]:
    """Move a track to the point of the target that moves along a straight course.

    Parameters
    ----------
    track : Track
        Positions (px, y down) and angles (rad, from x to y) of the tracked point.

    Returns
    -------
    track : Track
        The same track where the target rotates by less than a quarter turn, or no arm is significant.
    notes : tuple of str
        The length of the arm.

    """
    known = track.found & np.isfinite(track.angle)
    if np.count_nonzero(known) < MIN_ROTATING_FRAMES:
        return track, ()
    angle = np.full(len(track.angle), np.nan)
    angle[known] = np.unwrap(track.angle[known])
    if np.ptp(angle[known]) < MIN_ROTATION:
        return track, ()
    arm, std = _arm(np.stack([track.x_px, track.y_px], axis=1)[known], angle[known])
    length = float(np.hypot(*arm))
    if length < MIN_ARM_SIGMAS * std or std > MAX_ARM_ERROR * length:
        return track, ()
    offset = _turned(arm, angle)
    motion_per_rad = _turned(np.array([-arm[1], arm[0]]), angle)  # px per rad
    sigma_angle = np.zeros(len(angle)) if track.sigma_angle is None else track.sigma_angle
    note = (
        "the point of the rotating target that moves along a straight course is used: "
        f"{length:.3g} ± {std:.1g} px from the centre of its rectangle"
    )
    return replace(
        track,
        x_px=track.x_px + offset[:, 0],
        y_px=track.y_px + offset[:, 1],
        sigma_px=np.hypot(track.sigma_px, motion_per_rad[:, 0] * sigma_angle),
        sigma_y_px=np.hypot(track.sigma_y_px, motion_per_rad[:, 1] * sigma_angle),
        systematic=float(np.hypot(track.systematic, std)),
    ), (note,)


def _turned(arm: Array, angle: Array) -> Array:
    """Arm (2,) rotated by every angle (n,): (n, 2) px."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]], axis=1)


def _arm(place: Array, angle: Array) -> tuple[Array, float]:
    """Fit the arm (2,) px for which the path of places (n, 2) is smoothest across its direction; and its deviation."""
    at = np.zeros(2)
    for _ in range(N_ROUNDS):
        path = place + _turned(at, angle)
        direction = np.linalg.svd(path - path.mean(axis=0), full_matrices=False)[2][0]
        across = np.array([-direction[1], direction[0]])
        s = (path - path.mean(axis=0)) @ direction
        s = s / max(float(np.max(np.abs(s))), 1e-12)
        angle_columns = [_turned(unit, angle) @ across for unit in np.eye(2)]
        design = np.column_stack([*angle_columns, np.ones_like(s), s, s**2])
        coefficients, *_ = np.linalg.lstsq(design, -(place @ across), rcond=None)
        at = coefficients[:2]
    residual = -(place @ across) - design @ coefficients
    variance = (
        frames_per_independent(residual)
        * np.linalg.pinv(design.T @ design)[:2, :2]
        * np.sum(residual**2)
        / max(len(residual) - 5, 1)
    )
    return at, float(np.sqrt(max(np.trace(variance), 0.0)))
