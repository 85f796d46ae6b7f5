"""A track in pixels, sent through the map to the plane of the course: displacement along it and across."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from frictrack.calibration.course_direction import (
    Axis,
    PathLine,
    axes_in_plane,
    direction_notes,
    directions,
    fit_path,
    orient_forward,
)
from frictrack.calibration.plane import PlaneMap
from frictrack.calibration.rotating_target import follow_straight_point
from frictrack.calibration.scale import MIN_RULER_SHARE, Scale
from frictrack.calibration.scale_to_map import plane_map
from frictrack.calibration.shake import subtract_shake
from frictrack.errors import FrictrackError
from frictrack.records import Array, Displacement, Mask, Track

MIN_PATH_PX = 10.0  # a shorter path gets the uncertainty of the scale over this length
MIN_PITCH_CHANGE = 5e-3  # relative change of the pitch along the path that is reported


def calibrate(
    track: Track,
    scale: Scale | PlaneMap | None,
    *,
    axis: Axis = None,
    origin_px: Sequence[float] | None = None,
    x_offset: float = 0.0,
    reference: Track | None = None,
) -> Displacement:
    """Displacement along the course and across it, from a track in pixels.

    `scale` is what `plane_map` takes or gives. `axis` is the direction of +x in the picture, [dx, dy] px with y down,
    at the middle of the scale's points (default image right), or "track": the path's own direction, +x to the right,
    or downward where the path is steeper than 60 degrees. `origin_px` is the pixel [x, y] where x = 0 and y = 0
    (default the picture's corner, or the zero of the board or of the known places, so that all runs of one camera share
    it); `x_offset` is added to x, m. `reference` is the track of something fixed: what it moves beyond its own noise is
    camera shake and is subtracted (`shake`). Of a target that turns by a quarter or more, the point is taken that moves
    along a straight course (`straight`).

    x runs along the axis, y across it (upward in the picture), the angle counter-clockwise. Where the target was lost,
    or the reference of a shaking film, they are NaN and ``valid`` is false. ``pixel_pitch`` is that in the middle of
    the path, ``relative_scale_error`` the standard deviation of the length of the path over it: common to all frames,
    and to all runs of one camera.
    """
    plane = scale if isinstance(scale, PlaneMap) else plane_map(scale, track=track, axis=axis)
    track, shake_notes = subtract_shake(track, reference)
    track, rotation_notes = follow_straight_point(track)
    at = np.stack([track.x_px, track.y_px], axis=1)
    variance = np.stack([track.sigma_px, track.sigma_y_px], axis=1) ** 2
    valid = np.all(np.isfinite(at), axis=1)
    place = np.full(at.shape, np.nan)
    place[valid] = plane(at[valid])
    _check_placed(place, valid)
    direction, across = directions(axis)
    x, y = axes_in_plane(plane, direction, across)
    jacobian = np.full((len(at), 2, 2), np.nan)
    jacobian[valid] = plane.jacobian(at[valid])
    line = fit_path(place[valid], _sigma(variance, jacobian, y)[valid])
    if isinstance(axis, str):
        x, y = _path_axes(plane, line, y)
    place = place - _zero(plane, origin_px)
    ends = _ends(at[valid], place[valid] @ x)
    pitch = _pitch(plane, ends.mean(axis=0), x)
    notes = (*_scale_notes(plane, ends, x), *direction_notes(line, x, axis))
    return Displacement(
        t=track.t,
        x=place @ x + x_offset,
        y=place @ y,
        angle=-track.angle + np.where(valid, 0.0, np.nan),
        sigma_angle=None if track.sigma_angle is None else np.where(valid, track.sigma_angle, np.nan),
        sigma_x=_sigma(variance, jacobian, x),
        sigma_y=_sigma(variance, jacobian, y),
        valid=valid,
        pixel_pitch=pitch,
        systematic=track.systematic * pitch,
        relative_scale_error=plane.length(ends)[1],
        notes=(*track.notes, *shake_notes, *rotation_notes, *notes),
    )


def _check_placed(place: Array, valid: Mask) -> None:
    if not np.any(valid):
        raise FrictrackError(
            "expected a target that is found but it is lost in every frame; check target and reference"
        )
    lost = int(np.count_nonzero(~np.all(np.isfinite(place[valid]), axis=1)))
    if lost:
        raise FrictrackError(
            f"the calibration cannot place {lost} of {np.count_nonzero(valid)} frames on the plane: they lie beyond "
            "its horizon or where its lens distortion cannot be undone; check the points of the scale and the lens"
        )


def _sigma(variance: Array, jacobian: Array, direction: Array) -> Array:
    """Standard deviation (n,) m along a direction of the plane, from variances (n, 2) px^2."""
    weight = np.einsum("nij,i->nj", jacobian, direction) ** 2
    return np.asarray(np.sqrt(np.sum(weight * variance, axis=1)))


def _path_axes(plane: PlaneMap, line: PathLine | None, y: Array) -> tuple[Array, Array]:
    """Unit vectors along the path's own direction and across it, the second on the side of `y`."""
    if line is None:
        raise FrictrackError('expected a target that travels for axis = "track" but it rests; give axis = [dx, dy]')
    x = orient_forward(line.direction, plane.jacobian(np.array([plane.centre]))[0])
    across = np.array([-x[1], x[0]])
    return x, across if across @ y >= 0 else -across


def _zero(plane: PlaneMap, origin_px: Sequence[float] | None) -> Array:
    """The point of the plane (2,) m that is 0."""
    if origin_px is None and plane.zero is not None:
        return np.asarray(plane.zero)
    return plane(np.reshape(np.asarray([0.0, 0.0] if origin_px is None else origin_px, dtype=np.float64), (1, 2)))[0]


def _ends(at: Array, x: Array) -> Array:
    """Picture points (2, 2) px at both ends of the path; some px apart even for a target that rests."""
    ends = at[[int(np.argmin(x)), int(np.argmax(x))]]
    if np.hypot(*(ends[1] - ends[0])) < MIN_PATH_PX:
        ends = ends.mean(axis=0) + np.array([[-MIN_PATH_PX / 2, 0.0], [MIN_PATH_PX / 2, 0.0]])
    return np.asarray(ends)


def _pitch(plane: PlaneMap, middle: Array, x: Array) -> float:
    """Metres per pixel in the middle of the path, along the course."""
    turn = plane.jacobian(middle[None])[0]
    return plane.pitch(middle, np.linalg.solve(turn, x))


def _scale_notes(plane: PlaneMap, ends: Array, x: Array) -> tuple[str, ...]:
    """What the scale is made from, how good it is on this path, and what is to be said of it."""
    if not plane.used:
        return plane.notes
    first, last, middle = (_pitch(plane, p, x) for p in (*ends, ends.mean(axis=0)))
    path_px = float(np.hypot(*(ends[1] - ends[0])))
    share = 100 * plane.length(ends)[1]
    accuracy = f"its length known to {share:.2g} %" if share else "its uncertainty not given"
    notes = [f"{plane.used}: {1e6 * middle:.5g} µm/px in the middle of the path, {accuracy}"]
    change = max(first, middle, last) / min(first, middle, last) - 1
    if change > MIN_PITCH_CHANGE:
        notes.append(
            f"the pitch changes by {100 * change:.2g} % along the path (perspective and lens), which is undone"
        )
    if 0 < plane.reach < MIN_RULER_SHARE * path_px:
        notes.append(
            f"the scale was read over {plane.reach:.0f} px but the path is {path_px:.0f} px long: a longer ruler, or "
            "points farther apart, would give a surer scale"
        )
    return (*notes, *plane.notes)
