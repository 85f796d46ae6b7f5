"""Fit runs whose friction was measured by a load cell: no differentiation, no mass."""

from frictrack.fit.measured_friction.noise import FrictionNoise, friction_noise, weight_by_noise
from frictrack.fit.measured_friction.problem import (
    MeasuredFrictionPiece,
    MeasuredFrictionProblem,
    check_effects,
    friction_pieces,
    friction_spans,
    is_measured_friction,
    keep_compared_frames,
    reference_load,
    uses_measured_friction,
)
from frictrack.fit.measured_friction.solve import (
    block_covariance,
    fit_measured_friction,
    heldout_rms,
    search_measured_friction,
)
from frictrack.fit.measured_friction.summary import curves, errors_of, remarks, run_summary

__all__ = [
    "FrictionNoise",
    "MeasuredFrictionPiece",
    "MeasuredFrictionProblem",
    "block_covariance",
    "check_effects",
    "curves",
    "errors_of",
    "fit_measured_friction",
    "friction_noise",
    "friction_pieces",
    "friction_spans",
    "heldout_rms",
    "is_measured_friction",
    "keep_compared_frames",
    "reference_load",
    "remarks",
    "run_summary",
    "search_measured_friction",
    "uses_measured_friction",
    "weight_by_noise",
]
