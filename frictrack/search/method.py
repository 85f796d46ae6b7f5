"""The base of the search methods: a record of settings that is called to search, and the evaluator of the cost.

`ft.fit`, `frictrack fit --set` and the table [search] of a study file share the records, which are checked when they
are built. The evaluator counts evaluations, records the best points, and stops at the budget.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cache
from sys import maxsize
from typing import Any, ClassVar, Literal, Self, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model

from frictrack.base.errors import FrictrackError, UsageError, describe_fault
from frictrack.records import Array

Cost = Callable[[Array], Array]
Callback = Callable[[int, Array, float], "bool | None"]
MAX_EXCESS_COST_SHARE = 0.01  # of the best cost's size
MIN_OPTIMA_DISTANCE = 0.02  # of the box, in every direction: nearer points are one optimum
MAX_CELLS = 2000  # cells compared pairwise
UNIFORM_DEVIATION = 12**-0.5  # standard deviation of points spread evenly over the unit box


@dataclass(frozen=True, eq=False)
class Convergence:
    """A search generation by generation, G in all; restarts follow each other.

    Attributes
    ----------
    best : array of shape (G,)
        Lowest cost so far.
    mean : array of shape (G,)
        Mean cost of the population; of the points tried in that generation where a method has no population.
    diversity : array of shape (G,)
        Standard deviation of the population in the box, mean over the parameters; 1 for a uniform spread, 0 for copies.
    x : array of shape (G, d)
        Best point so far.
    start : array of int, shape (G,)
        0 for the first start, then the number of the restart.
    bounds : array of shape (d, 2)
        The box.
    parameters : tuple of str
        Names of the parameters.

    """

    best: Array
    mean: Array
    diversity: Array
    x: Array
    start: NDArray[np.int_]
    bounds: Array
    parameters: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The best point of a search and how it was reached. Generation 0 is the initial population."""

    x: Array  # (d,) the best point
    cost: float  # its cost
    evaluations: int  # points whose cost was asked for
    generations: int  # generations after the initial one
    generation_of_last_improvement: int  # the papers' "generations to find the optimum"
    convergence: Convergence  # generation by generation
    optima: Array  # (k, d) distinct optima within 1 % of the best, best first: "a group of feasible solutions"
    optima_costs: Array  # (k,)
    reason: str  # why it stopped: evaluations, generations, callback, stagnation, converged or interrupted
    settings: dict[str, Any] = field(default_factory=dict)  # method and all settings, those chosen here included

    @property
    def history(self) -> Array:
        """Best cost so far (generations + 1,)."""
        return self.convergence.best


class StopSearch(Exception):
    """Signal that ends a search from inside the cost function, whichever loop runs it. Its text is the reason."""


class CostEvaluator:
    """A cost function over the unit box that counts its evaluations and raises `StopSearch` when the search is over.

    Parameters
    ----------
    cost : callable
        Maps points (P, d) to costs (P,). NaN counts as infinite.
    bounds : array of shape (d, 2)
        Lower and upper bounds, already checked.
    max_evaluations : int
        Number of points that may be evaluated in each start; it does not count where the method sets its generations.
    callback : callable, optional
        Called after every generation with generation, best point and best cost. A true return value stops the search.
    stagnation : int, optional
        Number of generations without improvement after which the search stops.

    Attributes
    ----------
    evaluations : int
        Points evaluated so far.
    initial_spread : float
        Median minus minimum of the costs of the first population. Annealing scales its temperature by it.
    population : tuple of (array, array) or None
        Points (P, d) of the unit box and costs (P,) after a generation, set by methods that keep a population. The last
        one stays: a search that ends within a generation has not chosen among its children.

    """

    def __init__(
        self,
        cost: Cost,
        bounds: Array,
        max_evaluations: int,
        callback: Callback | None = None,
        stagnation: int | None = None,
    ) -> None:
        self.lower, self.width = bounds[:, 0], bounds[:, 1] - bounds[:, 0]
        self.max_evaluations = max_evaluations
        self.evaluations = 0
        self.initial_spread = 0.0
        self.population: tuple[Array, Array] | None = None
        self._cost, self._callback, self._stagnation = cost, callback, stagnation
        self._best_x, self._best = bounds[:, 0], np.inf
        self._rows: list[tuple[float, float, float, int]] = []  # best, mean, diversity, start of every generation
        self._path: list[Array] = []
        self._last_improvement = 0
        self._tried: list[tuple[Array, Array]] = []  # points of the open generation in the unit box, and their costs
        self._near_optimal: list[tuple[Array, Array]] = []  # within 1 % of the best cost so far
        self._start, self._begun, self._last_evaluation = -1, 0, max_evaluations
        self._last_generation: int | None = None

    @property
    def dimension(self) -> int:
        """Number of parameters d."""
        return len(self.lower)

    @property
    def generations_done(self) -> int:
        """Generations that have ended, the first included."""
        return len(self._rows)

    def begin(self, generations: int | None) -> None:
        """Begin the next start: with its own budget of evaluations, or with a number of generations in its place."""
        self._start, self._begun, self.initial_spread, self.population = self._start + 1, len(self._rows), -1.0, None
        self._last_generation = None if generations is None else self._begun + generations
        self._last_evaluation = maxsize if generations is not None else self.evaluations + self.max_evaluations

    def __call__(self, unit: Array) -> Array:
        """Evaluate the points ``unit`` (P, d) of the unit box and return their costs (P,).

        Raises `StopSearch` when the budget is used up.
        """
        unit = unit[: self._last_evaluation - self.evaluations]
        points = self.lower + self.width * unit
        costs = self._checked(self._cost(points), len(points))
        self.evaluations += len(points)
        self._record(unit, points, costs)
        if self.evaluations >= self._last_evaluation:
            self.end_generation()
            raise StopSearch("evaluations")
        return costs

    def generations(self) -> Iterator[int]:
        """Yield 1, 2, ... without end. Each step ends the previous generation."""
        while True:
            self.end_generation()
            yield len(self._rows) - self._begun

    def end_generation(self) -> None:
        """End the current generation: extend the history, call the callback, check whether the search is over."""
        if not self._tried:
            return
        generation = len(self._rows)
        unit, costs = self.population or tuple(np.concatenate(part) for part in zip(*self._tried, strict=True))
        self._tried, finite = [], costs[np.isfinite(costs)]
        mean = float(finite.mean()) if len(finite) else np.inf
        self._rows.append((self._best, mean, float(unit.std(axis=0).mean()) / UNIFORM_DEVIATION, self._start))
        self._path.append(self._best_x)
        if self._callback and self._callback(generation, self._best_x.copy(), self._best):
            raise StopSearch("callback")
        if self._stagnation and generation - max(self._last_improvement, self._begun) >= self._stagnation:
            raise StopSearch("stagnation")
        if self._last_generation is not None and generation >= self._last_generation:
            raise StopSearch("generations")

    def result(self, reason: str, settings: dict[str, Any]) -> SearchResult:
        """Return the result of the search, with the reason why it ended."""
        points = np.concatenate([p for p, _ in self._near_optimal])
        costs = np.concatenate([c for _, c in self._near_optimal])
        optima, optima_costs = distinct_optima(points, costs, self.lower, self.width)
        best, mean, diversity, start = np.array(self._rows).T
        bounds = np.column_stack([self.lower, self.lower + self.width])
        names = tuple(f"x_{i}" for i in range(1, self.dimension + 1))
        return SearchResult(
            x=self._best_x,
            cost=self._best,
            evaluations=self.evaluations,
            generations=len(self._rows) - 1,
            generation_of_last_improvement=self._last_improvement,
            convergence=Convergence(best, mean, diversity, np.array(self._path), start.astype(int), bounds, names),
            optima=optima,
            optima_costs=optima_costs,
            reason=reason,
            settings=settings,
        )

    def _record(self, unit: Array, points: Array, costs: Array) -> None:
        """Update the best point and the list of nearly optimal points."""
        if self.initial_spread < 0:  # the first population of a start
            finite = costs[np.isfinite(costs)]
            self.initial_spread = float(np.median(finite) - finite.min()) if len(finite) else 0.0
        self._tried.append((unit, costs))
        best = int(np.argmin(costs))
        if costs[best] < self._best or not self._near_optimal:
            self._best, self._best_x = float(costs[best]), points[best].copy()
            self._last_improvement = len(self._rows)
        near = costs <= self._best + MAX_EXCESS_COST_SHARE * abs(self._best)
        if near.any():
            self._near_optimal.append((points[near], costs[near]))

    @staticmethod
    def _checked(costs: Array, n: int) -> Array:
        """Costs as an array (n,), NaN replaced by infinity."""
        costs = np.asarray(costs, dtype=np.float64)
        if costs.shape != (n,):
            raise FrictrackError(
                f"expected one cost per point, shape ({n},), but got shape {costs.shape}; "
                "the cost must take the whole population (P, d) at once"
            )
        return np.where(np.isnan(costs), np.inf, costs)


def distinct_optima(points: Array, costs: Array, lower: Array, width: Array) -> tuple[Array, Array]:
    """Find the distinct optima within 1 % of the best cost.

    A point is an optimum of its own when no better point lies within 2 % of the box around it in every coordinate.
    These are the modes of quick shift, so that the slope of one valley counts once.

    Parameters
    ----------
    points : array of shape (n, d)
        Evaluated points.
    costs : array of shape (n,)
        Their costs.
    lower, width : array of shape (d,)
        Lower bounds and widths of the box.

    Returns
    -------
    points : array of shape (k, d)
        The distinct optima, best first.
    costs : array of shape (k,)
        Their costs.

    References
    ----------
    Vedaldi, A. & Soatto, S. (2008). Quick shift and kernel methods for mode seeking. ECCV, 705-718.

    """
    best = costs.min()
    keep = np.flatnonzero(costs <= best + MAX_EXCESS_COST_SHARE * abs(best))
    keep = keep[np.argsort(costs[keep], kind="stable")]
    unit = (points[keep] - lower) / width
    # one point per half radius is enough, and keeps the pairwise comparison small
    cells = np.floor(unit / (MIN_OPTIMA_DISTANCE / 2)).astype(np.int64)
    first = np.sort(np.unique(cells, axis=0, return_index=True)[1])[:MAX_CELLS]
    unit, keep = unit[first], keep[first]
    mode = [i for i in range(len(unit)) if np.all(np.abs(unit[:i] - unit[i]).max(axis=1) > MIN_OPTIMA_DISTANCE)]
    return points[keep[mode]], costs[keep[mode]]


COST_OF_MEMORY = 3.0  # of an evaluation of a law with memory, over one without (70 and 25 ms)


@dataclass(eq=False)
class EvaluationBudget:
    """Evaluations granted to a search and made so far; all fits of the search share one budget.

    A fit that finds it spent returns the best unknowns so far.

    Parameters
    ----------
    granted
        Evaluations that may be made; one is a simulation of all runs with its sensitivities, or what costs as much.
    used
        Evaluations made.
    was_cut
        Whether a step was left out because the budget was spent.

    Examples
    --------
    >>> budget = EvaluationBudget(granted=2)
    >>> budget.spend()
    >>> budget.stops()
    False
    >>> budget.spend()
    >>> budget.stops(), budget.was_cut
    (True, True)

    """

    granted: float = np.inf
    used: float = 0.0
    was_cut: bool = False

    @property
    def is_spent(self) -> bool:
        """Whether no evaluation is left."""
        return self.used >= self.granted

    def spend(self, evaluations: float = 1.0) -> None:
        """Count some evaluations."""
        self.used += evaluations

    def stops(self) -> bool:
        """Return whether the next step has to be left out, and remember it if so."""
        self.was_cut = self.was_cut or self.is_spent
        return self.is_spent

    def grant(self, evaluations: float) -> None:
        """Grant as many evaluations to what follows, whatever is left."""
        self.granted = self.used + evaluations


PAPER_NAMES = {"p_c": "crossover", "p_m": "mutation", "l": "bits"}  # symbol of the papers in small letters -> setting


def setting(default: Any, **limits: float) -> Any:
    """Declare a setting: its default, and its limits as pydantic names them (ge, gt, le)."""
    return field(default=default, metadata={"limits": limits})


@dataclass(frozen=True)
class SearchMethod:
    """A search method with its settings; a setting that is None is chosen for each problem.

    Parameters
    ----------
    generations : int, optional
        Generations after the first. None: as many as the budget of evaluations allows.
    restarts : int
        Further searches from new random points; the best of all counts.
    seed : int, optional
        Seed of the random numbers. None: that of the fit.

    Raises
    ------
    FrictrackError
        (usage) For values out of range; all are listed.

    """

    name: ClassVar[str] = ""
    generations: int | None = setting(None, ge=1, le=10**7)
    restarts: int = setting(0, ge=0, le=1000)
    seed: int | None = setting(None, ge=0)

    def __post_init__(self) -> None:
        try:
            self._table().model_validate({name: _as_builtin(value) for name, value in vars(self).items()})
        except ValidationError as invalid:
            refuse(self.name, *(describe_fault(fault, fault["loc"]) for fault in invalid.errors()))

    def __call__(self, evaluator: CostEvaluator, rng: np.random.Generator) -> None:
        """Ask the evaluator for the costs of points in the unit box until it stops the search, or until converged."""
        raise NotImplementedError

    @classmethod
    @cache
    def _table(cls) -> type[BaseModel]:
        """Return the settings as a model of pydantic, which checks them."""
        types = get_type_hints(cls, include_extras=True)
        checks = {f.name: Field(f.default, **f.metadata.get("limits", {})) for f in fields(cls)}
        known: dict[str, Any] = {name: (types[name], check) for name, check in checks.items()}
        return create_model(cls.__name__, __config__=ConfigDict(strict=True, allow_inf_nan=False), **known)

    @classmethod
    def describe_settings(cls) -> dict[str, dict[str, Any]]:
        """Describe the settings by name: the default (None: chosen for each problem), and the texts that it may be."""
        known = cls._table().model_fields.items()
        texts = {name: get_args(one.annotation) for name, one in known if get_origin(one.annotation) is Literal}
        return {name: {"default": one.default, "choices": texts.get(name)} for name, one in known}

    @property
    def points(self) -> tuple[int, int] | None:
        """Points evaluated in the first and in every later generation; None where this varies."""
        return None

    def resolved(self, evaluator: CostEvaluator) -> Self:
        """Return the settings with a value for each that is None, chosen for the problem of the evaluator."""
        return self

    def filled(self, **chosen: Any) -> Self:
        """Return the settings with values for those that are None."""
        return replace(self, **{name: value for name, value in chosen.items() if getattr(self, name) is None})

    def generation_limit(self, max_evaluations: int) -> int | None:
        """Return G_max, the generations of one start within a budget of evaluations; None where it is not known."""
        if self.generations is not None or self.points is None:
            return self.generations
        first, each = self.points
        return max(1, -(-(max_evaluations - first) // each))

    def limit(self, evaluator: CostEvaluator) -> int:
        """Return G_max of a method that evaluates the same number of points in every generation; at least 1."""
        limit = self.generation_limit(evaluator.max_evaluations)
        assert limit is not None  # such methods know their points
        return limit

    def summary(self) -> dict[str, Any]:
        """Return the name of the method and all settings as JSON."""
        return {"method": self.name, **asdict(self)}


def read_settings(kind: type[SearchMethod], raw: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings by their names, as numbers: texts are read, and the papers' symbols are known.

    Parameters
    ----------
    kind : type
        The method.
    raw : mapping
        Values by name: "population", or a symbol as the papers write it, "P_c".

    Raises
    ------
    FrictrackError
        (usage) For unknown settings, with the list of the known ones, and for values out of range.

    """
    known = [f.name for f in fields(kind)]
    names = {key: key.lower() if key.lower() in known else PAPER_NAMES.get(key.lower(), key) for key in raw}
    faults = [f'expected a setting among {", ".join(known)} but got "{key}"' for key in raw if names[key] not in known]
    given = list(names.values())
    faults += [f"expected {name} once but got it twice" for name in sorted({n for n in given if given.count(n) > 1})]
    refuse(kind.name, *faults)
    found = {name: _read(raw[key]) for key, name in names.items()}
    kind(**found)  # checks the values
    return found


def refuse(name: str, *faults: str) -> None:
    """Raise FrictrackError (usage) if there are faults in the settings of a method."""
    if faults:
        raise UsageError(f"search {name}: {'; '.join(faults)}")


def _as_builtin(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _read(value: Any) -> Any:
    """Read a text of the command line as a number, true, false or a list; other texts and values stay as they are."""
    if isinstance(value, str):
        try:
            value = json.loads(value if "," not in value else f"[{value}]")
        except ValueError:
            return None if value == "none" else value
    return tuple(value) if isinstance(value, list) else value
