"""Output-error Gauss-Newton: re-simulate, linearise, step, until the law stops moving."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear

from frictrack.errors import FrictrackError
from frictrack.fit.least_squares.problem import Problem, Response
from frictrack.fit.parameters import (
    Basis,
    balanced,
    basis_of,
    prior_departure,
    prior_rows,
    restraint,
    restraint_rows,
    settle,
)
from frictrack.records import Array, Mask

SPREADS = 4  # estimates of the spread of the levels, at most
PROJECTIONS = 2  # linear solves after a step that went too far, before it is taken back
FIRST_DAMPING, MOST_DAMPED = 1e-8, 1e8
UNDAMPED = 1e-12  # damping with which a step is Gauss-Newton's
ENOUGH = 1e-4  # fall of chi-squared below which a step changes nothing; more where the law is far off anyway
KINKED = 0.01  # likewise for motions with reversals: each is a kink that slips from one node to the next


@dataclass(frozen=True)
class Solution:
    """Where Gauss-Newton came to rest: unknowns p (P,), starts, spread tau, and the model linearised there."""

    problem: Problem
    p: Array
    starts: list[Array]
    tau: float
    responses: list[Response]
    objective: float

    @property
    def chi2(self) -> float:
        """Sum of squared whitened residuals."""
        return float(sum(r.r @ r.r for r in self.responses))

    @property
    def jac(self) -> Array:
        """Whitened Jacobian of all frames, starts removed, (N, P)."""
        return stacked(self.responses, len(self.p))

    @property
    def residual(self) -> Array:
        """Whitened residual of all frames, starts removed, (N,)."""
        return np.concatenate([r.r for r in self.responses])

    @property
    def basis(self) -> Basis:
        """Orthonormal basis of the linearised model."""
        layout = self.problem.layout
        return basis_of(self.jac, layout.levels, prior_rows(layout, self.p))

    def unlevelled(self) -> Array:
        """Residual with the fitted departures of the levels from one put back: data of the random effect, (N,).

        Departures from priors of parameters are put back likewise.
        """
        layout = self.problem.layout
        away = np.zeros(len(self.p))
        if layout.priors:
            away = np.linalg.pinv(prior_rows(layout, self.p)) @ prior_departure(layout, self.p)
        away[layout.levels] += self.p[layout.levels] - 1
        return self.residual + self.jac @ away


def stacked(responses: Sequence[Response], n_unknowns: int) -> Array:
    """Jacobians of all pieces one under the other, in the full set of unknowns."""
    blocks = []
    for r in responses:
        full = np.zeros((len(r.r), n_unknowns))
        full[:, r.active] = r.jac
        blocks.append(full)
    return np.concatenate(blocks)


@dataclass(frozen=True)
class _Walk:
    """What holds during one refinement: the problem, the spread of the levels, and which way each unknown may go."""

    problem: Problem
    tau: float
    low: Array
    high: Array
    whole: bool  # every unknown may move

    def at(self, p: Array, starts: list[Array]) -> Solution:
        """The law at p, brought within the bounds and to its plain form, the levels about one."""
        p = settle(self.problem.layout, np.clip(p, self.low, self.high))
        return _state(self.problem, balanced(self.problem.layout, p) if self.whole else p, starts, self.tau)

    def moved(self, state: Solution, step: Array) -> Solution:
        """The law after a step, its starts moved along."""
        pairs = zip(state.starts, state.responses, strict=True)
        return self.at(state.p + step, [s + r.start_step(step[r.active]) for s, r in pairs])

    def stepped(self, state: Solution, step: Array) -> Solution:
        """The law after a trial step.

        Where it went too far, the coefficients are solved again for its non-linear parameters (variable projection).
        """
        trial = self.moved(state, step)
        linear = self.problem.layout.coefficients
        for _ in range(PROJECTIONS):
            if trial.objective < state.objective:
                break
            bounds = np.where(linear, self.low, trial.p), np.where(linear, self.high, trial.p)
            trial = self.moved(trial, _step(trial, UNDAMPED, bounds)[0])
        return trial


def refine(  # noqa: PLR0913 - one door to the solver, all settings named
    problem: Problem,
    p: Array,
    starts: Sequence[Array],
    *,
    tau: float = 0.03,
    free: Mask | None = None,
    max_steps: int = 20,
    enough: float = ENOUGH,
) -> Solution:
    """Bounded Levenberg-Marquardt on the simulated motion from p (P,), at a given spread of the levels.

    `free` (P,) tells which unknowns may move; default all. A step that promises less than `enough` is not taken.
    """
    walk = _walk(problem, p, tau, free)
    return _walked(walk, walk.at(p, list(starts)), max_steps, enough)


def continued(
    solution: Solution, tau: float, *, free: Mask | None = None, max_steps: int = 20, enough: float = ENOUGH
) -> Solution:
    """Refine a law further from where it stands, at another spread of the levels; nothing is simulated again there."""
    held = restraint(solution.problem.layout, solution.p, tau)
    objective = sum(float(r.r_full @ r.r_full) for r in solution.responses) + float(held @ held)
    state = replace(solution, tau=tau, objective=objective)
    return _walked(_walk(solution.problem, solution.p, tau, free), state, max_steps, enough)


def promising(
    problem: Problem, p: Array, starts: Sequence[Array], *, tau: float, free: Mask | None = None
) -> tuple[float, Solution]:
    """The objective that the first step from p (P,) promises, and the law at p; one simulation of each piece."""
    walk = _walk(problem, p, tau, free)
    state = walk.at(p, list(starts))
    return state.objective - _step(state, FIRST_DAMPING, (walk.low, walk.high))[1], state


def _walk(problem: Problem, p: Array, tau: float, free: Mask | None) -> _Walk:
    """A refinement in which only what is `free` may move; default all."""
    low, high = problem.layout.bounds
    if free is not None:
        low, high = np.where(free, low, p), np.where(free, high, p)
    return _Walk(problem, tau, low, high, free is None)


def _walked(walk: _Walk, state: Solution, max_steps: int, enough: float) -> Solution:
    """Steps of Levenberg and Marquardt from a state until one promises less than `enough`."""
    problem, (low, high), damping = walk.problem, (walk.low, walk.high), FIRST_DAMPING
    if any(getattr(piece, "turns", False) for piece in problem.pieces):
        enough = max(enough, KINKED)
    for _ in range(max_steps):
        least = enough * max(1.0, state.objective / max(problem.n_frames, 1))
        step, promised = _step(state, damping, (low, high))
        if promised < least or damping > MOST_DAMPED:
            break
        try:
            trial = walk.stepped(state, step)
        except FrictrackError:  # a law so wild that the motion cannot be integrated: a shorter step
            damping *= 100
            continue
        improved = state.objective - trial.objective
        if improved > 0:
            state, damping = trial, max(damping * 0.01, UNDAMPED)
        else:
            damping *= 100
        if 0 < improved < least and damping == UNDAMPED:
            break
    return state


def _state(problem: Problem, p: Array, starts: list[Array], tau: float) -> Solution:
    responses = problem.evaluate(p, starts)
    held = restraint(problem.layout, p, tau)
    objective = sum(float(r.r_full @ r.r_full) for r in responses) + float(held @ held)
    return Solution(problem, p, starts, tau, responses, objective)


def _step(state: Solution, damping: float, bounds: tuple[Array, Array]) -> tuple[Array, float]:
    """Bounded damped least-squares step of the unknowns, and the fall of the objective that it promises."""
    n = len(state.p)
    layout = state.problem.layout
    rows, right = _compressed(state.responses, n)
    rows = np.vstack([rows, restraint_rows(layout, state.tau, state.p)])
    right = np.concatenate([right, -restraint(layout, state.p, state.tau)])
    rows[:, bounds[1] <= bounds[0]] = 0.0
    norm = np.linalg.norm(rows, axis=0)
    norm[norm == 0] = 1.0
    if not (np.all(np.isfinite(rows)) and np.all(np.isfinite(right))):
        raise FrictrackError("the motion under this law could not be integrated; check mass, drive and units")
    damped = np.vstack([rows / norm, np.sqrt(damping) * np.eye(n)])
    target = np.concatenate([right, np.zeros(n)])
    low, high = (bounds[0] - state.p) * norm, (bounds[1] - state.p) * norm
    z = np.linalg.lstsq(damped, target, rcond=1e-13)[0]
    if np.any(z < low) or np.any(z > high):
        wall = 1e-12 * (1 + np.abs(state.p)) * norm
        z = lsq_linear(damped, target, bounds=(np.minimum(low, -wall), np.maximum(high, wall)), method="bvls").x
    # what a change of the starts alone would gain counts too: r_full against r
    waste = sum(float(r.r_full @ r.r_full - r.r @ r.r) for r in state.responses)
    gain = float(right @ right - np.sum((right - rows @ (z / norm)) ** 2)) + waste
    return z / norm, gain


def _compressed(responses: Sequence[Response], n: int) -> tuple[Array, Array]:
    """The same least-squares problem in few rows: R factors of every piece's (Jacobian, residual)."""
    rows, right = [], []
    for r in responses:
        k = len(r.active)
        upper = np.asarray(np.linalg.qr(np.column_stack([r.jac, r.r]), mode="r"))
        block = np.zeros((len(upper), n))
        block[:, r.active] = upper[:, :k]
        rows.append(block)
        right.append(upper[:, k])
    return np.vstack(rows), np.concatenate(right)


def settle_scatter(
    problem: Problem,
    p: Array,
    starts: Sequence[Array],
    tau: float = 0.03,
    *,
    max_steps: int = 20,
    enough: float = ENOUGH,
) -> Solution:
    """Refine the law and the spread of the levels in turn until the spread stays."""
    solution = refine(problem, p, starts, tau=tau, max_steps=max_steps, enough=enough)
    return _settled(solution, max_steps, enough)


def resettled(solution: Solution, tau: float) -> Solution:
    """The same from a law that was simulated already, to the end."""
    return _settled(continued(solution, tau), 20, ENOUGH)


def _settled(solution: Solution, max_steps: int, enough: float) -> Solution:
    """The spread of the levels and the law at it in turn, from a law refined at some spread."""
    for _ in range(SPREADS):
        basis = solution.basis
        if not basis.random or solution.problem.layout.levels_free:
            return solution
        data = solution.unlevelled()
        old, new = solution.tau, basis.spread(basis.u.T @ data, float(data @ data))
        solution = continued(solution, new, max_steps=max_steps, enough=enough)
        if abs(np.log(new / old)) < 0.02 or max(new, old) < 1e-3:
            break
    return solution
