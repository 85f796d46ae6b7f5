"""Grids of values on which a search first tries the non-linear parameters of an effect."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from frictrack.records import Array, EarlierRuns

USUAL_TOP_SPEED = 6.0  # m/s; where runs are faster, or a scale is wrong, the range of Stribeck velocities grows along


@dataclass(frozen=True)
class Span:
    """How far the recorded runs reach: what a scan can hope to see."""

    duration: float  # s, of the longest run
    x_min: float  # m
    x_max: float
    v_min: float  # m/s, slowest speed seen
    v_max: float
    fps: float  # Hz
    clamp_x: float | None = None  # m
    beam_length: float | None = None  # m, where it is known
    earlier: EarlierRuns = ()  # the longest series before a run, where it is known


@dataclass(frozen=True)
class ScanValues:
    """A scan of the same values for all runs."""

    values: tuple[float, ...]

    def __call__(self, span: Span) -> Array:
        """Values worth trying."""
        return np.array(self.values)


MIN_SCAN_VALUES = 9  # of a scan between bounds


@dataclass(frozen=True)
class Within:
    """A scan that keeps to bounds; without a grid of its own it runs evenly from one to the other."""

    bounds: tuple[float, float]
    scan: Callable[[Span], Array] | None = None

    def __call__(self, span: Span) -> Array:
        """Values worth trying, at least `MIN_SCAN_VALUES` where the scan has as many and the bounds leave room."""
        low, high = self.bounds
        if self.scan is None:
            return np.linspace(low, high, MIN_SCAN_VALUES)
        grid = self.scan(span)
        inside = grid[(grid >= low) & (grid <= high)]
        if len(inside) >= min(MIN_SCAN_VALUES, len(grid)):
            return inside
        if np.all(np.isfinite(self.bounds)):
            return np.linspace(low, high, MIN_SCAN_VALUES)
        return np.unique(np.clip(grid, low, high))


def frequency_range(span: Span) -> tuple[float, float]:
    """Lowest and highest frequency worth trying, Hz: at least one period in the longest run, five frames per period."""
    lowest = max(1.0 / span.duration, 2.0)
    return lowest, max(min(0.2 * span.fps, 600.0), 2 * lowest)


def frequencies(span: Span) -> Array:
    """Scan of a line in time, Hz: a quarter of a Rayleigh cell apart."""
    return np.arange(*frequency_range(span), 0.25 / span.duration)


def log_grid(low: float, high: float, per_decade: int) -> Array:
    """Logarithmic scan from low to high with about so many points per decade."""
    return np.geomspace(low, high, max(2, round(per_decade * np.log10(high / low)) + 1))


def spatial_periods(span: Span) -> Array:
    """Return periods worth trying, m: equal steps in 1/period, a quarter of a cell of the travelled span apart."""
    travel = span.x_max - span.x_min
    shortest = max(min(0.002, travel / 20), span.v_min / (0.2 * span.fps), travel / 200)
    return 1.0 / np.arange(1.0 / travel, 1.0 / shortest, 0.25 / travel)


def stribeck_velocities(span: Span, low: float = 0.02, per_decade: int = 8) -> Array:
    """Return Stribeck velocities worth trying, m/s: one far below the slowest speed seen leaves no trace."""
    growth = max(1.0, span.v_max / USUAL_TOP_SPEED)
    highest = min(2.0 * growth, 2 * span.v_max)
    lowest = max(min(low * growth, span.v_max / 100), span.v_min / 6)
    return log_grid(min(lowest, highest / 2), highest, per_decade)


def bend_velocities(span: Span, above: float = 2.0) -> Array:
    """Return velocities at which a law may bend, m/s, up to `above` times the fastest seen: beyond, it is a line."""
    return log_grid(max(span.v_min / 3, span.v_max / 30), above * span.v_max, 4)


def breakaway_lengths(span: Span) -> Array:
    """Return breakaway lengths worth trying, m: from a micrometre up to a third of the travel."""
    longest = max((span.x_max - span.x_min) / 3.0, 1e-5)
    return log_grid(max(1e-6, 1e-4 * longest), longest, 4)
