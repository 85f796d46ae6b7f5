"""Runs whose friction was measured: fitted to that series, without differentiation and without a mass."""

from frictrack.fit.series.law import covariance, heldout_rms, solve_series
from frictrack.fit.series.problem import (
    SeriesProblem,
    check_model,
    common_load,
    is_series,
    measured,
    series_pieces,
    spans_of_series,
)
from frictrack.fit.series.told import curves, errors_of, row

__all__ = [
    "SeriesProblem",
    "check_model",
    "common_load",
    "covariance",
    "curves",
    "errors_of",
    "heldout_rms",
    "is_series",
    "measured",
    "row",
    "series_pieces",
    "solve_series",
    "spans_of_series",
]
