"""How a model is fitted, by domain and search, and what comes out: the solution with its runs."""

from __future__ import annotations

from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any

from frictrack.base.distributions import RNG
from frictrack.base.errors import UsageError
from frictrack.fit.cutting import Reference
from frictrack.fit.least_squares import Solution
from frictrack.fit.parameters import with_fitted_mass
from frictrack.records import Array, Run
from frictrack.search import METHODS, Convergence, SearchMethod, search_method

DOMAINS = ("displacement", "force")
SEARCHES = ("varpro", *METHODS)
SEARCH_SPACES = ("all", "nonlinear")


@dataclass(frozen=True)
class Route:
    """How a model is fitted: domain, search, source of random numbers, and what a global search varies.

    `method` holds the settings of a global search; it is None for variable projection.
    """

    domain: str = "displacement"
    search: str = "varpro"
    rng: RNG = 0
    over: str = "all"
    method: SearchMethod | None = None

    @classmethod
    def of(cls, domain: str, search: str | SearchMethod, rng: RNG, over: str) -> Route:
        """Return the route of a search given by its name or with its settings, whose seed wins over `rng`."""
        if search == "varpro":
            return cls(domain, "varpro", rng, over)
        method = search_method(search)
        return cls(domain, method.name, rng if method.seed is None else method.seed, over, method)

    @property
    def is_default(self) -> bool:
        """Whether the displacement is fitted by variable projection, the default."""
        return (self.domain, self.search) == ("displacement", "varpro")


@dataclass(frozen=True, eq=False)
class SearchedOptima:
    """What a global search found.

    Attributes
    ----------
    points : array of shape (k, P)
        The "group of feasible solutions", best first.
    costs : array of shape (k,)
        Their misfits: squared acceleration residuals, m^2/s^4, or chi-squared of the displacement.
    convergence : Convergence or None
        The search generation by generation; None for fits that were stored by an early version.
    summary : dict
        JSON: the method and all its settings, generations, evaluations, why it ended.

    """

    points: Array
    costs: Array
    convergence: Convergence | None = None
    summary: dict[str, Any] = field(default_factory=dict)

    @property
    def remark(self) -> str:
        """A sentence if the search was stopped before its end; else empty."""
        if self.summary.get("ended") != "interrupted":
            return ""
        done, limit = self.summary["generations"], self.summary["generation_limit"]
        planned = "" if limit is None else f" of {limit}"
        return f"the search was stopped by hand after generation {done}{planned}; these are its best values until then"


@dataclass(frozen=True)
class FitOutcome:
    """A fitted model: in the displacement domain, and in the force domain where it was fitted there.

    Attributes
    ----------
    solution : Solution
        In the displacement domain.
    force : Solution or None
        In the force domain.
    searched : SearchedOptima or None
        What a global search found.

    """

    solution: Solution
    force: Solution | None = None
    searched: SearchedOptima | None = None


@dataclass(frozen=True, eq=False)
class FittedRuns:
    """A fitted model with its runs.

    Attributes
    ----------
    found : FitOutcome
        The solution, and the optima that a search met.
    runs, validation : tuple of Run
        Runs that were fitted, and runs that were only predicted.
    predictions : tuple of Solution
        The model on every validation run, with the shared parameters of the fit.
    reference : Reference
        Mass (kg) and normal load (N) at which forces are quoted.
    route : Route
        Domain and search.
    lengths : tuple of int
        Frames per segment of every run, 0 where its stretches are whole.

    """

    found: FitOutcome
    runs: tuple[Run, ...]
    validation: tuple[Run, ...] = ()
    predictions: tuple[Solution, ...] = ()
    reference: Reference = field(default=Reference(1.0, 1.0))
    route: Route = field(default=Route())
    lengths: tuple[int, ...] = ()

    @property
    def solution(self) -> Solution:
        """The parameters, and the model linearised there."""
        return self.found.solution

    @property
    def compared(self) -> Solution:
        """The solution in the compared domain: displacement, acceleration or measured friction."""
        return self.found.force or self.solution

    @property
    def covariance(self) -> Array:
        """Covariance (P, P) of the unknowns."""
        raise NotImplementedError

    @property
    def weighed(self) -> tuple[Run, ...]:
        """The fitted runs, each with its mass: given, or the fitted one."""
        return tuple(with_fitted_mass(run, self.reference.mass) for run in self.runs)

    @property
    def degrees(self) -> int:
        """Degrees of freedom: frames less fitted numbers (levels count as what their scatter leaves)."""
        starts = sum(len(start) for start in self.solution.starts)
        return int(self.solution.problem.n_frames - starts - round(self.solution.fitted_numbers))


def require_one_fit(result: object) -> None:
    """Raise an error (usage) for fits of several groups."""
    if not isinstance(result, FittedRuns):
        raise UsageError(
            "expected the fit of one group but got several; take one of fits[name], or leave out --per group"
        )


def check_route(domain: str, search: str, per: str | None = None, over: str = "all") -> None:
    """Check domain, search, division into groups and what is searched.

    Raises
    ------
    FrictrackError
        (usage) For an unknown value, with the nearest valid one.

    """
    arguments = (
        ("domain", domain, DOMAINS),
        ("search", search, SEARCHES),
        ("per", per, ("group",)),
        ("over", over, SEARCH_SPACES),
    )
    for what, asked, known in arguments:
        if asked is not None and asked not in known:
            closest = get_close_matches(asked.lower(), known, 1, 0.0)[0]
            raise UsageError(f'expected a {what} among {", ".join(known)} but got "{asked}"; did you mean {closest}?')
    if over != "all" and search == "varpro":
        raise UsageError(
            f'expected over = "{over}" with a global search ({", ".join(METHODS)}) but got search = "varpro", which '
            "works on the non-linear parameters anyway; leave it out"
        )
