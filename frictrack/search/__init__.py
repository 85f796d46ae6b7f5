"""Minimise a cost function over a box by a global search: `minimise(cost, bounds, method=..., rng=...)`.

The methods of the two papers are ``ga``, ``mga``, ``sa`` and ``sga``. ``de``, ``da`` and ``cmaes`` are established
methods to compare them with. Each is a record of its settings, such as ``MGA(generations=500)``. The genetic methods
share one loop, `evolve.GeneticMethod`, and differ in their operators only.
"""

# ruff: noqa: F401 - the imports are the interface

from frictrack.search.adapters import CMAES, DA, DE
from frictrack.search.driver import METHODS, minimise, search_method
from frictrack.search.genetic import GA, MGA, SA, SGA, code_length, code_length_as_printed
from frictrack.search.method import (
    COST_OF_MEMORY,
    Convergence,
    EvaluationBudget,
    SearchMethod,
    SearchResult,
    read_settings,
)
