"""Find the moving body: what differs from the still background and travels."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from frictrack.errors import FrictrackError
from frictrack.records import Array, Mask
from frictrack.recording import Frame, Recording
from frictrack.tracking.follow import Rectangle, correlate

SAMPLES = 60
SAMPLE_BYTES = 96_000_000
LEAST_AREA = 30  # px
LEAST_TRAVEL = 1.5  # px
MATCH = 0.6
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
    """Rectangle (x, y, w, h) px of the moving body in the first frame that shows it; see `locate`."""
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
    noise = 1.4826 * float(np.median([np.median(np.abs(d)) for d in differences]))
    return Sample(index, frames, background, [_foreground(d, noise) for d in differences])


def _difference(frame: Frame, background: Array) -> Array:
    """Frame minus background, after the light has been evened out."""
    picture = frame.astype(np.float32)
    bright = background > np.median(background) * 0.5
    ratio = float(np.median(picture[bright] / np.maximum(background[bright], 1)))
    return picture - (ratio if 0.2 < ratio < 5 else 1.0) * background


def _foreground(difference: Array, noise: float) -> Mask:
    """Where the picture differs from the background by more than noise, as closed patches."""
    energy = cv2.GaussianBlur(difference**2, (0, 0), 1.5)
    # Smoothed squared noise scatters by about a quarter of its mean: nine times the mean is never noise.
    mask = (energy > 9 * max(noise, 0.5) ** 2).astype(np.uint8)
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8))
    return cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0


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
    blobs = [s for s in stats[1:] if s[4] >= LEAST_AREA and min(s[2:4]) >= 5 and s[4] < 0.6 * mask.size]
    return [(int(x), int(y), int(w), int(h)) for x, y, w, h, _ in sorted(blobs, key=lambda s: -s[4])]


def _pursue(sample: Sample, row: int, box: Rectangle) -> Body:
    """Look for the contents of `box` in every sampled frame, among what is foreground there."""
    x, y, w, h = box
    patch = sample.frames[row][y : y + h, x : x + w]
    corner = np.full((len(sample.frames), 2), np.nan)
    for k, frame in enumerate(sample.frames):
        scores = correlate(frame, patch)
        _, score, _, (i, j) = cv2.minMaxLoc(scores)
        still = not sample.foreground[k][j : j + h, i : i + w].mean() > 0.3
        if score > MATCH and not still:
            corner[k] = i, j
    seen = np.isfinite(corner[:, 0])
    travel = float(np.hypot(*np.ptp(corner[seen], axis=0))) if seen.any() else 0.0
    merit = seen.sum() * travel * np.sqrt(w * h) if travel > LEAST_TRAVEL else 0.0
    return Body(box, row, corner, float(merit))


def _outline(sample: Sample, body: Body) -> tuple[Rectangle, int]:
    """The rectangle inside what moves with the body, and the first sampled frame that shows it."""
    member, (left, top) = _members(sample, body)
    inner = _inside(member)
    seen = np.flatnonzero(np.isfinite(body.corner[:, 0]))
    first = int(seen[0])
    x, y = (int(c) for c in body.corner[first] + (left, top))
    return (x + inner[0], y + inner[1], inner[2], inner[3]), sample.index[first]


def _members(sample: Sample, body: Body) -> tuple[Mask, tuple[int, int]]:
    """Pixels round the box that move with the body, and the offset of that window from the box's corner.

    A pixel moves with the body if, over the frames, the body's median picture explains it better than the
    background does.
    """
    x, y, w, h = body.box
    reach = int(np.ceil(0.1 * max(w, h))) + 3
    shape = (h + 2 * reach, w + 2 * reach)
    seen = np.flatnonzero(np.isfinite(body.corner[:, 0]))
    pictures, scenes = [], []
    for k in seen:
        at = body.corner[k].astype(int) - reach
        pictures.append(_window(sample.frames[k].astype(np.float32), at, shape))
        scenes.append(_window(sample.background, at, shape))
    stack, scene = np.stack(pictures), np.stack(scenes)
    spread = np.nanmedian((stack - np.nanmedian(stack, axis=0)) ** 2, axis=0)
    differs = np.nanmedian((stack - scene) ** 2, axis=0)
    smooth = [cv2.GaussianBlur(np.nan_to_num(e), (0, 0), 1.0) for e in (spread, differs)]
    member = (smooth[0] < 0.5 * smooth[1]).astype(np.uint8)
    member = cv2.morphologyEx(member, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    member = cv2.morphologyEx(member, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return member > 0, (-reach, -reach)


def _window(picture: Array, corner: np.ndarray, shape: tuple[int, int]) -> Array:
    """A window of the picture, NaN outside it."""
    out = np.full(shape, np.nan, np.float32)
    x, y = corner
    height, width = picture.shape
    y0, y1, x0, x1 = max(y, 0), min(y + shape[0], height), max(x, 0), min(x + shape[1], width)
    out[y0 - y : y1 - y, x0 - x : x1 - x] = picture[y0:y1, x0:x1]
    return out


def _inside(member: Mask) -> Rectangle:
    """Rectangle within the largest connected patch: sides come in until each is nearly all member."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(member.astype(np.uint8))
    best = 1 + int(np.argmax(stats[1:, 4]))
    x, y, w, h, _ = (int(s) for s in stats[best])
    x1, y1 = x + w, y + h
    mask = labels == best
    while min(x1 - x, y1 - y) > 8:
        part = mask[y:y1, x:x1]
        fill = [part[:, 0].mean(), part[0].mean(), part[:, -1].mean(), part[-1].mean()]
        side = int(np.argmin(fill))
        if fill[side] > 0.85:
            break
        x, y, x1, y1 = x + (side == 0), y + (side == 1), x1 - (side == 2), y1 - (side == 3)
    return (x + 1, y + 1, x1 - x - 2, y1 - y - 2)
