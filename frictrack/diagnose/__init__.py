"""Which effect is missing, how sure, and what would settle it."""

from __future__ import annotations

from frictrack.diagnose.search import diagnose
from frictrack.diagnose.verdict import Candidate, Diagnosis

__all__ = ["Candidate", "Diagnosis", "diagnose"]
