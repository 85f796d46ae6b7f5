"""Gauss-Newton on the projected problem: bounded least squares gives the coefficients for any non-linear parameters.

The model along the measured motion is linear in its coefficients c, given its non-linear parameters p:

    data = sum over k of c_k (level of the run, if column k carries the load) column_k(p) + error

So c is solved for every p, and only p is searched (variable projection). A step needs only the Gram matrix of the
columns. The friction levels are non-linear parameters here, with a penalty about one.

Solve small quadratic problems within bounds, one at a time or for a population at once.

References
----------
Golub, G. H. & Pereyra, V. (1973). SIAM J. Numer. Anal. 10, 413-432.
Kaufman, L. (1975). A variable projection method for solving separable nonlinear least squares problems. BIT 15,
49-57.
Portugal, L. F., Judice, J. J. & Vicente, L. N. (1994). A comparison of block pivoting and interior-point algorithms.
Mathematics of Computation 63, 625-643.

"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dposv

from frictrack.fit.parameters import LEVEL
from frictrack.fit.penalties import direct_prior_equations, penalty_jacobian
from frictrack.fit.separable.model import Indices, SeparableModel
from frictrack.records import Array, Mask
from frictrack.search import COST_OF_MEMORY, EvaluationBudget

RIDGE = 1e-12  # relative; keeps nearly equal columns solvable
POPULATION_RIDGE = 1e-9  # the same for a population, whose members may be far from any solution
MAX_BLOCK_ROUNDS, MAX_ROUNDS = 6, 60  # rounds of pivoting: in blocks, and in all
PULL_PRECISION = 1e-12  # relative; a smaller pull does not release a coefficient from its bound
RELATIVE_STEP = 1e-6  # finite-difference step over the value, or over a thousandth of its range
FIRST_DAMPING, MAX_DAMPING, MIN_DAMPING = 1e-6, 1e6, 1e-10
MIN_DAMPING_AFTER_FAILURE = 1e-3  # larger ones end in other minima: two of 1000 searches for ATM2 missed their optimum
COST_OF_EVALUATION = 0.1  # in a budget, where a simulation of all runs costs 1 (2 and 18 ms)
MAX_PROMISE_FACTOR = 3.0  # times the predicted fall: the most that the misfit may still fall
NO_INDICES: Indices = np.zeros(0, dtype=int)


def bounded_coefficients(
    gram: Array, right: Array, low: Array, high: Array, *, damping: float = 0.0
) -> tuple[Array, Mask]:
    """Minimise c' G c - 2 c' u within bounds.

    Examples
    --------
    >>> c, free = bounded_coefficients(np.eye(2), np.array([1.0, -1.0]), np.zeros(2), np.full(2, 9.0))
    >>> c.round(6).tolist(), free.tolist()
    ([1.0, 0.0], [True, False])

    """
    size = np.sqrt(np.maximum(gram.diagonal(), 0.0))
    dead = size == 0
    size[dead] = 1.0
    unit = gram / (size * size[:, None])
    unit.flat[:: len(size) + 1] += RIDGE + damping + dead
    if not (low == high).any():
        c = solve_positive(unit, right / size) / size
        if not ((c < low) | (c > high)).any():
            return c, (c > low) & (c < high) & ~dead
    c = _pivoted(unit[None], right[None] / size, (low * size)[None], (high * size)[None])[0] / size
    c = np.clip(c, low, high)
    return c, (c > low) & (c < high) & ~dead


def bounded_population(gram: Array, right: Array, low: Array, high: Array) -> Array:
    """Minimise c' G c - 2 c' u within bounds (K,) for all G (Q, K, K) and u (Q, K) at once; gives c (Q, K)."""
    size = np.sqrt(np.einsum("qkk->qk", gram))
    size[size == 0] = 1.0
    unit = gram / size[:, :, None] / size[:, None, :] + POPULATION_RIDGE * np.eye(len(low))
    c = np.linalg.solve(unit, (right / size)[:, :, None])[:, :, 0] / size
    bad = np.flatnonzero(np.any((c < low) | (c > high), axis=1))
    if len(bad):
        c[bad] = _pivoted(unit[bad], right[bad] / size[bad], low * size[bad], high * size[bad]) / size[bad]
    return np.clip(c, low, high)


def _pivoted(unit: Array, right: Array, low: Array, high: Array) -> Array:
    """Block pivoting: set coefficients (Q, K) on their bounds and release them until none changes."""
    fixed = low == high
    value = np.where(fixed, low, 0.0)
    k, least_pull = np.arange(right.shape[1]), PULL_PRECISION * np.abs(right).max(initial=0.0)
    for number in range(MAX_ROUNDS):
        system = np.where(fixed[:, :, None] | fixed[:, None, :], 0.0, unit)
        system[:, k, k] = np.where(fixed, 1.0, unit[:, k, k])
        rest = np.where(fixed, value, right - np.einsum("qkj,qj->qk", unit, np.where(fixed, value, 0.0)))
        c = np.linalg.solve(system, rest[:, :, None])[:, :, 0]
        pull = right - np.einsum("qkj,qj->qk", unit, c)
        leaving = ~fixed & ((c < low) | (c > high))
        inward = ((c <= low) & (pull > least_pull)) | ((c >= high) & (pull < -least_pull))
        changed = leaving | (fixed & (low < high) & inward)
        if not changed.any():
            break
        if number >= MAX_BLOCK_ROUNDS:  # the first alone, which always ends (Murty 1974)
            changed &= np.cumsum(changed, axis=1) == 1
        value = np.where(leaving & changed, np.clip(c, low, high), value)
        fixed ^= changed
    return np.clip(c, low, high)


def solve_positive(matrix: Array, right: Array) -> Array:
    """Solve a small symmetric positive definite system; LAPACK is called directly, since checks take longer.

    Examples
    --------
    >>> solve_positive(np.array([[4.0, 0.0], [0.0, 2.0]]), np.array([2.0, 2.0])).round(6).tolist()
    [0.5, 1.0]

    """
    _, solution, info = dposv(matrix, right)
    return np.asarray(solution if info == 0 else np.linalg.solve(matrix, right))


@dataclass(frozen=True, eq=False)
class SeparableSolution:
    """The solution for given non-linear values.

    Attributes
    ----------
    nonlinear_values : array of shape (P,)
        Parameter vector; linear entries are not used.
    columns : dict of int to array of shape (1 + q, k, M)
        Columns of every evaluated group at level one, and their derivatives by its q non-linear parameters.
    rows : array of shape (K, M)
        Data per unit coefficient.
    gram : array of shape (K, K)
        Gram matrix of the rows; zero where coefficients are excluded.
    coefficients : array of shape (K,)
        Least-squares coefficients within their bounds.
    unconstrained : array of bool, shape (K,)
        Coefficients that are not at a bound.
    residual : array of shape (M,)
        Whitened residual.
    misfit : float
        Sum of squared residuals plus penalties.
    excluded : array of bool, shape (K,)
        Coefficients that take no part.

    """

    nonlinear_values: Array
    columns: dict[int, Array]
    rows: Array
    gram: Array
    coefficients: Array
    unconstrained: Mask
    residual: Array
    misfit: float
    excluded: Mask


@dataclass(frozen=True, eq=False)
class Tangent:
    """The response of a solution to d non-linear parameters and R friction levels, at constant coefficients.

    Attributes
    ----------
    positions : array of int, shape (d + R,)
        Positions of the parameters in the layout, the levels last.
    rows : array of shape (d + R, M)
        Change of the modelled data per unit of each.
    normal : array of shape (d + R, d + R)
        Inner products of the rows, with the precision of the penalties.
    gradient : array of shape (d + R,)
        Half the downward slope of the misfit.
    is_inside : array of bool, shape (d + R,)
        Which of them are inside their bounds.

    """

    positions: Indices
    rows: Array
    normal: Array
    gradient: Array
    is_inside: Mask


class ProjectedProblem:
    """The projected problem of one data set (M,), with the scatter `tau` of the friction levels.

    Its evaluations count in `budget`; once that is spent, nothing is refined further.
    """

    def __init__(
        self, separable: SeparableModel, data: Array, tau: float = 0.03, budget: EvaluationBudget | None = None
    ) -> None:
        self.separable, self.data, self.tau = separable, data, tau
        self.budget = budget or EvaluationBudget()
        self.layout = separable.layout
        self.levels = self.layout.levels
        self.low, self.high = self.layout.bounds
        effects = {e.name: e for e in self.layout.model.effects}
        is_phase = [
            s.effect != LEVEL and effects[s.effect].parameter(s.parameter).role == "phase" for s in self.layout.slots
        ]
        self.low[is_phase], self.high[is_phase] = -np.inf, np.inf  # phases are periodic
        self._prior_rows, self._prior_target = self._prior_equations(tau)
        width = self.high - self.low
        self._min_step = RELATIVE_STEP * np.where(np.isfinite(width), 1e-3 * width, 1.0)

    def for_data(self, data: Array) -> ProjectedProblem:
        """Return the same problem for other data (M,)."""
        out = copy(self)
        out.data = data
        return out

    def with_other_level(self, effect: str) -> ProjectedProblem:
        """Return the same problem in which an effect follows the friction levels, or does not follow them, if it did.

        Only the levels can be refined in it.
        """
        out, separable = copy(self), copy(self.separable)
        separable.loaded = separable.loaded ^ np.array([c.effect == effect for c in separable.coefficients])
        out.separable = separable
        return out

    def solved_again(self, state: SeparableSolution) -> SeparableSolution:
        """Return a solution of other data with the coefficients of these data."""
        return self._solved(state.nonlinear_values, state.columns, state.excluded)

    def without(self, state: SeparableSolution, coefficients: Indices) -> SeparableSolution:
        """Return a solution with some coefficients excluded and the others solved again."""
        excluded = state.excluded.copy()
        excluded[coefficients] = True
        return self._solved(state.nonlinear_values, state.columns, excluded)

    def _prior_equations(self, tau: float) -> tuple[Array, Array]:
        """Rows (m, P) and targets (m,) of the penalties, in standard deviations, without priors of coefficients."""
        levels = np.zeros(len(self.low))
        levels[self.levels] = 1.0
        rows = penalty_jacobian(self.layout, tau)
        rows = rows[: len(rows) - len(self.layout.priors)]
        prior_rows, prior_targets = direct_prior_equations(self.layout, self.separable.free)
        return np.vstack([rows, prior_rows]), np.concatenate([rows @ levels, prior_targets])

    def at(
        self,
        nonlinear_values: Array,
        known: SeparableSolution | None = None,
        groups: Iterable[int] | None = None,
        taking_part: Indices | None = None,
    ) -> SeparableSolution:
        """Evaluate the solution for given non-linear values."""
        chosen = [*range(len(self.separable.groups))] if groups is None else [*groups]
        if chosen:
            self.budget.spend(COST_OF_EVALUATION * (COST_OF_MEMORY if self.separable.layout.model.memory else 1.0))
        columns = {} if known is None else dict(known.columns)
        excluded = np.ones(len(self.separable.coefficients), bool) if known is None else known.excluded.copy()
        steps = np.maximum(RELATIVE_STEP * np.abs(nonlinear_values), self._min_step)
        for g in chosen:
            columns[g] = self.separable.columns(g, nonlinear_values, steps)
            excluded[self.separable.group_coefficients[g] if taking_part is None else taking_part] = False
        return self._solved(nonlinear_values, columns, excluded)

    def _solved(self, nonlinear_values: Array, columns: dict[int, Array], excluded: Mask) -> SeparableSolution:
        """Solve the coefficients for given columns."""
        separable, k = self.separable, len(excluded)
        rows = np.zeros((k + 1, separable.size))  # the last one for columns without a coefficient
        for g, own in columns.items():
            at = separable.at[g]
            rows[at if at.ndim == 1 else (at, np.arange(separable.size))] = own[0]
        rows = rows[:k]
        if self.levels:
            rows[separable.loaded] *= self._levels_of_data(nonlinear_values)
        gram, right = rows @ rows.T, rows @ self.data
        if excluded.any():
            taking_part = ~excluded
            gram *= taking_part & taking_part[:, None]
            right *= taking_part
        c, unconstrained = bounded_coefficients(gram, right, separable.low, separable.high)
        residual = self.data - c @ rows
        departure = self._prior_rows @ nonlinear_values - self._prior_target
        misfit = float(residual @ residual + departure @ departure)
        return SeparableSolution(nonlinear_values, columns, rows, gram, c, unconstrained, residual, misfit, excluded)

    def _levels_of_data(self, nonlinear_values: Array) -> Array:
        """The friction level of the run of every datum, (M,)."""
        return np.asarray(nonlinear_values[self.levels][self.separable.run_of_datum])

    def tangent(self, state: SeparableSolution, parameters: Sequence[int]) -> Tangent:
        """Compute the response of a solution to non-linear parameters, given by their positions, and to all levels."""
        separable, run, c = self.separable, self.separable.run_of_datum, state.coefficients
        positions = np.array([*parameters, *self.levels], dtype=int)
        rows = np.zeros((len(positions), separable.size))
        slopes = {
            g: self._slopes(state, g)
            for g in {g for i in parameters for g, *_ in separable.responses[i]} & set(state.columns)
        }
        for row, i in zip(rows, parameters, strict=False):
            for g, j, own in separable.responses[i]:
                if g in slopes:
                    row[:] += slopes[g][j] if own is None else np.where(run == own, slopes[g][j], 0.0)
        if self.levels:
            dry = c[separable.loaded] @ state.rows[separable.loaded] / self._levels_of_data(state.nonlinear_values)
            rows[len(parameters) + run, np.arange(separable.size)] = dry
        own, prior_rows = state.nonlinear_values[positions], self._prior_rows[:, positions]
        departure = self._prior_rows @ state.nonlinear_values - self._prior_target
        return Tangent(
            positions=positions,
            rows=rows,
            normal=rows @ rows.T + prior_rows.T @ prior_rows,
            gradient=rows @ state.residual - prior_rows.T @ departure,
            is_inside=(own > self.low[positions]) & (own < self.high[positions]),
        )

    def _slopes(self, state: SeparableSolution, g: int) -> Array:
        """Change of the modelled data per unit of the q parameters of a group, (q, M)."""
        columns, loaded = state.columns[g][1:], self.separable.loaded_columns(g)
        if self.levels and loaded.any():
            columns = columns * np.where(loaded[:, None], self._levels_of_data(state.nonlinear_values), 1.0)
        return self.separable.weighted(g, state.coefficients, columns)

    def refine(
        self,
        state: SeparableSolution,
        groups: Iterable[int] | None = None,
        *,
        steps: int = 24,
        enough: float = 1e-5,
        below: float = np.inf,
    ) -> SeparableSolution:
        """Refine the non-linear parameters of some groups and the friction levels by Levenberg-Marquardt.

        A solution stays as it is once the budget is spent.
        """
        chosen = sorted(set(range(len(self.separable.groups)) if groups is None else groups))
        parameters = sorted({i for g in chosen for i in self.separable.groups[g].nonlinear_slots})
        if self.budget.stops() or not (parameters or self.levels):
            return state
        changed_groups = [g for g in chosen if self.separable.groups[g].nonlinear_slots]
        tangent, damping = self.tangent(state, parameters), FIRST_DAMPING
        normal = self._normal_matrix(state, tangent)
        for _ in range(steps):
            step, predicted_fall = self._step(state, tangent, normal, damping)
            hopeless = state.misfit - MAX_PROMISE_FACTOR * predicted_fall > below
            if predicted_fall < enough * state.misfit or damping > MAX_DAMPING or hopeless:
                break
            nonlinear_values = state.nonlinear_values.copy()
            nonlinear_values[tangent.positions] += step
            trial = self.at(nonlinear_values, state, changed_groups, NO_INDICES)
            if trial.misfit < state.misfit:
                state, tangent, damping = trial, self.tangent(trial, parameters), max(0.1 * damping, MIN_DAMPING)
                normal = self._normal_matrix(state, tangent)
            else:
                damping = max(30 * damping, MIN_DAMPING_AFTER_FAILURE)
        return state

    def _normal_matrix(self, state: SeparableSolution, tangent: Tangent) -> Array:
        """Normal matrix (R, R) of the parameters of a tangent, coefficients projected out."""
        free = state.unconstrained
        gram, products = state.gram[np.ix_(free, free)], state.rows[free] @ tangent.rows.T
        size = np.sqrt(gram.diagonal())
        unit = gram / (size * size[:, None])
        unit.flat[:: len(size) + 1] += RIDGE
        products /= size[:, None]
        return np.asarray(tangent.normal - products.T @ solve_positive(unit, products)) if len(size) else tangent.normal

    def _step(self, state: SeparableSolution, tangent: Tangent, normal: Array, damping: float) -> tuple[Array, float]:
        """Damped step (R,) within the bounds, and the predicted fall of the misfit."""
        values = state.nonlinear_values[tangent.positions]
        low, high = self.low[tangent.positions] - values, self.high[tangent.positions] - values
        step, _ = bounded_coefficients(normal, tangent.gradient, low, high, damping=damping)
        return step, float(2 * tangent.gradient @ step - step @ normal @ step)
