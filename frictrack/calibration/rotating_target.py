"""Follow the point of a rotating target that moves along a straight course: its centre of mass, as far as visible.

A point at (a, b) from the tracked one, in the target's own axes, is at p + R(angle) (a, b). Across the course nothing
drives the mass: its own path is smooth there, and any part proportional to the rotation is due to the arm (a, b). A
target that rocks by a few degrees rotates about its contact instead and is not changed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from frictrack.calibration.course_direction import frames_per_independent
from frictrack.records import Array, Track

MIN_ROTATION = np.pi / 2  # rad; a target that turns farther is seen along its axis, and does not rock on its course
MIN_FRAMES = 24
MIN_ARM_SIGMAS = 5.0  # standard deviations of the arm from which the point is moved
MAX_ARM_ERROR = 0.2  # of the arm, that its standard deviation may be
N_ROUNDS = 4  # of the direction of the course and the arm; two are enough where the path is long


@dataclass(frozen=True)
class _Arm:
    """Arm from the tracked to the straight-moving point: (2,) px in the target's axes, and its deviation."""

    at: Array
    std: float


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
    if np.count_nonzero(known) < MIN_FRAMES:
        return track, ()
    angle = np.full(len(track.angle), np.nan)
    angle[known] = np.unwrap(track.angle[known])
    if np.ptp(angle[known]) < MIN_ROTATION:
        return track, ()
    arm = _arm(np.stack([track.x_px, track.y_px], axis=1)[known], angle[known])
    length = float(np.hypot(*arm.at))
    if length < MIN_ARM_SIGMAS * arm.std or arm.std > MAX_ARM_ERROR * length:
        return track, ()
    offset = _turned(arm.at, angle)
    motion_per_rad = _turned(np.array([-arm.at[1], arm.at[0]]), angle)  # px per rad
    sigma_angle = np.zeros(len(angle)) if track.sigma_angle is None else track.sigma_angle
    note = (
        "the point of the rotating target that moves along a straight course is used: "
        f"{length:.3g} ± {arm.std:.1g} px from the centre of its rectangle"
    )
    return replace(
        track,
        x_px=track.x_px + offset[:, 0],
        y_px=track.y_px + offset[:, 1],
        sigma_px=np.hypot(track.sigma_px, motion_per_rad[:, 0] * sigma_angle),
        sigma_y_px=np.hypot(track.sigma_y_px, motion_per_rad[:, 1] * sigma_angle),
        systematic=float(np.hypot(track.systematic, arm.std)),
    ), (note,)


def _turned(arm: Array, angle: Array) -> Array:
    """Arm (2,) rotated by every angle (n,): (n, 2) px."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]], axis=1)


def _arm(place: Array, angle: Array) -> _Arm:
    """Fit the arm for which the path of places (n, 2) is smoothest across its own direction."""
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
    return _Arm(at, float(np.sqrt(max(np.trace(variance), 0.0))))
