"""Bring the rows of a table to an even clock, and find samples that come unevenly although their stamps are even.

Stamps may jitter, be rounded or be repeated. They may be wrong while the samples are even (a computer wrote them with
delay), or right while the samples are uneven. The motion decides: with the wrong choice a moving mass shows the jitter
as noise. A sample that comes late by tau is off by v tau, so that the variance of a position is a^2 + (v s)^2, s being
the rms of tau. Fourth differences, from which any smooth motion is gone, show it by bins of speed.

Quantised positions are counts of an encoder, centimetres of an ultrasonic sensor, digits of a table. Rounding to a
step q adds an error of standard deviation q / sqrt(12) (Bennett 1948, Bell Syst. Tech. J. 27). It is white where the
position changes by more than a step, or its noise by half of one, from sample to sample. A slower mass shares its error
with the samples before: differences of the positions then show less noise than there is, or none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from frictrack.base.distributions import noise_of_differences, robust_std
from frictrack.records import Array, Mask

REACH_STEPS = 12  # steps on either side from which the usual step is taken
MIN_KNOWN_STEPS = 3  # known steps that can show it
ROWS_AT_ONCE = 1 << 14  # whose speeds or quantiles are computed together
MAX_STEP_ERROR = 0.02  # of a step; positions may be off a whole multiple by this much
MAX_PARTS = 1000  # of the smallest gap between two positions: a fast mass skips some steps
MAX_CHANCE = 1e-6  # probability that gaps which are no multiples of a step seem to be, over all parts tried
MAX_GAP_STEPS = 1e5  # times the smallest gap
FIRST_GAPS = 8  # smallest gaps from which a step is first estimated
MIN_POSITIONS = 3  # distinct positions that can show a step
TURNS = (360.0, 2 * np.pi)  # of angles
MIN_BITS = 8  # of a counter
MAX_STEP_RATIO = 3.0  # an unwrapped step may differ from the usual one by so many times what its neighbours do
MAX_SPREAD = 0.15  # of the range of a counter; steps that scatter by more show no jump
MIN_NOISE_SHARE = 0.5  # of the noise that the differences show; a larger step is reported


def usual_steps(steps: Array, share: float = 0.5) -> Array:
    """Quantile (n,) of the steps near every step; NaN where fewer than `MIN_KNOWN_STEPS` are known.

    `steps` (n,): steps from one sample to the next, NaN where one is not known; `share`: quantile: the median, or a
    higher one where many samples may repeat the one before.

    Examples
    --------
    >>> import numpy as np
    >>> usual_steps(np.array([1.0, 1.0, 5.0, 1.0, np.nan])).tolist()
    [1.0, 1.0, 1.0, 1.0, 1.0]

    """
    padded = np.pad(steps, REACH_STEPS, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * REACH_STEPS + 1)
    out = np.full(len(steps), np.nan)
    for first in range(0, len(steps), ROWS_AT_ONCE):
        some = windows[first : first + ROWS_AT_ONCE]
        enough = np.sum(np.isfinite(some), axis=1) >= MIN_KNOWN_STEPS
        out[first : first + ROWS_AT_ONCE][enough] = _row_quantile(some[enough], share)
    return out


def _row_quantile(values: Array, share: float) -> Array:
    """Quantile (m,) of the known values in every row of (m, n), as `np.nanquantile`, which takes one row at a time."""
    ordered = np.sort(values, axis=1)  # NaN last
    rows = np.arange(len(ordered))
    place = share * (np.sum(~np.isnan(ordered), axis=1) - 1)
    low = np.floor(place).astype(np.intp)
    below, above = ordered[rows, low], ordered[rows, np.ceil(place).astype(np.intp)]
    quantile: Array = below + (place - low) * (above - below)
    return quantile


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
    gaps = gaps[gaps < MAX_GAP_STEPS * gaps[0]]  # the digits of a double do not count the steps of a longer one
    parts = np.arange(1, _max_parts(len(gaps)) + 1)
    steps = np.outer(parts, gaps[:FIRST_GAPS] / gaps[0])
    for part in parts[np.all(np.abs(steps - np.rint(steps)) <= MAX_STEP_ERROR, axis=1)].tolist():
        if step := _refine_step(gaps, float(gaps[0]) / part):
            return 0.0 if _is_even_motion(gaps, step, len(values) < len(x)) else _with_few_digits(step, digits / step)
    return 0.0


def _with_few_digits(step: float, error: float) -> float:
    """The number of fewest digits within a relative error of a step: 2^32 times it is then right, too."""
    digits = (float(f"{step:.{n}g}") for n in range(1, 11))
    return next((one for one in digits if abs(one / step - 1.0) < max(error, 1e-10)), float(f"{step:.10g}"))


def _is_even_motion(gaps: Array, step: float, repeated: bool) -> bool:
    """Whether the gaps are all the same and no position occurs twice: a mass at constant velocity leaves the same."""
    return not repeated and bool(np.all(np.rint(gaps / step) == np.rint(gaps[0] / step)))


def _max_parts(count: int) -> int:
    """Largest divisor of the smallest gap that is tested, so that the other gaps do not fit by chance."""
    return max(min(MAX_PARTS, int(MAX_CHANCE * (2 * MAX_STEP_ERROR) ** (1 - min(count, FIRST_GAPS)))), 1)


def _refine_step(gaps: Array, near: float) -> float:
    """Refine a step of which all rising gaps are whole multiples; 0 where they are not."""
    step = near
    for some in (gaps[:FIRST_GAPS], gaps[: FIRST_GAPS**2], gaps, gaps):  # the mean of many is better than the smallest
        counts = np.rint(some / step)
        if np.any(counts < 1) or np.max(np.abs(some - counts * step)) > MAX_STEP_ERROR * step:
            return 0.0
        step = float(np.sum(some) / np.sum(counts))
    return step


def rounding_noise(step: float) -> float:
    """Standard deviation that rounding to a step adds, m."""
    return step / float(np.sqrt(12.0))


def unwrapped(x: Array) -> tuple[Array, tuple[str, ...]]:
    """Positions (n,) of a counter that rolled over, or of an angle that wrapped, as one course; and a note.

    Beyond the usual step a jump is then a power of two of the counter's step, or a turn, and no two positions are
    further apart than that.

    Examples
    --------
    >>> import numpy as np
    >>> k = np.arange(60.0)
    >>> unwrapped((60000 + 250 * k - k**2) % 65536)[0][-1]
    np.float64(71269.0)

    """
    steps, step, span = np.diff(x), quantum(x), float(np.ptp(x))
    bits = max(int(np.ceil(np.log2(span / step))), MIN_BITS) if step else 0
    for full, what in (
        *((turn, "an angle wrapped") for turn in TURNS),
        *((step * 2.0**n, f"a counter of {n} bits rolled over") for n in (bits, bits + 1) if step),
    ):
        turns = np.rint(steps / full)
        rows = np.flatnonzero(turns)
        if not len(rows) or span > full + step:
            continue
        smooth = steps - full * turns
        off = np.abs(smooth - usual_steps(smooth))
        nearby = MAX_STEP_RATIO * usual_steps(np.where(turns == 0, off, np.nan), 0.9)[rows] + step
        if np.all((off[rows] <= nearby) & (nearby < MAX_SPREAD * full)):
            count = "once" if len(rows) == 1 else f"{len(rows)} times"
            note = f"positions jump by {full:.6g}, as if {what}, {count}: unwrapped"
            return x - full * np.concatenate(([0.0], np.cumsum(turns))), (note,)
    return x, ()


def consecutive_noise(x: Array, frames: Array | Ticks) -> float:
    """White noise from the median fourth difference of consecutive frames."""
    difference, whole = fourth_differences(x, frames)
    return noise_of_differences(difference[whole], 4)


def fourth_differences(x: Array, frames: Array | Ticks) -> tuple[Array, Mask]:
    """Fourth differences (n - 4,), and where their frames are consecutive."""
    return np.diff(x, 4), np.asarray(frames[4:] - frames[:-4] == 4)


MAX_UNEVENNESS = 0.01  # of the interval; even stamps may be off by this much
MAX_ROUNDING_STEPS = 1.15  # steps of rounded stamps between the rows that are earliest and latest for an even clock
MIN_ROUNDING_RMS = 0.1  # of a step: a few wrong stamps or rows are no rounding, whose error is 0.29 rms
HALF_STEP_TIE = 1e-4  # steps by which stamps may miss their rounding: halves are rounded either way
SLOPE_BLOCKS = 16  # of stamps, taken to be off an even clock independently
ROUNDINGS_PER_SPAN = 16  # steps of rounding in the span from whose length an interval is first estimated
MIN_SHORT_SHARE = 0.1  # of intervals that are as short as the smallest, where the rate changes
MIN_SHORTEST = 0.3  # of the median interval
CUBIC_ROWS = 9  # through which a cubic is fitted
MIN_PART = 32  # rows that show to what stamps are rounded
MAX_JITTER = 0.2  # of the interval, rms: stamps that jitter by more show no even clock
SPEED_REACH_ROWS = 6  # rows on either side from which the speed is taken
MIN_ROWS = 16  # rows whose noise can show which stamps are right
ROWS_PER_BIN, MAX_BINS = 40, 12  # rows of a bin of speed, and bins
MIN_BINS = 4  # bins of speed that can show a trend
MIN_SLOPE_SIGMAS = 4.0  # standard deviations of the slope: 3e-5 by chance, less than one in 10^4 records
SMALLEST_VARIANCE = np.finfo(float).tiny  # a smaller variance has lost its digits
MIN_REST_SHARE = 0.01  # of the smallest variance of a bin, that a sample at rest has: weights stay finite
CLIP_SIGMAS = 3.0  # robust deviations at which a square is cut off
CLIPPED_MEAN_SQUARE = 0.99501  # of a Gaussian that is cut off there
# Relative deviation of the variance of n fourth differences, each of which shares its noise with its neighbours (2.63).
RELATIVE_DEVIATION = float(np.sqrt(2.0 * 2.63))

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
    error : float
        Relative standard deviation of the interval, where it is from the stamps.

    """

    t: Array
    late: Array
    notes: tuple[str, ...] = ()
    error: float = 0.0


def is_even(t: Array) -> bool:
    """Test whether time stamps rise by whole multiples (within 1 %) of the median interval.

    `t` (n,): time stamps, s. Gaps are allowed.

    Examples
    --------
    >>> is_even(np.array([0.0, 0.1, 0.2, 0.4])), is_even(np.array([0.0, 0.1, 0.26, 0.3]))
    (True, False)

    """
    return base_interval(t) > 0


def base_interval(t: Array) -> float:
    """Interval (s) of which those of the stamps (n,) are whole multiples within 1 %; 0 where there is none.

    It is the median one, or the smallest where the rate changes: a tenth of the intervals are then as short.

    Examples
    --------
    >>> import numpy as np
    >>> base_interval(np.array([0.0, 1.0, 2.0, 4.0, 6.0, 8.0]))
    1.0

    """
    steps = np.diff(t)
    smallest = float(np.min(steps))
    for interval in (float(np.median(steps)), smallest):
        if interval > 0 and (interval > smallest or np.mean(steps < 1.5 * interval) > MIN_SHORT_SHARE):
            off = steps / interval - np.rint(steps / interval)
            if np.all((steps > 0.5 * interval) & (np.abs(off) <= MAX_UNEVENNESS)):
                return interval
    return 0.0


def moved_to_grid(t: Array, columns: Sequence[Array]) -> tuple[Array, list[Array]] | None:
    """Times of the nearest points of an even grid, and what columns (n,) are there; None for times that nearly repeat.

    The grid is as fine as the smallest interval, so that every row has its own point. A column moves along a cubic
    through its neighbours; its noise stays its own, and NaN stays.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.array([0.0, 1.0, 2.2, 3.7, 4.7, 5.9, 7.0, 8.0, 9.1, 10.2])
    >>> grid, (x,) = moved_to_grid(t, [t**2])
    >>> grid.tolist(), bool(np.allclose(x, grid**2))
    ([0.0, 1.0, 2.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0], True)

    """
    interval, n = float(np.min(np.diff(t))), len(t)
    if not MIN_SHORTEST * np.median(np.diff(t)) < interval or n <= CUBIC_ROWS:
        return None
    grid = t[0] + interval * np.rint((t - t[0]) / interval)
    first = np.clip(np.arange(n) - CUBIC_ROWS // 2, 0, n - CUBIC_ROWS)
    rows = first[:, None] + np.arange(CUBIC_ROWS)
    powers = np.arange(4)
    scale = interval * CUBIC_ROWS
    inverse = np.linalg.pinv(((t[rows] - t[:, None]) / scale)[:, :, None] ** powers)
    shift = ((grid - t) / scale)[:, None] ** powers - (powers == 0)
    return grid, [c + np.einsum("nj,nji,ni->n", shift, inverse, _without_nan(t, c)[rows]) for c in columns]


def uneven_noise(t: Array, x: Array, relative: Array | float = 1.0) -> float:
    """White noise of positions x (n,) at uneven times t (n,), over `relative`, from fourth divided differences.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> t = np.sort(rng.uniform(0, 1, 800))
    >>> 0.8e-3 < uneven_noise(t, t**2 + 1e-3 * rng.standard_normal(800)) < 1.2e-3
    True

    """
    rows = np.arange(len(t) - 4)[:, None] + np.arange(5)
    apart = t[rows][:, :, None] - t[rows][:, None, :] + np.eye(5)
    weight = 1.0 / np.prod(apart / np.mean(np.diff(t)), axis=2)  # of a difference from which any cubic is gone
    deviation = np.linalg.norm(weight * np.broadcast_to(relative, len(t))[rows], axis=1)
    return float(robust_std(np.sum(weight * x[rows], axis=1) / deviation))


def _without_nan(t: Array, column: Array) -> Array:
    """Interpolate unknown values of a column (n,); zeros where none is known."""
    known = np.isfinite(column)
    return np.interp(t, t[known], column[known]) if known.any() else np.zeros(len(t))


def stamp_rounding(t: Array) -> float:
    """Compute to what time stamps (n,) are rounded, s; 0 where no step shows.

    A fixed number of digits gives a coarser step later in the record: the coarsest quarter counts.

    Examples
    --------
    >>> import numpy as np
    >>> stamp_rounding(np.round(np.arange(100) / 300, 3))
    0.001

    """
    parts = np.array_split(t, min(max(len(t) // MIN_PART, 1), 4))
    return max(quantum(part) for part in (t, *parts))


def count_intervals(t: Array, rounding: float, interval: float | None = None) -> Ticks:
    """Count the intervals of an even clock from the first row to each row of rounded stamps.

    A row is one interval after the row before unless the rounding excludes it: then others are missing, or the row is
    there twice. The interval comes from the whole record.

    `t` (n,): time stamps, s, rising or equal; `rounding`: step to which they are rounded, s; `interval`: interval of
    the clock, s, if it is known.

    Examples
    --------
    >>> import numpy as np
    >>> taken = np.delete(np.arange(60), 30)
    >>> bool(np.all(count_intervals(np.round(taken / 30, 2), 0.01) == taken))
    True

    """
    span = min(max(round(ROUNDINGS_PER_SPAN * rounding * (len(t) - 1) / float(t[-1] - t[0])), 8), len(t) // 2)
    spans = t[span:] - t[:-span]
    usual = np.sort(spans)[len(spans) // 2]
    complete = np.abs(spans - usual) < MAX_ROUNDING_STEPS * rounding  # no row is missing in it
    found = interval or float(np.mean(spans[complete])) / span
    ticks = _count_rows(t, found, 0.49)
    slope, start = np.polyfit(ticks, t, 1)
    jitter = np.sqrt(max(float(np.var(t - start - slope * ticks)) - rounding**2 / 12, 0.0))
    found = interval or float(slope)
    reach = 0.5 * MAX_ROUNDING_STEPS * rounding + MAX_UNEVENNESS * found + 4 * jitter
    return _count_rows(t, found, min(reach / found, 0.49)) if found > 0 else ticks


def _count_rows(t: Array, interval: float, reach: float) -> Ticks:
    """Count intervals: a row within `reach` intervals of the phases that all rows before allow is the next one."""
    low, high, skipped = -np.inf, np.inf, 0
    ticks = np.arange(len(t))
    for i, place in enumerate(((t - t[0]) / interval - ticks).tolist()):
        phase = place - skipped
        change = max(int(np.ceil(phase - reach - high)), 0) - max(int(np.ceil(low - phase - reach)), 0) if i else 0
        skipped += change
        low, high = max(low, phase - change - reach), min(high, phase - change + reach)
        ticks[i] += skipped
    return ticks


def rounded_clock(t: Array, ticks: Ticks, rounding: float, interval: float | None = None) -> EvenClock | None:
    """Fit an even clock to rounded stamps (n,) of rows that are `ticks` intervals after the first one.

    Returns None where the rows are not off the line as rounding makes them, uniformly, unless the `interval` is given.
    """
    slope, error = (interval, 0.0) if interval else _interval_of_rounded(t, ticks, rounding)
    start = float(np.mean(t - slope * ticks))
    off = t - start - slope * ticks
    uniform = np.ptp(off) < MAX_ROUNDING_STEPS * rounding and np.std(off) > MIN_ROUNDING_RMS * rounding
    if not (uniform or interval) or slope <= 0:
        return None
    note = (
        f"time stamps are rounded to {rounding:.4g} s: the rows are taken as evenly spaced by {slope:.6g} s"
        f"{'' if interval else f', the slope of all stamps, known to {100 * error:.2g} %; fps would decide'}"
    )
    return EvenClock(start + slope * ticks.astype(np.float64), np.zeros(len(t)), (note,), error)


def _interval_of_rounded(t: Array, ticks: Ticks, rounding: float) -> tuple[float, float]:
    """Interval (s) of stamps t (n,), and its relative deviation: of all lines that rounding allows, the middle one.

    Rounding errors that beat slowly with the interval shift the least-squares line more than white ones would.
    """
    slope, start = np.polyfit(ticks, t, 1)
    off, span, place = t - start - slope * ticks, float(ticks[-1]), (ticks - 0.5 * ticks[-1]) / ticks[-1]

    def width(turn: float) -> float:  # `turn`: of the line over the record, in steps of the rounding
        return float(np.ptp(off / rounding - turn * place)) - 1.0 - HALF_STEP_TIE

    exact: Any = {"xatol": 0.1 * HALF_STEP_TIE}
    best = scipy.optimize.minimize_scalar(width, bounds=(-2.0, 2.0), method="bounded", options=exact).x
    if width(best) >= 0:  # the stamps jitter, too
        return float(slope), _slope_error(t, off)
    low, high = (scipy.optimize.brentq(width, best, best + side * 4.0) for side in (-1, 1))
    found = float(slope) + 0.5 * (low + high) * rounding / span
    return found, rounding_noise((high - low) * rounding) / span / found


def _slope_error(t: Array, off: Array) -> float:
    """Relative standard deviation of the slope of a line through stamps t (n,) that are `off` it, (n,).

    Sums over blocks hold that neighbours are off alike, as stamps are whose rounding beats with the interval.
    """
    moments = off * np.linspace(-0.5, 0.5, len(t))
    blocks = [float(np.sum(part)) ** 2 for part in np.array_split(moments, min(SLOPE_BLOCKS, len(t)))]
    return 12.0 * float(np.sqrt(max(sum(blocks), np.sum(moments**2)))) / len(t) / float(t[-1] - t[0])


def jittered_clock(t: Array, ticks: Ticks, x: Array, rounding: float = 0.0) -> EvenClock | None:
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
    if interval <= 0 or not (
        MIN_ROUNDING_RMS * rounding <= np.std(late) <= np.hypot(MAX_JITTER * interval, rounding / np.sqrt(12.0))
    ):
        return None
    share = 100 * float(np.std(late)) / interval
    as_even, as_stamped = (consecutive_noise(one, ticks) for one in (x, x - robust_speed(t, x) * late))
    jitter = f"time stamps jitter by {share:.2g} % of the interval of {interval:.6g} s (rms)"
    if len(t) >= MIN_ROWS and as_even < as_stamped:
        words = f"{jitter}; the motion is even, so that the rows are taken as evenly spaced"
        return EvenClock(even, np.zeros(len(t)), (words,), _slope_error(t, late))
    note = f"{jitter}; each position is moved to the even clock by its speed times how late it was sampled"
    return EvenClock(even, late, (note,))


def robust_speed(t: Array, x: Array) -> Array:
    """Compute the speed as the median over several spans, which outliers do not affect.

    `t`, `x` (n,): times (s) and positions (m). Returns the speed, m/s.

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


def unevenness(t: Array, x: Array, slowest: float = 0.0) -> tuple[float, float]:
    """Jitter of samples (s, rms) and the noise of a sample at rest (m); 0 and 0 where no jitter shows.

    `t` (n,): even time stamps, s; `x` (n,): positions, m; `slowest`: speed below which rows are not looked at, m/s:
    slower ones share the error of their pixel, or of their step.

    Examples
    --------
    >>> import numpy as np
    >>> rng, t = np.random.default_rng(0), np.arange(800) / 4000
    >>> late = 1e-5 * rng.standard_normal(800)
    >>> x = 4 * (t + late) - 9 * (t + late) ** 2 + 3e-6 * rng.standard_normal(800)
    >>> round(1e6 * unevenness(t, x)[0], 1)
    10.2

    """
    squares, size = _bin_by_speed(t, x, slowest)
    if len(squares) < MIN_BINS or not (
        np.min(size) > SMALLEST_VARIANCE and np.min(squares) > SMALLEST_VARIANCE and np.all(np.isfinite(size))
    ):
        return 0.0, 0.0
    (at_rest, slope), sigma = _fit_line(squares, size)
    if slope <= MIN_SLOPE_SIGMAS * sigma:
        return 0.0, 0.0
    return float(np.sqrt(slope)), float(np.sqrt(max(at_rest, MIN_REST_SHARE * np.min(size[:, 0]))))


def _fit_line(squares: Array, size: Array) -> tuple[Array, float]:
    """Fit the variance at rest and its slope over squared speed; also the slope's deviation.

    `size` (k, 2) are variances and the numbers of their rows, which determine their deviations.
    """
    design = np.stack([np.ones_like(squares), squares], axis=1)
    variance = np.full(len(squares), float(np.average(size[:, 0], weights=size[:, 1])))
    for _ in range(3):  # deviations by the fitted variances themselves
        weight = np.sqrt(size[:, 1]) / (RELATIVE_DEVIATION * variance)
        rows, right = design * weight[:, None], size[:, 0] * weight
        found, *_ = np.linalg.lstsq(rows, right, rcond=None)
        variance = np.maximum(design @ found, 1e-3 * np.max(size[:, 0]))
    sigma = float(np.sqrt(np.linalg.pinv(rows.T @ rows)[1, 1]))
    return np.asarray(found, dtype=np.float64), sigma


def _bin_by_speed(t: Array, x: Array, slowest: float) -> tuple[Array, Array]:
    """Mean squared speed (k,) of bins; variance of a position and number of rows in each, (k, 2)."""
    if len(x) < 5:
        return np.zeros(0), np.zeros((0, 2))
    difference = np.diff(x, 4) / np.sqrt(70.0)
    fast = np.abs(robust_speed(t, x))[2:-2]
    whole = np.rint((t[4:] - t[:-4]) / np.median(np.diff(t))) == 4
    rows = np.flatnonzero(whole & (fast > slowest))
    rows = rows[np.argsort(fast[rows])]
    parts = [
        part
        for part in np.array_split(rows, min(max(len(rows) // ROWS_PER_BIN, 1), MAX_BINS))
        if len(part) >= ROWS_PER_BIN // 2
    ]
    variances = [_clipped_variance(difference[part]) for part in parts]
    squares = np.array([float(np.mean(fast[part] ** 2)) for part in parts])
    return squares, np.array([(v, len(part)) for v, part in zip(variances, parts, strict=True)]).reshape(-1, 2)


def _clipped_variance(difference: Array) -> float:
    """Variance from clipped squares, consistent for Gaussian noise and robust against outliers (Huber 1981)."""
    most = CLIP_SIGMAS * float(robust_std(difference))
    return float(np.mean(np.minimum(np.abs(difference), most) ** 2)) / CLIPPED_MEAN_SQUARE


def frame_numbers(t: Array) -> Array:
    """Convert times to frame numbers, counted from the first.

    `t` (n,): times, s. Returns the whole numbers; gaps are kept.

    Examples
    --------
    >>> frame_numbers(np.array([0.0, 0.1, 0.2, 0.5])).tolist()
    [0.0, 1.0, 2.0, 5.0]

    """
    steps = np.diff(t)  # one by one: the rounding of their median would add up
    return np.concatenate(
        ([0.0], np.cumsum(np.maximum(np.rint(steps / (base_interval(t) or float(np.median(steps)))), 1.0)))
    )
