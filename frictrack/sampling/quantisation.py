"""Find the step of quantised positions: counts of an encoder, centimetres of an ultrasonic sensor, digits of a table.

Rounding to a step q adds an error of standard deviation q / sqrt(12) (Bennett 1948, Bell Syst. Tech. J. 27). It is
white where the position changes by more than a step, or its noise by half of one, from sample to sample. A slower mass
shares its error with the samples before: differences of the positions then show less noise than there is, or none.
"""

from __future__ import annotations

import numpy as np

from frictrack.records import Array

MAX_STEP_ERROR = 0.02  # of a step; positions may be off a whole multiple by this much
MAX_PARTS = 1000  # of the smallest gap between two positions: a fast mass skips some steps
MAX_CHANCE = 1e-6  # probability that gaps which are no multiples of a step seem to be, over all parts tried
FIRST_GAPS = 8  # smallest gaps from which a step is first estimated
MIN_POSITIONS = 3  # distinct positions that can show a step
MIN_NOISE_SHARE = 0.5  # of the noise that the differences show; a larger step is reported


def quantum(x: Array) -> float:
    """Step of which all differences of positions x (n,) are whole multiples, m; 0 where there is none.

    Examples
    --------
    >>> import numpy as np
    >>> quantum(np.round(np.linspace(0.0, 1.0, 50), 2))
    0.01

    """
    values = np.unique(x)
    gaps = np.diff(values)
    digits = 16 * np.finfo(float).eps * float(np.max(np.abs(values), initial=0.0))  # of a double
    gaps = gaps[gaps > digits]
    if len(gaps) < MIN_POSITIONS - 1:
        return 0.0
    gaps = np.sort(gaps)
    for parts in range(1, _max_parts(len(gaps)) + 1):
        if step := _refine_step(gaps, float(gaps[0]) / parts):
            return 0.0 if _is_even_motion(gaps, step, len(values) < len(x)) else step
    return 0.0


def _is_even_motion(gaps: Array, step: float, repeated: bool) -> bool:
    """Whether the gaps are all the same and no position occurs twice: a mass at constant velocity leaves the same."""
    return not repeated and bool(np.all(np.rint(gaps / step) == np.rint(gaps[0] / step)))


def _max_parts(count: int) -> int:
    """Largest divisor of the smallest gap that is tested, so that the other gaps do not fit by chance."""
    return max(min(MAX_PARTS, int(MAX_CHANCE * (2 * MAX_STEP_ERROR) ** (1 - min(count, FIRST_GAPS)))), 1)


def _refine_step(gaps: Array, near: float) -> float:
    """Refine a step of which all rising gaps are whole multiples; 0 where they are not."""
    step = near
    for some in (
        gaps[:FIRST_GAPS],
        gaps[: FIRST_GAPS**2],
        gaps,
        gaps,
    ):  # the mean of many is known better than the smallest
        counts = np.rint(some / step)
        if np.any(counts < 1) or np.max(np.abs(some - counts * step)) > MAX_STEP_ERROR * step:
            return 0.0
        step = float(np.sum(some) / np.sum(counts))
    return float(f"{step:.10g}")


def rounding_noise(step: float) -> float:
    """Standard deviation that rounding to a step adds, m."""
    return step / float(np.sqrt(12.0))
