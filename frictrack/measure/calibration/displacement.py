"""Convert a track in pixels to displacement along and across the course, in metres.

The course runs to the image right, along a given axis, or along the path. Of a rotating target the point is followed
that moves along a straight course: its centre of mass, as far as visible. A point at (a, b) from the tracked one, in
the target's own axes, is at p + R(angle) (a, b). Across the course nothing drives the mass: its own path is smooth
there, and any part proportional to the rotation is due to the arm (a, b). A target that rocks by a few degrees rotates
about its contact instead and is not changed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import numpy as np

from frictrack.base.distributions import robust_std
from frictrack.base.errors import FrictrackError
from frictrack.base.units import parse_quantity
from frictrack.measure.calibration import scale as scale_input
from frictrack.measure.calibration.circle import fit_circle, on_circle
from frictrack.measure.calibration.scale import MIN_RULER_SHARE, PlaneMap, Scale, Straight, as_seen, from_points
from frictrack.measure.calibration.shake import subtract_shake
from frictrack.records import Array, Displacement, Mask, Track

if TYPE_CHECKING:
    from frictrack.measure.calibration.lens import Lens
    from frictrack.recording import Recording

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
    noise, weight = float(np.median(sigma)), np.ones(len(at))
    for _ in range(MAX_ROUNDS):
        offsets = at - np.average(at, axis=0, weights=weight)
        direction = np.linalg.svd(offsets * np.sqrt(weight)[:, None], full_matrices=False)[2][0]
        deviation = offsets @ [-direction[1], direction[0]]
        scale = max(float(robust_std(deviation)), noise)
        weight = np.minimum(1.0, 2.0 * scale / np.maximum(np.abs(deviation), 1e-30))
    s = offsets @ direction
    half = float(np.ptp(s)) / 2
    if 2 * half < MIN_TRAVEL_SIGMAS * noise:
        return None
    u = (s - (s.min() + s.max()) / 2) / half
    powers, root = np.stack([np.ones_like(u), u, u**2], axis=1), np.sqrt(weight)
    design = powers * root[:, None]
    shape = np.linalg.lstsq(design, deviation * root, rcond=None)[0]
    residual = deviation - powers @ shape
    spread = max(float(robust_std(residual)), noise) * np.sqrt(frames_per_independent(residual))
    std = spread * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
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
    if np.count_nonzero(known) < MIN_ROTATING_FRAMES or fit_circle(np.stack([track.x_px, track.y_px], axis=1)):
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
    covariance = frames_per_independent(residual) * np.linalg.pinv(design.T @ design)[:2, :2]
    variance = covariance * np.sum(residual**2) / max(len(residual) - 5, 1)
    return at, float(np.sqrt(max(np.trace(variance), 0.0)))


MIN_DISAGREEMENT_SIGMAS = 2.0  # standard deviations between two scales from which it is reported ...
MIN_DISAGREEMENT = 2e-3  # ... and the least relative difference that is reported


def plane_map(
    scale: Scale | None,
    *,
    lens: str | Path | None = None,
    track: Track | None = None,
    film: Recording | None = None,
    axis: Axis = None,
) -> PlaneMap:
    """Create the map from the picture to the plane of the course.

    Parameters
    ----------
    scale : number, str, mapping or list
        A number (``"0.500 +/- 0.002 mm/px"``), a ruler (``{"points": [[x, y], [x, y]], "length": "100 mm"}``), the
        target's size along the course (``{"target": "40 mm"}``), a board (``{"board": "board.png", "squares": [9, 6],
        "square": "10 mm"}``; with ``dictionary`` and ``marker`` a ChArUco board; several pictures or a recording also
        give
        lens and perspective; picture number ``plane``, by default the first, lies in the plane of the course), or four
        and
        more points of known place (``{"points": [[x, y], ...], "plane": [[X, Y], ...]}`` in m or in ``unit``). Of
        several
        in a list the first is used, and the others are compared with it.
    lens : str or Path, optional
        Calibration file with camera matrix and distortion.
    track : Track, optional
        Track of the target, for its size and direction.
    film : Recording, optional
        Film, for the outline of the target and the size of the picture.
    axis : sequence of float or "track", optional
        As in `calibrate`.

    Returns
    -------
    PlaneMap
        Map with its covariance.

    Raises
    ------
    FrictrackError
        For a malformed scale, unreadable files, a board that is not found, or points that determine no plane.

    Examples
    --------
    >>> import frictrack as ft
    >>> plane = ft.plane_map("0.500 +/- 0.002 mm/px")
    >>> plane(np.array([[100.0, 40.0]])).tolist()
    [[0.05, 0.02]]

    """
    kind = scale_input.scale_kind(scale)
    if kind == "several":
        several = [plane_map(s, lens=lens, track=track, film=film, axis=axis) for s in cast(Any, scale)]
        return _compare_maps(several, track)
    shape = film.shape if film is not None else None
    known_lens = None
    if lens is not None:
        from frictrack.measure.calibration.lens import read_lens  # noqa: PLC0415 - loads OpenCV; tables do without

        known_lens = read_lens(Path(lens), shape)
    straight = known_lens.undistorted if known_lens else as_seen
    table = cast(Any, scale)
    makers = {
        "number": lambda: scale_input.map_from_number(scale, straight),
        "ruler": lambda: scale_input.map_from_ruler(table, straight),
        "points": lambda: from_points(table, straight),
        "target": lambda: _map_by_target(table, track, film, axis, straight),
        "board": lambda: _map_by_board(table, known_lens, shape),
    }
    plane = makers[kind]()
    if lens is None:
        return plane
    used = plane.used or "scale as given"
    return replace(plane, used=f"{used}, seen through the lens of {Path(lens).name}")


def _map_by_board(scale: dict[str, Any], lens: Lens | None, shape: tuple[int, int] | None) -> PlaneMap:
    from frictrack.measure.calibration.lens import plane_from_views  # noqa: PLC0415
    from frictrack.measure.calibration.pictures import find_views, parse_board  # noqa: PLC0415

    board = parse_board(scale)
    track_and_film, missed = find_views(scale, board, shape)
    plane = plane_from_views(track_and_film, board, lens)
    if not missed:
        return plane
    names = f"{missed[0]} and {len(missed) - 1} more" if len(missed) > 1 else missed[0]
    return replace(plane, notes=(*plane.notes, f"the board was not found in {names}, which the scale goes without"))


def _map_by_target(
    scale: dict[str, Any], track: Track | None, film: Recording | None, axis: Axis, straight: Straight
) -> PlaneMap:
    """Create the map whose values are the target's size in m and its width in px."""
    from frictrack.measure.calibration.pictures import target_width  # noqa: PLC0415

    size, std = parse_quantity(scale["target"], "m", scale_input.TARGET_SIZE, above=0.0)
    if track is None:
        raise FrictrackError("expected a track for a scale by the target's size but got none")
    direction = directions(axis)[0]
    if isinstance(axis, str):  # along the path
        at, found = np.stack([track.x_px, track.y_px], axis=1), track.found
        line = fit_path(at[found], track.sigma_px[found])
        direction = direction if line is None else line.direction
    width = target_width(track, direction, film)

    # the deviation of the width comes from both ends
    plane = scale_input.map_from_length((size, std), width.ends, width.std / np.sqrt(2.0), straight)
    return replace(plane, used=f"scale by the target's size of {1e3 * size:g} mm, {width.used}")


def _compare_maps(maps: list[PlaneMap], track: Track | None) -> PlaneMap:
    """Return the first of several maps, with a note on each that differs from it in the middle of the path."""
    first = maps[0]
    at = np.array(first.centre)
    if track is not None and np.any(track.found):
        at = np.array([np.nanmedian(track.x_px), np.nanmedian(track.y_px)])
    ends = at + np.array([[-5.0, 0.0], [5.0, 0.0]])
    length, std = first.length(ends)
    notes = []
    for other in maps[1:]:
        theirs, also = other.length(ends)
        ratio, sigma = theirs / length - 1, float(np.hypot(std, also))
        if abs(ratio) > max(MIN_DISAGREEMENT_SIGMAS * sigma, MIN_DISAGREEMENT):
            notes.append(
                f"two scales disagree: {1e5 * theirs:.5g} µm/px ({other.used or 'as given'}) is {100 * ratio:+.2g} % "
                f"off the {1e5 * length:.5g} µm/px that is used, and their standard deviation is {100 * sigma:.2g} %"
            )
    return replace(first, notes=(*first.notes, *notes))


MIN_PATH_PX = 10.0  # a shorter path gets the uncertainty of the scale over this length
MIN_PITCH_CHANGE = 5e-3  # relative change of the pitch along the path that is reported


def calibrate(
    track: Track,
    scale: Scale | PlaneMap | None,
    *,
    axis: Axis = None,
    origin_px: Sequence[Annotated[float, "px"]] | None = None,
    x_offset: Annotated[float, "m"] = 0.0,
    reference: Track | None = None,
) -> Displacement:
    """Convert a track in pixels to displacement along and across the course.

    Parameters
    ----------
    track : Track
        Track of the target.
    scale : number, str, mapping, list or PlaneMap
        Scale as `plane_map` takes it, or its result.
    axis : sequence of float or "track", optional
        Direction of +x in the picture, [dx, dy] px with y down, at the middle of the scale's points; image right by
        default. "track" follows the path: +x to the right, or down where the path is steeper than 60 degrees.
    origin_px : sequence of float, optional
        Pixel [x, y] with x = 0 and y = 0. By default the corner of the picture, or the zero of the board or of the
        known
        places, so that all runs of one camera share it.
    x_offset : float
        Added to x, m.
    reference : Track, optional
        Track of a fixed object. Its motion beyond its own noise is camera shake and is subtracted.

    Returns
    -------
    Displacement
        x along the axis, y across it (up in the picture), angle counter-clockwise. NaN and ``valid`` false where the
        target, or the reference of a shaking film, was lost. ``pixel_pitch`` is the pitch in the middle of the path;
        ``relative_scale_error`` is the relative standard deviation of the path's length, common to all frames and to
        all
        runs of one camera.

    Raises
    ------
    FrictrackError
        For a target lost in all frames, or a map that cannot place all frames.

    Notes
    -----
    For a target that rotates by a quarter turn or more, the point that moves along a straight course is used
    (`follow_straight_point`).

    Examples
    --------
    >>> import frictrack as ft
    >>> track = ft.track(ft.open_recording(ft.samples.films_folder() / "fast.avi"))
    >>> displacement = ft.calibrate(track, scale="0.5 mm/px")
    >>> float(displacement.x[140].round(4))
    0.2254

    """
    plane = scale if isinstance(scale, PlaneMap) else plane_map(scale, track=track, axis=axis)
    repaired, track = track.repaired, track.measured
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
    notes = _scale_notes(plane, ends, x)
    displacement = Displacement(
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
        raised=track.raised,
        relative_scale_error=plane.length(ends)[1],
        notes=(*track.notes, *shake_notes, *rotation_notes, *notes),
        repaired=repaired,
    )
    found = on_circle(displacement, x_offset)
    return found if found.radius else replace(found, notes=(*found.notes, *direction_notes(line, x, axis)))


def _check_placed(place: Array, valid: Mask) -> None:
    """Check that the target was found and that the map places all frames."""
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
    """Unit vectors along and across the path, the second on the side of `y`."""
    if line is None:
        raise FrictrackError('expected a target that travels for axis = "track" but it rests; give axis = [dx, dy]')
    x = orient_forward(line.direction, plane.jacobian(np.array([plane.centre]))[0])
    across = np.array([-x[1], x[0]])
    return x, across if across @ y >= 0 else -across


def _zero(plane: PlaneMap, origin_px: Sequence[float] | None) -> Array:
    """Origin in the plane (2,) m."""
    if origin_px is None and plane.zero is not None:
        return np.asarray(plane.zero)
    return plane(np.reshape(np.asarray([0.0, 0.0] if origin_px is None else origin_px, dtype=np.float64), (1, 2)))[0]


def _ends(at: Array, x: Array) -> Array:
    """Picture points (2, 2) px at both ends of the path; at least `MIN_PATH_PX` apart."""
    ends = at[[int(np.argmin(x)), int(np.argmax(x))]]
    if np.hypot(*(ends[1] - ends[0])) < MIN_PATH_PX:
        ends = ends.mean(axis=0) + np.array([[-MIN_PATH_PX / 2, 0.0], [MIN_PATH_PX / 2, 0.0]])
    return np.asarray(ends)


def _pitch(plane: PlaneMap, middle: Array, x: Array) -> float:
    """Pitch along the course at a point of the picture, m/px."""
    turn = plane.jacobian(middle[None])[0]
    return plane.pitch(middle, np.linalg.solve(turn, x))


def _scale_notes(plane: PlaneMap, ends: Array, x: Array) -> tuple[str, ...]:
    """Describe the origin of the scale and its accuracy on this path."""
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
            "points farther apart, would give a more accurate scale"
        )
    return (*notes, *plane.notes)
