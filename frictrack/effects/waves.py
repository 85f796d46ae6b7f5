"""Sinusoids as columns of an effect."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from frictrack.effects.path import Path
from frictrack.records import Array


@dataclass(frozen=True)
class ScanWave:
    """That columns depend on one scanned parameter only as sin(2 pi q u + phase): a scan may interpolate in q.

    Attributes
    ----------
    parameter : str
        The frequency q, or the period 1/q.
    coordinate : callable
        Map a path and the other non-linear parameters to u (n,), whose unit is that of 1/q.
    is_period : bool
        Whether the parameter is a period.

    """

    parameter: str
    coordinate: Callable[[Path, Any], Array]
    is_period: bool = False

    def frequency(self, values: Array) -> Array:
        """Convert values of the parameter to q, or q to values of the parameter."""
        return 1.0 / values if self.is_period else values


def over_time(path: Path, nonlinear: Any) -> Array:
    """Return the coordinate u of a wave in time, s."""
    return path.t


def over_position(path: Path, nonlinear: Any) -> Array:
    """Return the coordinate u of a wave in space, m."""
    return path.x


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
