"""Find doubled and missing frames from the motion itself, where no time stamp shows them.

Both show in the steps from frame to frame, in any pattern, once a step exceeds the noise by far:

- A frame without a step, while the mass moves on both sides, repeats the one before. The step that follows says whether
  the frame was put in (one step) or took the place of lost ones (as many steps more).
- A step that is a whole multiple of what its neighbours say it should be, to within the noise, passes over so many
  intervals less one of lost frames. A collision changes the steps that follow and a stop ends them; neither makes one
  step alone a multiple.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack.base.distributions import noise_of_differences, robust_std
from frictrack.records import Array, Mask, stretches
from frictrack.sampling.clock import MIN_KNOWN_STEPS, REACH_STEPS, usual_steps

MAX_STILL_STEP = 0.15  # of the usual step; a smaller one is none
MIN_NEIGHBOUR_STEP = 0.6  # of the usual step, before and after: nothing stops and goes on in between
USUAL_QUANTILE = 0.75  # of the sizes of nearby steps, taken as the usual step: many repeats do not count
MIN_STEP_SIGMAS = 8.0  # standard deviations that the usual step must have
MAX_STEP_ERROR = 0.25  # of a step, by which the step after a repeat may miss a whole number of steps
FREQUENT_SHARE = 0.2  # share of repeats from which the first and the last frame may be one too
MAX_REPEATS = 4  # in a row: a mass may stick for longer
SINGLE_STEP_TOLERANCE = 0.25  # of the usual step, within which a step passes over one interval
MAX_MULTIPLE_SIGMAS = 4.0  # standard deviations within which a step is a whole multiple
MAX_MULTIPLE_ERROR = 0.12  # intervals: a multiple that is known no better cannot be counted
MAX_MULTIPLE = 200  # intervals in one step
MAX_RETURN = 0.5  # intervals by which the steps around may fall short: after a missing frame nothing is made up for
STEADY_STEPS, MAX_ODD_STEPS = 5, 1  # steps on either side that are whole multiples, too, and how many may not be

Ticks = NDArray[np.int64]


@dataclass(frozen=True)
class Slip:
    """A fault of the time base: at `frame` so many `frames` are missing before it (> 0), or it is a doubled one.

    A doubled frame was put in (-1, all later ones are one too late) or stands in place of a lost one (0).
    """

    frame: int
    frames: int

    @property
    def doubled(self) -> bool:
        """Whether the frame repeats the one before it."""
        return self.frames <= 0


@dataclass(frozen=True, eq=False)
class SampledPath:
    """Position along the course at whole ticks.

    Attributes
    ----------
    p, sigma : array (n,)
        Position and its standard deviation.
    ticks : array of int (n,)
        Frame intervals since the first frame.
    good : array of bool (n,)
        Frames that count.
    smallest : float
        Smallest jump that counts; tracking errors may be as large.
    exact : bool
        Whether a repeated frame is equal to the last digit.

    """

    p: Array
    sigma: Array
    ticks: Ticks
    good: Mask
    smallest: float
    exact: bool = False

    def corrected(self, found: Sequence[Slip]) -> SampledPath:
        """The path at corrected ticks, on which doubled frames do not count."""
        ticks, keep = correct_ticks(self.ticks, found)
        return replace(self, ticks=ticks, good=self.good & keep)

    def rows(self, rows: Ticks) -> SampledPath:
        """Some frames of the path."""
        return replace(self, p=self.p[rows], sigma=self.sigma[rows], ticks=self.ticks[rows], good=self.good[rows])


def find_slips(path: SampledPath, *, held: bool = False) -> tuple[Slip, ...]:
    """Find doubled and missing frames, in any pattern.

    `held`: whether, where every frame comes several times, the time stamps are right and the position was held; else
    the frames were put in, and time counts pictures.

    Examples
    --------
    >>> k = np.repeat(np.arange(40.0), 1 + (np.arange(40) == 20))
    >>> path = SampledPath(k, np.full(41, 1e-3), np.arange(41), np.ones(41, bool), 0.1)
    >>> find_slips(path)
    (Slip(frame=21, frames=-1),)

    """
    repeated = repeated_frames(path, held=held)
    stay = np.setdiff1d(np.arange(len(path.p)), [s.frame for s in repeated if s.frames < 0])
    rest = path.corrected(repeated).rows(stay)
    moved = (replace(s, frame=int(stay[s.frame])) for s in missing_frames(rest))
    return tuple(sorted([*repeated, *moved], key=lambda s: s.frame))


def correct_ticks(ticks: Ticks, found: Sequence[Slip]) -> tuple[Ticks, Mask]:
    """Correct ticks for doubled and missing frames.

    `ticks` (n,): frame intervals since the first frame. Returns `ticks` (n,), with gaps where frames are missing;
    `keep` (n,), false for doubled frames.

    Examples
    --------
    >>> ticks, keep = correct_ticks(np.arange(4), [Slip(2, 3)])
    >>> ticks.tolist(), keep.tolist()
    ([0, 1, 5, 6], [True, True, True, True])

    """
    out, keep = np.array(ticks, dtype=np.int64), np.ones(len(ticks), np.bool_)
    for slip in found:
        out[slip.frame :] += slip.frames
        keep[slip.frame] &= not slip.doubled
    return out, keep


# --- repeated frames


def repeated_frames(path: SampledPath, *, held: bool) -> list[Slip]:
    """Frames that repeat the one before, in order; where `exact`, many come at even distances, or the mass sticks."""
    good = path.good & np.concatenate(([True], np.diff(path.ticks) == 1))
    steps = np.where(good[1:] & good[:-1], np.diff(path.p), np.nan)
    usual = usual_steps(np.abs(steps), USUAL_QUANTILE)
    still = (steps == 0.0) if path.exact else np.abs(steps) < MAX_STILL_STEP * usual
    often = bool(np.sum(still) > FREQUENT_SHARE * len(still))
    disturbed = still | np.append(False, still[:-1]) | np.append(still[1:], False) | np.isnan(steps)
    runs = [run for run in stretches(still) if run.stop - run.start <= MAX_REPEATS]
    for run in runs:  # the speed changes along a swing
        if np.isfinite(step := _undisturbed_step(steps, disturbed, run)):
            usual[run] = abs(step)
    found = [run for run in runs if _moves_on_both_sides(steps, run, usual, ends=often)]
    if not found:
        return []
    noise = _step_noise(path, good, found)
    found = [run for run in found if usual[run.start] > MIN_STEP_SIGMAS * noise]
    if path.exact and often and len({run.stop - run.start for run in found[1:-1]}) > 1:
        return []
    expected = [_undisturbed_step(steps, disturbed, run) for run in found]
    return [
        slip
        for run, step in zip(found, expected, strict=True)
        for slip in _slips_of_repeats(steps, run, step, held=held)
    ]


def _undisturbed_step(steps: Array, disturbed: Mask, run: slice) -> float:
    """Step that the undisturbed ones near a run of repeats expect there; NaN where these are too few."""
    near = np.arange(max(run.start - REACH_STEPS, 0), min(run.stop + REACH_STEPS, len(steps)))
    used = near[~disturbed[near]]
    return (
        float(_expected_steps(steps, used, 0.5 * (run.start + run.stop))[0][0])
        if len(used) >= MIN_KNOWN_STEPS
        else np.nan
    )


def _moves_on_both_sides(steps: Array, run: slice, usual: Array, *, ends: bool) -> bool:
    """Whether the mass moves at full speed in one direction before and after; at the `ends` on one side."""
    near = [steps[i] for i in (run.start - 1, run.stop) if 0 <= i < len(steps)]
    if len(near) < (1 if ends else 2) or not np.all(np.isfinite(near)):
        return False
    return bool(min(np.abs(near)) > MIN_NEIGHBOUR_STEP * usual[run.start] and near[0] * near[-1] > 0)


def _step_noise(path: SampledPath, good: Mask, repeats: list[slice]) -> float:
    """Noise of a step without the repeats; at least the stated one."""
    keep = np.array(good)
    for run in repeats:
        keep[run.start + 1 : run.stop + 1] = False
    measured = noise_of_differences(np.diff(path.p[keep], 3), 3)
    return float(np.sqrt(2.0)) * max(float(np.median(path.sigma[keep])), measured)


def _slips_of_repeats(steps: Array, run: slice, expected: float, *, held: bool) -> Iterator[Slip]:
    """Repeated frames as slips: as many as time allows in place of lost ones, the first of them put in.

    None where the step after them is no whole number of intervals.
    """
    count = run.stop - run.start
    ticks = count + 1 if held or run.stop == len(steps) else 1  # from the original to the frame after the last repeat
    if run.stop < len(steps) and np.isfinite(expected):
        ratio = float(steps[run.stop] / expected)
        ticks = max(round(ratio), 1)
        if abs(ratio - ticks) >= MAX_STEP_ERROR * ticks:
            return
    put_in = max(count + 1 - ticks, 0)
    for i in range(count):
        yield Slip(run.start + 1 + i, -1 if i < put_in else 0)
    if ticks > count + 1:
        yield Slip(run.stop + 1, ticks - count - 1)


# --- missing frames


def missing_frames(path: SampledPath) -> list[Slip]:
    """Missing frames that the steps show, in order.

    Examples
    --------
    >>> k = np.delete(np.arange(60.0), [20, 24, 25])
    >>> p = k + 0.01 * np.random.default_rng(0).standard_normal(57)
    >>> path = SampledPath(p, np.full(57, 0.01), np.arange(57), np.ones(57, bool), 0.0)
    >>> [(slip.frame, slip.frames) for slip in missing_frames(path)]
    [(20, 1), (23, 2)]

    """
    rows = np.flatnonzero(path.good)
    if len(rows) < 2 * MIN_KNOWN_STEPS + 2:
        return []
    intervals = np.diff(path.ticks[rows])
    steps = np.diff(path.p[rows]) / intervals
    usual = usual_steps(steps)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = steps / usual
    is_long = (ratio > 1.5) & (ratio < MAX_MULTIPLE) & (np.abs(steps - usual) > path.smallest)
    noise = float(np.sqrt(2.0) * np.median(path.sigma[rows]))
    long_steps = np.flatnonzero((intervals == 1) & is_long).tolist()
    found = [(i, _missing_in_step(steps, ratio, noise, i)) for i in long_steps]
    return [Slip(int(rows[i + 1]), missing) for i, missing in found if missing]


def _missing_in_step(steps: Array, ratio: Array, noise: float, i: int) -> int:
    """Number of frames missing in a step; 0 where it is no whole multiple of its neighbours."""
    near = np.arange(max(i - REACH_STEPS, 0), min(i + REACH_STEPS + 1, len(steps)))
    used = near[(np.abs(ratio[near] - 1) < SINGLE_STEP_TOLERANCE) & (near != i)]
    # both neighbouring steps are at least one interval: an outlier makes one long and one short step
    enough = min(np.sum(used < i), np.sum(used > i)) >= MIN_KNOWN_STEPS
    if not (enough and np.all(ratio[[i - 1, i + 1]] > 1 - SINGLE_STEP_TOLERANCE)):
        return 0
    line, error = _expected_steps(steps, used, i)
    usual, error = float(line[0]), max(error, noise)
    around = near[(np.abs(near - i) <= STEADY_STEPS) & (near != i)]
    beside = steps[around] / (usual + line[1] * (around - i))
    if np.sum(_is_odd(beside)) > MAX_ODD_STEPS or np.sum(beside - 1) < -MAX_RETURN:  # some outliers, and back again
        return 0
    multiple = round(steps[i] / usual)
    whole = abs(steps[i] - multiple * usual) < MAX_MULTIPLE_SIGMAS * error and not _is_odd(steps[i] / usual)
    return multiple - 1 if whole and error < MAX_MULTIPLE_ERROR * abs(usual) else 0


def _is_odd(ratio: Array) -> Any:
    """Whether steps over the usual one pass over no whole number of intervals: then the mass shakes."""
    return np.abs(ratio - np.maximum(np.rint(ratio), 1.0)) > SINGLE_STEP_TOLERANCE


def _expected_steps(steps: Array, used: Ticks, i: float) -> tuple[Array, float]:
    """Line (2,) through the steps `used`, its value at i first, and how far a step there lies off it (deviation)."""
    design = np.stack([np.ones(len(used)), used - i], axis=1)
    best, *_ = np.linalg.lstsq(design, steps[used], rcond=None)
    left = steps[used] - design @ best
    spread = max(float(robust_std(left)), float(np.sqrt(np.sum(left**2) / (len(used) - 2))))
    return np.asarray(best), spread * float(np.sqrt(1.0 + np.linalg.inv(design.T @ design)[0, 0]))
