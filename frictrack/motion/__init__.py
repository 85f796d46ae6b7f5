"""Compute position, velocity and acceleration with their standard deviations from a displacement.

`low_pass` smooths the displacement, `differentiate` derives it; `noise` and `smoother` hold their methods.
"""

from frictrack.filters import METHOD_NAMES
from frictrack.motion.derivative import (
    Derivatives,
    best_smoothing,
    covariance,
    derivatives,
    differentiate,
    filtered_acceleration,
)
from frictrack.motion.filter import MISSING_SIGMA, KnownAcceleration, frame_weights, low_pass
from frictrack.motion.filter_comparison import FilteredMotion, compare_filters, cutoff_tradeoff
from frictrack.motion.filter_methods import FilterMethod, Smoother, interpolate_missing, unit_responses
from frictrack.motion.grid import STENCIL_FRAMES, FrameGrid, frame_grid, stencil_start, stencil_weights, stencils
from frictrack.motion.noise import CorrelatedNoise, NoiseStretch, correlated_noise, noise_level

__all__ = [
    "METHOD_NAMES",
    "MISSING_SIGMA",
    "STENCIL_FRAMES",
    "CorrelatedNoise",
    "Derivatives",
    "FilterMethod",
    "FilteredMotion",
    "FrameGrid",
    "KnownAcceleration",
    "NoiseStretch",
    "Smoother",
    "best_smoothing",
    "compare_filters",
    "correlated_noise",
    "covariance",
    "cutoff_tradeoff",
    "derivatives",
    "differentiate",
    "filtered_acceleration",
    "frame_grid",
    "frame_weights",
    "interpolate_missing",
    "low_pass",
    "noise_level",
    "stencil_start",
    "stencil_weights",
    "stencils",
    "unit_responses",
]
