"""Find the events of a run: release, impacts, stops, starts, reversals, rests; and what was slid before the run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.friction.force import is_motion, is_moving, release_time, split_by_direction
from frictrack.records import Array, EarlierRuns, Run, RunEvents, stretches

MIN_DISTANCE_SIGMAS = 5.0  # standard deviations of the position that a motion must cover
MIN_IMPACT_RATIO = 5.0  # change of velocity in an impact over that by the typical acceleration
MIN_REST_FRAMES = 12  # frames needed to estimate the noise
EDGE_FRAMES = 3  # frames at either end of a rest that may still move


def find_events(run: Run) -> RunEvents:
    """Find the events and the rests of a run.

    A reversal is where the velocity crosses zero between two motions of opposite direction. A stop and a start are
    where the mass rests between motions. An impact changes the velocity by far more than friction does in that time.
    The noise at rest is that of the unfiltered displacement about the mean of each rest, without rests that creep.

    Parameters
    ----------
    run
        A run with displacement and motion.

    Returns
    -------
    RunEvents
        Events in order as (kind, begin s, end s), rests as (begin s, end s), and the noise at rest, m.

    Examples
    --------
    >>> import frictrack as ft
    >>> [kind for kind, _, _ in ft.find_events(ft.samples.runs()[2]).events]
    ['release', 'stop']

    """
    t, v = run.motion.t, run.motion.v
    motions = [
        s
        for s in split_by_direction(run, stretches(is_moving(run) | ~run.displacement.valid))
        if is_motion(run, s) and _travels(run, s)
    ]
    found: list[tuple[str, float, float]] = []
    if run.free is None and run.drive is None and run.friction_N is None:
        found += _release(run)
    for before, after in zip(motions, [*motions[1:], None], strict=False):  # of no motions, no pair
        ends = before.stop - 1
        if after is None:
            if ends < len(t) - 2:
                found.append(("stop", float(t[ends]), float(t[ends + 1])))
            continue
        reverses = np.sign(v[ends]) != np.sign(v[after.start])
        if reverses and after.start - ends <= MIN_REST_FRAMES:
            found.append(("reversal", float(t[ends]), float(t[after.start])))
        else:
            found.append(("stop", float(t[ends]), float(t[ends + 1])))
            found.append(("start", float(t[after.start - 1]), float(t[after.start])))
    if motions and motions[0].start > MIN_REST_FRAMES:
        found.append(("start", float(t[motions[0].start - 1]), float(t[motions[0].start])))
    found += _impacts(run, motions, found[0][1] if found[:1] and found[0][0] == "release" else -np.inf)
    rests = _rests(run, motions)
    return RunEvents(tuple(sorted(found, key=lambda e: e[1])), tuple(_span(t, s) for s in rests), _noise(run, rests))


def _release(run: Run) -> list[tuple[str, float, float]]:
    """The release, if it lies after the first frame."""
    try:
        at = release_time(run)
    except FrictrackError:
        return []
    return [("release", at, at)] if at > run.motion.t[0] else []


def _travels(run: Run, s: slice) -> bool:
    """Whether a motion covers more than the noise of the position."""
    return float(np.ptp(run.motion.x[s])) > MIN_DISTANCE_SIGMAS * float(np.nanmedian(run.displacement.sigma_x))


def _impacts(run: Run, motions: list[slice], after: float) -> list[tuple[str, float, float]]:
    """The smoother's events after the release that reduce the speed abruptly and are no stop, start or push."""
    t, v, a = run.motion.t, run.motion.v, np.abs(run.motion.a)
    moving = np.zeros(len(t), dtype=bool)
    for s in motions:
        moving[s] = True
    typical = float(np.median(a[moving])) if moving.any() else np.inf
    out = []
    for first, last in run.motion.events:
        i, j = max(first - EDGE_FRAMES, 0), min(last + EDGE_FRAMES, len(t) - 1)
        if not (moving[i] and moving[j]) or t[first] <= after:
            continue
        change = v[j] - v[i]
        if change * v[i] < 0 and abs(change) > MIN_IMPACT_RATIO * typical * (t[j] - t[i]):
            out.append(("impact", float(t[first]), float(t[last])))
    return out


def _rests(run: Run, motions: list[slice]) -> list[slice]:
    """Stretches between the motions that are long enough to show the noise."""
    edges = [0, *[k for s in motions for k in (s.start, s.stop)], len(run.motion)]
    between = [
        slice(i + EDGE_FRAMES, max(j - EDGE_FRAMES, i + EDGE_FRAMES))
        for i, j in zip(edges[::2], edges[1::2], strict=True)
    ]
    return [s for s in between if np.sum(run.displacement.valid[s]) >= MIN_REST_FRAMES]


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


def with_earlier_runs(runs: Sequence[Run], pauses: Sequence[float | None]) -> list[Run]:
    """Return the runs, each with the runs that were made before it.

    Parameters
    ----------
    runs : sequence of Run
        All runs on the same surfaces, in the order in which they were made.
    pauses : sequence of float or None
        Time between the end of the run before and the beginning of each, s; that of the first does not count. None
        where it is not known: what happened before then is not known either, for this run and those after it.

    Returns
    -------
    list of Run
        The runs with `earlier`.

    Raises
    ------
    FrictrackError
        If there is not one pause per run.

    Examples
    --------
    >>> import frictrack as ft
    >>> runs = ft.with_earlier_runs(ft.samples.runs()[:2], [None, 60.0])
    >>> runs[0].earlier, [(rest, round(slid, 2)) for rest, slid in runs[1].earlier]
    ((), [(60.0, 0.21)])

    """
    if len(pauses) != len(runs):
        raise FrictrackError(f"expected one pause for each of the {len(runs)} runs but got {len(pauses)}")
    if all(pause is None for pause in pauses[1:]):
        return list(runs)
    earlier: EarlierRuns | None = ()
    out = [replace(runs[0], earlier=earlier)]
    for run, pause in zip(runs[1:], pauses[1:], strict=True):
        if earlier is not None and pause is not None:
            t = out[-1].motion.t
            earlier = after_run(earlier, float(t[-1] - t[0]), _distance(out[-1]), pause)
        else:
            earlier = None
        out.append(replace(run, earlier=earlier))
    return out


def after_run(earlier: EarlierRuns, duration: float, distance: float, pause: float) -> EarlierRuns:
    """Return what was slid before a run that begins a pause after another one.

    Parameters
    ----------
    earlier
        What was slid before that other run.
    duration, distance
        Its duration, s, and the distance slid in it, m.
    pause
        Time since its end, s.

    """
    return *((rest + duration + pause, slid) for rest, slid in earlier), (pause, distance)


def _distance(run: Run) -> float:
    """Distance that a run slides, m, without the noise at rest."""
    return float(np.sum(np.abs(np.diff(run.motion.x)) * is_moving(run)[1:]))
