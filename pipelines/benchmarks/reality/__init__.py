"""Blind studies with the faults that real records have: is a verdict confidently wrong, and is the fault named."""

from __future__ import annotations

from reality import faults, judge, spoil, studies, tally

__all__ = ["faults", "judge", "spoil", "studies", "tally"]
