"""Benchmark of identification: errors over the bound, a real machine, and success of global optimisers."""

from .accuracy import Plan
from .scenes import SCENES

__all__ = ["SCENES", "Plan"]
