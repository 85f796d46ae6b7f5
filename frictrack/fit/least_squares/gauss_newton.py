"""Fit by output-error Gauss-Newton: simulate, linearise, step, until the parameters stop changing.

Steps are bounded and kept within a trust region. The scatter of the friction levels is estimated in between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.evaluation_budget import COST_OF_MEMORY
from frictrack.fit.least_squares.few_rows import RotatedJacobian, rotated_jacobian, stacked_jacobian, triangular
from frictrack.fit.least_squares.problem import LeastSquaresProblem, PieceResponse
from frictrack.fit.least_squares.trust_region import MIN_DAMPING, DampedStep, TrustRegion, damped_step, is_converged
from frictrack.fit.parameters import (
    MIN_RUNS_FOR_SCATTER,
    JacobianBasis,
    canonical_form,
    jacobian_basis,
    normalise_levels,
    penalty_jacobian,
    penalty_residual,
    prior_jacobian,
    prior_residual,
)
from frictrack.records import Array, Mask

MAX_STEPS_WITH_SCATTER = 40  # Gauss-Newton steps in which the scatter of the levels is estimated too
MIN_TAU_OF_OTHER_RUNS = 1e-3  # relative standard deviation of the friction levels
MAX_FALL_SHARE_SCATTER = 0.01  # predicted fall over the objective, below which a state is near enough to estimate tau
MAX_DISTANCE_HELD = 1e-9  # from a bound at which an unknown is held, relative beyond 1
MAX_PROJECTIONS = 2  # linear solves after a step that went too far
MIN_CHI2_FALL = 1e-4  # smaller predicted falls are ignored; scaled up where the misfit is large
MIN_CHI2_FALL_REVERSALS = 0.01  # the same for motions with reversals, which are not smooth between nodes


@dataclass(frozen=True)
class Solution:
    """Where Gauss-Newton converged, and the model linearised there.

    Attributes
    ----------
    problem : LeastSquaresProblem
        What was fitted.
    p : array of shape (P,)
        The unknowns.
    starts : list of array of shape (2,)
        Start position (m) and speed (m/s) of every piece.
    tau : float
        Relative standard deviation of the friction levels.
    responses : list of PieceResponse
        Residuals and sensitivities of all pieces.
    objective : float
        Chi-squared plus penalties.

    """

    problem: LeastSquaresProblem
    p: Array
    starts: list[Array]
    tau: float
    responses: list[PieceResponse]
    objective: float

    @property
    def chi2(self) -> float:
        """Sum of squared whitened residuals."""
        return float(sum(r.r @ r.r for r in self.responses))

    @property
    def jac(self) -> Array:
        """Whitened Jacobian of all frames, starts projected out, (N, P)."""
        return stacked_jacobian(self.responses, len(self.p))

    @property
    def residual(self) -> Array:
        """Whitened residual of all frames, starts projected out, (N,)."""
        return np.concatenate([r.r for r in self.responses])

    @property
    def basis(self) -> JacobianBasis:
        """Orthonormal basis of the linearised model."""
        rotated = self.rotated_jacobian
        few = self._basis_of(rotated.rows)
        return replace(few, u=rotated.expanded(few.u))

    @property
    def fitted_numbers(self) -> float:
        """How many numbers the data determine: the trace of the smoothing matrix, starts not counted.

        A friction level counts as the share of it that the scatter of the levels leaves to the data (Hastie,
        Tibshirani & Friedman 2009, The Elements of Statistical Learning, section 7.6).
        """
        return float(np.trace(self._basis_of(self.few_rows).shrink(self.tau or 0.03)))

    @property
    def rotated_jacobian(self) -> RotatedJacobian:
        """The whitened Jacobian as a rotation of few rows."""
        return rotated_jacobian(self.responses, len(self.p))

    @property
    def few_rows(self) -> Array:
        """Few rows (M, P) with the normal matrix, singular values and right singular vectors of `jac`."""
        return self.few_rows_and_residual[0]

    @cached_property
    def few_rows_and_residual(self) -> tuple[Array, Array]:
        """The linearised model in few rows: Jacobian (M, P) and residual (M,)."""
        return triangular(self.responses, len(self.p))

    @property
    def penalised_rows_and_residual(self) -> tuple[Array, Array]:
        """The linearised objective in few rows: Jacobian (M, P) and residual (M,), penalties included."""
        rows, right = self.few_rows_and_residual
        layout = self.problem.layout
        rows = np.vstack([rows, penalty_jacobian(layout, self.tau, self.p)])
        return rows, np.concatenate([right, -penalty_residual(layout, self.p, self.tau)])

    def _basis_of(self, rows: Array) -> JacobianBasis:
        layout = self.problem.layout
        return jacobian_basis(rows, layout.levels, prior_jacobian(layout, self.p))

    @cached_property
    def held(self) -> Mask:
        """Parameters (P,) at a bound beyond which the objective would fall: there they are not free.

        Friction levels count as free: their bounds only keep them finite.
        """
        rows, right = self.penalised_rows_and_residual
        descent, margin = rows.T @ right, MAX_DISTANCE_HELD * (1 + np.abs(self.p))
        low, high = self.problem.layout.bounds
        held = ((self.p <= low + margin) & (descent < 0)) | ((self.p >= high - margin) & (descent > 0))
        held[self.problem.layout.levels] = False
        return held

    def random_effect_data(self) -> Array:
        """Return the residual with the fitted deviations of levels and priors added back, (N,).

        These are the data from which the scatter of the levels is estimated.
        """
        departure = self._departure()
        return np.concatenate([r.r + r.jac @ departure[r.active] for r in self.responses])

    def level_scatter(self) -> float:
        """Estimate tau, the relative standard deviation of the friction levels."""
        rows, residual = self.few_rows_and_residual
        basis, data = self._basis_of(rows), residual + rows @ self._departure()
        return basis.spread(basis.u.T @ data, float(data @ data))

    def scatter_penalty(self, tau: float) -> float:
        """Compute what integrating out levels of scatter tau adds to minus twice the log-likelihood."""
        if not self.levels_are_random:
            return 0.0
        levels = self.few_rows[:, self.problem.layout.levels]
        return float(np.linalg.slogdet(np.eye(levels.shape[1]) + tau**2 * (levels.T @ levels))[1])

    def with_scatter(self, tau: float) -> Solution:
        """Return the same unknowns and responses with another scatter of the levels."""
        penalty = penalty_residual(self.problem.layout, self.p, tau)
        objective = sum(float(r.r_full @ r.r_full) for r in self.responses) + float(penalty @ penalty)
        scattered = replace(self, tau=tau, objective=objective)
        vars(scattered)["few_rows_and_residual"] = self.few_rows_and_residual  # of the same responses
        return scattered

    @property
    def tau_of_other_runs(self) -> float:
        """Scatter to expect of the friction levels of other runs: those of few runs may be nearly equal by chance."""
        return max(self.tau, MIN_TAU_OF_OTHER_RUNS)

    @property
    def levels_are_random(self) -> bool:
        """Whether the friction levels are a random effect."""
        return len(self.problem.layout.levels) >= MIN_RUNS_FOR_SCATTER

    def _departure(self) -> Array:
        """Fitted deviations (P,) of levels and priors."""
        layout = self.problem.layout
        departure = np.zeros(len(self.p))
        if layout.priors:
            departure = np.linalg.pinv(prior_jacobian(layout, self.p)) @ prior_residual(layout, self.p)
        departure[layout.levels] += self.p[layout.levels] - 1
        return departure


@dataclass(frozen=True)
class _Refinement:
    """The constant settings of one refinement: problem and bounds of the unknowns."""

    problem: LeastSquaresProblem
    low: Array
    high: Array
    all_free: bool  # whether every unknown may change
    estimates_scatter: bool = False  # whether tau is estimated again at every step near the optimum

    def step(self, state: Solution, region: TrustRegion) -> DampedStep:
        """The next step from a state."""
        return _step(state, region, (self.low, self.high))

    def next_step(self, state: Solution, region: TrustRegion) -> tuple[Solution, DampedStep]:
        """A new state with its scatter of the levels, and the step from there."""
        step = self.step(state, region)
        if not self.estimates_scatter or step.predicted_fall > MAX_FALL_SHARE_SCATTER * state.objective:
            return state, step
        state = state.with_scatter(state.level_scatter())
        return state, self.step(state, region)

    def at(self, p: Array, starts: list[Array], tau: float) -> Solution:
        """The solution at p, clipped to the bounds and brought to canonical form."""
        p = canonical_form(self.problem.layout, np.clip(p, self.low, self.high))
        return _solution_at(self.problem, normalise_levels(self.problem.layout, p) if self.all_free else p, starts, tau)

    def after_step(self, state: Solution, step: Array) -> Solution:
        """The solution after a step, its starts adjusted."""
        pairs = zip(state.starts, state.responses, strict=True)
        return self.at(state.p + step, [s + r.start_step(step[r.active]) for s, r in pairs], state.tau)

    def after_trial(self, state: Solution, step: Array) -> Solution:
        """The solution after a trial step.

        If the step went too far, the coefficients are solved again for its non-linear parameters (variable
        projection).
        """
        trial = self.after_step(state, step)
        linear = self.problem.layout.coefficients
        for _ in range(MAX_PROJECTIONS):
            if trial.objective < state.objective:
                break
            bounds = np.where(linear, self.low, trial.p), np.where(linear, self.high, trial.p)
            projection = _step(trial, TrustRegion(MIN_DAMPING), bounds)
            if trial.objective - projection.predicted_fall >= state.objective:
                break
            projected = self.after_step(trial, projection.values)
            if projected.objective >= trial.objective:
                break
            trial = projected
        return trial


def refine(  # noqa: PLR0913 - one door to the solver, all settings named
    problem: LeastSquaresProblem,
    p: Array,
    starts: Sequence[Array],
    *,
    tau: float = 0.03,
    free: Mask | None = None,
    max_steps: int = 20,
    min_fall: float = MIN_CHI2_FALL,
) -> Solution:
    """Minimise chi-squared plus penalties by bounded Levenberg-Marquardt, at a given scatter of the friction levels.

    Parameters
    ----------
    problem : LeastSquaresProblem
        What is fitted.
    p : array of shape (P,)
        First unknowns.
    starts : sequence of array of shape (2,)
        First starts of the pieces.
    tau : float
        Relative standard deviation of the friction levels.
    free : array of bool, shape (P,), optional
        Unknowns that may change; default all.
    max_steps : int
        Largest number of steps.
    min_fall : float
        A step is not taken if it is predicted to lower chi-squared by less.

    Returns
    -------
    Solution
        The refined unknowns.

    Raises
    ------
    FrictrackError
        If the motion at p cannot be integrated.

    """
    refinement = _make_refinement(problem, p, free)
    return _run_refinement(refinement, refinement.at(p, list(starts), tau), max_steps, min_fall)


def refine_further(
    solution: Solution, tau: float, *, free: Mask | None = None, max_steps: int = 20, min_fall: float = MIN_CHI2_FALL
) -> Solution:
    """Continue the refinement of a solution at another scatter of the levels, without simulating it again.

    Parameters
    ----------
    solution : Solution
        Where to start.
    tau : float
        Relative standard deviation of the friction levels.
    free : array of bool, shape (P,), optional
        Unknowns that may change; default all.
    max_steps : int
        Largest number of steps.
    min_fall : float
        See `refine`.

    Returns
    -------
    Solution
        The refined unknowns.

    """
    refinement = _make_refinement(solution.problem, solution.p, free)
    return _run_refinement(refinement, solution.with_scatter(tau), max_steps, min_fall)


def predicted_objective(
    problem: LeastSquaresProblem, p: Array, starts: Sequence[Array], *, tau: float, free: Mask | None = None
) -> tuple[float, Solution]:
    """Compute the objective that the first step from p is predicted to reach. Every piece is simulated once.

    Parameters
    ----------
    problem : LeastSquaresProblem
        The problem.
    p : array of shape (P,)
        The unknowns.
    starts : sequence of array of shape (2,)
        Starts of the pieces.
    tau : float
        Relative standard deviation of the friction levels.
    free : array of bool, shape (P,), optional
        Unknowns that may change; default all.

    Returns
    -------
    objective : float
        Predicted chi-squared plus penalties.
    solution : Solution
        The solution at p.

    """
    refinement = _make_refinement(problem, p, free)
    state = refinement.at(p, list(starts), tau)
    return state.objective - refinement.step(state, TrustRegion()).predicted_fall, state


def _make_refinement(problem: LeastSquaresProblem, p: Array, free: Mask | None) -> _Refinement:
    """A refinement in which only the `free` unknowns may change; default all."""
    low, high = problem.layout.bounds
    if free is not None:
        low, high = np.where(free, low, p), np.where(free, high, p)
    return _Refinement(problem, low, high, free is None)


def _run_refinement(refinement: _Refinement, state: Solution, max_steps: int, min_fall: float) -> Solution:
    """Damped steps from a state until one is predicted to gain less than `min_fall`."""
    region = TrustRegion()
    if any(getattr(piece, "turns", False) for piece in refinement.problem.pieces):
        min_fall = max(min_fall, MIN_CHI2_FALL_REVERSALS)
    state, step = refinement.next_step(state, region)
    for _ in range(max_steps):
        threshold = min_fall * max(1.0, state.objective / max(refinement.problem.n_frames, 1))
        if step.predicted_fall < threshold or refinement.problem.budget.stops():
            break
        try:
            trial = refinement.after_trial(state, step.values)
        except FrictrackError:  # the motion diverges: take a shorter step
            region = region.after_divergence(step)
            step = refinement.step(state, region)
            continue
        fall = state.objective - trial.objective
        state, region, converged = (
            trial if fall > 0 else state,
            region.after(step, fall),
            is_converged(step, fall, threshold),
        )
        if converged:
            break
        state, step = refinement.next_step(state, region) if fall > 0 else (state, refinement.step(state, region))
    return state


def _solution_at(problem: LeastSquaresProblem, p: Array, starts: list[Array], tau: float) -> Solution:
    problem.budget.spend(COST_OF_MEMORY if problem.model.memory else 1.0)
    responses = problem.evaluate(p, starts)
    penalty = penalty_residual(problem.layout, p, tau)
    objective = sum(float(r.r_full @ r.r_full) for r in responses) + float(penalty @ penalty)
    return Solution(problem, p, starts, tau, responses, objective)


def _step(state: Solution, region: TrustRegion, bounds: tuple[Array, Array]) -> DampedStep:
    """Bounded damped least-squares step of the unknowns, and the predicted fall of the objective."""
    rows, right = state.penalised_rows_and_residual
    rows[:, bounds[1] <= bounds[0]] = 0.0
    if not (np.all(np.isfinite(rows)) and np.all(np.isfinite(right))):
        raise FrictrackError("the motion under this law could not be integrated; check mass, drive and units")
    margin = 1e-12 * (1 + np.abs(state.p))
    steps = np.minimum(bounds[0] - state.p, -margin), np.maximum(bounds[1] - state.p, margin)
    found = damped_step(rows, right, steps, region)
    # the gain from the starts alone is included (r_full against r)
    start_gain = sum(float(r.r_full @ r.r_full - r.r @ r.r) for r in state.responses)
    return replace(found, predicted_fall=found.predicted_fall + start_gain)


def fit_with_scatter(
    problem: LeastSquaresProblem,
    p: Array,
    starts: Sequence[Array],
    tau: float = 0.03,
    *,
    max_steps: int = MAX_STEPS_WITH_SCATTER,
    min_fall: float = MIN_CHI2_FALL,
) -> Solution:
    """Refine the unknowns and the scatter of the friction levels together.

    The estimate of the scatter hardly depends on the unknowns while these are near the optimum, because it is made from
    the linearised model with the levels projected out. It is therefore made again after every step there.

    Parameters
    ----------
    problem : LeastSquaresProblem
        What is fitted.
    p : array of shape (P,)
        First unknowns.
    starts : sequence of array of shape (2,)
        First starts of the pieces.
    tau : float
        First relative standard deviation of the levels.
    max_steps : int
        Largest number of steps.
    min_fall : float
        See `refine`.

    Returns
    -------
    Solution
        Unknowns at the restricted-maximum-likelihood estimate of tau.

    """
    refinement = _estimating_scatter(problem, p)
    return _run_refinement(refinement, refinement.at(p, list(starts), tau), max_steps, min_fall)


def refit_with_scatter(
    solution: Solution, tau: float, *, max_steps: int = MAX_STEPS_WITH_SCATTER, min_fall: float = MIN_CHI2_FALL
) -> Solution:
    """Refine an existing solution and the scatter of its levels; see `fit_with_scatter`."""
    refinement = _estimating_scatter(solution.problem, solution.p)
    return _run_refinement(refinement, solution.with_scatter(tau), max_steps, min_fall)


def _estimating_scatter(problem: LeastSquaresProblem, p: Array) -> _Refinement:
    """A refinement of all unknowns that estimates the scatter of the levels, where these are a random effect."""
    layout = problem.layout
    is_random = len(layout.levels) >= MIN_RUNS_FOR_SCATTER and not layout.levels_free
    return replace(_make_refinement(problem, p, None), estimates_scatter=is_random)
