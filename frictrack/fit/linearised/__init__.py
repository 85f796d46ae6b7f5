"""Linearise a fitted model about the measured motion, and scan a candidate effect on it."""

from frictrack.fit.linearised.gains import MIN_COLUMN_SQUARE, MIN_UNEXPLAINED_SHARE
from frictrack.fit.linearised.grid import CandidateGrid, candidate_grids, has_per_run_coefficients
from frictrack.fit.linearised.measured_motion import is_linearised_about_measurement, linearise_about_measurement
from frictrack.fit.linearised.model import LinearisedModel, LinearisedPiece, linearise
from frictrack.fit.linearised.scan import CandidateScan, scan_candidate, scan_candidates
from frictrack.fit.linearised.series import Float32Array, ScannedSeries, measured_series
from frictrack.fit.linearised.small_grids import products_of_grids

__all__ = [
    "MIN_COLUMN_SQUARE",
    "MIN_UNEXPLAINED_SHARE",
    "CandidateGrid",
    "CandidateScan",
    "Float32Array",
    "LinearisedModel",
    "LinearisedPiece",
    "ScannedSeries",
    "candidate_grids",
    "has_per_run_coefficients",
    "is_linearised_about_measurement",
    "linearise",
    "linearise_about_measurement",
    "measured_series",
    "products_of_grids",
    "scan_candidate",
    "scan_candidates",
]
