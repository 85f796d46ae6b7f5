"""Create the map to the plane of the course from a scale of any kind."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from frictrack.calibration import scale as scale_input
from frictrack.calibration.course_direction import Axis, directions, fit_path
from frictrack.calibration.plane import PlaneMap, Straight, as_seen, uniform
from frictrack.calibration.scale import Scale
from frictrack.errors import FrictrackError
from frictrack.records import Array, Track

if TYPE_CHECKING:
    from frictrack.calibration.lens import Lens
    from frictrack.recording import Recording

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
        return _compare_maps(
            [plane_map(s, lens=lens, track=track, film=film, axis=axis) for s in cast(Any, scale)], track
        )
    shape = film.shape if film is not None else None
    known_lens = _lens(lens, shape)
    straight = known_lens.undistorted if known_lens else as_seen
    makers = {
        "number": lambda: scale_input.map_from_number(scale, straight),
        "ruler": lambda: scale_input.map_from_ruler(_table(scale), straight),
        "points": lambda: _map_by_points(_table(scale), straight),
        "target": lambda: _map_by_target(_table(scale), (track, film), _direction(track, axis), straight),
        "board": lambda: _map_by_board(_table(scale), known_lens, shape),
    }
    plane = makers[kind]()
    if lens is None:
        return plane
    used = plane.used or "scale as given"
    return replace(plane, used=f"{used}, seen through the lens of {Path(lens).name}")


def _table(scale: Any) -> dict[str, Any]:
    return dict(scale)


def _lens(path: str | Path | None, shape: tuple[int, int] | None) -> Lens | None:
    if path is None:
        return None
    from frictrack.calibration.lens import read_lens  # noqa: PLC0415 - loads OpenCV; tables do without

    return read_lens(Path(path), shape)


def _map_by_points(scale: dict[str, Any], straight: Straight) -> PlaneMap:
    from frictrack.calibration.known_points import from_points  # noqa: PLC0415

    return from_points(scale, straight)


def _map_by_board(scale: dict[str, Any], lens: Lens | None, shape: tuple[int, int] | None) -> PlaneMap:
    from frictrack.calibration.board import find_views, parse_board  # noqa: PLC0415
    from frictrack.calibration.camera import plane_from_views  # noqa: PLC0415

    board = parse_board(scale)
    track_and_film, missed = find_views(scale, board, shape)
    plane = plane_from_views(track_and_film, board, lens)
    if not missed:
        return plane
    names = f"{missed[0]} and {len(missed) - 1} more" if len(missed) > 1 else missed[0]
    return replace(plane, notes=(*plane.notes, f"the board was not found in {names}, which the scale goes without"))


def _direction(track: Track | None, axis: Axis) -> Array:
    """Direction of the course in the picture: the axis, or that of the path for "track"."""
    if isinstance(axis, str) and track is not None:
        found = track.found
        line = fit_path(np.stack([track.x_px, track.y_px], axis=1)[found], track.sigma_px[found])
        if line is not None:
            return line.direction
    return directions(axis)[0]


def _map_by_target(
    scale: dict[str, Any], track_and_film: tuple[Track | None, Recording | None], direction: Array, straight: Straight
) -> PlaneMap:
    """Create the map whose values are the target's size in m and its width in px."""
    from frictrack.calibration.target_size import target_width  # noqa: PLC0415

    track, film = track_and_film
    size, std = scale_input.parse_length(scale["target"], "the target's size along the course")
    if track is None:
        raise FrictrackError("expected a track for a scale by the target's size but got none")
    width = target_width(track, direction, film)

    pitch = partial(_pitch_of_target, straight, direction, width.ends.mean(axis=0))
    plane = uniform([size, width.px], np.diag([std**2, width.std**2]), pitch, straight)
    return replace(plane, used=f"scale by the target's size of {1e3 * size:g} mm, {width.used}")


def _pitch_of_target(straight: Straight, direction: Array, middle: Array, values: Array) -> float:
    reach = direction * values[1] / 2
    ends = straight(np.stack([middle - reach, middle + reach]))
    return float(values[0] / np.hypot(*(ends[1] - ends[0])))


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
