"""Compute what step from one sample to the next is usual, the noise of positions, and the step of quantised positions.

Quantised positions are counts of an encoder, centimetres of an ultrasonic sensor, digits of a table. Rounding to a
step q adds an error of standard deviation q / sqrt(12) (Bennett 1948, Bell Syst. Tech. J. 27). It is white where the
position changes by more than a step, or its noise by half of one, from sample to sample. A slower mass shares its error
with the samples before: differences of the positions then show less noise than there is, or none.
"""

from __future__ import annotations

import numpy as np

from frictrack.records import Array

REACH_STEPS = 12  # steps on either side from which the usual step is taken
MIN_KNOWN_STEPS = 3  # known steps that can show it
ROWS_AT_ONCE = 1 << 14  # whose quantiles are computed together
MAX_STEP_ERROR = 0.02  # of a step; positions may be off a whole multiple by this much
MAX_PARTS = 1000  # of the smallest gap between two positions: a fast mass skips some steps
MAX_CHANCE = 1e-6  # probability that gaps which are no multiples of a step seem to be, over all parts tried
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
