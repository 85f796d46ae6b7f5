"""Studies with a sealed truth, and how a diagnosis fares on them.

from frictrack.blind import make, score
make(Path("blind"), n=42)           # studies and their seal
score(Path("blind"))                # named first, false alarms, missed, ... with intervals
"""

from __future__ import annotations

from frictrack.blind.benchmark import make, score

__all__ = ["make", "score"]
