"""The target's own size as the scale: its outline, edge to edge along the course, on its averaged picture.

The picture is the median of cut-outs over the run, so that the background goes grey while the target stays. On
every line along the course the two places are found at which the grey value is half-way between background and
target. Squared chords of a rectangle are constant from line to line, those of a disc or ellipse a parabola whose
top is the diameter: the width is read there.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from frictrack.errors import FrictrackError
from frictrack.recording import Recording
from frictrack.records import Array, Mask, Track

FRAMES = 48
RIM = 12  # px beyond the rectangle, or a fifth of it where that is more
OVERSAMPLED = 4  # readings per px along the course
EDGE = 0.1  # px: how far light and focus may move an edge
CLEAR = 4.0  # noise of the background above which a line belongs to the target
BAND = 0.8  # of the rectangle's height that is read
LEAST = 8  # lines on which both edges must be found
TOGETHER = 8.0  # lines that are wrong together (texture, blur), px
ROUND = 4.0  # standard deviations from which chords are taken for those of a disc


@dataclass(frozen=True, eq=False)
class Width:
    """The target's extent along the course: the two `ends` (2, 2) px of the picture, and its deviation, px."""

    ends: Array
    std: float
    used: str

    @property
    def px(self) -> float:
        """Length in the picture."""
        return float(np.hypot(*(self.ends[1] - self.ends[0])))


def target_width(track: Track, direction: Array, film: Recording | None = None) -> Width:
    """Extent of the target along `direction` (2,) of the picture, from the film or else the track's own picture.

    Raises `FrictrackError` when the outline does not stand out from the background on both sides.
    """
    if track.target is None or (film is None and track.picture is None):
        raise FrictrackError("expected a track with its target's rectangle for a scale by the target's size")
    picture = _averaged(track, film) if film is not None else np.asarray(track.picture)
    along = np.asarray(direction, dtype=np.float64) / np.hypot(*direction)
    lines, step = _lines(picture, along, track.target[2:])
    left, right = _edges(lines), lines.shape[1] - 1 - _edges(lines[:, ::-1])
    chords = (right - left) * step
    good = np.isfinite(chords) & (chords > 0)
    good[good] &= np.abs(chords[good] - np.median(chords[good])) < 0.25 * np.median(chords[good])
    if np.count_nonzero(good) < max(LEAST, len(lines) // 3):
        raise FrictrackError(
            "the target's outline does not stand out from the background on both sides, so its size gives no scale; "
            'give target = [x, y, w, h] round all of it, or a ruler as scale = {points = [[x, y], [x, y]], length = "100 mm"}'
        )
    width, std, shape = _widest(np.flatnonzero(good).astype(float), chords[good])
    middle = float(np.median((left + right)[good])) / 2
    centre = np.array(track.target[:2]) + (np.array(track.target[2:]) - 1) / 2
    centre = centre + along * (middle - (lines.shape[1] - 1) / 2) * step
    ends = np.stack([centre - along * width / 2, centre + along * width / 2])
    total = float(np.hypot(std, np.sqrt(2) * EDGE))
    used = f"{width:.2f} ± {total:.2f} px from edge to edge on {np.count_nonzero(good)} lines ({shape})"
    return Width(ends, total, used)


def _averaged(track: Track, film: Recording) -> Array:
    """Median (h, w) of cut-outs with a rim round the rectangle, registered to a small part of a pixel."""
    assert track.target is not None
    w, h = (round(s) for s in track.target[2:])
    size = tuple(s + 2 * max(RIM, s // 5) for s in (w, h))
    half = (np.array(size) - 1) / 2 + 2
    at = np.stack([track.x_px, track.y_px], axis=1)
    room = np.array(film.shape[::-1]) - 1
    whole = np.flatnonzero(np.all((at - half >= 0) & (at + half <= room), axis=1))
    if len(whole) < 3:
        raise FrictrackError(
            "the target is nowhere in the film with a rim of background round it, so its size gives no scale; "
            'give a ruler as scale = {points = [[x, y], [x, y]], length = "100 mm"}'
        )
    chosen = np.unique(whole[_spread(at[whole])])
    shift = [np.array([[1, 0, s[0]], [0, 1, s[1]]]) for s in at[chosen] - (np.array(size) - 1) / 2]
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    cuts = [
        cv2.warpAffine(np.asarray(film.frame(int(i)), np.float32), m, size, flags=flags)
        for i, m in zip(chosen, shift, strict=True)
    ]
    return np.asarray(np.median(cuts, axis=0), dtype=np.float64)


def _spread(at: Array) -> np.ndarray:
    """Rows spread over the path that is travelled."""
    path = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(at, axis=0).T))])
    path = 0.9 * path / max(path[-1], 1e-9) + 0.1 * np.linspace(0, 1, len(path))
    return np.searchsorted(path, np.linspace(0, path[-1], FRAMES)).clip(0, len(at) - 1)


def _lines(picture: Array, along: Array, size: tuple[float, ...]) -> tuple[Array, float]:
    """Readings (lines, n) along the course, through the middle of the picture, and their step in px."""
    across = np.array([-along[1], along[0]])
    middle = (np.array(picture.shape[::-1]) - 1) / 2
    high = BAND * float(np.abs(across) @ np.array(size)) / 2
    reach = min(m / max(abs(a), 1e-9) for m, a in zip(middle, along, strict=True))
    offsets = np.arange(-np.floor(high), np.floor(high) + 1)
    n = int(np.floor(reach * OVERSAMPLED))
    s = np.arange(-n, n + 1) / OVERSAMPLED
    at = middle + offsets[:, None, None] * across + s[None, :, None] * along
    lines = map_coordinates(picture, [at[..., 1], at[..., 0]], order=3, mode="nearest")
    return np.asarray(lines, dtype=np.float64), 1 / OVERSAMPLED


def _edges(lines: Array) -> Array:
    """Where each line (coming from the left) leaves the background: reading number (lines,), NaN where it is not clear.

    The half level between the background outside and the plateau that the first change leads to.
    """
    rim = max(3 * OVERSAMPLED // 2, 4)
    outside = np.median(lines[:, :rim], axis=1)
    noise = max(float(np.median(np.abs(lines[:, :rim] - outside[:, None]))) * 1.5, 1.0)
    off = np.abs(lines - outside[:, None])
    strong = np.quantile(off[:, : lines.shape[1] // 2], 0.75, axis=1)
    level = np.maximum(0.5 * strong, CLEAR * noise)
    return np.array([_crossing(line, base, least) for line, base, least in zip(lines, outside, level, strict=True)])


def _crossing(line: Array, outside: float, least: float) -> float:
    """Half-way between the background and the first extreme that differs from it by `least`."""
    off = np.abs(line[: len(line) * 3 // 4] - outside)
    beyond: Mask = off > least
    if not np.any(beyond):
        return float("nan")
    first = int(np.argmax(beyond))
    if first < OVERSAMPLED:
        return float("nan")  # no background is left outside
    top = first
    while top + 1 < len(off) and off[top + 1] >= off[top]:
        top += 1
    half = off[top] / 2
    below = np.flatnonzero(off[:top] < half)
    if not len(below):
        return float("nan")
    i = int(below[-1])
    return float(i + (half - off[i]) / (off[i + 1] - off[i]))


def _widest(row: Array, chords: Array) -> tuple[float, float, str]:
    """Width, its standard deviation and what shape it was read from."""
    u = (row - row.mean()) / max(float(np.ptp(row)) / 2, 1.0)
    spread = 1.4826 * float(np.median(np.abs(chords - np.median(chords))))
    design = np.stack([np.ones_like(u), u, u**2], axis=1)
    weight = np.ones_like(u)
    for _ in range(5):
        root = np.sqrt(weight)[:, None]
        (a, b, c), *_ = np.linalg.lstsq(design * root, chords**2 * root[:, 0], rcond=None)
        left = chords**2 - design @ np.array([a, b, c])
        scale = 1.4826 * float(np.median(np.abs(left))) + 1e-9
        weight = 1 / (1 + (left / (2 * scale)) ** 2)
    together = np.sqrt(min(TOGETHER, len(u)) / len(u))
    std_c = 3.4 * scale * together  # of the u^2 coefficient: 1 / sqrt(var(u^2)) of even spacing
    if c < -ROUND * std_c and abs(b / (2 * c)) < 1 and -c > 0.02 * a:
        width = float(np.sqrt(a - b**2 / (4 * c)))
        return width, 1.5 * scale * together / (2 * width), "round: its diameter"
    return float(np.median(chords)), 1.25 * spread * together, "straight: their median"
