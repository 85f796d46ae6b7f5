"""Linearise a fitted model about the measured motion, and scan a candidate effect on it."""

from frictrack.fit.linearised.model import LinearisedModel, LinearisedPiece, linearise
from frictrack.fit.linearised.scan import (
    MIN_UNEXPLAINED_SHARE,
    CandidateScan,
    Float32Array,
    ScannedSeries,
    candidate_grids,
    has_per_run_coefficients,
    measured_series,
    scan_candidate,
)

__all__ = [
    "MIN_UNEXPLAINED_SHARE",
    "CandidateScan",
    "Float32Array",
    "LinearisedModel",
    "LinearisedPiece",
    "ScannedSeries",
    "candidate_grids",
    "has_per_run_coefficients",
    "linearise",
    "measured_series",
    "scan_candidate",
]
