"""Tell every run what was slid before it on the same surfaces: distance by distance, and how long ago."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.friction.force import is_moving
from frictrack.records import EarlierRuns, Run


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
