"""Which effect is missing, how sure, and what would settle it."""

from __future__ import annotations

from frictrack.diagnose.search import Candidate, Diagnosis, diagnose

__all__ = ["Candidate", "Diagnosis", "diagnose"]
