"""What happens in a run: release, impacts, stops, starts, reversals; and its rests, which show the noise for free."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.friction import is_motion, is_moving, release_time
from frictrack.records import Array, Run, RunEvents, stretches

WAY = 5.0  # standard deviations of the position that a motion must cover
SUDDEN = 5.0  # times what the usual acceleration would change the velocity by: an impact
LEAST_REST = 12  # frames, fewer do not tell the noise
EDGE = 3  # frames at either end of a rest that may still move


def happenings(run: Run) -> RunEvents:
    """Release, impacts, stops, starts and reversals of a run, in order, and its rests.

    A reversal is where the velocity crosses zero between two motions of opposite direction, a stop and a start where
    the mass rests between. An impact changes the velocity at once by far more than the slide does in that time. The
    noise at rest is that of the unfiltered displacement about the mean of each rest, a rest that creeps left out.
    """
    t, v = run.motion.t, run.motion.v
    motions = [s for s in _one_way(run) if is_motion(run, s) and _goes(run, s)]
    found: list[tuple[str, float, float]] = []
    if run.free is None and run.drive is None and run.friction_N is None:
        found += _release(run)
    for before, after in zip(motions, [*motions[1:], None], strict=False):  # of no motions, no pair
        ends = before.stop - 1
        if after is None:
            if ends < len(t) - 2:
                found.append(("stop", float(t[ends]), float(t[ends + 1])))
            continue
        turned = np.sign(v[ends]) != np.sign(v[after.start])
        if turned and after.start - ends <= LEAST_REST:
            found.append(("reversal", float(t[ends]), float(t[after.start])))
        else:
            found.append(("stop", float(t[ends]), float(t[ends + 1])))
            found.append(("start", float(t[after.start - 1]), float(t[after.start])))
    if motions and motions[0].start > LEAST_REST:
        found.append(("start", float(t[motions[0].start - 1]), float(t[motions[0].start])))
    found += _impacts(run, motions, found[0][1] if found[:1] and found[0][0] == "release" else -np.inf)
    rests = _rests(run, motions)
    return RunEvents(tuple(sorted(found, key=lambda e: e[1])), tuple(_span(t, s) for s in rests), _noise(run, rests))


def _one_way(run: Run) -> list[slice]:
    """Stretches of moving frames, cut where the direction changes from one frame to the next."""
    out = []
    for s in stretches(is_moving(run) | ~run.displacement.valid):
        turns = s.start + 1 + np.flatnonzero(np.diff(np.sign(run.motion.v[s])) != 0)
        out += [slice(int(i), int(j)) for i, j in pairwise([s.start, *turns, s.stop])]
    return out


def _release(run: Run) -> list[tuple[str, float, float]]:
    try:
        at = release_time(run)
    except FrictrackError:
        return []
    return [("release", at, at)] if at > run.motion.t[0] else []


def _goes(run: Run, s: slice) -> bool:
    return float(np.ptp(run.motion.x[s])) > WAY * float(np.nanmedian(run.displacement.sigma_x))


def _impacts(run: Run, motions: list[slice], after: float) -> list[tuple[str, float, float]]:
    """The smoother's events after the release that take speed away at once: those that are no stop, start or push."""
    t, v, a = run.motion.t, run.motion.v, np.abs(run.motion.a)
    moving = np.zeros(len(t), dtype=bool)
    for s in motions:
        moving[s] = True
    usual = float(np.median(a[moving])) if moving.any() else np.inf
    out = []
    for first, last in run.motion.events:
        i, j = max(first - EDGE, 0), min(last + EDGE, len(t) - 1)
        if not (moving[i] and moving[j]) or t[first] <= after:
            continue
        change = v[j] - v[i]
        if change * v[i] < 0 and abs(change) > SUDDEN * usual * (t[j] - t[i]):
            out.append(("impact", float(t[first]), float(t[last])))
    return out


def _rests(run: Run, motions: list[slice]) -> list[slice]:
    """Stretches between the motions long enough to tell the noise."""
    edges = [0, *[k for s in motions for k in (s.start, s.stop)], len(run.motion)]
    between = [slice(i + EDGE, max(j - EDGE, i + EDGE)) for i, j in zip(edges[::2], edges[1::2], strict=True)]
    return [s for s in between if np.sum(run.displacement.valid[s]) >= LEAST_REST]


def _span(t: Array, s: slice) -> tuple[float, float]:
    return float(t[s.start]), float(t[s.stop - 1])


def _noise(run: Run, rests: list[slice]) -> float:
    """Standard deviation of the displacement at rest, m; NaN without a rest."""
    squares, count = 0.0, 0
    for s in rests:
        x = run.displacement.x[s][run.displacement.valid[s]]
        squares += float(np.sum((x - np.mean(x)) ** 2))
        count += len(x) - 1
    return float(np.sqrt(squares / count)) if count else float("nan")
