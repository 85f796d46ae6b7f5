"""Compute what step from one sample to the next is usual near every step of a course."""

from __future__ import annotations

import numpy as np

from frictrack.records import Array

REACH_STEPS = 12  # steps on either side from which the usual step is taken
MIN_KNOWN_STEPS = 3  # known steps that can show it
ROWS_AT_ONCE = 1 << 14  # whose quantiles are computed together


def usual_steps(steps: Array, share: float = 0.5) -> Array:
    """Quantile (n,) of the steps near every step; NaN where fewer than `MIN_KNOWN_STEPS` are known.

    Parameters
    ----------
    steps : array (n,)
        Steps from one sample to the next, NaN where one is not known.
    share : float
        Quantile: the median, or a higher one where many samples may repeat the one before.

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
