"""Fit by output-error Gauss-Newton: simulate, linearise, step, until the parameters stop changing.

Steps are damped (Levenberg-Marquardt) and bounded. The scatter of the friction levels is estimated in between.

References
----------
Levenberg, K. (1944). Quarterly of Applied Mathematics 2, 164-168.
Marquardt, D. W. (1963). SIAM J. Appl. Math. 11, 431-441.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear

from frictrack.errors import FrictrackError
from frictrack.fit.least_squares.few_rows import RotatedJacobian, rotated_jacobian, stacked_jacobian, triangular
from frictrack.fit.least_squares.problem import LeastSquaresProblem, PieceResponse
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

MAX_SCATTER_ESTIMATES = 4  # estimates of tau
MAX_PROJECTIONS = 2  # linear solves after a step that went too far
FIRST_DAMPING, MAX_DAMPING = 1e-8, 1e8
MIN_DAMPING = 1e-12  # below: Gauss-Newton steps
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
    def rotated_jacobian(self) -> RotatedJacobian:
        """The whitened Jacobian as a rotation of few rows."""
        return rotated_jacobian(self.responses, len(self.p))

    @property
    def few_rows(self) -> Array:
        """Few rows (M, P) with the normal matrix, singular values and right singular vectors of `jac`."""
        return triangular(self.responses, len(self.p))[0]

    def _basis_of(self, rows: Array) -> JacobianBasis:
        layout = self.problem.layout
        return jacobian_basis(rows, layout.levels, prior_jacobian(layout, self.p))

    def random_effect_data(self) -> Array:
        """Return the residual with the fitted deviations of levels and priors added back, (N,).

        These are the data from which the scatter of the levels is estimated.
        """
        departure = self._departure()
        return np.concatenate([r.r + r.jac @ departure[r.active] for r in self.responses])

    def level_scatter(self) -> float:
        """Estimate tau, the relative standard deviation of the friction levels."""
        rows, residual = triangular(self.responses, len(self.p))
        basis, data = self._basis_of(rows), residual + rows @ self._departure()
        return basis.spread(basis.u.T @ data, float(data @ data))

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
    """The constant settings of one refinement: problem, scatter of the levels, and bounds of the unknowns."""

    problem: LeastSquaresProblem
    tau: float
    low: Array
    high: Array
    all_free: bool  # whether every unknown may change

    def at(self, p: Array, starts: list[Array]) -> Solution:
        """The solution at p, clipped to the bounds and brought to canonical form."""
        p = canonical_form(self.problem.layout, np.clip(p, self.low, self.high))
        return _solution_at(
            self.problem, normalise_levels(self.problem.layout, p) if self.all_free else p, starts, self.tau
        )

    def after_step(self, state: Solution, step: Array) -> Solution:
        """The solution after a step, its starts adjusted."""
        pairs = zip(state.starts, state.responses, strict=True)
        return self.at(state.p + step, [s + r.start_step(step[r.active]) for s, r in pairs])

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
            trial = self.after_step(trial, _step(trial, MIN_DAMPING, bounds)[0])
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
    refinement = _make_refinement(problem, p, tau, free)
    return _run_refinement(refinement, refinement.at(p, list(starts)), max_steps, min_fall)


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
    penalty = penalty_residual(solution.problem.layout, solution.p, tau)
    objective = sum(float(r.r_full @ r.r_full) for r in solution.responses) + float(penalty @ penalty)
    state = replace(solution, tau=tau, objective=objective)
    return _run_refinement(_make_refinement(solution.problem, solution.p, tau, free), state, max_steps, min_fall)


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
    refinement = _make_refinement(problem, p, tau, free)
    state = refinement.at(p, list(starts))
    return state.objective - _step(state, FIRST_DAMPING, (refinement.low, refinement.high))[1], state


def _make_refinement(problem: LeastSquaresProblem, p: Array, tau: float, free: Mask | None) -> _Refinement:
    """A refinement in which only the `free` unknowns may change; default all."""
    low, high = problem.layout.bounds
    if free is not None:
        low, high = np.where(free, low, p), np.where(free, high, p)
    return _Refinement(problem, tau, low, high, free is None)


def _run_refinement(refinement: _Refinement, state: Solution, max_steps: int, min_fall: float) -> Solution:
    """Levenberg-Marquardt steps from a state until one is predicted to gain less than `min_fall`."""
    problem, (low, high), damping = refinement.problem, (refinement.low, refinement.high), FIRST_DAMPING
    if any(getattr(piece, "turns", False) for piece in problem.pieces):
        min_fall = max(min_fall, MIN_CHI2_FALL_REVERSALS)
    for _ in range(max_steps):
        threshold = min_fall * max(1.0, state.objective / max(problem.n_frames, 1))
        step, predicted_fall = _step(state, damping, (low, high))
        if predicted_fall < threshold or damping > MAX_DAMPING:
            break
        try:
            trial = refinement.after_trial(state, step)
        except FrictrackError:  # the motion diverges: take a shorter step
            damping *= 100
            continue
        improved = state.objective - trial.objective
        if improved > 0:
            state, damping = trial, max(damping * 0.01, MIN_DAMPING)
        else:
            damping *= 100
        if 0 < improved < threshold and damping == MIN_DAMPING:
            break
    return state


def _solution_at(problem: LeastSquaresProblem, p: Array, starts: list[Array], tau: float) -> Solution:
    responses = problem.evaluate(p, starts)
    penalty = penalty_residual(problem.layout, p, tau)
    objective = sum(float(r.r_full @ r.r_full) for r in responses) + float(penalty @ penalty)
    return Solution(problem, p, starts, tau, responses, objective)


def _step(state: Solution, damping: float, bounds: tuple[Array, Array]) -> tuple[Array, float]:
    """Bounded damped least-squares step of the unknowns, and the predicted fall of the objective."""
    n = len(state.p)
    layout = state.problem.layout
    rows, right = triangular(state.responses, n)
    rows = np.vstack([rows, penalty_jacobian(layout, state.tau, state.p)])
    right = np.concatenate([right, -penalty_residual(layout, state.p, state.tau)])
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
        half_width = 1e-12 * (1 + np.abs(state.p)) * norm
        z = lsq_linear(
            damped, target, bounds=(np.minimum(low, -half_width), np.maximum(high, half_width)), method="bvls"
        ).x
    # the gain from the starts alone is included (r_full against r)
    start_gain = sum(float(r.r_full @ r.r_full - r.r @ r.r) for r in state.responses)
    gain = float(right @ right - np.sum((right - rows @ (z / norm)) ** 2)) + start_gain
    return z / norm, gain


def fit_with_scatter(
    problem: LeastSquaresProblem,
    p: Array,
    starts: Sequence[Array],
    tau: float = 0.03,
    *,
    max_steps: int = 20,
    min_fall: float = MIN_CHI2_FALL,
) -> Solution:
    """Refine the unknowns and the scatter of the friction levels in turn until the scatter converges.

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
        Steps per refinement.
    min_fall : float
        See `refine`.

    Returns
    -------
    Solution
        Unknowns at the restricted-maximum-likelihood estimate of tau.

    """
    solution = refine(problem, p, starts, tau=tau, max_steps=max_steps, min_fall=min_fall)
    return _with_converged_scatter(solution, max_steps, min_fall)


def refit_with_scatter(solution: Solution, tau: float) -> Solution:
    """Refine an existing solution and the scatter of its levels to convergence."""
    return _with_converged_scatter(refine_further(solution, tau), 20, MIN_CHI2_FALL)


def _with_converged_scatter(solution: Solution, max_steps: int, min_fall: float) -> Solution:
    """Alternate between the scatter of the levels and the solution at that scatter."""
    for _ in range(MAX_SCATTER_ESTIMATES):
        if not solution.levels_are_random or solution.problem.layout.levels_free:
            return solution
        old, new = solution.tau, solution.level_scatter()
        solution = refine_further(solution, new, max_steps=max_steps, min_fall=min_fall)
        if abs(np.log(new / old)) < 0.02 or max(new, old) < 1e-3:
            break
    return solution
