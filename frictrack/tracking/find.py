"""Find the moving body: what differs from the still background and travels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from frictrack.errors import FrictrackError
from frictrack.recording import Frame, Recording
from frictrack.records import Array, Mask
from frictrack.tracking.match import Rectangle, correlate

SAMPLES = 60
SAMPLE_BYTES = 40_000_000
LEAST_AREA = 40  # px
LEAST_SIDE = 8  # px
LEAST_TRAVEL = 1.5  # px
MATCH = 0.6
ALIKE = 0.1  # share left unexplained in a frame that still shows the body well
OUTLINE = 0.5  # least share of the contrast that a rectangle inside the body must hold
CANDIDATES = 12


@dataclass(frozen=True, eq=False)
class Sample:
    """Frames spread over the recording, and what in them is not background."""

    index: list[int]
    frames: list[Frame]
    background: Array
    foreground: list[Mask]


@dataclass(frozen=True, eq=False)
class Body:
    """A moving thing: its bounding box, and where that was in the sampled frames (NaN where not seen)."""

    box: Rectangle
    row: int  # of the sample that the box was taken from
    corner: Array  # (k, 2)
    merit: float


def find_target(recording: Recording) -> Rectangle:
    """Rectangle (x, y, w, h) px of the moving body; in the first frame, unless `locate` names another one."""
    return locate(recording)[0]


def locate(recording: Recording) -> tuple[Rectangle, int]:
    """Rectangle of the body that moves farthest, slightly inside its outline, and the frame it refers to.

    Raises `FrictrackError` when the film has no contrast or nothing moves.
    """
    sample = _sample(recording)
    bodies = [_pursue(sample, row, box) for row, box in _candidates(sample)]
    best = max(bodies, key=lambda body: body.merit, default=None)
    if best is None or best.merit <= 0:
        raise FrictrackError(
            f"{recording.path.name}: expected a moving target but nothing moves by more than "
            f"{LEAST_TRAVEL:g} px; check the film, or give target = [x, y, w, h]"
        )
    return _outline(sample, best)


def _sample(recording: Recording) -> Sample:
    size = recording.shape[0] * recording.shape[1] * (2 if recording.bit_depth > 8 else 1)
    count = min(recording.n_frames, int(np.clip(SAMPLE_BYTES // size, 9, SAMPLES)))
    index = np.unique(np.linspace(0, recording.n_frames - 1, count).astype(int)).tolist()
    frames = recording.pick(index)
    index = index[: len(frames)]
    if max(int(np.ptp(frame)) for frame in frames) < 2:
        raise FrictrackError(
            f"{recording.path.name}: the film has no contrast, its frames are all one grey; "
            "check lighting, exposure and lens cap"
        )
    background = np.median(np.stack(frames), axis=0).astype(np.float32)
    differences = [_difference(frame, background) for frame in frames]
    noise = 1.4826 * float(np.median([np.median(np.abs(d[::3, ::3])) for d in differences]))
    return Sample(index, frames, background, [_foreground(d, noise) for d in differences])


def _difference(frame: Frame, background: Array) -> Array:
    """Frame minus background, after the light has been evened out."""
    picture = frame.astype(np.float32)
    few, still = picture[::3, ::3], background[::3, ::3]
    bright = still > 0.5 * np.median(still)
    ratio = float(np.median(few[bright] / np.maximum(still[bright], 1)))
    return picture - (ratio if 0.2 < ratio < 5 else 1.0) * background


def _foreground(difference: Array, noise: float) -> Mask:
    """Where the picture differs from the background by more than noise, as closed patches."""
    energy = cv2.GaussianBlur(difference**2, (0, 0), 1.5)
    # Smoothed squared noise scatters by about a quarter of its mean: nine times the mean is never noise.
    return _tidy(energy > 9 * max(noise, 0.5) ** 2, close=7)


def _tidy(mask: Mask, close: int) -> Mask:
    """The mask without gaps narrower than `close` px and without specks."""
    bits = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((close, close), np.uint8))
    return np.asarray(cv2.morphologyEx(bits, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0)


def _candidates(sample: Sample) -> list[tuple[int, Rectangle]]:
    """The largest patches of foreground, from frames spread over the film: (row, box)."""
    busy = [row for row, mask in enumerate(sample.foreground) if mask.any()]
    rows = [busy[i] for i in np.unique(np.linspace(0, len(busy) - 1, 6).astype(int))] if busy else []
    found = []
    for row in rows:
        boxes = _boxes(sample.foreground[row])
        found += [(row, box) for box in boxes[: CANDIDATES // len(rows)]]
    return found


def _boxes(mask: Mask) -> list[Rectangle]:
    """Bounding boxes of the connected patches, the largest first, those that fill the picture left out."""
    _, _, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    blobs = [s for s in stats[1:] if s[4] >= LEAST_AREA and min(s[2:4]) >= LEAST_SIDE and s[4] < 0.6 * mask.size]
    return [(int(x), int(y), int(w), int(h)) for x, y, w, h, _ in sorted(blobs, key=lambda s: -s[4])]


def _pursue(sample: Sample, row: int, box: Rectangle) -> Body:
    """Look for the contents of `box` in every sampled frame, among what is foreground there."""
    x, y, w, h = box
    patch = sample.frames[row][y : y + h, x : x + w]
    corner = np.full((len(sample.frames), 2), np.nan)
    for k, (frame, foreground) in enumerate(zip(sample.frames, sample.foreground, strict=True)):
        part = _surrounding(foreground, (h, w))
        if part is None:
            continue
        _, score, _, (i, j) = cv2.minMaxLoc(correlate(frame[part], patch))
        i, j = i + part[1].start, j + part[0].start
        if score > MATCH and foreground[j : j + h, i : i + w].mean() > 0.3:
            corner[k] = i, j
    seen = np.isfinite(corner[:, 0])
    travel = _travel(corner[seen])
    merit = seen.sum() * travel * np.sqrt(w * h) if travel > LEAST_TRAVEL else 0.0
    return Body(box, row, corner, float(merit))


def _travel(corner: Array) -> float:
    """Distance covered by the finds (k, 2), px; one stray match does not count."""
    if len(corner) < 2:
        return 0.0
    away = np.sort(np.hypot(*(corner - np.median(corner, axis=0)).T))
    return 2 * float(away[-2])


def _surrounding(foreground: Mask, size: tuple[int, int]) -> tuple[slice, slice] | None:
    """The part of the picture that holds all foreground and has room for a patch of `size` (h, w) round it."""
    x, y, w, h = cv2.boundingRect(foreground.astype(np.uint8))
    if not w:
        return None
    return slice(max(y - size[0], 0), y + h + size[0]), slice(max(x - size[1], 0), x + w + size[1])


def _outline(sample: Sample, body: Body) -> tuple[Rectangle, int]:
    """The rectangle of the body and the frame it refers to: the first, unless that shows it badly."""
    look = _look(sample, body)
    x, y, w, h = _rectangle(look)
    typical = int(np.argmin(look.misfit))
    row = 0 if look.misfit[0] < max(2 * look.misfit[typical], ALIKE) else typical
    left, top = (int(c) for c in look.corner[row])
    height, width = sample.background.shape
    x0, y0 = np.clip(left + x, 0, width - 8), np.clip(top + y, 0, height - 8)
    x1, y1 = min(left + x + w, width), min(top + y + h, height)
    return (int(x0), int(y0), int(x1 - x0), int(y1 - y0)), sample.index[look.rows[row]]


@dataclass(frozen=True, eq=False)
class Look:
    """What a body looks like, from the sampled frames registered on it: a window somewhat larger than it."""

    picture: Array  # median of the registered frames
    member: Mask  # pixels that move with the body
    corner: NDArray[np.int64]  # (k, 2) corner of the window in each frame that shows the body
    rows: NDArray[np.int64]  # (k,) those frames
    misfit: Array  # (k,) share of each that the median does not explain


def _look(sample: Sample, body: Body) -> Look:
    """A pixel moves with the body if the body's median picture explains it better than the background does."""
    _, _, w, h = body.box
    reach = int(np.ceil(0.1 * max(w, h))) + 3
    shape = (h + 2 * reach, w + 2 * reach)
    rows = np.flatnonzero(np.isfinite(body.corner[:, 0]))
    corner = body.corner[rows].astype(int) - reach
    stack = np.stack([_window(sample.frames[k], at, shape) for k, at in zip(rows, corner, strict=True)])
    scene = np.stack([_window(sample.background, at, shape) for at in corner])
    picture = np.median(stack, axis=0)
    spread = cv2.GaussianBlur(np.median((stack - picture) ** 2, axis=0), (0, 0), 1.0)
    differs = cv2.GaussianBlur(np.median((stack - scene) ** 2, axis=0), (0, 0), 1.0)
    member = _largest(_tidy(np.asarray(spread < 0.5 * differs), close=5))
    return Look(picture, member, corner, rows, _misfit(stack[:, member], picture[member]))


def _misfit(pictures: Array, picture: Array) -> Array:
    """Share (k,) of each picture (k, p) that the median picture (p,) does not explain, whatever the light."""
    pictures = pictures - pictures.mean(axis=1, keepdims=True)
    picture = picture - picture.mean()
    power = np.sum(pictures**2, axis=1) * np.sum(picture**2)
    return 1 - np.asarray(pictures @ picture) ** 2 / np.maximum(power, 1e-12)


def _largest(mask: Mask) -> Mask:
    """The largest connected patch of a mask; the whole window when there is none."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    if len(stats) < 2:
        return np.ones(mask.shape, np.bool_)
    return np.asarray(labels == 1 + int(np.argmax(stats[1:, 4])))


def _rectangle(look: Look) -> Rectangle:
    """Inside the body where its texture is; round it where most of its contrast is the outline."""
    inner = _inside(look.member)
    x, y, w, h = inner
    energy = np.sum(np.square(np.gradient(look.picture)), axis=0)
    outlined = cv2.dilate(look.member.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    if energy[y : y + h, x : x + w].sum() > OUTLINE * energy[outlined].sum():
        return inner
    x, y, w, h = cv2.boundingRect(outlined.astype(np.uint8))
    return (x, y, w, h)


def _window(picture: NDArray[Any], corner: NDArray[Any], shape: tuple[int, int]) -> Array:
    """A window of the picture, float32, continued by its edge where it reaches beyond."""
    height, width = picture.shape
    rows = np.clip(np.arange(shape[0]) + corner[1], 0, height - 1)
    columns = np.clip(np.arange(shape[1]) + corner[0], 0, width - 1)
    return picture[np.ix_(rows, columns)].astype(np.float32)


def _inside(member: Mask) -> Rectangle:
    """Rectangle within the mask: sides come in until each is nearly all member, then a little further.

    The margin is what interpolation reaches across: background beyond the edge would leak in.
    """
    x, y, w, h = cv2.boundingRect(member.astype(np.uint8))
    x1, y1 = x + w, y + h
    while min(x1 - x, y1 - y) > 8:
        part = member[y:y1, x:x1]
        fill = [part[:, 0].mean(), part[0].mean(), part[:, -1].mean(), part[-1].mean()]
        side = int(np.argmin(fill))
        if fill[side] > 0.85:
            break
        x, y, x1, y1 = x + (side == 0), y + (side == 1), x1 - (side == 2), y1 - (side == 3)
    inset = int(np.clip(min(x1 - x, y1 - y) // 12, 0, 3))
    return (x + inset, y + inset, x1 - x - 2 * inset, y1 - y - 2 * inset)
