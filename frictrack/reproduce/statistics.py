"""Intervals for shares, means and ratios of means: what a run of 50 or 200 seeds can tell."""

from __future__ import annotations

import numpy as np
from scipy.stats import fisher_exact

from frictrack.records import Array

Z = 1.959964  # of a 95 % interval
DRAWS = 4000  # of a bootstrap


def wilson(hits: int, n: int) -> tuple[float, float]:
    """95 % interval of a share, hits of n (Wilson 1927, J. Am. Stat. Assoc. 22)."""
    share, q = hits / n, Z**2 / n
    middle = (share + q / 2) / (1 + q)
    half = Z / (1 + q) * np.sqrt(share * (1 - share) / n + q / (4 * n))
    return max(0.0, float(middle - half)), min(1.0, float(middle + half))


def mean_interval(x: Array, rng: np.random.Generator) -> tuple[float, float]:
    """95 % interval of a mean by bootstrap percentiles (Efron 1979), x (n,)."""
    means = x[rng.integers(len(x), size=(DRAWS, len(x)))].mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


def change_interval(x: Array, base: Array, rng: np.random.Generator) -> tuple[float, float]:
    """95 % interval of mean(x)/mean(base) - 1 by bootstrap percentiles."""
    ratio = _means(x, len(x), rng) / _means(base, len(base), rng) - 1
    low, high = np.percentile(ratio, [2.5, 97.5])
    return float(low), float(high)


def by_chance(base: Array, runs: int, change: float, rng: np.random.Generator) -> float:
    """Probability that a method set against *itself*, `runs` against `runs`, shows at most this relative change."""
    ratio = _means(base, runs, rng) / _means(base, runs, rng) - 1
    return float(np.mean(ratio <= change))


def differ(hits: tuple[int, int], of: tuple[int, int]) -> float:
    """Two-sided p of two shares being the same (Fisher's exact test)."""
    table = np.array([[hits[0], of[0] - hits[0]], [hits[1], of[1] - hits[1]]])
    return float(fisher_exact(table).pvalue)


def _means(x: Array, n: int, rng: np.random.Generator) -> Array:
    out: Array = x[rng.integers(len(x), size=(DRAWS, n))].mean(axis=1)
    return out
