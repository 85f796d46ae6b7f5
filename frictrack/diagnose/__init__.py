"""Diagnose a fit: which effect the model lacks, how certain that is, and which experiment would settle it."""

from __future__ import annotations

from frictrack.diagnose.conclusion import diagnose
from frictrack.diagnose.detection_limits import noncentrality
from frictrack.diagnose.diagnosis import Candidate, Diagnosis
from frictrack.diagnose.examination import ALPHA
from frictrack.diagnose.model_selection import MAX_BIC_EQUAL, MIN_CHI2_SEPARATED
from frictrack.diagnose.unexplained import FIRST_FORMULA

__all__ = [
    "ALPHA",
    "FIRST_FORMULA",
    "MAX_BIC_EQUAL",
    "MIN_CHI2_SEPARATED",
    "Candidate",
    "Diagnosis",
    "diagnose",
    "noncentrality",
]
