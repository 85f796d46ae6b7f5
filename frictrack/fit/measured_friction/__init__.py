"""Runs whose friction was measured: fitted to that series, without differentiation and without a mass."""

from frictrack.fit.measured_friction.noise import Noise, noise_of, weighed
from frictrack.fit.measured_friction.problem import (
    SeriesPiece,
    SeriesProblem,
    check_model,
    common_load,
    compact,
    is_series,
    measured,
    series_pieces,
    spans_of_series,
)
from frictrack.fit.measured_friction.solve import covariance, heldout_rms, search_series, solve_series
from frictrack.fit.measured_friction.summary import curves, errors_of, remarks, row

__all__ = [
    "Noise",
    "SeriesPiece",
    "SeriesProblem",
    "check_model",
    "common_load",
    "compact",
    "covariance",
    "curves",
    "errors_of",
    "heldout_rms",
    "is_series",
    "measured",
    "noise_of",
    "remarks",
    "row",
    "search_series",
    "series_pieces",
    "solve_series",
    "spans_of_series",
    "weighed",
]
