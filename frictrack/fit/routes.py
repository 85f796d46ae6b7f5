"""Every way to a law: domain and search to what was found, and what a law so found says of frames not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.fit.displacement import until_stop
from frictrack.fit.force_domain import ForceProblem, at_rest, seen, solve_force
from frictrack.fit.global_search import Callback, misfit_of, searched, spread_of
from frictrack.fit.least_squares import HIDDEN_SIGMA_FACTOR, Problem, Solution, is_predictable, refine
from frictrack.fit.segments import Chain, Piece, chains_of
from frictrack.records import Array, Mask, Run
from frictrack.search import METHODS

DOMAINS = ("displacement", "force")
SEARCHES = ("varpro", *METHODS)
OVER = ("all", "nonlinear")
PERIODS = 2.0  # of the cut-off: length of the blocks that are held out within a run


@dataclass(frozen=True)
class Route:
    """How a law is sought."""

    domain: str = "displacement"
    search: str = "varpro"
    seed: int = 0
    over: str = "all"

    @property
    def plain(self) -> bool:
        """Variable projection of the displacement, the default."""
        return (self.domain, self.search) == ("displacement", "varpro")


@dataclass(frozen=True)
class Found:
    """A law: in the displacement's domain, and in the force domain where it was sought there.

    `optima` (k, P) are all unknowns of a search's "group of feasible solutions", best first, `costs` (k,) their
    misfits: squared acceleration residuals, m^2/s^4, or chi-squared of the displacement.
    """

    solution: Solution
    force: Solution | None = None
    optima: Array = field(default_factory=lambda: np.empty((0, 0)))
    costs: Array = field(default_factory=lambda: np.empty(0))


def check_how(domain: str, search: str, per: str | None = None, over: str = "all") -> None:
    """Raise FrictrackError (usage) for an unknown domain, search, division or extent, with the nearest right one."""
    asked_for = (
        ("domain", domain, DOMAINS),
        ("search", search, SEARCHES),
        ("per", per, ("group",)),
        ("over", over, OVER),
    )
    for what, asked, known in asked_for:
        if asked is not None and asked not in known:
            near = get_close_matches(asked.lower(), known, 1, 0.0)[0]
            raise FrictrackError(
                f'expected a {what} among {", ".join(known)} but got "{asked}"; did you mean {near}?', usage=True
            )
    if over != "all" and search == "varpro":
        raise FrictrackError(
            f'expected over = "{over}" with a global search ({", ".join(METHODS)}) but got search = "varpro", which '
            "works on the non-linear parameters anyway; leave it out",
            usage=True,
        )


def by_search(problem: Problem, runs: Sequence[Run], route: Route, callback: Callback | None = None) -> Found:
    """The law that a global search finds, over all unknowns at once or the non-linear ones, reported as it is."""
    chains = chains_of(runs, problem.pieces) if route.domain == "force" else None
    ones = np.ones(len(problem.layout.slots))
    misfit = misfit_of(problem, chains, route.over)
    optima, costs = searched(misfit, route.search, np.random.default_rng(route.seed), ones, callback)
    tau = spread_of(problem.layout, optima[0])
    law = at_rest(problem, optima[0], problem.first_starts(), tau)
    law = until_stop(law, np.zeros(len(law.p), dtype=bool))
    return standing(law.problem, law.p, (law.starts, tau), runs, route, (optima, costs))


def in_force(solution: Solution, runs: Sequence[Run]) -> Found:
    """The law of least squared acceleration residuals, from the displacement's."""
    force = solve_force(solution, runs)
    return Found(at_rest(solution.problem, force.p, force.starts, force.tau), force)


def standing(
    problem: Problem,
    p: Array,
    where: tuple[Sequence[Array], float],
    runs: Sequence[Run],
    route: Route,
    optima: tuple[Array, Array],
) -> Found:
    """A law that is known: only its starts are fitted. `where` holds starts and spread of the levels."""
    solution = at_rest(problem, p, *where)
    force = seen(solution, runs) if route.domain == "force" else None
    return Found(solution, force, *optima)


def heldout_rms(found: Found, runs: Sequence[Run], route: Route) -> tuple[float, str]:
    """Root mean square displacement, m, where a law sought in the same way has not looked; and how it was held out.

    By run: the shared parameters come from other runs (a search: from one half of the runs for the other), the run's
    own from its even frames in the displacement, and its odd frames are scored. Otherwise every other block of frames,
    longer than the filter, is left out of the comparison and scored.
    """
    solution = found.solution
    n = len(solution.problem.layout.run_names)
    if n < 2 or not is_predictable(solution):
        return float(np.sqrt(np.mean(_blocks(found, runs, route) ** 2))), "frames"
    folds = [{r} for r in range(n)] if route.search == "varpro" else [set(range(n)[::2]), set(range(n)[1::2])]
    residuals = np.concatenate([_left_out(found, runs, route, fold) for fold in folds])
    return float(np.sqrt(np.mean(residuals**2))), "run"


def _blocks(found: Found, runs: Sequence[Run], route: Route) -> Array:
    problem = found.solution.problem
    hidden = [_other_blocks(p, runs[p.run]) for p in problem.pieces]
    pieces = [_without(p, h) for p, h in zip(problem.pieces, hidden, strict=True)]
    half = Problem(problem.model, problem.layout, pieces)
    chains = None
    if route.domain == "force":
        chains = [c.only(~h) for c, h in zip(chains_of(runs, problem.pieces), hidden, strict=True)]
    p = _sought(half, chains, found, route, range(len(pieces)))
    held = at_rest(half, p, found.solution.starts, found.solution.tau)
    return np.concatenate([(r.piece.y - r.model_y)[h] for r, h in zip(held.responses, hidden, strict=True)])


def _left_out(found: Found, runs: Sequence[Run], route: Route, fold: set[int]) -> Array:
    """Residuals, m, at the odd frames of the runs of a fold, predicted by the others."""
    problem = found.solution.problem
    mine = [i for i, p in enumerate(problem.pieces) if p.run in fold]
    rest = [i for i, p in enumerate(problem.pieces) if p.run not in fold]
    others = Problem(problem.model, problem.layout, [problem.pieces[i] for i in rest])
    chains = chains_of(runs, others.pieces) if route.domain == "force" else None
    p = _sought(others, chains, found, route, rest)
    hidden = [np.arange(len(problem.pieces[i].t)) % 2 == 1 for i in mine]
    pieces = [_without(problem.pieces[i], h) for i, h in zip(mine, hidden, strict=True)]
    alone = Problem(problem.model, replace(problem.layout, levels_free=True), pieces)
    own = np.array([s.run in fold for s in problem.layout.slots])
    held = refine(alone, p, [found.solution.starts[i] for i in mine], free=own, max_steps=6)
    return np.concatenate([(r.piece.y - r.model_y)[h] for r, h in zip(held.responses, hidden, strict=True)])


def _sought(
    problem: Problem, chains: Sequence[Chain] | None, found: Found, route: Route, which: Sequence[int]
) -> Array:
    """All unknowns (P,) of the law sought again with fewer data; what these do not hold stays as it was found."""
    p = found.solution.p
    if route.search != "varpro":
        return searched(misfit_of(problem, chains, route.over), route.search, np.random.default_rng(route.seed), p)[0][
            0
        ]
    assert chains is not None  # variable projection of the displacement has its own held-out error
    held = {piece.run for piece in problem.pieces} | {None}
    free = np.array([s.run in held for s in problem.layout.slots])
    starts = [found.solution.starts[i] for i in which]
    return refine(ForceProblem(problem, chains), p, starts, tau=found.solution.tau or 0.03, free=free, max_steps=6).p


def _other_blocks(piece: Piece, run: Run) -> Mask:
    """Every other block of frames, each longer than the filter."""
    length = max(round(PERIODS / (run.motion.cutoff * float(np.median(np.diff(piece.t))))), 1)
    length = min(length, max(len(piece.t) // 4, 1))
    odd: Mask = (np.arange(len(piece.t)) // length) % 2 == 1
    return odd


def _without(piece: Piece, hidden: Mask) -> Piece:
    return replace(piece, sigma=np.where(hidden, HIDDEN_SIGMA_FACTOR, 1.0) * piece.sigma)
