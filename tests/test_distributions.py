"""The tail probabilities and quantiles are those of scipy.stats."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from frictrack.base import distributions as d

X = np.array([-2.0, 0.0, 0.3, 1.96, 7.0, 40.0])
P = np.array([1e-12, 1e-4, 0.01, 0.5, 0.975, 0.999])


@pytest.mark.parametrize("df", [1, 2, 5, 1000.0, 0.5])
def test_one_distribution_with_degrees_of_freedom(df: float) -> None:
    np.testing.assert_allclose(d.chi2_sf(X, df), stats.chi2.sf(X, df), rtol=1e-12)
    np.testing.assert_allclose(d.chi2_isf(P, df), stats.chi2.isf(P, df), rtol=1e-12)
    np.testing.assert_allclose(d.chi2_ppf(P, df), stats.chi2.ppf(P, df), rtol=1e-12)
    np.testing.assert_allclose(d.student_sf(X, df), stats.t.sf(X, df), rtol=1e-12)
    np.testing.assert_allclose(d.student_ppf(P, df), stats.t.ppf(P, df), rtol=1e-12)
    np.testing.assert_allclose(d.f_isf(P, df, 20), stats.f.isf(P, df, 20), rtol=1e-6)


def test_a_normal_variable() -> None:
    np.testing.assert_allclose(d.normal_sf(X), stats.norm.sf(X), rtol=1e-12)
    np.testing.assert_allclose(d.normal_ppf(P), stats.norm.ppf(P), rtol=1e-12)
