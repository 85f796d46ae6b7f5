"""Fit by output-error Gauss-Newton: simulate, linearise, step, until the parameters stop changing.

Steps are bounded, damped, and not longer than a radius. The radius shrinks where a step gains much less than predicted,
to the minimum of the parabola through the last step. It grows again where the prediction holds. The scatter of the
friction levels is estimated in between. Where it falls, the simulated motion has to follow within a few steps;
otherwise the fit goes back and the scatter changes by less (watchdog: Chamberlain et al. 1982).

References
----------
Levenberg, K. (1944). Quarterly of Applied Mathematics 2, 164-168.
Marquardt, D. W. (1963). SIAM J. Appl. Math. 11, 431-441.
More, J. J. (1978). The Levenberg-Marquardt algorithm. Lecture Notes in Mathematics 630, 105-116.
Conn, A. R., Gould, N. I. M. & Toint, P. L. (2000). Trust-Region Methods. SIAM.
Chamberlain, R. M., Powell, M. J. D., Lemarechal, C. & Pedersen, H. C. (1982). The watchdog technique for forcing
convergence in algorithms for constrained optimization. Mathematical Programming Study 16, 1-17.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear

from frictrack.base.errors import FrictrackError, result_or_none
from frictrack.fit.least_squares.problem import LeastSquaresProblem
from frictrack.fit.least_squares.solution import Solution
from frictrack.fit.parameters import MIN_RUNS_FOR_SCATTER, canonical_form, normalise_levels
from frictrack.fit.pieces import column_norms
from frictrack.records import Array, Mask

MAX_STEPS_WITH_SCATTER = 40  # Gauss-Newton steps in which the scatter of the levels is estimated too
MAX_FALL_SHARE_SCATTER = 0.01  # predicted fall over the objective, below which a state is near enough to estimate tau
SCATTER_SHRINKAGE, SCATTER_GROWTH = 0.25, 4.0  # of the largest change of log tau, after a refused and an accepted one
SCATTER_PATIENCE = 6  # steps in which the simulated motion may follow to a smaller scatter
MIN_SCATTER_CHANGE = 0.1  # of log tau; smaller changes are not tried after a refusal
MAX_PROJECTIONS = 2  # linear solves after a step that went too far
MAX_PROJECTION_STEPS = 10.0  # length of such a solve over that of the step; what lies farther off is not linear
MIN_CHI2_FALL = 1e-4  # smaller predicted falls are ignored; scaled up where the misfit is large
MIN_CHI2_FALL_REVERSALS = 0.01  # the same with reversals or memory, whose kinks move between nodes
FIRST_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-8, 1e-12, 1e8
DAMPINGS_PER_DECADE = 4
POOR_GAIN, GOOD_GAIN = 0.25, 0.75  # share of the predicted fall (Conn, Gould & Toint 2000, algorithm 6.1.1)
RADIUS_GROWTH = 4.0  # after a step of good gain
MIN_SHRINKAGE, MAX_SHRINKAGE = 0.5, 0.1  # of the radius after a step of poor gain
MAX_OVERSHOOT = 3.0  # times the predicted fall: a larger rise is not described by a parabola


def refine(  # noqa: PLR0913 - one door to the solver, all settings named
    problem: LeastSquaresProblem,
    p: Array,
    starts: Sequence[Array],
    *,
    tau: float = 0.03,
    free: Mask | None = None,
    max_steps: int = 20,
    min_fall: float = MIN_CHI2_FALL,
    min_share: float = 0.0,
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
    min_share : float
        The same as a share of the objective: for data without noise, which is all that the objective holds.

    Returns
    -------
    Solution
        The refined unknowns.

    Raises
    ------
    FrictrackError
        If the motion at p cannot be integrated.

    """
    refinement = _Refinement.of(problem, p, free)
    return refinement.run(refinement.at(p, list(starts), tau), max_steps, min_fall, min_share)


def hold(problem: LeastSquaresProblem, p: Array, starts: Sequence[Array], tau: float) -> Solution:
    """Return the solution at given unknowns and starts: nothing is refined."""
    return Solution.at(problem, canonical_form(problem.layout, p), starts, tau)


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
    refinement = _Refinement.of(problem, p, free)
    state = refinement.at(p, list(starts), tau)
    return state.objective - refinement.step(state, TrustRegion()).predicted_fall, state


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
    refinement = _Refinement.of(problem, p, scatter=True)
    return refinement.run(refinement.at(p, list(starts), tau), max_steps, min_fall)


def refit_with_scatter(
    solution: Solution, tau: float, *, max_steps: int = MAX_STEPS_WITH_SCATTER, min_fall: float = MIN_CHI2_FALL
) -> Solution:
    """Refine an existing solution and the scatter of its levels; see `fit_with_scatter`."""
    refinement = _Refinement.of(solution.problem, solution.p, scatter=True)
    return refinement.run(solution.with_scatter(tau), max_steps, min_fall)


@dataclass(frozen=True)
class _Refinement:
    """Steps of a problem whose unknowns move within bounds."""

    problem: LeastSquaresProblem
    bounds: tuple[Array, Array]
    all_free: bool  # whether every unknown may change
    estimates_scatter: bool  # whether tau is estimated again at every step near the optimum

    @classmethod
    def of(
        cls, problem: LeastSquaresProblem, p: Array, free: Mask | None = None, *, scatter: bool = False
    ) -> _Refinement:
        """Only the `free` unknowns may change, by default all; with `scatter`, tau where the levels are random."""
        low, high = problem.layout.bounds
        if free is not None:
            low, high = np.where(free, low, p), np.where(free, high, p)
        random = len(problem.layout.levels) >= MIN_RUNS_FOR_SCATTER
        return cls(problem, (low, high), free is None, scatter and random)

    def run(self, state: Solution, max_steps: int, min_fall: float, min_share: float = 0.0) -> Solution:
        """Take damped steps from a state until one is predicted to gain less than `min_fall`, or that share."""
        region, reach, anchor, patience = TrustRegion(), np.inf, state, SCATTER_PATIENCE
        if self.problem.model.memory or any(getattr(piece, "turns", False) for piece in self.problem.pieces):
            min_fall = max(min_fall, MIN_CHI2_FALL_REVERSALS)
        state, step, rise = self.next_step(anchor, region, reach)
        for _ in range(max_steps):
            share = max(min_fall / max(self.problem.n_frames, 1), min_share)
            threshold = max(min_fall, share * anchor.objective)
            ended = step.predicted_fall < threshold or self.problem.budget.stops()
            moved = False
            if not ended:
                state, region, moved, ended = self.advance(state, step, region, threshold)
            if state.tau < anchor.tau and state.objective + rise > anchor.objective + threshold:
                patience -= 1
                if patience and not ended:
                    step = self.step(state, region)
                    continue
                # the motion does not follow to the scatter that the linearised model promises: a smaller change
                reach, region = SCATTER_SHRINKAGE * abs(float(np.log(state.tau / anchor.tau))), TrustRegion()
                state, step, rise = self.next_step(anchor, region, reach)
                patience = SCATTER_PATIENCE
                continue
            if state.tau != anchor.tau or step.length > 1.0:  # by more than a standard deviation
                reach *= SCATTER_GROWTH
            anchor, patience = state, SCATTER_PATIENCE
            if ended:
                break
            state, step, rise = self.next_step(anchor, region, reach if moved else 0.0)
            if not moved and step.length**2 < MIN_CHI2_FALL:  # too short to change the misfit
                break
        return anchor

    def advance(
        self, state: Solution, step: DampedStep, region: TrustRegion, threshold: float
    ) -> tuple[Solution, TrustRegion, bool, bool]:
        """A state after a trial step, the region from there, whether it moved, and whether little is left to gain."""
        trial = self.after(state, step)
        if trial is None:  # the motion diverges: take a shorter step
            return state, replace(region, radius=MAX_SHRINKAGE * step.length), False, False
        fall = state.objective - trial.objective
        return trial if fall > 0 else state, region.after(step, fall), fall > 0, is_converged(step, fall, threshold)

    def after(self, state: Solution, step: DampedStep) -> Solution | None:
        """The solution after a trial step; None if its motion cannot be integrated.

        Where it went too far, the coefficients are solved again for its non-linear parameters (variable projection):
        along a valley that bends, a time constant and the friction levels change together.
        """
        low, high = self.bounds
        linear, trial = self.problem.layout.coefficients, self._moved(state, step.values)
        for _ in range(MAX_PROJECTIONS):
            if trial is None or trial.objective < state.objective:
                break
            bounds = np.where(linear, low, trial.p), np.where(linear, high, trial.p)
            within = TrustRegion(MIN_DAMPING, MAX_PROJECTION_STEPS * step.length)
            projection = self.step(trial, within, bounds)
            if trial.objective - projection.predicted_fall >= state.objective:
                break
            projected = self._moved(trial, projection.values)
            if projected is None or projected.objective >= trial.objective:
                break
            trial = projected
        return trial

    def _moved(self, state: Solution, step: Array) -> Solution | None:
        """The solution after a step (P,), its starts adjusted; None if its motion cannot be integrated."""
        pairs = zip(state.starts, state.responses, strict=True)
        starts = [start + r.start_step(step[r.active]) for start, r in pairs]
        return result_or_none(self.at, state.p + step, starts, state.tau)

    def next_step(self, state: Solution, region: TrustRegion, reach: float) -> tuple[Solution, DampedStep, float]:
        """A state with the scatter of its levels, the step from there, and the rise of the determinant term by it.

        The scatter changes by at most a factor of exp(reach).
        """
        step = self.step(state, region)
        near = step.predicted_fall <= MAX_FALL_SHARE_SCATTER * state.objective
        if not self.estimates_scatter or not near or reach < MIN_SCATTER_CHANGE:
            return state, step, 0.0
        tau, rise = state.level_scatter(reach)
        state = state.with_scatter(tau)
        return state, self.step(state, region), rise

    def step(self, state: Solution, region: TrustRegion, bounds: tuple[Array, Array] | None = None) -> DampedStep:
        """Bounded damped least-squares step of the unknowns, and the predicted fall of the objective."""
        low, high = bounds or self.bounds
        rows, right = state.penalised_rows_and_residual
        rows[:, high <= low] = 0.0
        if not (np.all(np.isfinite(rows)) and np.all(np.isfinite(right))):
            raise FrictrackError("the motion under this law could not be integrated; check mass, drive and units")
        margin = 1e-12 * (1 + np.abs(state.p))
        found = damped_step(
            rows, right, (np.minimum(low - state.p, -margin), np.maximum(high - state.p, margin)), region
        )
        # the gain from the starts alone is included (r_full against r)
        start_gain = sum(float(r.r_full @ r.r_full - r.r @ r.r) for r in state.responses)
        return replace(found, predicted_fall=found.predicted_fall + start_gain)

    def at(self, p: Array, starts: list[Array], tau: float) -> Solution:
        """The solution at p, clipped to the bounds and brought to canonical form."""
        p = canonical_form(self.problem.layout, np.clip(p, *self.bounds))
        return Solution.at(self.problem, normalise_levels(self.problem.layout, p) if self.all_free else p, starts, tau)


@dataclass(frozen=True)
class DampedStep:
    """A step of the unknowns (P,), its length in units of the columns, and the predicted fall of the objective."""

    values: Array
    length: float
    predicted_fall: float


@dataclass(frozen=True)
class TrustRegion:
    """Damping and largest length of the next step.

    Attributes
    ----------
    damping : float
        Smallest damping, relative to the squared norms of the columns.
    radius : float
        Largest length in units of the columns.

    """

    damping: float = FIRST_DAMPING
    radius: float = np.inf

    def after(self, step: DampedStep, fall: float) -> TrustRegion:
        """Return the region after a step that lowered the objective by `fall`."""
        predicted = step.predicted_fall
        if fall >= GOOD_GAIN * predicted:
            return TrustRegion(max(0.01 * self.damping, MIN_DAMPING), max(self.radius, RADIUS_GROWTH * step.length))
        if fall >= POOR_GAIN * predicted:
            return self
        shrinkage = predicted / (2 * predicted - fall) if fall <= 0 else MIN_SHRINKAGE
        return TrustRegion(self.damping, float(np.clip(shrinkage, MAX_SHRINKAGE, MIN_SHRINKAGE)) * step.length)

    def sufficient_damping(self, eigenvalues: Array, on_basis: Array) -> float:
        """Return the smallest damping with which the step is not longer than the radius.

        Parameters
        ----------
        eigenvalues : array of shape (P,)
            Of the normal matrix of normalised columns.
        on_basis : array of shape (P,)
            The gradient along its eigenvectors.

        """
        if not np.isfinite(self.radius):
            return self.damping
        decades = np.log10(MAX_DAMPING / self.damping)
        dampings = self.damping * 10.0 ** np.linspace(0, decades, int(decades * DAMPINGS_PER_DECADE) + 1)
        lengths = np.linalg.norm(on_basis / (eigenvalues + dampings[:, None]), axis=1)
        return float(dampings[np.argmax(lengths <= self.radius)]) if lengths[-1] <= self.radius else MAX_DAMPING


def is_converged(step: DampedStep, fall: float, threshold: float) -> bool:
    """Return whether a step of poor gain leaves less than a threshold to gain along it, by a parabola.

    The parabola has the predicted slope at the start of the step and the actual fall at its end.
    """
    predicted = step.predicted_fall
    if not -MAX_OVERSHOOT * predicted < fall < POOR_GAIN * predicted:
        return False
    return predicted / (2 - fall / predicted) - max(fall, 0.0) < threshold


def damped_step(rows: Array, right: Array, bounds: tuple[Array, Array], region: TrustRegion) -> DampedStep:
    """Solve a linear least-squares problem within bounds and a trust region.

    Parameters
    ----------
    rows : array of shape (M, P)
        The linear problem; columns of zeros belong to unknowns that do not change.
    right : array of shape (M,)
        Its right-hand side.
    bounds : tuple of two arrays of shape (P,)
        Smallest and largest step.
    region : TrustRegion
        Damping and largest length.

    Returns
    -------
    DampedStep

    """
    norm = column_norms(rows)
    z = _bounded_step(rows / norm, right, (bounds[0] * norm, bounds[1] * norm), region)
    step = z / norm
    fall = float(right @ right - np.sum((right - rows @ step) ** 2))
    return DampedStep(step, float(np.linalg.norm(z)), fall)


def _bounded_step(rows: Array, right: Array, bounds: tuple[Array, Array], region: TrustRegion) -> Array:
    """Damped step (P,) of normalised columns: unknowns that would leave their bounds stay there, the others go on."""
    # The damping is that of the unknowns that move. An unknown at its bound would otherwise shorten the steps of all.
    (low, high), z, free = bounds, np.zeros(rows.shape[1]), np.ones(rows.shape[1], dtype=bool)
    damping = region.damping
    while np.any(free):
        u, size, vt = np.linalg.svd(rows[:, free], full_matrices=False)
        on_basis = size * (u.T @ (right - rows[:, ~free] @ z[~free]))
        left = replace(region, radius=float(np.sqrt(max(region.radius**2 - float(z[~free] @ z[~free]), 0.0))))
        damping = left.sufficient_damping(size**2, on_basis)
        z[free] = (on_basis / (size**2 + damping)) @ vt
        outside = (z < low) | (z > high)
        if not np.any(outside):
            break
        z, free = np.clip(z, low, high), free & ~outside
    gradient = rows.T @ (right - rows @ z) - damping * z
    if np.any(~free & np.where(z <= low, gradient > 0, gradient < 0)):  # one of them should move again
        damped = np.vstack([rows, np.sqrt(damping) * np.eye(len(z))])
        z = lsq_linear(damped, np.concatenate([right, np.zeros(len(z))]), bounds=bounds, method="bvls").x
    return z
