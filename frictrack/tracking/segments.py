"""Follow and measure a long film in segments, in this process or in several, with the same numbers.

A long film is always cut into the same segments, however many processes there are. The target is looked for in the
whole first frame of each segment, and followed from there into the first frames of the next one. Two segments are
joined if they agree about these frames. From the first segment that does not fit, the film is followed frame by frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from frictrack.errors import FrictrackError
from frictrack.recording import Recording
from frictrack.records import Array
from frictrack.tracking.batch_tracker import CONFIDENT_SCORE, BatchTracker, Progress
from frictrack.tracking.correlation import correlate
from frictrack.tracking.fixed_pattern import FixedPattern
from frictrack.tracking.raw_track import RawTrack, empty_track
from frictrack.tracking.template import Template

if TYPE_CHECKING:
    from frictrack.workers import WorkerPool

SEGMENT_FRAMES = 1000  # a search of one picture costs as much as following a few dozen frames
OVERLAP_FRAMES = 8  # that two segments have in common
# Of two segments about the same frame. A first template errs by a quarter of a pixel where edges are sharp; another
# object, or the next period of a pattern, is farther away.
MAX_DISAGREEMENT_PX = 1.0


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
    both = [np.arange(frame, n), *([np.arange(frame, -1, -1)] if frame else [])]
    if max(len(order) for order in both) < 2 * SEGMENT_FRAMES:
        return tracker.follow(start, frame, work.progress)
    what = tracker.film, tracker.template, tracker.pattern
    result = empty_track(n)
    for order in both:
        segments = [_Segment(*what, piece, frame, None if k else start) for k, piece in enumerate(_cut_order(order))]
        _join(segments, [*work.run(_follow_segment, [(segment,) for segment in segments], "follow")], result)
    return result


@dataclass(frozen=True)
class _Segment:
    """Frames in order, and where the target is in the first of them; None where it is to be searched."""

    film: Recording
    template: Template
    pattern: FixedPattern | None
    order: NDArray[np.int64]
    template_frame: int
    start: Array | None


def _cut_order(order: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Cut frames into segments, each with the first frames of the next; the last is not short."""
    count = max(len(order) // SEGMENT_FRAMES, 1)
    cuts = [SEGMENT_FRAMES * k for k in range(count)] + [len(order)]
    return [order[a : b + OVERLAP_FRAMES] for a, b in pairwise(cuts)]


def _follow_segment(segment: _Segment) -> RawTrack | None:
    """Follow the target through a segment: one row per frame; None where it is not in the first frame."""
    order, tracker = segment.order, BatchTracker(segment.film, segment.template, segment.pattern)
    start = segment.start if segment.start is not None else _searched(tracker, int(order[0]))
    return None if start is None else tracker.follow_order(order, start, segment.template_frame)


def _searched(tracker: BatchTracker, frame: int) -> Array | None:
    """Corner (2,) px of the best match in a whole frame; None where it is no clear match."""
    try:
        picture = tracker.film.frame(frame)
    except FrictrackError:
        return None
    _, score, _, corner = cv2.minMaxLoc(correlate(picture, tracker.patch, tracker.template.mask))
    return np.array(corner, dtype=np.float64) if score >= CONFIDENT_SCORE else None


def _join(tasks: Sequence[_Segment], found: Sequence[RawTrack | None], result: RawTrack) -> None:
    """Put segments together; from the first that does not fit to the one before it, follow the rest frame by frame."""
    for k, (task, part) in enumerate(zip(tasks, found, strict=True)):
        if k and not _fits(found[k - 1], part):
            before = tasks[k - 1]
            rest = np.concatenate([before.order, *[t.order[OVERLAP_FRAMES:] for t in tasks[k:]]])
            begun = found[k - 1]
            assert begun is not None
            start = begun.position[0] if before.start is None else before.start
            whole = _follow_segment(replace(before, order=rest, start=start))
            assert whole is not None
            result.put(rest, whole)
            return
        assert part is not None
        result.put(task.order, part)


def _fits(before: RawTrack | None, part: RawTrack | None) -> bool:
    """Whether a segment begins where the one before it ends."""
    if before is None or part is None:
        return False
    old, new = before[slice(-OVERLAP_FRAMES, None)], part[slice(0, OVERLAP_FRAMES)]
    if not (old.found.all() and new.found.all()):
        return False
    return bool(np.max(np.abs(old.position - new.position)) < MAX_DISAGREEMENT_PX)
