"""Find frames that show what the frame before showed, in any pattern: a few in a row, scattered, or every second one.

While the mass moves by much more than the noise from frame to frame, a frame without a step repeats the one before.
The step that follows says whether the frame was put in (one step) or took the place of lost ones (as many steps more).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array, Mask
from frictrack.samples.steps import FEWEST, NEAR, usual_steps

STILL = 0.15  # of the usual step, below which there was none
FULL = 0.6  # of the usual step, which those before and after must have: nothing stops and goes on in between
USUAL = 0.75  # quantile of the sizes of steps near one that is usual
CLEAR = 8.0  # standard deviations of the usual step
OFF = 0.25  # of a step, by which the step after may miss whole ones
OFTEN = 0.2  # share of repeats from which the first and the last frame may be one
LONGEST = 4  # repeats in a row: a mass may stick for longer
THIRD = np.array([1.0, -3.0, 3.0, -1.0])

Rows = NDArray[np.int64]


@dataclass(frozen=True)
class Repeat:
    """Frames `first` to `last` repeat the one before; `ticks` intervals pass from that to the frame after them."""

    first: int
    last: int
    ticks: int


def repeats(p: Array, good: Mask, sigma: Array, *, held: bool, exact: bool = False) -> list[Repeat]:
    """Frames that repeat the one before, in order.

    Parameters
    ----------
    p : array (n,)
        Position along the course.
    good : array (n,)
        Frames whose position is known, one frame interval after the row before.
    sigma : array (n,)
        Standard deviations of p.
    held : bool
        Whether, where every frame comes several times, the time stamps are right and the position was held; else the
        frames were put in, and time counts pictures.
    exact : bool
        Whether a repeat is the same to the last digit. Many of them then come at even distances, or the mass sticks.

    Examples
    --------
    >>> import numpy as np
    >>> k = np.repeat(np.arange(40.0), 1 + (np.arange(40) == 20))
    >>> repeats(k, np.ones(41, bool), np.full(41, 1e-3), held=False)
    [Repeat(first=21, last=21, ticks=1)]

    """
    steps = np.where(good[1:] & good[:-1], np.diff(p), np.nan)
    usual = usual_steps(np.abs(steps), USUAL)  # a high quantile, so that many repeats do not count
    still = (steps == 0.0) if exact else np.abs(steps) < STILL * usual
    if not still.any():
        return []
    often = bool(np.sum(still) > OFTEN * len(still))
    found = [run for run in _runs(still) if _moves(steps, run, usual, ends=often)]
    noise = _noise(p, sigma, good, found)
    found = [run for run in found if usual[run.start] > CLEAR * noise]
    if exact and often and len({run.stop - run.start for run in found[1:-1]}) > 1:
        return []
    clean = _clean(steps, still)
    judged = (_judged(steps, run, clean, held=held) for run in found)
    return [one for one in judged if one is not None]


def _runs(still: Mask) -> Iterator[slice]:
    """Consecutive steps that are none, few enough."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], still, [False]))))
    for first, stop in zip(edges[::2], edges[1::2], strict=True):
        if stop - first <= LONGEST:
            yield slice(int(first), int(stop))


def _moves(steps: Array, run: slice, usual: Array, *, ends: bool) -> bool:
    """Whether the mass moves at full speed, the same way, before and after; at the `ends` of the record on one side."""
    near = [steps[i] for i in (run.start - 1, run.stop) if 0 <= i < len(steps)]
    if len(near) < (1 if ends else 2) or not np.all(np.isfinite(near)):
        return False
    return bool(min(np.abs(near)) > FULL * usual[run.start] and near[0] * near[-1] > 0)


def _noise(p: Array, sigma: Array, good: Mask, found: list[slice]) -> float:
    """Noise of a step when the repeats are left out: at least what is stated."""
    keep = np.array(good)
    for run in found:
        keep[run.start + 1 : run.stop + 1] = False
    third = np.convolve(p[keep], THIRD, mode="valid")
    stated = float(np.median(sigma[keep]))
    measured = 1.4826 * float(np.median(np.abs(third))) / np.sqrt(20.0) if len(third) else 0.0
    return float(np.sqrt(2.0)) * max(stated, measured)


def _clean(steps: Array, still: Mask) -> Array:
    """Steps that pass between two frames neither of which repeats another; NaN elsewhere."""
    after = np.concatenate(([False], still[:-1]))
    before = np.concatenate((still[1:], [False]))
    return np.where(still | after | before, np.nan, steps)


def _judged(steps: Array, run: slice, clean: Array, *, held: bool) -> Repeat | None:
    """How many frame intervals pass over a run of repeats; None where the step after it is no whole number of them."""
    count = run.stop - run.start
    if run.stop == len(steps):
        return Repeat(run.start + 1, run.stop, count + 1)
    near = clean[max(run.start - NEAR, 0) : run.stop + NEAR]
    known = near[np.isfinite(near)]
    whole = Repeat(run.start + 1, run.stop, count + 1 if held else 1)
    if len(known) < FEWEST:
        return whole
    ratio = float(steps[run.stop] / np.median(known))
    ticks = max(round(ratio), 1)
    return replace(whole, ticks=ticks) if abs(ratio - ticks) < OFF * max(ticks, 1) else None
