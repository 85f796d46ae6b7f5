"""Fit a model by least squares of the simulated motion (output error), and quantify the result.

The modules: the problem and its sensitivities, the linearised solution, Gauss-Newton, covariance, held-out error.
"""

# ruff: noqa: F401 - the imports are the interface

from frictrack.fit.least_squares.gauss_newton import (
    MIN_CHI2_FALL,
    fit_with_scatter,
    hold,
    predicted_objective,
    refine,
    refit_with_scatter,
)
from frictrack.fit.least_squares.problem import LeastSquaresProblem, PieceResponse
from frictrack.fit.least_squares.solution import (
    MIN_SINGULAR_VALUE,
    NORMAL_QUANTILE_975,
    Solution,
    batch_count,
    clustered_covariance,
    covariance_of,
    displacement_response,
    heldout_rms,
    inverse_normal_matrix,
    model_projection,
    position_and_velocity,
    white_noise_covariance,
)
