"""Gauss-Newton on the projected problem: bounded least squares gives the coefficients for any non-linear parameters.

A step needs only the Gram matrix of the model's rows. The friction levels are non-linear parameters here, with a
penalty about one.

References
----------
Golub, G. H. & Pereyra, V. (1973). SIAM J. Numer. Anal. 10, 413-432.
Kaufman, L. (1975). A variable projection method for solving separable nonlinear least squares problems. BIT 15,
49-57.

"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count

import numpy as np

from frictrack.evaluation_budget import COST_OF_MEMORY, EvaluationBudget
from frictrack.fit.parameters import LEVEL, direct_prior_equations, penalty_jacobian
from frictrack.fit.separable.bounded import RIDGE, bounded_coefficients, solve_positive
from frictrack.fit.separable.derivatives import RELATIVE_STEP, RowChange, RowEvaluator, Tangent
from frictrack.fit.separable.model import NO_INDICES, Indices, SeparableModel
from frictrack.records import Array, Mask

FIRST_DAMPING, MAX_DAMPING, MIN_DAMPING = 1e-6, 1e6, 1e-10
MIN_DAMPING_AFTER_FAILURE = 1e-3  # larger ones end in other minima: two of 1000 searches for ATM2 missed their optimum
COST_OF_EVALUATION = 0.1  # in a budget, where a simulation of all runs costs 1 (2 and 18 ms)
MAX_PROMISE_FACTOR = 3.0  # times the predicted fall: the most that the misfit may still fall


@dataclass(frozen=True, eq=False)
class SeparableSolution:
    """The solution for given non-linear values.

    Attributes
    ----------
    nonlinear_values : array of shape (P,)
        Parameter vector; linear entries are not used.
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
    versions : tuple of int
        Evaluation number of every group's rows.
    tangent : Tangent
        Response to the parameters that were refined last; of a solution that was not refined, to the friction levels.
    row_derivatives : dict
        Derivatives of the rows by the position of the non-linear parameter.

    """

    nonlinear_values: Array
    rows: Array
    gram: Array
    coefficients: Array
    unconstrained: Mask
    residual: Array  # (M,)
    misfit: float
    excluded: Mask
    versions: tuple[int, ...]
    tangent: Tangent
    row_derivatives: dict[int, list[RowChange]] = field(default_factory=dict)


class ProjectedProblem:
    """The projected problem of one data set (M,), with the scatter `tau` of the friction levels.

    Its evaluations count in `budget`; once that is spent, nothing is refined further.
    """

    _versions = count(1)

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
        self._evaluate = RowEvaluator(separable, self._min_step)
        self._loaded = np.array([c.loaded for c in separable.coefficients], dtype=bool)

    def for_data(self, data: Array) -> ProjectedProblem:
        """Return the same problem for other data (M,)."""
        out = copy(self)
        out.data = data
        return out

    def solved_again(self, state: SeparableSolution) -> SeparableSolution:
        """Return a solution of other data with the coefficients of these data."""
        return self._solution_of(
            state.nonlinear_values, state.rows, state.excluded, (state.versions, state.row_derivatives)
        )

    @cached_property
    def _no_tangent(self) -> Tangent:
        """The response to no parameter."""
        none, empty = np.zeros(0), np.zeros((0, self.separable.size))
        return Tangent(NO_INDICES, empty, none, NO_INDICES, None, none, none.astype(bool))

    def _prior_equations(self, tau: float) -> tuple[Array, Array]:
        """Rows (m, P) and targets (m,) of the penalties, in standard deviations, without priors of coefficients."""
        levels = np.zeros(len(self.low))
        levels[self.levels] = 1.0
        rows = penalty_jacobian(self.layout, tau)
        rows = rows[: len(rows) - len(self.layout.priors)]
        prior_rows, prior_targets = direct_prior_equations(self.layout, self.separable.free)
        return np.vstack([rows, prior_rows]), np.concatenate([rows @ levels, prior_targets])

    def empty_solution(self, nonlinear_values: Array) -> SeparableSolution:
        """Return a solution without any effect: all rows zero."""
        k = len(self.separable.coefficients)
        zero = np.zeros((k, self.separable.size))
        no_coefficient = np.zeros(k, dtype=bool)
        versions = (0,) * len(self.separable.groups)
        return SeparableSolution(
            nonlinear_values,
            zero,
            np.zeros((k, k)),
            np.zeros(k),
            no_coefficient,
            self.data,
            np.inf,
            ~no_coefficient,
            versions,
            self._no_tangent,
        )

    def without(self, state: SeparableSolution, coefficients: Indices) -> SeparableSolution:
        """Return a solution with some coefficients excluded and the others solved again."""
        excluded = state.excluded.copy()
        excluded[coefficients] = True
        return self._solution_of(state.nonlinear_values, state.rows, excluded, (state.versions, state.row_derivatives))

    def at(
        self,
        nonlinear_values: Array,
        known: SeparableSolution | None = None,
        groups: Iterable[int] | None = None,
        taking_part: Indices | None = None,
    ) -> SeparableSolution:
        """Evaluate the solution for given non-linear values.

        Parameters
        ----------
        nonlinear_values : array of shape (P,)
            Parameter vector.
        known : SeparableSolution, optional
            Solution whose rows are reused for all groups not in `groups`.
        groups : iterable of int, optional
            Groups to evaluate; default all.
        taking_part : array of int, optional
            Coefficients that take part from now on; default all of these groups.

        Returns
        -------
        SeparableSolution
            Coefficients, residual and misfit.

        """
        self.budget.spend(COST_OF_EVALUATION * (COST_OF_MEMORY if self.separable.layout.model.memory else 1.0))
        base = known or self.empty_solution(nonlinear_values)
        rows, excluded = base.rows.copy(), base.excluded.copy()
        row_derivatives, versions = dict(base.row_derivatives), list(base.versions)
        if self.levels:
            self._rescale_levels(base.nonlinear_values, nonlinear_values, rows, (row_derivatives, versions))
        chosen = list(range(len(self.separable.groups)) if groups is None else groups)
        for g in chosen:
            versions[g] = next(self._versions)
            excluded[self.separable.coefficients_of(g) if taking_part is None else taking_part] = False
            for i in self.separable.groups[g].nonlinear_slots:
                row_derivatives[i] = [c for c in row_derivatives.get(i, ()) if c.g != g]
        for i, change in self._evaluate(chosen, nonlinear_values, rows):
            row_derivatives[i].append(change)
        return self._solution_of(nonlinear_values, rows, excluded, (tuple(versions), row_derivatives))

    def _rescale_levels(
        self, old: Array, new: Array, rows: Array, kept: tuple[dict[int, list[RowChange]], list[int]]
    ) -> None:
        """Rescale rows and derivatives to new friction levels, and renew the versions of the groups that change."""
        separable, (row_derivatives, versions) = self.separable, kept
        factor = new[self.levels] / old[self.levels]
        if np.all(factor == 1.0):
            return
        factors = factor[separable.run_of_datum]
        rows[self._loaded] *= factors
        for i, own in row_derivatives.items():
            row_derivatives[i] = [change.rescaled(self._loaded, factors) for change in own]
        for g in range(len(separable.groups)):
            if self._loaded[separable.coefficients_of(g)].any():
                versions[g] = next(self._versions)

    def _solution_of(
        self,
        nonlinear_values: Array,
        rows: Array,
        excluded: Mask,
        kept: tuple[tuple[int, ...], dict[int, list[RowChange]]],
    ) -> SeparableSolution:
        """Solve the coefficients for given rows."""
        gram, right = rows @ rows.T, rows @ self.data
        if excluded.any():
            taking_part = ~excluded
            gram *= taking_part & taking_part[:, None]
            right *= taking_part
        c, unconstrained = bounded_coefficients(gram, right, self.separable.low, self.separable.high)
        residual = self.data - c @ rows
        misfit = float(residual @ residual)
        if len(self._prior_target):
            departure = self._prior_rows @ nonlinear_values - self._prior_target
            misfit += float(departure @ departure)
        state = SeparableSolution(
            nonlinear_values,
            rows,
            gram,
            c,
            unconstrained,
            residual,
            misfit,
            excluded,
            kept[0],
            self._no_tangent,
            kept[1],
        )
        return replace(state, tangent=self.tangent(state, ())) if self.levels else state

    def tangent(self, state: SeparableSolution, parameters: Sequence[int]) -> Tangent:
        """Compute the response of a solution to non-linear parameters.

        Parameters
        ----------
        state : SeparableSolution
            The solution.
        parameters : sequence of int
            Positions of the parameters in the layout, without friction levels. These are added at the end.

        Returns
        -------
        Tangent
            The response at constant coefficients.

        """
        positions = np.array([*parameters, *self.levels], dtype=int)
        own = state.nonlinear_values[positions]
        is_inside = (own > self.low[positions]) & (own < self.high[positions])
        slopes, per_datum, run = np.zeros((len(parameters), self.separable.size)), np.zeros(0), NO_INDICES
        c = np.append(state.coefficients, 0.0)  # the last one for columns without a coefficient
        for slope, i in zip(slopes, parameters, strict=True):
            for change in state.row_derivatives.get(i, ()):
                slope[change.cut] += c[change.at] @ change.rows
        if self.levels:
            run = self.separable.run_of_datum
            dry = state.coefficients[self._loaded] @ state.rows[self._loaded]
            per_datum = dry / state.nonlinear_values[self.levels][run]
        tangent = Tangent(positions, slopes, per_datum, run, None, np.zeros(0), is_inside)
        gradient = tangent.products(state.residual[None])[0]
        if not len(self._prior_target):
            return replace(tangent, gradient=gradient)
        prior_rows = self._prior_rows[:, positions]
        gradient -= prior_rows.T @ (self._prior_rows @ state.nonlinear_values - self._prior_target)
        return replace(tangent, gradient=gradient, precision=prior_rows.T @ prior_rows)

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

        Parameters
        ----------
        state : SeparableSolution
            Where to start.
        groups : iterable of int, optional
            Groups to refine; default all.
        steps : int
            Largest number of steps.
        enough : float
            Stop when a step is predicted to gain less than this share of the misfit.
        below : float
            Stop when the misfit is not expected to fall below this value.

        Returns
        -------
        SeparableSolution
            The refined solution.

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
        return replace(state, tangent=tangent)

    def _normal_matrix(self, state: SeparableSolution, tangent: Tangent) -> Array:
        """Normal matrix (R, R) of the parameters of a tangent, coefficients projected out."""
        normal, products, gram = tangent.normal, tangent.products(state.rows), state.gram
        if not state.unconstrained.all():
            products, gram = products[state.unconstrained], gram[np.ix_(state.unconstrained, state.unconstrained)]
        if not len(gram):
            return normal
        size = np.sqrt(gram.diagonal())
        unit = gram / (size * size[:, None])
        unit.flat[:: len(size) + 1] += RIDGE
        products /= size[:, None]
        return np.asarray(normal - products.T @ solve_positive(unit, products))

    def _step(self, state: SeparableSolution, tangent: Tangent, normal: Array, damping: float) -> tuple[Array, float]:
        """Damped step (R,) within the bounds, and the predicted fall of the misfit."""
        values = state.nonlinear_values[tangent.positions]
        low, high = self.low[tangent.positions] - values, self.high[tangent.positions] - values
        step, _ = bounded_coefficients(normal, tangent.gradient, low, high, damping=damping)
        return step, float(2 * tangent.gradient @ step - step @ normal @ step)
