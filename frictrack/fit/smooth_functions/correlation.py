"""Compute over how many frames a series is correlated."""

from __future__ import annotations

import numpy as np

from frictrack.records import Array


def correlation_time_frames(r: Array, window: float = 5.0) -> float:
    """Integrated correlation time of a residual (n,) in frames, summed over a growing window (Sokal 1997)."""
    n = len(r)
    if n < 8:
        return 1.0
    spectrum = np.abs(np.fft.rfft(r - r.mean(), 2 * n)) ** 2
    rho = np.fft.irfft(spectrum)[: n // 2]
    total = 1 + 2 * np.cumsum(rho[1:] / max(float(rho[0]), 1e-300))
    far = np.flatnonzero(np.arange(1, len(total) + 1) >= window * total)
    return max(float(total[far[0]] if len(far) else total[-1]), 1.0)
