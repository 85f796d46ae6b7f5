"""Measure the width of the target in the picture, from edge to edge along the course, for a scale by its size.

The picture is the median of cut-outs over the run, in which the background averages out. On each line along the course
the two places are found at which the grey value is half-way between background and target. The squared chords of a
rectangle are constant from line to line; those of a disc or ellipse form a parabola whose maximum is the diameter.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import scipy

from frictrack.base.errors import FrictrackError
from frictrack.recording import Recording
from frictrack.records import Array, Track

N_FRAMES = 48  # whose median is the picture
RIM_PX = 12  # beyond the rectangle, or a fifth of it where that is more
READINGS_PER_PX = 4  # readings per px along the course
EDGE_ERROR_PX = 0.15  # by which light and focus may move an edge
MIN_CONTRAST = 4.0  # noise of the background above which a line belongs to the target
READ_SHARE = 0.8  # of the rectangle's height that is read
MIN_LINES = 12  # lines on which the edge must be found
MIN_CURVATURE = 0.1  # of the squared chords, from which the target is a disc
MAX_EDGE_SIGMA_PX = 0.3  # an edge that is known no better is none
N_GROUPS = 6  # of lines, whose scatter is the uncertainty of the edge
PROFILE_REACH_PX, EDGE_ZONE_PX = 7, 3  # px from the edge within which its two levels are read


@dataclass(frozen=True, eq=False)
class TargetWidth:
    """Extent of the target along the course.

    Attributes
    ----------
    ends : array (2, 2)
        Both ends in the picture, px.
    std : float
        Standard deviation of the width, px.
    used : str
        Description for the user.

    """

    ends: Array
    std: float
    used: str

    @property
    def px(self) -> float:
        """Width in the picture, px."""
        return float(np.hypot(*(self.ends[1] - self.ends[0])))


def target_width(track: Track, direction: Array, film: Recording | None = None) -> TargetWidth:
    """Measure the extent of the target along the course.

    Parameters
    ----------
    track : Track
        Track with the target's rectangle.
    direction : array (2,)
        Direction of the course in the picture.
    film : Recording, optional
        Film; without it the picture of the track is used.

    Returns
    -------
    TargetWidth
        Ends and standard deviation.

    Raises
    ------
    FrictrackError
        Where the outline does not contrast with the background on both sides.

    """
    if track.target is None or (film is None and track.picture is None):
        raise FrictrackError("expected a track with its target's rectangle for a scale by the target's size")
    picture = _median_picture(track, film) if film is not None else np.asarray(track.picture)
    course = np.asarray(direction, dtype=np.float64) / np.hypot(*direction)
    lines = _lines(picture, course, track.target[2:])
    left, right = _edge(lines), _edge(lines[:, ::-1])
    chords = (lines.shape[1] - 1 - right.at - left.at) / READINGS_PER_PX
    width, shape = _width_and_shape(chords)
    std = float(np.sqrt(left.std**2 + right.std**2 + 2 * EDGE_ERROR_PX**2))
    middle = float(np.median(left.at - right.at)) / 2 / READINGS_PER_PX
    centre = np.array(track.target[:2]) + (np.array(track.target[2:]) - 1) / 2 + course * middle
    ends = np.stack([centre - course * width / 2, centre + course * width / 2])
    return TargetWidth(ends, std, f"{width:.2f} ± {std:.2f} px from edge to edge ({shape})")


def _median_picture(track: Track, film: Recording) -> Array:
    """Median (h, w) of cut-outs with a margin round the rectangle, registered to a small part of a pixel."""
    assert track.target is not None
    w, h = (round(s) for s in track.target[2:])
    size = tuple(s + 2 * max(RIM_PX, s // 5) for s in (w, h))
    half = (np.array(size) - 1) / 2 + 2
    at = np.stack([track.x_px, track.y_px], axis=1)
    room = np.array(film.shape[::-1]) - 1
    whole = np.flatnonzero(np.all((at - half >= 0) & (at + half <= room), axis=1))
    if len(whole) < 3:
        raise FrictrackError(
            "the target is nowhere in the film with a rim of background round it, so its size gives no scale; "
            'give a ruler as scale = {points = [[x, y], [x, y]], length = "100 mm"}'
        )
    chosen = np.unique(whole[_spread_rows(at[whole])])
    shift = [np.array([[1, 0, s[0]], [0, 1, s[1]]]) for s in at[chosen] - (np.array(size) - 1) / 2]
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    cuts = [
        cv2.warpAffine(np.asarray(film.frame(int(i)), np.float32), m, size, flags=flags)
        for i, m in zip(chosen, shift, strict=True)
    ]
    return np.asarray(np.median(cuts, axis=0), dtype=np.float64)


def _spread_rows(at: Array) -> np.ndarray:
    """Rows spread over the path travelled."""
    path = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(at, axis=0).T))])
    path = 0.9 * path / max(path[-1], 1e-9) + 0.1 * np.linspace(0, 1, len(path))
    return np.searchsorted(path, np.linspace(0, path[-1], N_FRAMES)).clip(0, len(at) - 1)


def _lines(picture: Array, course: Array, size: tuple[float, ...]) -> Array:
    """Profiles (lines, n) along the course through the middle of the picture, `READINGS_PER_PX` per px."""
    across = np.array([-course[1], course[0]])
    middle = (np.array(picture.shape[::-1]) - 1) / 2
    high = READ_SHARE * float(np.abs(across) @ np.array(size)) / 2
    reach = min(m / max(abs(a), 1e-9) for m, a in zip(middle, course, strict=True))
    offsets = np.arange(-np.floor(high), np.floor(high) + 1)
    n = int(np.floor(reach * READINGS_PER_PX))
    s = np.arange(-n, n + 1) / READINGS_PER_PX
    at = middle + offsets[:, None, None] * across + s[None, :, None] * course
    lines = scipy.ndimage.map_coordinates(picture, [at[..., 1], at[..., 0]], order=3, mode="nearest")
    return np.asarray(lines, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _Edge:
    """Edge of the target on lines from the left: reading number `at` (lines,) and its deviation, px."""

    at: Array
    std: float


def _edge(lines: Array) -> _Edge:
    """Find the left edge on each of the lines (n, m), then refine it on groups of aligned lines."""
    rough = _first_edges(lines)
    good = np.flatnonzero(np.isfinite(rough))
    if len(good) < max(MIN_LINES, 0.6 * len(lines)):
        raise _no_outline()
    filled = np.interp(np.arange(len(lines)), good, rough[good])
    window = max(len(lines) // 3 // 2 * 2 + 1, 5)
    smooth = scipy.signal.savgol_filter(
        scipy.ndimage.median_filter(filled, size=min(window, 7), mode="nearest"), window, 2, mode="interp"
    )
    offset = np.arange(-PROFILE_REACH_PX * READINGS_PER_PX, PROFILE_REACH_PX * READINGS_PER_PX + 1)
    readings = np.arange(lines.shape[1])
    laid = np.array([np.interp(at + offset, readings, line) for at, line in zip(smooth, lines, strict=True)])
    found = np.array([_half_level(group.mean(axis=0)) for group in np.array_split(laid, N_GROUPS)])
    shifts, steps = found.T
    std = float(shifts.std(ddof=1) / np.sqrt(N_GROUPS) / READINGS_PER_PX)
    if not std < MAX_EDGE_SIGMA_PX or abs(np.sign(steps).sum()) < N_GROUPS:
        raise _no_outline()
    return _Edge(smooth + shifts.mean(), std)


def _no_outline() -> FrictrackError:
    """Error for a target whose outline does not contrast with the background."""
    return FrictrackError(
        "the target's outline does not stand out from the background on both sides, so its size gives no scale; "
        "give target = [x, y, w, h] round all of it, or a ruler: "
        'scale = {points = [[x, y], [x, y]], length = "100 mm"}'
    )


def _half_level(profile: Array) -> tuple[float, float]:
    """Shift of the half-level point from the middle of a profile, in readings; and the grey-value step."""
    flat = EDGE_ZONE_PX * READINGS_PER_PX
    middle = len(profile) // 2
    outside, inside = float(np.mean(profile[: middle - flat])), float(np.mean(profile[middle + flat :]))
    over = (profile - (outside + inside) / 2) * np.sign(inside - outside)
    turns = np.flatnonzero((over[:-1] < 0) & (over[1:] >= 0))
    if not len(turns):
        return float("nan"), inside - outside
    i = int(turns[np.argmin(np.abs(turns - middle))])
    return float(i - over[i] / (over[i + 1] - over[i]) - middle), inside - outside


def _first_edges(lines: Array) -> Array:
    """Reading number (lines,) at which each line first differs from its background; NaN where this is unclear."""
    rim = max(3 * READINGS_PER_PX // 2, 4)
    outside = np.median(lines[:, :rim], axis=1)
    noise = max(1.5 * float(np.median(np.abs(lines[:, :rim] - outside[:, None]))), 1.0)
    off = np.abs(lines - outside[:, None])[:, : lines.shape[1] * 3 // 4]
    level = np.maximum(0.5 * np.quantile(off[:, : lines.shape[1] // 2], 0.75, axis=1), MIN_CONTRAST * noise)
    first = np.argmax(off > level[:, None], axis=1).astype(np.float64)
    return np.where(np.any(off > level[:, None], axis=1) & (first >= READINGS_PER_PX), first, np.nan)


def _width_and_shape(chords: Array) -> tuple[float, str]:
    """Width of the target, px, and the shape from which it was read."""
    u = np.linspace(-1.0, 1.0, len(chords))
    c, b, a = np.polyfit(u, chords**2, 2)
    left = chords**2 - np.polyval([c, b, a], u)
    if -c > MIN_CURVATURE * a and np.std(left) < 0.2 * abs(c) and abs(b) < -2 * c:
        return float(np.sqrt(a - b**2 / (4 * c))), "round: its diameter"
    return float(np.median(chords)), "straight: the middle chord"
