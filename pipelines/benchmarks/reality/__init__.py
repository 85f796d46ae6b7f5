"""Benchmark of robustness: blind studies with faults of real records; wrong verdicts and faults named."""

from __future__ import annotations

from reality import faults, judge, spoil, studies, tally

__all__ = ["faults", "judge", "spoil", "studies", "tally"]
