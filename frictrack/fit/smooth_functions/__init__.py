"""Smooth functions: interpolation, correlation time of a series, and Gaussian processes of the most likely size."""

from frictrack.fit.smooth_functions.gaussian_process import (
    SmoothProcess,
    matern_covariance,
    matern_root,
    most_likely_process,
)
from frictrack.fit.smooth_functions.interpolation import (
    correlated_frames,
    correlation_time_frames,
    linear_interpolation_matrix,
)

__all__ = [
    "SmoothProcess",
    "correlated_frames",
    "correlation_time_frames",
    "linear_interpolation_matrix",
    "matern_covariance",
    "matern_root",
    "most_likely_process",
]
