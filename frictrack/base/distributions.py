"""Distributions for tests, robust spreads, and random generators as SPEC 7 has them."""

from __future__ import annotations

from math import comb
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike

MEDIAN_TO_SIGMA = 1.482602218505602  # standard deviation of a normal variable over its median absolute value


def robust_std(deviations: ArrayLike, axis: int | None = None) -> Any:
    """Return the standard deviation of normal deviations from their median absolute value: outliers hardly matter.

    Examples
    --------
    >>> round(float(robust_std([-1.0, 1.0, -1.0, 1.0, 99.0])), 3)
    1.483

    """
    return MEDIAN_TO_SIGMA * np.median(np.abs(deviations), axis=axis)


def noise_of_differences(differences: ArrayLike, order: int) -> float:
    """Return the white noise of a series from the median of its differences of order k; 0 without any.

    The differences have C(2k, k) times the variance of the noise.

    Examples
    --------
    >>> round(noise_of_differences([1.0, -1.0], 3), 3)
    0.332

    """
    return float(robust_std(differences)) / float(np.sqrt(comb(2 * order, order))) if np.size(differences) else 0.0


def normal_sf(x: Any) -> Any:
    """Return the probability that a standard normal variable exceeds `x`."""
    return scipy.special.ndtr(-x)


def normal_ppf(p: Any) -> Any:
    """Return the value that a standard normal variable exceeds with probability 1 - `p`."""
    return scipy.special.ndtri(p)


def student_sf(x: Any, df: Any) -> Any:
    """Return the probability that Student's t of `df` degrees of freedom exceeds `x`."""
    return scipy.special.stdtr(df, -x)


def student_ppf(p: Any, df: Any) -> Any:
    """Return the value that Student's t of `df` degrees of freedom exceeds with probability 1 - `p`."""
    return scipy.special.stdtrit(df, p)


def chi2_sf(x: Any, df: Any) -> Any:
    """Return the probability that chi-squared of `df` degrees of freedom exceeds `x`."""
    return scipy.special.chdtrc(df, np.maximum(x, 0.0))  # scipy.special has no value below 0


def chi2_isf(p: Any, df: Any) -> Any:
    """Return the value that chi-squared of `df` degrees of freedom exceeds with probability `p`."""
    return scipy.special.chdtri(df, p)


def chi2_ppf(p: Any, df: Any) -> Any:
    """Return the value that chi-squared of `df` degrees of freedom exceeds with probability 1 - `p`."""
    return 2 * scipy.special.gammaincinv(df / 2, p)


def f_sf(x: Any, df_numerator: Any, df_denominator: Any) -> Any:
    """Return the probability that F exceeds `x`."""
    return scipy.special.fdtrc(df_numerator, df_denominator, x)


def f_isf(p: Any, df_numerator: Any, df_denominator: Any) -> Any:
    """Return the value that F exceeds with probability `p`."""
    return scipy.special.fdtri(df_numerator, df_denominator, 1 - p)


RNG = np.random.Generator | int | None
"""What `rng` takes: a generator, which is advanced; a seed; or None for other numbers in every call."""


def as_seed(rng: RNG) -> int | None:
    """Return the seed if `rng` is one, to store it with a result; None for a generator.

    Examples
    --------
    >>> as_seed(3), as_seed(np.random.default_rng(3))
    (3, None)

    """
    return None if rng is None or isinstance(rng, np.random.Generator) else int(rng)
