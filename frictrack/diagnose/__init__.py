"""Diagnose a fit: which effect the model lacks, how certain that is, and which experiment would settle it."""
# ruff: noqa: F401 - the imports are the interface

from __future__ import annotations

from frictrack.diagnose.conclusion import diagnose, unsearched
from frictrack.diagnose.diagnosis import Candidate, Diagnosis
from frictrack.diagnose.examination import ALPHA
from frictrack.diagnose.model_selection import MAX_BIC_EQUAL, MIN_CHI2_SEPARATED
