"""Benchmark of global optimisation: success rate and time of frictrack's searches and other optimisers."""

from .problems import PROBLEMS
from .run import compare

__all__ = ["PROBLEMS", "compare"]
