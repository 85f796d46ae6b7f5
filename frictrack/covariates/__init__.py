"""Fit how the parameters of a law depend on a condition that differs between studies: temperature, load, material."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from frictrack.covariates.regression import Design, design_of, fit_trends
from frictrack.covariates.results import CovariateTrend, CovariateTrends, Prediction
from frictrack.errors import FrictrackError
from frictrack.priors import Prior

__all__ = ["CovariateTrend", "CovariateTrends", "Prediction", "trend"]
MIN_DEGREES = 2  # studies more than coefficients


def trend(laws: Sequence[Any], at: Sequence[float | str], condition: str = "condition") -> CovariateTrends:
    """Fit how the parameters of a law depend on a condition that differs between studies.

    Forces that scale with the load are converted to the load of the first study.

    Parameters
    ----------
    laws : sequence of Fit or Prior
        One law per study.
    at : sequence of float or str
        The condition of every study: numbers, or names of categories.
    condition : str
        Name of the condition.

    Returns
    -------
    CovariateTrends
        Coefficients, scatter between studies, and predictions of every parameter.

    Raises
    ------
    FrictrackError
        (usage) If there are too few studies, or all have the same condition.

    Examples
    --------
    >>> import frictrack as ft
    >>> def law(force):
    ...     return ft.Prior(("coulomb.F_c",), (force,), ((0.0001,),), ("N",), (True,), load=3.0)
    >>> found = ft.trend([law(f) for f in (1.0, 1.09, 1.21, 1.3, 1.41)], [20, 30, 40, 50, 60], "temperature")
    >>> slope = found["coulomb.F_c"]
    >>> round(float(slope.coefficients[1]), 4), slope.p < 0.01
    (0.0103, True)
    >>> round(slope.predict(45).value, 2)
    1.25

    """
    priors = [one if isinstance(one, Prior) else one.to_prior() for one in laws]
    if len(priors) != len(at):
        raise FrictrackError(
            f"expected one value of {condition} per law but got {len(at)} for {len(priors)}", usage=True
        )
    design = design_of(at, condition)
    load = priors[0].load if priors else None
    converted = [one.at_load(load) for one in priors]
    names = list(dict.fromkeys(name for one in converted for name in one.names))
    left_out = {name: reason for name in names if (reason := _too_few(name, converted, design))}
    kept = [name for name in names if name not in left_out]
    if not kept:
        raise FrictrackError(
            f"expected a parameter that at least {len(design.terms) + MIN_DEGREES} studies determine, in every "
            f"category, but got {len(priors)} studies of {condition}",
            usage=True,
        )
    units = {name: unit for one in converted for name, unit in zip(one.names, one.units, strict=True)}
    fitted = fit_trends(converted, design, kept, units)
    return CovariateTrends(condition, fitted, load, left_out)


def _too_few(name: str, priors: Sequence[Prior], design: Design) -> str:
    """Return why a parameter has no trend; "" if it has one."""
    rows = np.array([row for one, row in zip(priors, design.rows, strict=True) if name in one.names])
    q = len(design.terms)
    if len(rows) < q + MIN_DEGREES:
        return f"only {len(rows)} studies determine it; {q + MIN_DEGREES} are needed"
    return "" if np.linalg.matrix_rank(rows) == q else "the studies that determine it do not have all conditions"
