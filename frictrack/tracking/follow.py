"""Coarse search: where the target is to a fraction of a pixel in every frame, by normalised correlation.

The position is predicted from the last frames and looked for near there; when that fails, everywhere. What
later stages need of the film is kept on the way, so that it is decoded only once: a cut-out per frame (in a
temporary file, memory stays bounded) and the still background.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import IO

import cv2
import numpy as np
from numpy.typing import NDArray

from frictrack.recording import Frame, Recording
from frictrack.records import Array
from frictrack.tracking.match import Rectangle, correlate, cut_out, vertex
from frictrack.tracking.resample import PAD, Patch

Progress = Callable[[int, int, str], None]

UNREAD = "frame cannot be read"
NEAR = 0.8  # share of the usual score that a find near the prediction needs
SURE = 0.8  # a score below makes the rest of the picture worth a look, or a false find would be followed for ever
BETTER = 0.1  # by this much must another place match better
ANYWHERE = 0.5  # least score of a find anywhere
BACKGROUND_FRAMES = 25
BACKGROUND_BYTES = 64_000_000


@dataclass(frozen=True, eq=False)
class Coarse:
    """What the search leaves: one row per frame, and the cut-outs of the frames in which it found something."""

    corner: Array  # (n, 2) px, upper left corner of the target, NaN where lost
    score: Array  # (n,)
    reason: list[str]
    patches: Patch  # (m, h + 2 PAD, w + 2 PAD), on disk
    frame: NDArray[np.int64]  # (m,) frame of each cut-out
    origin: NDArray[np.int64]  # (m, 2) px, whole-pixel corner that each cut-out was taken at
    background: Array  # (H, W)
    change: Array  # (n,) rms by which the picture differs from the one before, grey values

    @property
    def start(self) -> Array:
        """Where the target is on each cut-out (m, 2) px."""
        return self.corner[self.frame] - self.origin


@dataclass
class Follower:
    """Looks for one patch in frame after frame."""

    patch: Frame
    usual: float = 1.0  # score of the last finds
    last: list[Array] = field(default_factory=list)  # up to two positions in successive frames
    lost: int = 0

    def find(self, frame: Frame) -> tuple[Array, float]:
        """Corner (x, y) px of the best match in `frame`, and its score; near the prediction if that will do."""
        part = self._near(frame)
        near = None if part is None else _match(frame, self.patch, part)
        if near is not None and near[1] >= max(SURE, NEAR * self.usual):
            return near
        anywhere = _match(frame, self.patch, None)
        if near is not None and near[1] >= max(ANYWHERE, NEAR * self.usual, anywhere[1] - BETTER):
            return near
        return anywhere

    def predicted(self) -> Array | None:
        """Where the corner should be now, from the last two finds."""
        if not self.last:
            return None
        return self.last[-1] + (self.lost + 1) * self._velocity()

    def accept(self, corner: Array, score: float) -> None:
        """Remember a find."""
        self.last = [*self.last[-1:], corner] if not self.lost else [corner]
        self.usual, self.lost = 0.8 * self.usual + 0.2 * score, 0

    def _velocity(self) -> Array:
        return self.last[-1] - self.last[-2] if len(self.last) == 2 else np.zeros(2)

    def _near(self, frame: Frame) -> Rectangle | None:
        """The part of the frame (x, y, w, h) to search first."""
        centre = self.predicted()
        if centre is None or self.lost:
            return None
        reach = 5 + np.ceil(0.5 * np.abs(self._velocity())) + (16 if len(self.last) < 2 else 0)
        size = np.array(self.patch.shape[::-1])
        low = np.clip(np.rint(centre) - reach, 0, np.array(frame.shape[::-1]) - size).astype(int)
        high = np.clip(np.rint(centre) + reach + size, low + size, frame.shape[::-1]).astype(int)
        return (int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))


def follow(
    recording: Recording, patch: Frame, start: tuple[int, int] | None = None, progress: Progress | None = None
) -> Coarse:
    """Search the `patch` (h, w) in every frame of `recording`; `start` is its corner in the first, if known."""
    follower = Follower(patch)
    follower.last = [] if start is None else [np.array(start, dtype=np.float64)]
    n = recording.n_frames
    corner, score, change = np.full((n, 2), np.nan), np.full(n, np.nan), np.full(n, np.nan)
    reason = [UNREAD] * n
    kept: list[Frame] = []
    stride = -(-n // _background_frames(recording))
    before: Frame | None = None
    with tempfile.TemporaryFile() as spool:
        for i, frame in enumerate(recording.frames()):
            corner[i], score[i], reason[i] = _one(follower, frame)
            if not reason[i]:
                spool.write(cut_out(frame, np.rint(corner[i]).astype(int), patch.shape).tobytes())
            if i % stride == 0:
                kept.append(frame)
            change[i], before = _change(before, frame), frame
            if progress and i % 50 == 0:
                progress(i, n, "search")
        rows = np.flatnonzero([not r for r in reason])
        patches = _mapped(spool, patch, len(rows))
    background = np.median(np.stack(kept), axis=0)
    return Coarse(corner, score, reason, patches, rows, np.rint(corner[rows]).astype(int), background, change)


def _mapped(spool: IO[bytes], patch: Frame, count: int) -> Patch:
    """The cut-outs in the temporary file, read as they are used."""
    shape = (count, patch.shape[0] + 2 * PAD, patch.shape[1] + 2 * PAD)
    if not count:
        return np.empty(shape, patch.dtype)
    spool.flush()
    return np.memmap(spool, patch.dtype, "r", shape=shape)


def _change(before: Frame | None, frame: Frame) -> float:
    """Rms difference of two pictures beyond a change of light, on every fourth pixel."""
    if before is None:
        return np.nan
    return float(np.std(frame[::4, ::4].astype(np.float32) - before[::4, ::4]))


def _one(follower: Follower, frame: Frame) -> tuple[Array, float, str]:
    """Corner, score and reason ("" when found) in one frame."""
    nowhere = np.full(2, np.nan)
    if frame.min() == frame.max():
        follower.lost += 1
        return nowhere, np.nan, "picture without contrast"
    corner, score = follower.find(frame)
    if score >= max(ANYWHERE, 0.6 * follower.usual):
        follower.accept(corner, score)
        return corner, score, ""
    reason = f"match score {score:.2f} below {max(ANYWHERE, 0.6 * follower.usual):.2f}"
    if _outside(follower.predicted(), follower.patch.shape, frame.shape):
        reason = "target leaves the frame"
    follower.lost += 1
    return nowhere, score, reason


def _outside(corner: Array | None, size: tuple[int, ...], shape: tuple[int, ...]) -> bool:
    """Whether a rectangle at `corner` would stick out of the frame or touch its edge."""
    if corner is None:
        return False
    room = np.array(shape[::-1]) - np.array(size[::-1])
    return bool(np.any(corner <= 0.5) or np.any(corner >= room - 0.5))


def _match(frame: Frame, patch: Frame, part: Rectangle | None) -> tuple[Array, float]:
    """Best zero-normalised correlation of `patch` in (a `part` of) `frame`: corner (x, y), score."""
    x, y, w, h = part or (0, 0, frame.shape[1], frame.shape[0])
    scores = correlate(frame[y : y + h, x : x + w], patch)
    _, best, _, (i, j) = cv2.minMaxLoc(scores)
    return np.array([x + i + vertex(scores[j], i), y + j + vertex(scores[:, i], j)]), float(best)


def _background_frames(recording: Recording) -> int:
    size = recording.shape[0] * recording.shape[1] * (2 if recording.bit_depth > 8 else 1)
    return int(np.clip(BACKGROUND_BYTES // size, 7, BACKGROUND_FRAMES))
