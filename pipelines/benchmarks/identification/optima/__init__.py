"""How surely and how fast the global optimum is found: frictrack's searches and other optimisers on the same series."""

from .problems import PROBLEMS
from .run import compare

__all__ = ["PROBLEMS", "compare"]
