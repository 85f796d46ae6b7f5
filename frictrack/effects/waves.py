"""Sinusoids as columns of an effect."""

from __future__ import annotations

import numpy as np

from frictrack.records import Array


def wave(cycles: Array, phase: float) -> Array:
    """One column sin(2 pi cycles + phase), shape (n, 1); a sin + b cos is one amplitude and one phase."""
    # sin z = 2 u/(1 + u^2) with u = tan(z/2): numpy's tangent takes many numbers at once, its sine one by one
    u = np.pi * cycles
    u += phase / 2
    np.tan(u, out=u)
    below = u * u
    below += 1.0
    u += u
    u /= below
    return u[:, None]
