"""Identification measured: how near to the bound, on a machine, and how surely the global optimum is found."""

from .accuracy import Plan
from .scenes import SCENES

__all__ = ["SCENES", "Plan"]
