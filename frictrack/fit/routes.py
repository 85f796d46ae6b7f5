"""Select how a model is fitted, by domain and search, and compute the held-out error of the other routes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.fit.displacement import refit_until_stop
from frictrack.fit.force_domain import ForceProblem, fit_accelerations, fit_starts, linearise_in_force_domain
from frictrack.fit.global_search import Callback, population_misfit, search_parameters, searched_scatter
from frictrack.fit.least_squares import HIDDEN_SIGMA_FACTOR, LeastSquaresProblem, Solution, is_predictable, refine
from frictrack.fit.pieces import AccelerationChain, Piece, acceleration_chains
from frictrack.randomness import RNG
from frictrack.records import Array, Mask, Run
from frictrack.search import METHODS

DOMAINS = ("displacement", "force")
SEARCHES = ("varpro", *METHODS)
SEARCH_SPACES = ("all", "nonlinear")
BLOCK_PERIODS = 2.0  # length of held-out blocks in periods of the cut-off frequency


@dataclass(frozen=True)
class Route:
    """How a model is fitted: domain, search, source of random numbers, and what a global search varies."""

    domain: str = "displacement"
    search: str = "varpro"
    rng: RNG = 0
    over: str = "all"

    @property
    def is_default(self) -> bool:
        """Whether the displacement is fitted by variable projection, the default."""
        return (self.domain, self.search) == ("displacement", "varpro")


@dataclass(frozen=True)
class FitOutcome:
    """A fitted model: in the displacement domain, and in the force domain where it was fitted there.

    Attributes
    ----------
    solution : Solution
        In the displacement domain.
    force : Solution or None
        In the force domain.
    optima : array of shape (k, P)
        The "group of feasible solutions" of a search, best first.
    costs : array of shape (k,)
        Their misfits: squared acceleration residuals, m^2/s^4, or chi-squared of the displacement.

    """

    solution: Solution
    force: Solution | None = None
    optima: Array = field(default_factory=lambda: np.empty((0, 0)))
    costs: Array = field(default_factory=lambda: np.empty(0))


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
            raise FrictrackError(
                f'expected a {what} among {", ".join(known)} but got "{asked}"; did you mean {closest}?', usage=True
            )
    if over != "all" and search == "varpro":
        raise FrictrackError(
            f'expected over = "{over}" with a global search ({", ".join(METHODS)}) but got search = "varpro", which '
            "works on the non-linear parameters anyway; leave it out",
            usage=True,
        )


def fit_by_search(
    problem: LeastSquaresProblem, runs: Sequence[Run], route: Route, callback: Callback | None = None
) -> FitOutcome:
    """Fit a model by a global search, reported as found.

    Parameters
    ----------
    problem : LeastSquaresProblem
        The problem.
    runs : sequence of Run
        The fitted runs.
    route : Route
        Domain, method, random numbers, and what is searched.
    callback : callable, optional
        See `search_parameters`.

    Returns
    -------
    FitOutcome
        The best point and the distinct optima.

    """
    chains = acceleration_chains(runs, problem.pieces) if route.domain == "force" else None
    ones = np.ones(len(problem.layout.slots))
    misfit = population_misfit(problem, chains, route.over)
    optima, costs = search_parameters(misfit, route.search, np.random.default_rng(route.rng), ones, callback)
    tau = searched_scatter(problem.layout, optima[0])
    law = fit_starts(problem, optima[0], problem.first_starts(), tau)
    law = refit_until_stop(law, np.zeros(len(law.p), dtype=bool))
    return outcome_at(law.problem, law.p, (law.starts, tau), runs, route, (optima, costs))


def fit_in_force_domain(solution: Solution, runs: Sequence[Run]) -> FitOutcome:
    """Minimise the squared acceleration residuals, starting from the fit of the displacement."""
    force = fit_accelerations(solution, runs)
    return FitOutcome(fit_starts(solution.problem, force.p, force.starts, force.tau), force)


def outcome_at(
    problem: LeastSquaresProblem,
    p: Array,
    starts_and_scatter: tuple[Sequence[Array], float],
    runs: Sequence[Run],
    route: Route,
    optima: tuple[Array, Array],
) -> FitOutcome:
    """Create the outcome of known unknowns: only their starts are fitted."""
    solution = fit_starts(problem, p, *starts_and_scatter)
    force = linearise_in_force_domain(solution, runs) if route.domain == "force" else None
    return FitOutcome(solution, force, *optima)


def heldout_rms(found: FitOutcome, runs: Sequence[Run], route: Route) -> tuple[float, str]:
    """Compute the held-out root mean square displacement of a model fitted by any route.

    By run: the shared parameters come from other runs (a search uses one half of the runs for the other), the run's
    own from its even frames in the displacement; its odd frames are scored. Otherwise every other block of frames,
    longer than the filter, is left out of the comparison and scored.

    Parameters
    ----------
    found : FitOutcome
        The fit.
    runs : sequence of Run
        The fitted runs.
    route : Route
        How it was fitted.

    Returns
    -------
    rms : float
        Held-out error, m.
    by : str
        What was held out: "run" or "frames".

    """
    solution = found.solution
    n = len(solution.problem.layout.run_names)
    if n < 2 or not is_predictable(solution):
        return float(np.sqrt(np.mean(_residuals_of_blocks(found, runs, route) ** 2))), "frames"
    folds = [{r} for r in range(n)] if route.search == "varpro" else [set(range(n)[::2]), set(range(n)[1::2])]
    residuals = np.concatenate([_residuals_left_out(found, runs, route, fold) for fold in folds])
    return float(np.sqrt(np.mean(residuals**2))), "run"


def _residuals_of_blocks(found: FitOutcome, runs: Sequence[Run], route: Route) -> Array:
    """Residuals, m, at held-out blocks of frames."""
    problem = found.solution.problem
    hidden = [_alternate_blocks(p, runs[p.run]) for p in problem.pieces]
    pieces = [_with_hidden_frames(p, h) for p, h in zip(problem.pieces, hidden, strict=True)]
    half = LeastSquaresProblem(problem.model, problem.layout, pieces)
    chains = None
    if route.domain == "force":
        chains = [c.only(~h) for c, h in zip(acceleration_chains(runs, problem.pieces), hidden, strict=True)]
    p = _search_again(half, chains, found, route, range(len(pieces)))
    held = fit_starts(half, p, found.solution.starts, found.solution.tau)
    return np.concatenate([(r.piece.y - r.model_y)[h] for r, h in zip(held.responses, hidden, strict=True)])


def _residuals_left_out(found: FitOutcome, runs: Sequence[Run], route: Route, fold: set[int]) -> Array:
    """Residuals, m, at the odd frames of the runs of a fold, predicted by the others."""
    problem = found.solution.problem
    mine = [i for i, p in enumerate(problem.pieces) if p.run in fold]
    rest = [i for i, p in enumerate(problem.pieces) if p.run not in fold]
    others = LeastSquaresProblem(problem.model, problem.layout, [problem.pieces[i] for i in rest])
    chains = acceleration_chains(runs, others.pieces) if route.domain == "force" else None
    p = _search_again(others, chains, found, route, rest)
    hidden = [np.arange(len(problem.pieces[i].t)) % 2 == 1 for i in mine]
    pieces = [_with_hidden_frames(problem.pieces[i], h) for i, h in zip(mine, hidden, strict=True)]
    alone = LeastSquaresProblem(problem.model, replace(problem.layout, levels_free=True), pieces)
    own = np.array([s.run in fold for s in problem.layout.slots])
    held = refine(alone, p, [found.solution.starts[i] for i in mine], free=own, max_steps=6)
    return np.concatenate([(r.piece.y - r.model_y)[h] for r, h in zip(held.responses, hidden, strict=True)])


def _search_again(
    problem: LeastSquaresProblem,
    chains: Sequence[AccelerationChain] | None,
    found: FitOutcome,
    route: Route,
    which: Sequence[int],
) -> Array:
    """All unknowns (P,) fitted again with fewer data; those that the data do not include stay as they were."""
    p = found.solution.p
    if route.search != "varpro":
        return search_parameters(
            population_misfit(problem, chains, route.over), route.search, np.random.default_rng(route.rng), p
        )[0][0]
    assert chains is not None  # the default route has its own held-out error
    held = {piece.run for piece in problem.pieces} | {None}
    free = np.array([s.run in held for s in problem.layout.slots])
    starts = [found.solution.starts[i] for i in which]
    return refine(ForceProblem(problem, chains), p, starts, tau=found.solution.tau or 0.03, free=free, max_steps=6).p


def _alternate_blocks(piece: Piece, run: Run) -> Mask:
    """Every other block of frames, each longer than the filter."""
    length = max(round(BLOCK_PERIODS / (run.motion.cutoff * float(np.median(np.diff(piece.t))))), 1)
    length = min(length, max(len(piece.t) // 4, 1))
    odd: Mask = (np.arange(len(piece.t)) // length) % 2 == 1
    return odd


def _with_hidden_frames(piece: Piece, hidden: Mask) -> Piece:
    return replace(piece, sigma=np.where(hidden, HIDDEN_SIGMA_FACTOR, 1.0) * piece.sigma)
