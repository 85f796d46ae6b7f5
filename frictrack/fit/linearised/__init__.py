"""Linearise a fitted model about the measured motion, and scan a candidate effect on it."""

# ruff: noqa: F401 - the imports are the interface

from frictrack.fit.linearised.columns import (
    MIN_COLUMN_SQUARE,
    CandidateGrid,
    candidate_grids,
    has_per_run_coefficients,
    products_of_grids,
    scan_points,
)
from frictrack.fit.linearised.model import (
    Float32Array,
    LinearisedModel,
    ScannedSeries,
    is_linearised_about_measurement,
    linearise,
    linearise_about_measurement,
    measured_series,
)
from frictrack.fit.linearised.scan import MIN_UNEXPLAINED_SHARE, CandidateScan, scan_candidate, scan_candidates
