"""The door to every search: `minimise`, and the table of methods."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from frictrack.errors import FrictrackError, gather
from frictrack.records import Array
from frictrack.search.adapters import CMAES, DA, DE
from frictrack.search.ga import GA
from frictrack.search.ledger import Callback, Cost, Ledger, SearchResult, Stop
from frictrack.search.mga import MGA
from frictrack.search.sa import SA
from frictrack.search.sga import SGA


class Search(Protocol):
    """A method with its settings: asks the ledger for costs of points in the unit box until it stops or converges."""

    def __call__(self, ledger: Ledger, rng: np.random.Generator) -> None:
        """Search; returning means converged."""


METHODS: dict[str, Callable[..., Search]] = {
    "ga": GA,
    "mga": MGA,
    "sa": SA,
    "sga": SGA,
    "de": DE,
    "da": DA,
    "cmaes": CMAES,
}


def minimise(  # noqa: PLR0913 - one door with named settings, all but two of them optional
    cost: Cost,
    bounds: ArrayLike,
    *,
    method: str,
    rng: np.random.Generator,
    max_evaluations: int = 20_000,
    callback: Callback | None = None,
    stagnation: int | None = None,
    **settings: Any,
) -> SearchResult:
    """Minimise ``cost`` over a box by one of `METHODS`; the same ``rng`` state gives the same result.

    ``cost`` takes a population (P, d) and returns (P,), NaN counting as infinitely bad; ``bounds`` is (d, 2), lower
    and upper. ``max_evaluations``, the points whose cost is asked for, is never exceeded, and the papers' G_max follows
    from it. ``callback(generation, best_x, best_cost)`` is called after every generation and stops the search by a
    true answer; ``stagnation`` stops it after so many generations without improvement. ``settings`` are the fields of
    the method's class, such as ``population=80`` or ``as_printed=True``.

    Raises FrictrackError for an unknown method or setting, bounds that are no box, a budget below 1, a cost of the
    wrong shape, a missing optional package.
    """
    box = _box(bounds)
    search = _search(method, settings)
    if max_evaluations < 1:
        raise FrictrackError(f"expected max_evaluations of at least 1 but got {max_evaluations}")
    ledger = Ledger(cost, box, max_evaluations, callback, stagnation)
    reason = "converged"
    try:
        search(ledger, rng)
        ledger.close()
    except Stop as stop:
        reason = str(stop)
    return ledger.result(reason)


def _search(method: str, settings: dict[str, Any]) -> Search:
    if method not in METHODS:
        raise FrictrackError(f'expected a search among {", ".join(METHODS)} but got "{method}"')
    known = [f.name for f in fields(METHODS[method])]  # type: ignore[arg-type]
    gather(
        [f'expected a setting among {", ".join(known)} but got "{name}"' for name in settings if name not in known],
        f"search {method}",
    )
    return METHODS[method](**settings)


def _box(bounds: ArrayLike) -> Array:
    box = np.array(bounds, dtype=np.float64)
    if box.ndim != 2 or box.shape[1] != 2 or len(box) == 0:
        raise FrictrackError(f"expected bounds of shape (d, 2) but got shape {box.shape}; give one [lower, upper] each")
    bad = ~(np.isfinite(box).all(axis=1) & (box[:, 0] < box[:, 1]))
    gather(
        [
            f"expected finite lower < upper but got [{lo:g}, {hi:g}] in row {i}"
            for i, (lo, hi) in zip(np.flatnonzero(bad), box[bad], strict=True)
        ],
        "bounds",
    )
    return box
