"""Bring the rows of a table to an even clock: stamps that jitter, are rounded, or are repeated.

Stamps may be wrong while the samples are even (a computer wrote them with delay), or right while the samples are
uneven. The motion decides: with the wrong choice a moving mass shows the jitter as noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array
from frictrack.sampling.outlier_search import FOURTH_DIFFERENCE, MEDIAN_TO_SIGMA

MAX_UNEVENNESS = 0.01  # of the interval; even stamps may be off by this much
MAX_ROUNDING_STEPS = 1.01  # steps of rounded stamps by which a row may be off the even clock
MAX_JITTER = 0.2  # of the interval, rms: stamps that jitter by more show no even clock
SPEED_REACH_ROWS = 6  # rows on either side from which the speed is taken
ROWS_AT_ONCE = 1 << 16  # whose speeds are computed together
MIN_ROWS = 16  # rows whose noise can show which stamps are right

Ticks = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class EvenClock:
    """Times of rows on an even clock.

    Attributes
    ----------
    t : array (n,)
        Times, s.
    late : array (n,)
        How late each row was sampled, s.
    notes : tuple of str
        Findings.

    """

    t: Array
    late: Array
    notes: tuple[str, ...] = ()


def is_even(t: Array) -> bool:
    """Test whether time stamps rise by whole multiples (within 1 %) of the median interval.

    Parameters
    ----------
    t : array (n,)
        Time stamps, s.

    Returns
    -------
    bool
        Gaps are allowed.

    Examples
    --------
    >>> is_even(np.array([0.0, 0.1, 0.2, 0.4])), is_even(np.array([0.0, 0.1, 0.25, 0.3]))
    (True, False)

    """
    usual = float(np.median(np.diff(t)))
    if usual <= 0:
        return False
    steps = np.diff(t) / usual
    return bool(np.all((np.rint(steps) >= 1) & (np.abs(steps - np.rint(steps)) <= MAX_UNEVENNESS)))


def rounded_clock(t: Array) -> EvenClock | None:
    """Compute an even clock through stamps that are rounded so far that they repeat.

    Parameters
    ----------
    t : array (n,)
        Time stamps, s.

    Returns
    -------
    EvenClock or None
        None where the stamps do not repeat or are not rounded even times.

    """
    steps = np.diff(np.unique(t))
    if len(steps) < 2 or len(steps) > 0.9 * len(t):
        return None
    rounding = float(np.min(steps))
    rows = np.arange(len(t))
    slope, start = np.polyfit(rows, t, 1)
    if slope <= 0 or np.max(np.abs(t - start - slope * rows)) > MAX_ROUNDING_STEPS * rounding:
        return None
    note = (
        f"time stamps are rounded to {rounding:.4g} s and repeat: the rows are taken as evenly spaced by {slope:.6g} s"
    )
    return EvenClock(start + slope * rows, np.zeros(len(t)), (note,))


def jittered_clock(t: Array, ticks: Ticks, x: Array) -> EvenClock | None:
    """An even clock for stamps (n,) that jitter about whole frame intervals `ticks` (n,); None where they do not.

    The positions x (n,) tell whether stamps or samples are uneven.

    Examples
    --------
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> even = np.arange(400) / 1000
    >>> true = even + 1e-4 * rng.standard_normal(400)
    >>> x = 2 * true + 1e-6 * rng.standard_normal(400)
    >>> jittered_clock(true, np.arange(400), x).notes[0][:37]
    'time stamps jitter by 9.9 % of the in'

    """
    interval, start = np.polyfit(ticks, t, 1)
    even = start + interval * ticks
    late = t - even
    if interval <= 0 or np.std(late) > MAX_JITTER * interval:
        return None
    share = 100 * float(np.std(late)) / interval
    as_even = _noise_level(x, ticks)
    as_stamped = _noise_level(x - robust_speed(t, x) * late, ticks)
    jitter = f"time stamps jitter by {share:.2g} % of the interval of {interval:.6g} s (rms)"
    if len(t) >= MIN_ROWS and as_even < as_stamped:
        return EvenClock(
            even, np.zeros(len(t)), (f"{jitter}; the motion is even, so that the rows are taken as evenly spaced",)
        )
    note = f"{jitter}; each position is moved to the even clock by its speed times how late it was sampled"
    return EvenClock(even, late, (note,))


def robust_speed(t: Array, x: Array) -> Array:
    """Compute the speed as the median over several spans, which outliers do not affect.

    Parameters
    ----------
    t, x : array (n,)
        Times (s) and positions (m).

    Returns
    -------
    array (n,)
        Speed, m/s.

    Examples
    --------
    >>> float(robust_speed(np.arange(20.0), 3.0 * np.arange(20.0))[0])
    3.0

    """
    out, reach = np.empty(len(t)), np.arange(1, SPEED_REACH_ROWS + 1)[:, None]
    for first in range(0, len(t), ROWS_AT_ONCE):
        rows = np.arange(first, min(first + ROWS_AT_ONCE, len(t)))
        before, after = np.maximum(rows - reach, 0), np.minimum(rows + reach, len(t) - 1)
        out[rows] = np.median((x[after] - x[before]) / (t[after] - t[before]), axis=0)
    return out


def _noise_level(x: Array, ticks: Ticks) -> float:
    """Noise of positions by their fourth differences."""
    whole = ticks[4:] - ticks[:-4] == 4
    difference = np.convolve(x, FOURTH_DIFFERENCE, mode="valid")[whole]
    return MEDIAN_TO_SIGMA * float(np.median(np.abs(difference))) / float(np.sqrt(70.0)) if len(difference) else 0.0
