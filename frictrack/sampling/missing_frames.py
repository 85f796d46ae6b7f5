"""Find missing frames by the steps of a course: where many are lost, no two of them leave an undisturbed curve between.

Among frames that follow each other the step from one to the next changes slowly. A step that is a whole multiple of
what its neighbours say it should be, to within the noise, passes over so many intervals less one of lost frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frictrack.distributions import robust_std
from frictrack.records import Array, Mask
from frictrack.sampling.usual_steps import MIN_KNOWN_STEPS, REACH_STEPS, usual_steps

SINGLE_STEP_TOLERANCE = 0.25  # of the usual step, within which a step passes over one interval
MAX_MULTIPLE_SIGMAS = 4.0  # standard deviations within which a step is a whole multiple
MAX_MULTIPLE_ERROR = 0.06  # intervals: a multiple that is known no better cannot be counted
MAX_MULTIPLE = 200  # intervals in one step

Ticks = NDArray[np.int64]


@dataclass(frozen=True)
class MissingFrames:
    """Missing frames in one step.

    Attributes
    ----------
    at : int
        Frame before which they are missing.
    missing : int
        Number of missing frames.
    significance : float
        Standard deviations by which the step is too long.

    """

    at: int
    missing: int
    significance: float


def missing_frames(p: Array, ticks: Ticks, good: Mask, smallest: float = 0.0) -> list[MissingFrames]:
    """Missing frames of a course, in order.

    Parameters
    ----------
    p : array (n,)
        Position along the course.
    ticks : array (n,)
        Frame interval that each row is thought to be.
    good : array (n,)
        Rows whose position is known.
    smallest : float
        A step longer than usual by less, in the unit of p, may be a fault of the tracker.

    Examples
    --------
    >>> import numpy as np
    >>> k = np.delete(np.arange(60.0), [20, 24, 25])
    >>> p = k + 0.01 * np.random.default_rng(0).standard_normal(57)
    >>> [(gap.at, gap.missing) for gap in missing_frames(p, np.arange(57), np.ones(57, bool))]
    [(20, 1), (23, 2)]

    """
    rows = np.flatnonzero(good)
    if len(rows) < 2 * MIN_KNOWN_STEPS + 2:
        return []
    steps = np.diff(p[rows]) / np.diff(ticks[rows])
    usual = usual_steps(steps)
    follows = np.diff(ticks[rows]) == 1
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = steps / usual
    tried = np.flatnonzero(follows & (ratio > 1.5) & (ratio < MAX_MULTIPLE) & (np.abs(steps - usual) > smallest))
    found = [(i, _missing_in_step(steps, ratio, int(i))) for i in tried]
    return [MissingFrames(int(rows[i + 1]), missing, z) for i, (missing, z) in found if missing]


def _missing_in_step(steps: Array, ratio: Array, i: int) -> tuple[int, float]:
    """Number of frames missing in a step and its significance; 0 where it is no whole multiple of its neighbours."""
    near = np.arange(max(i - REACH_STEPS, 0), min(i + REACH_STEPS + 1, len(steps)))
    used = near[(np.abs(ratio[near] - 1) < SINGLE_STEP_TOLERANCE) & (near != i)]
    if min(np.sum(used < i), np.sum(used > i)) < MIN_KNOWN_STEPS or not _neighbours_advance(ratio, i):
        return 0, 0.0
    design = np.stack([np.ones(len(used)), used - i], axis=1)
    best, *_ = np.linalg.lstsq(design, steps[used], rcond=None)
    left = steps[used] - design @ best
    spread = max(float(robust_std(left)), float(np.std(left)))
    error = spread * float(np.sqrt(1.0 + np.linalg.inv(design.T @ design)[0, 0]))
    usual = float(best[0])
    multiple = round(steps[i] / usual)
    whole = abs(steps[i] - multiple * usual) < MAX_MULTIPLE_SIGMAS * error and error < MAX_MULTIPLE_ERROR * abs(usual)
    return (multiple - 1, abs(steps[i] - usual) / error) if whole else (0, 0.0)


def _neighbours_advance(ratio: Array, i: int) -> bool:
    """Whether both neighbouring steps are at least one interval: an outlier makes one long and one short step."""
    return bool(ratio[i - 1] > 1 - SINGLE_STEP_TOLERANCE and ratio[i + 1] > 1 - SINGLE_STEP_TOLERANCE)
