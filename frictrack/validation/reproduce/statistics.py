"""Compute intervals and tests for shares and means over seeds."""

from __future__ import annotations

import numpy as np
from scipy.stats import fisher_exact

from frictrack.records import Array

N_BOOTSTRAP = 4000


def mean_interval(x: Array, rng: np.random.Generator) -> tuple[float, float]:
    """95 % interval of a mean.

    Parameters
    ----------
    x
        Values, (n,).
    rng
        Source of the resampling.

    Returns
    -------
    tuple of float
        Lower and upper limit.

    References
    ----------
    Efron 1979, Ann. Statist. 7: percentiles of the bootstrap.

    """
    means = x[rng.integers(len(x), size=(N_BOOTSTRAP, len(x)))].mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


def change_interval(x: Array, base: Array, rng: np.random.Generator) -> tuple[float, float]:
    """95 % interval of a relative change of means, from bootstrap percentiles.

    Parameters
    ----------
    x, base
        Values of both methods, (n,) and (m,).
    rng
        Source of the resampling.

    Returns
    -------
    tuple of float
        Limits of mean(x)/mean(base) - 1.

    """
    ratio = _bootstrap_means(x, len(x), rng) / _bootstrap_means(base, len(base), rng) - 1
    low, high = np.percentile(ratio, [2.5, 97.5])
    return float(low), float(high)


def probability_by_chance(base: Array, runs: int, change: float, rng: np.random.Generator) -> float:
    """Probability that a method compared with itself shows at most a relative change.

    Parameters
    ----------
    base
        Values of the method, (n,).
    runs
        Runs on each side of the comparison.
    change
        Relative change of the mean.
    rng
        Source of the resampling.

    Returns
    -------
    float
        Probability.

    """
    ratio = _bootstrap_means(base, runs, rng) / _bootstrap_means(base, runs, rng) - 1
    return float(np.mean(ratio <= change))


def fisher_p_value(hits: tuple[int, int], of: tuple[int, int]) -> float:
    """Two-sided p value of two equal shares (Fisher's exact test).

    Parameters
    ----------
    hits, of
        Hits and cases of both groups.

    Returns
    -------
    float
        p value.

    Examples
    --------
    >>> fisher_p_value((10, 10), (50, 50))
    1.0

    """
    table = np.array([[hits[0], of[0] - hits[0]], [hits[1], of[1] - hits[1]]])
    return float(fisher_exact(table).pvalue)


def _bootstrap_means(x: Array, n: int, rng: np.random.Generator) -> Array:
    """Means of n values drawn with replacement, (N_BOOTSTRAP,)."""
    out: Array = x[rng.integers(len(x), size=(N_BOOTSTRAP, n))].mean(axis=1)
    return out
