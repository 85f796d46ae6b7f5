"""Compute position, velocity and acceleration with their standard deviations from a displacement.

`low_pass` smooths the displacement by one of `filter_methods` or by a structural model (a trend of varying stiffness,
lines, events, forces that are periodic in place, and coloured noise), and `differentiate` derives it. Of that model,
`structure_search` finds the structure, `smoother` solves the equations, `posterior_deviations` says what is uncertain.
"""

# ruff: noqa: F401 - the imports are the interface

from frictrack.measure.motion.banded_equations import SmootherData
from frictrack.measure.motion.derivative import (
    FilteredMotion,
    compare_filters,
    covariance,
    cutoff_tradeoff,
    derivatives,
    differentiate,
    filtered_acceleration,
)
from frictrack.measure.motion.filter import MISSING_SIGMA, KnownAcceleration, frame_weights, low_pass
from frictrack.measure.motion.filter_methods import FilterMethod, Smoother, unit_responses
from frictrack.measure.motion.grid import STENCIL_FRAMES, frame_grid, stencils
from frictrack.measure.motion.noise import CorrelatedNoise, NoiseStretch, correlated_noise, slow_spectrum
from frictrack.measure.motion.smoother import FactoredSmoother, Structure
from frictrack.settings.filters import METHOD_NAMES
