"""Least squares of the simulated motion: problem, Gauss-Newton, covariance, projection of residuals, held-out error."""

from frictrack.fit.least_squares.covariance import NULL, Z95, batches_of, covariance_of, inverse, plain_covariance
from frictrack.fit.least_squares.gauss_newton import Solution, continued, promising, refine, resettled, settle_scatter
from frictrack.fit.least_squares.heldout import HIDDEN_SIGMA_FACTOR, heldout_rms, is_predictable
from frictrack.fit.least_squares.problem import Problem, Response
from frictrack.fit.least_squares.projection import Linearised, linearised, place, traces

__all__ = [
    "HIDDEN_SIGMA_FACTOR",
    "NULL",
    "Z95",
    "Linearised",
    "Problem",
    "Response",
    "Solution",
    "batches_of",
    "continued",
    "covariance_of",
    "heldout_rms",
    "inverse",
    "is_predictable",
    "linearised",
    "place",
    "plain_covariance",
    "promising",
    "refine",
    "resettled",
    "settle_scatter",
    "traces",
]
