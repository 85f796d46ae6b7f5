"""The fitted model linearised about the measured motion, and the scan of a candidate effect on it."""

from frictrack.fit.linearised.model import Beside, Strip, beside
from frictrack.fit.linearised.scan import (
    ABSORBED,
    Scan,
    Series,
    Short,
    families,
    one_series,
    per_run_coefficients,
    scan,
)

__all__ = [
    "ABSORBED",
    "Beside",
    "Scan",
    "Series",
    "Short",
    "Strip",
    "beside",
    "families",
    "one_series",
    "per_run_coefficients",
    "scan",
]
