"""Select a search method by name and minimise a cost function with it: `minimise` and the table `METHODS`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from frictrack.errors import FrictrackError, raise_faults
from frictrack.records import Array
from frictrack.search.adapters import CMAES, DA, DE
from frictrack.search.evaluator import Callback, Cost, CostEvaluator, SearchResult, StopSearch
from frictrack.search.ga import GA, SGA
from frictrack.search.mga import MGA
from frictrack.search.sa import SA


class SearchMethod(Protocol):
    """The interface of a search method: a callable object whose fields are its settings.

    It asks the evaluator for the costs of points in the unit box until the evaluator stops it or it has converged.
    """

    def __call__(self, evaluator: CostEvaluator, rng: np.random.Generator) -> None:
        """Search; return when converged."""


METHODS: dict[str, Callable[..., SearchMethod]] = {
    "ga": GA,
    "mga": MGA,
    "sa": SA,
    "sga": SGA,
    "de": DE,
    "da": DA,
    "cmaes": CMAES,
}


def minimise(  # noqa: PLR0913 - the one public function of the searches; all but two settings are optional
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
    """Minimise a cost function over a box.

    The same state of ``rng`` gives the same result.

    Parameters
    ----------
    cost : callable
        Maps a population (P, d) to its costs (P,). NaN counts as infinite.
    bounds : array_like of shape (d, 2)
        Lower and upper bound of every parameter.
    method : str
        A key of `METHODS`: ``"ga"``, ``"mga"``, ``"sa"``, ``"sga"``, ``"de"``, ``"da"`` or ``"cmaes"``.
    rng : numpy.random.Generator
        Source of all random numbers of the search.
    max_evaluations : int
        Number of points whose cost may be evaluated. It is never exceeded; the papers' G_max follows from it.
    callback : callable, optional
        ``callback(generation, best_x, best_cost)`` is called after every generation. A true return value stops the
        search.
    stagnation : int, optional
        Stop after this number of generations without improvement.
    **settings
        Fields of the method's class, for example ``population=80`` or ``as_printed=True``.

    Returns
    -------
    SearchResult
        The best point, its cost, the history of the search and the distinct optima.

    Raises
    ------
    FrictrackError
        If the method or a setting is unknown, the bounds are not finite with lower < upper, the budget is below 1,
        the cost has the wrong shape, or an optional package is missing.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> found = minimise(lambda x: np.sum((x - 0.5) ** 2, axis=1), [[-2, 2], [-2, 2]], method="de", rng=rng)
    >>> np.round(found.x, 2)
    array([0.5, 0.5])

    """
    box = _box(bounds)
    search = _search(method, settings)
    if max_evaluations < 1:
        raise FrictrackError(f"expected max_evaluations of at least 1 but got {max_evaluations}")
    evaluator = CostEvaluator(cost, box, max_evaluations, callback, stagnation)
    reason = "converged"
    try:
        search(evaluator, rng)
        evaluator.end_generation()
    except StopSearch as stop:
        reason = str(stop)
    return evaluator.result(reason)


def _search(method: str, settings: dict[str, Any]) -> SearchMethod:
    """Create the search method of a name with its settings."""
    if method not in METHODS:
        raise FrictrackError(f'expected a search among {", ".join(METHODS)} but got "{method}"')
    known = [f.name for f in fields(METHODS[method])]  # type: ignore[arg-type]
    raise_faults(
        [f'expected a setting among {", ".join(known)} but got "{name}"' for name in settings if name not in known],
        f"search {method}",
    )
    return METHODS[method](**settings)


def _box(bounds: ArrayLike) -> Array:
    """Check bounds and return them as an array (d, 2)."""
    box = np.array(bounds, dtype=np.float64)
    if box.ndim != 2 or box.shape[1] != 2 or len(box) == 0:
        raise FrictrackError(f"expected bounds of shape (d, 2) but got shape {box.shape}; give one [lower, upper] each")
    bad = ~(np.isfinite(box).all(axis=1) & (box[:, 0] < box[:, 1]))
    raise_faults(
        [
            f"expected finite lower < upper but got [{lo:g}, {hi:g}] in row {i}"
            for i, (lo, hi) in zip(np.flatnonzero(bad), box[bad], strict=True)
        ],
        "bounds",
    )
    return box
