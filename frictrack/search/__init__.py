"""Minimise a cost function over a box by a global search: `minimise(cost, bounds, method=..., rng=...)`.

The methods of the two papers are ``ga``, ``mga``, ``sa`` and ``sga``. ``de``, ``da`` and ``cmaes`` are established
methods to compare them with. Each is a record of its settings, such as ``MGA(generations=500)``. The genetic methods
share one loop, `genetic.GeneticMethod`, and differ in their operators only.
"""

# ruff: noqa: F401 - some imports are the interface

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from frictrack.base.errors import FrictrackError, UsageError, raise_faults
from frictrack.records import Array
from frictrack.search.adapters import CMAES, DA, DE
from frictrack.search.genetic import GA, MGA, SA, SGA, code_length, code_length_as_printed
from frictrack.search.method import (
    COST_OF_MEMORY,
    Callback,
    Convergence,
    Cost,
    CostEvaluator,
    EvaluationBudget,
    SearchMethod,
    SearchResult,
    StopSearch,
    read_settings,
)

METHODS: dict[str, type[SearchMethod]] = {kind.name: kind for kind in (GA, MGA, SA, SGA, DE, DA, CMAES)}


def search_method(method: str | SearchMethod, settings: Mapping[str, Any] | None = None) -> SearchMethod:
    """Return a search method with settings: from its name, or a record that is complete.

    Parameters
    ----------
    method : str or SearchMethod
        A key of `METHODS`, or a record such as ``MGA(generations=500)``.
    settings : mapping, optional
        Settings by name. Texts, as the command line has them, are read as numbers.

    Raises
    ------
    FrictrackError
        (usage) For an unknown method, unknown settings and values out of range, with what is known.

    Examples
    --------
    >>> search_method("mga", {"generations": "500", "P_const": 0.05}).p_const
    0.05

    """
    if isinstance(method, SearchMethod):
        return replace(method, **read_settings(type(method), settings or {}))
    if method not in METHODS:
        raise UsageError(f'expected a search among {", ".join(METHODS)} but got "{method}"')
    return METHODS[method](**read_settings(METHODS[method], settings or {}))


def minimise(  # noqa: PLR0913 - the one public function of the searches; all but two settings are optional
    cost: Cost,
    bounds: ArrayLike,
    *,
    method: str | SearchMethod,
    rng: np.random.Generator,
    max_evaluations: int = 20_000,
    callback: Callback | None = None,
    stagnation: int | None = None,
    keep_interrupted: bool = False,
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
    method : str or SearchMethod
        A key of `METHODS`: ``"ga"``, ``"mga"``, ``"sa"``, ``"sga"``, ``"de"``, ``"da"`` or ``"cmaes"``; or a record
        such as ``MGA(generations=500)``.
    rng : numpy.random.Generator
        Source of all random numbers of the search.
    max_evaluations : int
        Number of points whose cost may be evaluated in each start. It is never exceeded; the papers' G_max follows from
        it. It does not count where the method has the setting ``generations``.
    callback : callable, optional
        ``callback(generation, best_x, best_cost)`` is called after every generation. A true return value stops the
        search.
    stagnation : int, optional
        Stop after this number of generations without improvement.
    keep_interrupted : bool
        Whether Ctrl-C ends the search with the best point so far instead of an error.
    **settings
        Settings of a method given by name, for example ``population=80`` or ``as_printed=True``.

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
    search = search_method(method, settings)
    if max_evaluations < 1:
        raise FrictrackError(f"expected max_evaluations of at least 1 but got {max_evaluations}")
    evaluator = CostEvaluator(cost, box, max_evaluations, callback, stagnation)
    search, rng = search.resolved(evaluator), rng if search.seed is None else np.random.default_rng(search.seed)
    for _ in range(1 + search.restarts):
        evaluator.begin(search.generations)
        reason = "converged"
        try:
            search(evaluator, rng)
            evaluator.end_generation()
        except StopSearch as stop:
            reason = str(stop)
        except KeyboardInterrupt:
            if not keep_interrupted or not evaluator.generations_done:
                raise
            reason = "interrupted"
        if reason in ("callback", "interrupted"):
            break
    return evaluator.result(reason, search.summary())


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
