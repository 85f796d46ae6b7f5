"""Smooth functions: interpolation from knots, Matern covariance, correlation time of a series."""

from frictrack.fit.smooth_functions.correlation import correlation_time_frames
from frictrack.fit.smooth_functions.interpolation import linear_interpolation_matrix, matern_covariance

__all__ = [
    "correlation_time_frames",
    "linear_interpolation_matrix",
    "matern_covariance",
]
