"""Tell every run what was slid before it on the same surfaces: distance by distance, and how long ago."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.friction import is_moving
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
    ((), [(60.0, 0.3)])

    """
    if len(pauses) != len(runs):
        raise FrictrackError(f"expected one pause for each of the {len(runs)} runs but got {len(pauses)}")
    if all(pause is None for pause in pauses[1:]):
        return list(runs)
    earlier: EarlierRuns | None = ()
    out = [replace(runs[0], earlier=earlier)]
    for run, pause in zip(runs[1:], pauses[1:], strict=True):
        earlier = None if earlier is None or pause is None else _after(earlier, out[-1], pause)
        out.append(replace(run, earlier=earlier))
    return out


def _after(earlier: EarlierRuns, last: Run, pause: float) -> EarlierRuns:
    """What was slid before a run that begins a pause after the end of `last`, before which `earlier` was slid."""
    duration = float(last.motion.t[-1] - last.motion.t[0])
    return *((rest + duration + pause, slid) for rest, slid in earlier), (pause, _distance(last))


def _distance(run: Run) -> float:
    """Distance that a run slides, m, without the noise at rest."""
    return float(np.sum(np.abs(np.diff(run.motion.x)) * is_moving(run)[1:]))
