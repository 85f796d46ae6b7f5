"""Compute over how many frames a series is correlated."""

from __future__ import annotations

import numpy as np

from frictrack.records import Array


def correlation_time_frames(r: Array, window: float = 5.0) -> float:
    """Compute the integrated correlation time of a residual, summed over a growing window.

    Parameters
    ----------
    r : array of shape (n,)
        Residual.
    window : float
        The sum ends at the first lag above this multiple of the correlation time.

    Returns
    -------
    float
        Correlation time in frames, at least 1.

    References
    ----------
    Sokal, A. (1997). Monte Carlo methods in statistical mechanics. Functional Integration, NATO ASI 361, 131-192.

    Examples
    --------
    >>> correlation_time_frames(np.tile([1.0, -1.0], 50))
    1.0

    """
    n = len(r)
    if n < 8:
        return 1.0
    spectrum = np.abs(np.fft.rfft(r - r.mean(), 2 * n)) ** 2
    rho = np.fft.irfft(spectrum)[: n // 2]
    total = 1 + 2 * np.cumsum(rho[1:] / max(float(rho[0]), 1e-300))
    far = np.flatnonzero(np.arange(1, len(total) + 1) >= window * total)
    return max(float(total[far[0]] if len(far) else total[-1]), 1.0)
