"""Global optimisers behind one call: `minimise(cost, bounds, method=..., rng=...)`.

One room for the papers' searches (``ga``, ``mga``, ``sa``, ``sga``) and for their stronger peers (``de``, ``da``,
``cmaes``). The genetic ones share one loop, `evolve.evolve`, and bring only their operators.
"""

from frictrack.search.driver import METHODS, Search, minimise
from frictrack.search.ledger import SearchResult

__all__ = ["METHODS", "Search", "SearchResult", "minimise"]
