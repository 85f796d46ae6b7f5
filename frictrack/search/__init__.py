"""Minimise a cost function over a box by a global search: `minimise(cost, bounds, method=..., rng=...)`.

The methods of the two papers are ``ga``, ``mga``, ``sa`` and ``sga``. ``de``, ``da`` and ``cmaes`` are established
methods to compare them with. The genetic methods share one loop, `evolve.evolve`, and differ in their operators only.
"""

from frictrack.search.driver import METHODS, SearchMethod, minimise
from frictrack.search.evaluator import SearchResult
from frictrack.search.mga import code_length, code_length_as_printed

__all__ = [
    "METHODS",
    "SearchMethod",
    "SearchResult",
    "code_length",
    "code_length_as_printed",
    "minimise",
]
