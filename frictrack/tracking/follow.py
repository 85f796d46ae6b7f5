"""Follow the target through the film: predict, read its rectangle, refine; search where that fails.

Frames are taken in batches: from the path so far the target's place is predicted in all of them, only the
rectangles there are read, and the products with the template say where it really is. A prediction that is off
by more than the template's reach is mended by reading again; one that fails is followed by a search near there
and then in the whole picture.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from frictrack.errors import FrictrackError
from frictrack.recording import Frame, Recording
from frictrack.records import Array, Mask
from frictrack.tracking.match import Patch, Rectangle, correlate, vertex
from frictrack.tracking.measure import LEAST_LEFT, without_what_does_not_fit
from frictrack.tracking.refine import Fine, products, refine
from frictrack.tracking.template import Template
from frictrack.tracking.view import View
from frictrack.tracking.waves import RANGE

Progress = Callable[[int, int, str], None]

UNREAD = "frame cannot be read"
FLAT = "picture without contrast"
LEAVES = "target leaves the frame"
UNSETTLED = "sub-pixel search did not settle"
LEAST_SCORE = 0.35  # below this nothing is taken for the target, however noisy the film is
SHARE = 0.7  # of the film's usual score that a find must reach
SURE = 0.8  # a score below makes the rest of the picture worth a look, or a false find would be followed for ever
ANYWHERE = 0.5  # least score of a find far from where the target should be
BETTER = 0.1  # by this much must another place match better than the one that is near
SURPRISE = 1.5  # px off the prediction: no find in a batch, or a pattern that repeats would be followed one period off
REACH = 24  # px searched round the prediction
STILL = 4  # px that a shaken camera may move what stands
BATCH = (8, 256)  # frames predicted at once: least, most
AGAIN = 4  # times that a batch is read at better corners
FORGOTTEN = 128  # frames without a find after which the target may be anywhere
HIDDEN = 16  # frames after which the path is no guide any more
NOISIER = 4.0  # times the usual misfit at most, of what is left of a partly hidden target
MEMORY = 24  # frames from which the next are predicted


@dataclass(frozen=True, eq=False)
class Followed:
    """Where the target is, frame by frame: rows of `fine` are NaN where it was not found."""

    corner: NDArray[np.int64]  # (n, 2) px, upper left corner of each cut-out
    fine: Fine
    reason: NDArray[np.object_]  # (n,), "" where found

    @property
    def at(self) -> Array:
        """Upper left corner of the target's rectangle (n, 2) px."""
        return self.corner + self.fine.at

    @property
    def found(self) -> Mask:
        """Frames in which the target was found."""
        return np.asarray(self.reason == "")


def nowhere(n: int) -> Followed:
    """A track of `n` frames in which nothing was found yet."""
    nan = np.full(n, np.nan)
    pair = np.full((n, 2), np.nan)
    score, gain, offset, misfit = (nan.copy() for _ in range(4))
    fine = Fine(pair, nan, np.full((n, 3), np.nan), score, gain, offset, misfit, np.zeros(n, np.bool_))
    return Followed(np.zeros((n, 2), np.int64), fine, np.full(n, UNREAD, dtype=object))


@dataclass
class _Path:
    """The path so far, and which polynomial foretold it best, for each axis."""

    way: int = 1  # forward or backward through the film
    frame: list[int] = field(default_factory=list)
    at: list[Array] = field(default_factory=list)
    degree: list[int] = field(default_factory=lambda: [1, 1])

    def add(self, frame: NDArray[np.int64], at: Array) -> None:
        """Remember finds; judge the predictors by them first."""
        if len(frame) > 2 and len(self.frame) > 4:
            miss = [np.max(np.abs(foretold - at), axis=0) for foretold in self._foretold(frame)]
            self.degree = np.argmin(miss, axis=0).tolist()
        self.frame = [*self.frame, *frame[-MEMORY:].tolist()][-MEMORY:]
        self.at = [*self.at, *at[-MEMORY:]][-MEMORY:]

    def forget(self, frame: int, at: Array) -> None:
        """Start again: the path broke off, the target is here now; the frame before may still tell the velocity."""
        last = [(f, a) for f, a in zip(self.frame, self.at, strict=True) if f == frame - self.way]
        self.frame, self.at = [f for f, _ in last] + [frame], [a for _, a in last] + [at]
        self.degree = [1, 1]

    def age(self, frame: int) -> int:
        """Frames since the last find."""
        return abs(frame - self.frame[-1])

    def predicted(self, frame: NDArray[np.int64]) -> Array:
        """Where the target should be in these frames (n, 2) px."""
        every = self._foretold(frame)
        return np.stack([every[min(d, len(every) - 1)][:, axis] for axis, d in enumerate(self.degree)], axis=1)

    def _foretold(self, frame: NDArray[np.int64]) -> list[Array]:
        """The same by polynomials of degree 0, 1, 2 through the path so far, as far as that carries them."""
        when = np.array(self.frame, dtype=np.float64) - self.frame[-1]
        scale = max(abs(when[0]), 1.0)
        powers, ahead = ((t[:, None] / scale) ** np.arange(3) for t in (when, frame - self.frame[-1]))
        known = np.array(self.at)
        normal, right = powers.T @ powers, powers.T @ known
        highest = 2 if len(known) > 4 else len(known) - 1 if len(known) < 3 else 1
        fits = [ahead[:, :d] @ np.linalg.solve(normal[:d, :d], right[:d]) for d in range(2, highest + 2)]
        return [np.broadcast_to(known[-1], (len(frame), 2)), *fits]


class Follower:
    """Follows one target through a film of which any rectangle can be read."""

    def __init__(self, film: Recording, template: Template, view: View | None = None) -> None:
        self.film, self.template, self.view = film, template, view
        self.size = template.weight.shape
        self.room = np.array(film.shape[::-1]) - np.array(self.size[::-1])
        self.usual, self.noise = 1.0, np.inf  # score and misfit of the last finds
        self.template_frame, self.start = 0, np.zeros(2)
        low = template.image
        self.patch = np.clip(np.rint(low), 0, 2**film.bit_depth - 1).astype(
            np.uint8 if film.bit_depth == 8 else np.uint16
        )

    @property
    def least_score(self) -> float:
        """What a find must reach."""
        return max(LEAST_SCORE, SHARE * self.usual)

    def follow(self, start: Array, template: int = 0, progress: Progress | None = None) -> Followed:
        """All frames; `start` (2,) is the corner in frame `template`, from which the film is followed both ways."""
        result, self.template_frame, self.start = nowhere(self.film.n_frames), template, np.asarray(start)
        self._along(np.arange(template, self.film.n_frames), start, result, progress)
        if template:
            self._along(np.arange(template, -1, -1), start, result, progress)
        return result

    def _along(
        self, order: NDArray[np.int64], start: Array, result: Followed, progress: Progress | None = None
    ) -> None:
        """The frames in this order, the target being at `start` in the first of them."""
        path, n = _Path(int(order[-1] >= order[0]) * 2 - 1), len(order)
        path.forget(int(order[0]), np.asarray(start, dtype=np.float64))
        self._batch(order[:1], path, result)
        path.forget(int(order[0]), path.at[-1])  # one place tells no velocity
        i, batch = 1, BATCH[0]
        while i < n:
            if progress:
                progress(i, n, "follow")
            if path.age(order[i]) <= BATCH[0]:
                frames = order[i : i + batch]
                done, calm = self._batch(frames, path, result)
                i += done
                batch = int(np.clip(batch * 2 if calm else batch // 2, *BATCH))
                if done:  # what was found foretells the rest better
                    continue
            if not self._covered(int(order[i]), path, result):
                self._search(int(order[i]), path, result)
            batch, i = BATCH[0], i + 1

    def _batch(self, frames: NDArray[np.int64], path: _Path, result: Followed) -> tuple[int, bool]:
        """How many of these frames, from the first on, hold the target; and whether the prediction was good."""
        predicted = path.predicted(frames)
        try:
            corner, fine = self.read(frames, predicted)
        except FrictrackError:
            return 0, False
        miss = np.max(np.abs(corner + fine.at - predicted), axis=1)
        good = self.accepted(corner, fine) & (miss < SURPRISE) & (fine.misfit < NOISIER * self.noise)
        count = len(frames) if good.all() else int(np.argmin(good))
        self._keep(frames[:count], corner[:count], fine[slice(0, count)], result)
        if count:
            path.add(frames[:count], (corner + fine.at)[:count])
            if fine.score[count - 1] < SURE:
                self._doubt(int(frames[count - 1]), path, float(fine.score[count - 1]))
        return count, bool(count == len(frames) and np.max(miss) < RANGE)

    def _covered(self, i: int, path: _Path, result: Followed) -> bool:
        """Whether the target is where it should be in frame `i`, though partly hidden; if so it is kept."""
        if path.age(i) > HIDDEN or np.isinf(self.noise):
            return False
        frames = np.array([i])
        predicted = path.predicted(frames)
        corner = np.rint(predicted).astype(np.int64).clip(0, self.room)
        try:
            cuts = self.film.cut(frames, corner, self.size)
        except FrictrackError:
            return False
        last = result.fine[np.array([path.frame[-1]])]
        guess = replace(last, at=np.clip(predicted - corner, -RANGE, RANGE))
        share = None if self.view is None else self.view.shares(corner, self.size)
        fine, _ = without_what_does_not_fit(cuts, guess, self.template, share, self.noise)
        near = np.max(np.abs(corner + fine.at - predicted)) < SURPRISE
        if not (near and self.accepted(corner, fine)[0] and fine.misfit[0] < NOISIER * self.noise):
            return False
        result.corner[i], result.reason[i] = corner[0], ""
        result.fine.put(frames, fine)
        path.add(frames, corner + fine.at)
        return True

    def read(self, frames: NDArray[np.int64], predicted: Array) -> tuple[NDArray[np.int64], Fine]:
        """Corners (n, 2) and positions in these frames, from predictions (n, 2) px good to a pixel or two."""
        corner = np.rint(predicted).astype(np.int64).clip(0, self.room)
        fine = self._refined(frames, corner, np.clip(predicted - corner, -RANGE, RANGE))
        before = corner.copy()
        for _ in range(AGAIN):
            better = (corner + np.rint(np.nan_to_num(fine.at)).astype(np.int64)).clip(0, self.room)
            anew = np.any(better != corner, axis=1) & np.any(better != before, axis=1)  # no going to and fro
            off = np.any(np.abs(fine.at) > RANGE, axis=1) & anew
            if not off.any():
                break
            start = np.clip((corner + fine.at - better)[off], -RANGE, RANGE)
            before[off], corner[off] = corner[off], better[off]
            again = self._refined(frames[off], corner[off], start)
            fine.put(off, again)
        return corner, fine

    def _refined(self, frames: NDArray[np.int64], corner: NDArray[np.int64], start: Array) -> Fine:
        cuts = self.film.cut(frames, corner, self.size)
        fine = refine(products(cuts, self.template), start, self.template)
        if self.view is None:
            return fine
        share = self.view.shares(corner, self.size)
        rows = np.flatnonzero(np.any(share < 1, axis=(1, 2)))
        if len(rows):
            fine.put(rows, refine(products(cuts[rows], self.template, share[rows]), start[rows], self.template))
            fine.settled[rows] &= _shown(share[rows], self.template) > LEAST_LEFT
        return fine

    def accepted(self, corner: NDArray[np.int64], fine: Fine) -> Mask:
        """Finds that can be trusted: settled, well matched, and within the picture."""
        inside = np.all((corner + fine.at > -0.5) & (corner + fine.at < self.room + 0.5), axis=1)
        within = np.all(np.abs(fine.at) < RANGE + 0.05, axis=1)
        return fine.settled & (fine.score >= self.least_score) & inside & within

    def _keep(self, frames: NDArray[np.int64], corner: NDArray[np.int64], fine: Fine, result: Followed) -> None:
        result.corner[frames] = corner
        result.fine.put(frames, fine)
        result.reason[frames] = ""
        if len(frames):
            self.usual = 0.9 * self.usual + 0.1 * float(np.median(fine.score))
        if len(frames) and frames[0] != self.template_frame:  # that fits itself too well
            misfit = max(float(np.median(fine.misfit)), self.template.least_misfit)
            self.noise = misfit if np.isinf(self.noise) else 0.9 * self.noise + 0.1 * misfit

    def _search(self, i: int, path: _Path, result: Followed) -> None:
        """Look for the target in frame `i`, near where it should be and then everywhere."""
        try:
            frame = self.film.frame(i)
        except FrictrackError:
            return
        if frame.min() == frame.max():
            result.reason[i] = FLAT
            return
        predicted = path.predicted(np.array([i]))[0]
        place, score = self._look(frame, predicted if path.age(i) < FORGOTTEN else None)
        if score >= max(ANYWHERE * self.usual, LEAST_SCORE):
            corner, fine = self.read(np.array([i]), place[None])
            if self.accepted(corner, fine)[0] and not self._stands(place, score):
                self._keep(np.array([i]), corner, fine, result)
                path.forget(i, (corner + fine.at)[0])
                return
            score = min(score, float(fine.score[0]))
        result.fine.score[i] = score
        result.reason[i] = f"match score {score:.2f} below {self.least_score:.2f}"
        if self._touches(predicted):
            result.reason[i] = LEAVES

    def _doubt(self, i: int, path: _Path, score: float) -> None:
        """What matches so badly may be a false find: go on from another place if that is clearly better."""
        place, best = self._match(self.film.frame(i), None)
        away = np.max(np.abs(place - path.at[-1])) > SURPRISE
        if best > score + BETTER and away and not self._stands(place, best):
            path.forget(i, place)

    def _stands(self, place: Array, score: float) -> bool:
        """Whether what matches at a place stood there as well while the target was elsewhere: then it is another."""
        if np.all(np.abs(place - self.start) < self.size[::-1]):
            return False
        return self._near(self.film.frame(self.template_frame), place, STILL)[1] > score - BETTER

    def _touches(self, corner: Array) -> bool:
        """Whether a rectangle at `corner` would stick out of the picture or touch its edge."""
        return bool(np.any(corner <= 0.5) or np.any(corner >= self.room - 0.5))

    def _look(self, frame: Frame, predicted: Array | None) -> tuple[Array, float]:
        """The best match: near the prediction, unless another place is clearly better."""
        near = None
        if predicted is not None:
            near = self._near(frame, predicted, REACH)
            if near[1] >= 0.8 * self.usual:
                return near
        anywhere = self._match(frame, None)
        return near if near is not None and near[1] >= max(ANYWHERE, anywhere[1] - BETTER) else anywhere

    def _near(self, frame: Frame, place: Array, reach: int) -> tuple[Array, float]:
        """The best match within so many pixels of a place."""
        low = np.clip(np.rint(place) - reach, 0, self.room).astype(int)
        high = np.clip(np.rint(place) + reach, low, self.room).astype(int) + self.size[::-1]
        return self._match(frame, (int(low[0]), int(low[1]), *(high - low).tolist()))

    def _match(self, frame: Frame, part: Rectangle | None) -> tuple[Array, float]:
        """Best zero-normalised correlation of the target in (a `part` of) a frame: corner (x, y), score."""
        x, y, w, h = part or (0, 0, frame.shape[1], frame.shape[0])
        scores = correlate(frame[y : y + h, x : x + w], self.patch, self.template.belongs)
        _, best, _, (i, j) = cv2.minMaxLoc(scores)
        return np.array([x + i + vertex(scores[j], i), y + j + vertex(scores[:, i], j)]), float(best)


def _shown(share: Patch, template: Template) -> Array:
    """How much of the target's pixels (n,) is not behind an obstacle."""
    counts = template.weight > 0
    return np.asarray(share[:, counts].mean(axis=1))
