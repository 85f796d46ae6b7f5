"""Follow a target through the film: predict batches of frames, read their cut-outs, refine; search where that fails.

The path so far predicts the position in a batch of frames. Only the cut-outs at the predicted positions are read, and
the products with the template give the true positions. A cut-out that is off by more than the range of the template is
read again. A frame in which that fails is searched, first near the prediction and then everywhere.

Follow and measure a long film in segments, in this process or in several, with the same numbers.

A long film is always cut into the same segments, however many processes there are. The target is looked for in the
whole first frame of each segment, and followed from there into the first frames of the next one. Two segments are
joined if they agree about these frames. From the first segment that does not fit, the film is followed frame by frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError, result_or_none
from frictrack.recording import Frame, Recording
from frictrack.records import Array, Mask
from frictrack.tracking.correlation import Patch, Rectangle, best_match, nearest_corner
from frictrack.tracking.measure import MIN_REMAINING_SHARE, refine_predicted
from frictrack.tracking.subpixel_fit import (
    FLAT,
    LEAVES,
    RawTrack,
    SubpixelFit,
    empty_track,
    refine_positions,
    template_products,
)
from frictrack.tracking.template import MAX_SHIFT_PX, FixedPattern, TargetModel, Template

if TYPE_CHECKING:
    from frictrack.base.workers import WorkerPool

Progress = Callable[[int, int, str], None]

MIN_SCORE = 0.35  # a lower match score is never accepted, however noisy the film is
MIN_SCORE_SHARE = 0.7  # of the film's typical score, that a find must reach
CONFIDENT_SCORE = 0.8  # below it the rest of the picture is searched, or a false find would be tracked to the end
MIN_DISTANT_SCORE_SHARE = 0.5  # of the typical score, that a find far from the prediction must reach
CLEARLY_BETTER_SCORE = 0.1  # difference by which a distant match must exceed the near one
# a batch find further off is rejected, or a periodic pattern would be tracked one period off
MAX_PREDICTION_ERROR_PX = 1.5
SEARCH_RADIUS_PX = 24  # round the prediction
STATIC_SEARCH_PX = 4  # by which camera shake may move a static object
BATCH_FRAMES = (8, 256)  # smallest and largest number of frames predicted at once
MAX_RECENTRINGS = 4  # times that a batch is read again at better corners
MAX_LOST_FRAMES = 128  # after which the target may be anywhere
MAX_OCCLUDED_FRAMES = 16  # after which the prediction is no longer used
MAX_MISFIT_RATIO = 4.0  # misfit over the typical one, for the visible part of a partly hidden target
PREDICTOR_FRAMES = 24  # last finds from which the next are predicted
SEGMENT_FRAMES = 1000  # a search of one picture costs as much as following a few dozen frames
OVERLAP_FRAMES = 8  # that two segments have in common
# Of two segments about the same frame. A first template errs by a quarter of a pixel where edges are sharp; another
# object, or the next period of a pattern, is farther away.
MAX_DISAGREEMENT_PX = 1.0


@dataclass
class _PathPredictor:
    """Predict positions from the last finds, by the polynomial that predicted best so far on each axis."""

    direction: int = 1  # forward or backward through the film
    frame: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    position: Array = field(default_factory=lambda: np.empty((0, 2)))
    degree: list[int] = field(default_factory=lambda: [1, 1])

    def add(self, frame: NDArray[np.int64], at: Array) -> None:
        """Add finds; first choose the degree that would have predicted them best."""
        if len(frame) > 2 and len(self.frame) > 4:
            errors = [np.max(np.abs(prediction - at), axis=0) for prediction in self._polynomial_predictions(frame)]
            self.degree = np.argmin(errors, axis=0).tolist()
        self.frame = np.append(self.frame, frame)[-PREDICTOR_FRAMES:]
        self.position = np.concatenate([self.position, at])[-PREDICTOR_FRAMES:]

    def restart(self, frame: int, at: Array) -> None:
        """Start a new path at this place; only a find in the frame just before is kept, for the velocity."""
        last = self.frame == frame - self.direction
        self.frame, self.position = np.append(self.frame[last], frame), np.vstack([self.position[last], at])
        self.degree = [1, 1]

    def age(self, frame: int) -> int:
        """Frames since the last find."""
        return abs(frame - int(self.frame[-1]))

    def predicted(self, frame: NDArray[np.int64]) -> Array:
        """Predicted positions (n, 2) px in these frames."""
        predictions = self._polynomial_predictions(frame)
        return np.stack(
            [predictions[min(d, len(predictions) - 1)][:, axis] for axis, d in enumerate(self.degree)], axis=1
        )

    def _polynomial_predictions(self, frame: NDArray[np.int64]) -> list[Array]:
        """Predictions by polynomials of degree 0, 1 and 2, as far as there are enough finds."""
        past = (self.frame - self.frame[-1]).astype(np.float64)
        scale = max(abs(past[0]), 1.0)
        powers, ahead = ((t[:, None] / scale) ** np.arange(3) for t in (past, frame - self.frame[-1]))
        count = len(self.position)
        normal, right = powers.T @ powers, powers.T @ self.position
        highest = 2 if count > 4 else count - 1 if count < 3 else 1
        fits = [ahead[:, :d] @ np.linalg.solve(normal[:d, :d], right[:d]) for d in range(2, highest + 2)]
        return [np.broadcast_to(self.position[-1], (len(frame), 2)), *fits]


class BatchTracker:
    """Follow one target through a film whose frames can be read in any order.

    Parameters
    ----------
    film : Recording
        Film with random access.
    template : Template
        Template of the target.
    pattern : FixedPattern, optional
        Obstacles before the target.
    typical_score : float
        Match score that the target has at first.

    """

    def __init__(
        self, film: Recording, template: Template, pattern: FixedPattern | None = None, typical_score: float = 1.0
    ) -> None:
        self.film, self.template, self.pattern, self.first_score = film, template, pattern, typical_score
        self.size = template.weight.shape
        self.max_corner = np.array(film.shape[::-1]) - np.array(self.size[::-1])
        grey = np.uint8 if film.bit_depth == 8 else np.uint16
        self.patch = np.clip(np.rint(template.image), 0, 2**film.bit_depth - 1).astype(grey)

    @property
    def min_score(self) -> float:
        """Match score that a find must reach."""
        return max(MIN_SCORE, MIN_SCORE_SHARE * self.typical_score)

    def follow(
        self, order: NDArray[np.int64], start: Array, template: int, progress: Progress | None = None
    ) -> RawTrack:
        """Follow the target through some frames.

        Parameters
        ----------
        order : array of int (m,)
            Numbers of neighbouring frames, rising or falling.
        start : array (2,)
            Corner of the target's rectangle in the first of them, px.
        template : int
            Number of the frame that made the first template.
        progress : callable, optional
            Called as ``progress(done, total, step)``.

        Returns
        -------
        RawTrack
            One row per frame of `order`.

        """
        result, self.template_frame, self.start = empty_track(self.film.n_frames), template, np.asarray(start)
        self.typical_score, self.typical_misfit = self.first_score, np.inf  # score and misfit of the last finds
        path, n = _PathPredictor(int(order[-1] >= order[0]) * 2 - 1), len(order)
        path.restart(int(order[0]), np.asarray(start, dtype=np.float64))
        self._follow_batch(order[:1], path, result)
        path.restart(int(order[0]), path.position[-1])  # one position gives no velocity
        i, batch = 1, BATCH_FRAMES[0]
        while i < n:
            if progress:
                progress(i, n, "follow")
            if path.age(order[i]) <= BATCH_FRAMES[0]:
                frames = order[i : i + batch]
                done, well_predicted = self._follow_batch(frames, path, result)
                i += done
                batch = int(np.clip(batch * 2 if well_predicted else batch // 2, *BATCH_FRAMES))
                if done:  # what was found foretells the rest better
                    continue
            if not self._find_occluded(int(order[i]), path, result):
                self._search(int(order[i]), path, result)
            batch, i = BATCH_FRAMES[0], i + 1
        return result[order]

    def _follow_batch(self, frames: NDArray[np.int64], path: _PathPredictor, result: RawTrack) -> tuple[int, bool]:
        """Measure a batch of frames at their predicted positions.

        Returns how many of the frames hold the target, counted from the first, and whether the prediction was accurate.
        """
        predicted = path.predicted(frames)
        try:
            corner, fit = self.read(frames, predicted)
        except FrictrackError:
            return 0, False
        errors = np.max(np.abs(corner + fit.position - predicted), axis=1)
        accepted_rows = (
            self.accepted(corner, fit)
            & (errors < MAX_PREDICTION_ERROR_PX)
            & (fit.misfit < MAX_MISFIT_RATIO * self.typical_misfit)
        )
        count = len(frames) if accepted_rows.all() else int(np.argmin(accepted_rows))
        self._accept(frames[:count], corner[:count], fit[slice(0, count)], result)
        if count:
            path.add(frames[:count], (corner + fit.position)[:count])
            if fit.score[count - 1] < CONFIDENT_SCORE:
                self._check_other_places(int(frames[count - 1]), path, float(fit.score[count - 1]))
        return count, bool(count == len(frames) and np.max(errors) < MAX_SHIFT_PX)

    def _find_occluded(self, i: int, path: _PathPredictor, result: RawTrack) -> bool:
        """Look for a partly hidden target at its predicted position in frame `i`; store it if it is there."""
        if path.age(i) > MAX_OCCLUDED_FRAMES or np.isinf(self.typical_misfit):
            return False
        frames = np.array([i])
        predicted, last = path.predicted(frames), result.fit[np.array([path.frame[-1]])]
        model = TargetModel(self.template, self.pattern)
        try:
            corner, fit = refine_predicted(self.film, frames, predicted, last, model, self.typical_misfit)
        except FrictrackError:
            return False
        near = np.max(np.abs(corner + fit.position - predicted)) < MAX_PREDICTION_ERROR_PX
        if not (near and self.accepted(corner, fit)[0] and fit.misfit[0] < MAX_MISFIT_RATIO * self.typical_misfit):
            return False
        result.corner[i], result.reason[i] = corner[0], ""
        result.fit.put(frames, fit)
        path.add(frames, corner + fit.position)
        return True

    def read(self, frames: NDArray[np.int64], predicted: Array) -> tuple[NDArray[np.int64], SubpixelFit]:
        """Read and refine frames at predicted positions.

        Parameters
        ----------
        frames : array of int (n,)
            Numbers of the frames.
        predicted : array (n, 2)
            Positions accurate to a pixel or two, px.

        Returns
        -------
        corner : array of int (n, 2)
            Corners of the cut-outs, px.
        fit : SubpixelFit
            Fit on these cut-outs.

        """
        corner = nearest_corner(predicted, self.film.shape, self.size)
        fit = self._refined(frames, corner, np.clip(predicted - corner, -MAX_SHIFT_PX, MAX_SHIFT_PX))
        previous = corner.copy()
        for _ in range(MAX_RECENTRINGS):
            recentred = (corner + np.rint(np.nan_to_num(fit.position)).astype(np.int64)).clip(0, self.max_corner)
            is_new = np.any(recentred != corner, axis=1) & np.any(recentred != previous, axis=1)  # no going to and fro
            moved = np.any(np.abs(fit.position) > MAX_SHIFT_PX, axis=1) & is_new
            if not moved.any():
                break
            start = np.clip((corner + fit.position - recentred)[moved], -MAX_SHIFT_PX, MAX_SHIFT_PX)
            previous[moved], corner[moved] = corner[moved], recentred[moved]
            fit.put(moved, self._refined(frames[moved], corner[moved], start))
        return corner, fit

    def _refined(self, frames: NDArray[np.int64], corner: NDArray[np.int64], start: Array) -> SubpixelFit:
        """Refine the positions on cut-outs at these corners, without the pixels that obstacles cover."""
        cuts = self.film.cut(frames, corner, self.size)
        fit = refine_positions(template_products(cuts, self.template), start, self.template)
        if self.pattern is None:
            return fit
        share = self.pattern.pixel_shares(corner, self.size)
        rows = np.flatnonzero(np.any(share < 1, axis=(1, 2)))
        if len(rows):
            products = template_products(cuts[rows], self.template, share[rows])
            fit.put(rows, refine_positions(products, start[rows], self.template))
            fit.converged[rows] &= _visible_share(share[rows], self.template) > MIN_REMAINING_SHARE
        return fit

    def accepted(self, corner: NDArray[np.int64], fit: SubpixelFit) -> Mask:
        """Decide which finds can be trusted: converged, a good match, and in the picture, (n,)."""
        inside = np.all((corner + fit.position > -0.5) & (corner + fit.position < self.max_corner + 0.5), axis=1)
        within = np.all(np.abs(fit.position) < MAX_SHIFT_PX + 0.05, axis=1)
        return fit.converged & (fit.score >= self.min_score) & inside & within

    def _accept(self, frames: NDArray[np.int64], corner: NDArray[np.int64], fit: SubpixelFit, result: RawTrack) -> None:
        """Store finds and update the typical score and misfit."""
        result.corner[frames] = corner
        result.fit.put(frames, fit)
        result.reason[frames] = ""
        if len(frames):
            self.typical_score = 0.9 * self.typical_score + 0.1 * float(np.median(fit.score))
        if len(frames) and frames[0] != self.template_frame:  # that fits itself too well
            misfit = max(float(np.median(fit.misfit)), self.template.min_misfit)
            self.typical_misfit = misfit if np.isinf(self.typical_misfit) else 0.9 * self.typical_misfit + 0.1 * misfit

    def _search(self, i: int, path: _PathPredictor, result: RawTrack) -> None:
        """Search frame `i` for the target, near the prediction and then everywhere."""
        frame = result_or_none(self.film.frame, i)
        if frame is None:
            return
        if frame.min() == frame.max():
            result.reason[i] = FLAT
            return
        predicted = path.predicted(np.array([i]))[0]
        place, score = self._best_match(frame, predicted if path.age(i) < MAX_LOST_FRAMES else None)
        if score >= max(MIN_DISTANT_SCORE_SHARE * self.typical_score, MIN_SCORE):
            corner, fit = self.read(np.array([i]), place[None])
            if self.accepted(corner, fit)[0] and not self._is_static(place, score):
                self._accept(np.array([i]), corner, fit, result)
                path.restart(i, (corner + fit.position)[0])
                return
            score = min(score, float(fit.score[0]))
        result.fit.score[i] = score
        result.reason[i] = f"match score {score:.2f} below {self.min_score:.2f}"
        if self._touches_edge(predicted):
            result.reason[i] = LEAVES

    def _check_other_places(self, i: int, path: _PathPredictor, score: float) -> None:
        """Continue from another place where it matches clearly better: a poor match may be a false find."""
        place, best = self.match(self.film.frame(i), None)
        is_elsewhere = np.max(np.abs(place - path.position[-1])) > MAX_PREDICTION_ERROR_PX
        if best > score + CLEARLY_BETTER_SCORE and is_elsewhere and not self._is_static(place, best):
            path.restart(i, place)

    def _is_static(self, place: Array, score: float) -> bool:
        """Whether the same match stood at this place while the target was elsewhere: then it is another object."""
        if np.all(np.abs(place - self.start) < self.size[::-1]):
            return False
        return (
            self.match_near(self.film.frame(self.template_frame), place, STATIC_SEARCH_PX)[1]
            > score - CLEARLY_BETTER_SCORE
        )

    def _touches_edge(self, corner: Array) -> bool:
        """Whether a rectangle at `corner` touches the edge of the picture or leaves it."""
        return bool(np.any(corner <= 0.5) or np.any(corner >= self.max_corner - 0.5))

    def _best_match(self, frame: Frame, predicted: Array | None) -> tuple[Array, float]:
        """The best match: near the prediction, unless another place is clearly better."""
        near = None
        if predicted is not None:
            near = self.match_near(frame, predicted, SEARCH_RADIUS_PX)
            if near[1] >= 0.8 * self.typical_score:
                return near
        anywhere = self.match(frame, None)
        return (
            near
            if near is not None and near[1] >= max(MIN_DISTANT_SCORE_SHARE, anywhere[1] - CLEARLY_BETTER_SCORE)
            else anywhere
        )

    def match_near(self, frame: Frame, place: Array, reach: int | Array) -> tuple[Array, float]:
        """The best match within `reach` px of a place."""
        low = np.clip(np.rint(place) - reach, 0, self.max_corner).astype(int)
        high = np.clip(np.rint(place) + reach, low, self.max_corner).astype(int) + self.size[::-1]
        return self.match(frame, (int(low[0]), int(low[1]), *(high - low).tolist()))

    def match(self, frame: Frame, part: Rectangle | None) -> tuple[Array, float]:
        """The best match in a frame or a `part` of it: corner (x, y) px and score."""
        x, y, w, h = part or (0, 0, frame.shape[1], frame.shape[0])
        corner, score = best_match(frame[y : y + h, x : x + w], self.patch, self.template.mask)
        return corner + np.array([x, y]), score


def _visible_share(share: Patch, template: Template) -> Array:
    """Share (n,) of the target's pixels that no obstacle covers."""
    counts = template.weight > 0
    return np.asarray(share[:, counts].mean(axis=1))


@dataclass(frozen=True)
class Work:
    """Where work is done, and who hears of its progress.

    Attributes
    ----------
    progress : callable or None
        Called as ``progress(done, total, step)``.
    pool : WorkerPool or None
        Processes that take over segments; None for this process.

    """

    progress: Progress | None = None
    pool: WorkerPool | None = None

    def report(self, done: int, total: int, step: str) -> None:
        """Report progress."""
        if self.progress:
            self.progress(done, total, step)

    def run(self, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], step: str) -> Iterator[Any]:
        """Call a function without side effects with each tuple of arguments; yield the results in the same order."""
        pool = self.pool if len(tasks) > 1 else None  # one task is done here while the processes would only start
        waiting = [None if pool is None else pool.submit(function, *task) for task in tasks]
        for k, (future, task) in enumerate(zip(waiting, tasks, strict=True)):
            self.report(k, len(tasks), step)
            yield function(*task) if future is None else future.result()


SILENT_WORK = Work()  # in this process, silently


def follow_film(tracker: BatchTracker, start: Array, frame: int, work: Work) -> RawTrack:
    """Follow a target through all frames of a film, both ways from the frame in which it is given.

    Parameters
    ----------
    tracker : BatchTracker
        Film, template and obstacles.
    start : array (2,)
        Corner of the target's rectangle in frame `frame`, px.
    frame : int
        Number of that frame.
    work : Work
        Where the segments of a long film are followed.

    Returns
    -------
    RawTrack
        One row per frame.

    """
    n = tracker.film.n_frames
    result = empty_track(n)
    for order in [np.arange(frame, n), *([np.arange(frame, -1, -1)] if frame else [])]:
        segments = _cut_order(order)
        if len(segments) == 1:
            result.put(order, tracker.follow(order, start, frame, work.progress))
            continue
        tasks = [(tracker, segment, None if k else start, frame) for k, segment in enumerate(segments)]
        found: list[RawTrack] = [*work.run(_follow_segment, tasks, "follow")]
        for k, (segment, part) in enumerate(zip(segments, found, strict=True)):
            if k and not _fits(found[k - 1], part):  # the rest is followed frame by frame
                rest = np.concatenate([segments[k - 1], *[later[OVERLAP_FRAMES:] for later in segments[k:]]])
                begin = start if k == 1 else found[k - 1].position[0]
                result.put(rest, tracker.follow(rest, begin, frame))
                break
            result.put(segment, part)
    return result


def _cut_order(order: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Cut frames into segments, each with the first frames of the next; the last is not short."""
    count = max(len(order) // SEGMENT_FRAMES, 1)
    cuts = [SEGMENT_FRAMES * k for k in range(count)] + [len(order)]
    return [order[a : b + OVERLAP_FRAMES] for a, b in pairwise(cuts)]


def _follow_segment(tracker: BatchTracker, order: NDArray[np.int64], start: Array | None, frame: int) -> RawTrack:
    """Follow the target through a segment, from a clear match in its first frame where no `start` is given."""
    if start is None:
        try:
            corner, score = tracker.match(tracker.film.frame(int(order[0])), None)
        except FrictrackError:
            score = -1.0
        if score < CONFIDENT_SCORE:
            return empty_track(len(order))
        start = np.rint(corner)
    return tracker.follow(order, start, frame)


def _fits(before: RawTrack, part: RawTrack) -> bool:
    """Whether a segment begins where the one before it ends."""
    old, new = before[slice(-OVERLAP_FRAMES, None)], part[slice(0, OVERLAP_FRAMES)]
    near = np.max(np.abs(old.position - new.position)) < MAX_DISAGREEMENT_PX
    return bool(near and old.found.all() and new.found.all())
