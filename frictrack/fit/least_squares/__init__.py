"""Fit a model by least squares of the simulated motion (output error), and quantify the result.

The modules: the problem and its sensitivities, the linearised solution, Gauss-Newton, covariance, held-out error.
"""

# ruff: noqa: F401 - the imports are the interface

from frictrack.fit.least_squares.gauss_newton import (
    fit_with_scatter,
    hold,
    predicted_objective,
    refine,
    refit_with_scatter,
)
from frictrack.fit.least_squares.problem import LeastSquaresProblem, PieceResponse
from frictrack.fit.least_squares.solution import (
    Solution,
    displacement_response,
    heldout_rms,
    inverse_normal_matrix,
    position_and_velocity,
    white_noise_covariance,
)
