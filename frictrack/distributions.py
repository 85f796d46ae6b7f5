"""Tail probabilities and quantiles of the normal, Student's, chi-squared and F distributions.

They are the functions of `scipy.special` that `scipy.stats` calls itself. Importing `scipy.stats` takes half a second,
and each call of it a hundred times as long, because it prepares all of its distributions and checks every argument.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy


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


def noncentral_chi2_sf(x: Any, df: Any, noncentrality: Any) -> Any:
    """Return the probability that a noncentral chi-squared of `df` degrees of freedom exceeds `x`."""
    return 1 - scipy.special.chndtr(x, df, noncentrality)


def f_sf(x: Any, df_numerator: Any, df_denominator: Any) -> Any:
    """Return the probability that F exceeds `x`."""
    return scipy.special.fdtrc(df_numerator, df_denominator, x)


def f_isf(p: Any, df_numerator: Any, df_denominator: Any) -> Any:
    """Return the value that F exceeds with probability `p`."""
    return scipy.special.fdtri(df_numerator, df_denominator, 1 - p)
