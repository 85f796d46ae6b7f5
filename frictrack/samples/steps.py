"""Compute what step from one sample to the next is usual near every step of a course."""

from __future__ import annotations

import numpy as np

from frictrack.records import Array

NEAR = 12  # steps on either side that say what is usual
FEWEST = 3  # known steps that can say it


def usual_steps(steps: Array, share: float = 0.5) -> Array:
    """Quantile (n,) of the steps near every step; NaN where fewer than `FEWEST` are known.

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
    padded = np.pad(steps, NEAR, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * NEAR + 1)
    enough = np.sum(np.isfinite(windows), axis=1) >= FEWEST
    out = np.full(len(steps), np.nan)
    out[enough] = np.nanquantile(windows[enough], share, axis=1)
    return out
