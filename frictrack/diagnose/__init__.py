"""Diagnose a fit: which effect the model lacks, how certain that is, and which experiment would settle it."""

from __future__ import annotations

from frictrack.diagnose.hypothesis_tests import ALPHA
from frictrack.diagnose.model_selection import MAX_BIC_EQUAL, MIN_CHI2_SEPARATED
from frictrack.diagnose.search import diagnose
from frictrack.diagnose.verdict import Candidate, Diagnosis

__all__ = [
    "ALPHA",
    "MAX_BIC_EQUAL",
    "MIN_CHI2_SEPARATED",
    "Candidate",
    "Diagnosis",
    "diagnose",
]
