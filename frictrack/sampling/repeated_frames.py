"""Find frames that show what the frame before showed, in any pattern: a few in a row, scattered, or every second one.

While the mass moves by much more than the noise from frame to frame, a frame without a step repeats the one before.
The step that follows says whether the frame was put in (one step) or took the place of lost ones (as many steps more).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from frictrack.distributions import noise_of_differences
from frictrack.records import Array, Mask
from frictrack.sampling.usual_steps import MIN_KNOWN_STEPS, REACH_STEPS, usual_steps

MAX_STILL_STEP = 0.15  # of the usual step; a smaller one is none
MIN_NEIGHBOUR_STEP = 0.6  # of the usual step, before and after: nothing stops and goes on in between
USUAL_QUANTILE = 0.75  # of the sizes of nearby steps, taken as the usual step
MIN_STEP_SIGMAS = 8.0  # standard deviations that the usual step must have
MAX_STEP_ERROR = 0.25  # of a step, by which the step after a repeat may miss a whole number of steps
FREQUENT_SHARE = 0.2  # share of repeats from which the first and the last frame may be one too
MAX_REPEATS = 4  # in a row: a mass may stick for longer
THIRD_DIFFERENCE = np.array([1.0, -3.0, 3.0, -1.0])

Rows = NDArray[np.int64]


@dataclass(frozen=True)
class RepeatedFrames:
    """Frames that repeat the one before them.

    Attributes
    ----------
    first, last : int
        First and last repeated frame.
    ticks : int
        Frame intervals from the original frame to the one after the last repeat.

    """

    first: int
    last: int
    ticks: int


def repeats(p: Array, good: Mask, sigma: Array, *, held: bool, exact: bool = False) -> list[RepeatedFrames]:
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
    [RepeatedFrames(first=21, last=21, ticks=1)]

    """
    steps = np.where(good[1:] & good[:-1], np.diff(p), np.nan)
    usual = usual_steps(np.abs(steps), USUAL_QUANTILE)  # a high quantile, so that many repeats do not count
    still = (steps == 0.0) if exact else np.abs(steps) < MAX_STILL_STEP * usual
    if not still.any():
        return []
    often = bool(np.sum(still) > FREQUENT_SHARE * len(still))
    found = [run for run in _runs_of_repeats(still) if _moves_on_both_sides(steps, run, usual, ends=often)]
    noise = _noise(p, sigma, good, found)
    found = [run for run in found if usual[run.start] > MIN_STEP_SIGMAS * noise]
    if exact and often and len({run.stop - run.start for run in found[1:-1]}) > 1:
        return []
    clean = _undisturbed_steps(steps, still)
    judged = (_classify(steps, run, clean, held=held) for run in found)
    return [one for one in judged if one is not None]


def _runs_of_repeats(still: Mask) -> Iterator[slice]:
    """Short runs of consecutive steps of zero."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], still, [False]))))
    for first, stop in zip(edges[::2], edges[1::2], strict=True):
        if stop - first <= MAX_REPEATS:
            yield slice(int(first), int(stop))


def _moves_on_both_sides(steps: Array, run: slice, usual: Array, *, ends: bool) -> bool:
    """Whether the mass moves at full speed in one direction before and after; at the `ends` on one side."""
    near = [steps[i] for i in (run.start - 1, run.stop) if 0 <= i < len(steps)]
    if len(near) < (1 if ends else 2) or not np.all(np.isfinite(near)):
        return False
    return bool(min(np.abs(near)) > MIN_NEIGHBOUR_STEP * usual[run.start] and near[0] * near[-1] > 0)


def _noise(p: Array, sigma: Array, good: Mask, found: list[slice]) -> float:
    """Noise of a step without the repeats; at least the stated one."""
    keep = np.array(good)
    for run in found:
        keep[run.start + 1 : run.stop + 1] = False
    third = np.convolve(p[keep], THIRD_DIFFERENCE, mode="valid")
    stated = float(np.median(sigma[keep]))
    return float(np.sqrt(2.0)) * max(stated, noise_of_differences(third, 3))


def _undisturbed_steps(steps: Array, still: Mask) -> Array:
    """Steps between frames of which neither repeats another; NaN elsewhere."""
    after = np.concatenate(([False], still[:-1]))
    before = np.concatenate((still[1:], [False]))
    return np.where(still | after | before, np.nan, steps)


def _classify(steps: Array, run: slice, clean: Array, *, held: bool) -> RepeatedFrames | None:
    """Frame intervals over a run of repeats; None where the step after it is no whole number of intervals."""
    count = run.stop - run.start
    if run.stop == len(steps):
        return RepeatedFrames(run.start + 1, run.stop, count + 1)
    near = clean[max(run.start - REACH_STEPS, 0) : run.stop + REACH_STEPS]
    known = near[np.isfinite(near)]
    whole = RepeatedFrames(run.start + 1, run.stop, count + 1 if held else 1)
    if len(known) < MIN_KNOWN_STEPS:
        return whole
    ratio = float(steps[run.stop] / np.median(known))
    ticks = max(round(ratio), 1)
    return replace(whole, ticks=ticks) if abs(ratio - ticks) < MAX_STEP_ERROR * max(ticks, 1) else None
