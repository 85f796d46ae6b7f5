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

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count

import numpy as np

from frictrack.fit.parameters import LEVEL, penalty_jacobian
from frictrack.fit.separable.bounded import RIDGE, bounded_coefficients, bounded_step, solve_positive
from frictrack.fit.separable.derivatives import RELATIVE_STEP, EvaluatedStack, RowChange
from frictrack.fit.separable.groups import NO_INDICES, Indices
from frictrack.fit.separable.model import SeparableModel
from frictrack.records import Array, Mask

FIRST_DAMPING, MAX_DAMPING, MIN_DAMPING = 1e-6, 1e6, 1e-10
MIN_DAMPING_AFTER_FAILURE = 1e-3  # larger ones end in other minima: two of 1000 searches for ATM2 missed their optimum
MAX_PROMISE_FACTOR = 3.0  # times the predicted fall: the most that the misfit may still fall


@dataclass(frozen=True, eq=False)
class LevelSlopes:
    """The response of a model to the friction levels of R runs.

    A datum belongs to one run, hence responds to one level only.

    Attributes
    ----------
    per_datum : array of shape (M,)
        Change of every modelled datum per unit of the level of its run.
    run : array of int, shape (M,)
        The run of every datum.
    precision : array of shape (R, R)
        Precision of the penalty on the levels.
    gradient : array of shape (R,)
        Half the downward slope of the misfit.

    """

    per_datum: Array
    run: Array
    precision: Array
    gradient: Array

    @cached_property
    def rows(self) -> Array:
        """Change of the modelled data per unit of every level, (R, M)."""
        out = np.zeros((len(self.gradient), len(self.run)))
        if len(out):
            out[self.run, np.arange(len(self.run))] = self.per_datum
        return out

    def products(self, others: Array) -> Array:
        """Multiply the responses to the levels with other data (K, M); gives (R, K)."""
        out = np.zeros((len(self.gradient), len(others)))
        for column, other in enumerate(others):
            out[:, column] = np.bincount(self.run, self.per_datum * other, len(self.gradient))
        return out

    @property
    def squares(self) -> Array:
        """Sum of squares of the response to every level, (R,)."""
        return self.products(self.per_datum[None])[:, 0]


@dataclass(frozen=True, eq=False)
class SeparableSolution:
    """The solution for given non-linear values.

    Attributes
    ----------
    nonlinear_values : array of shape (P,)
        Parameter vector; linear entries are not used.
    rows : array of shape (K, M)
        Data per unit coefficient.
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
    levels : LevelSlopes
        Response to the friction levels.
    row_derivatives : dict
        Derivatives of the rows by the position of the non-linear parameter.

    """

    nonlinear_values: Array
    rows: Array
    coefficients: Array
    unconstrained: Mask
    residual: Array  # (M,)
    misfit: float
    excluded: Mask
    versions: tuple[int, ...]
    levels: LevelSlopes
    row_derivatives: dict[int, list[RowChange]] = field(default_factory=dict)


class ProjectedProblem:
    """The projected problem of one data set (M,), with the scatter `tau` of the friction levels."""

    _versions = count(1)

    def __init__(self, separable: SeparableModel, data: Array, tau: float = 0.03) -> None:
        self.separable, self.data, self.tau = separable, data, tau
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
        self._loaded = np.array([c.loaded for c in separable.coefficients], dtype=bool)
        self._level_precision = self._prior_rows[:, self.levels].T @ self._prior_rows[:, self.levels]

    @cached_property
    def _no_levels(self) -> LevelSlopes | None:
        """The response of a model without friction levels; None if there are levels."""
        if self.levels:
            return None
        return self._level_slopes_of(np.zeros(self.separable.size), np.zeros(0))

    def _level_slopes_of(self, per_datum: Array, gradient: Array) -> LevelSlopes:
        return LevelSlopes(per_datum, self.separable.run_of_datum, self._level_precision, gradient)

    def _prior_equations(self, tau: float) -> tuple[Array, Array]:
        """Rows (m, P) and targets (m,) of the penalties, in standard deviations, without priors of coefficients."""
        levels = np.zeros(len(self.low))
        levels[self.levels] = 1.0
        rows = penalty_jacobian(self.layout, tau)
        rows = rows[: len(rows) - len(self.layout.priors)]
        priors = [q for q in self.layout.priors if q.slot in self.separable.free]
        prior_rows = np.zeros((len(priors), len(levels)))
        for row, q in zip(prior_rows, priors, strict=True):
            row[q.slot] = 1 / q.std
        return np.vstack([rows, prior_rows]), np.concatenate([rows @ levels, [q.mean / q.std for q in priors]])

    def empty_solution(self, nonlinear_values: Array) -> SeparableSolution:
        """Return a solution without any effect: all rows zero."""
        k = len(self.separable.coefficients)
        zero = np.zeros((k, self.separable.size))
        no_coefficient = np.zeros(k, dtype=bool)
        level_slopes = self._level_slopes_of(np.zeros(self.separable.size), np.zeros(len(self.levels)))
        versions = (0,) * len(self.separable.groups)
        return SeparableSolution(
            nonlinear_values,
            zero,
            np.zeros(k),
            no_coefficient,
            self.data,
            np.inf,
            ~no_coefficient,
            versions,
            level_slopes,
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
        base = known or self.empty_solution(nonlinear_values)
        rows, excluded = base.rows.copy(), base.excluded.copy()
        row_derivatives, versions = dict(base.row_derivatives), list(base.versions)
        if self.levels:
            self._rescale_levels(base.nonlinear_values, nonlinear_values, rows, (row_derivatives, versions))
        for g in range(len(self.separable.groups)) if groups is None else groups:
            self._evaluate(g, nonlinear_values, rows, row_derivatives)
            versions[g] = next(self._versions)
            excluded[self.separable.coefficients_of(g) if taking_part is None else taking_part] = False
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

    def _evaluate(
        self, g: int, nonlinear_values: Array, rows: Array, row_derivatives: dict[int, list[RowChange]]
    ) -> None:
        """Rows of one group and their derivatives, from one evaluation per stack."""
        separable = self.separable
        for i in separable.groups[g].nonlinear_slots:
            row_derivatives[i] = [c for c in row_derivatives.get(i, []) if c.g != g]
        for stack in separable.stacks_of(g):
            made = EvaluatedStack.of(separable, (g, stack), nonlinear_values, self._min_step)
            made.write_rows(rows)
            for i, change in made.changes():
                row_derivatives[i].append(change)

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
        departure = self._prior_rows @ nonlinear_values - self._prior_target
        misfit += float(departure @ departure)
        levels = self._no_levels or self._level_slopes(nonlinear_values, rows, c, (residual, departure))
        return SeparableSolution(
            nonlinear_values, rows, c, unconstrained, residual, misfit, excluded, kept[0], levels, kept[1]
        )

    def _level_slopes(self, nonlinear_values: Array, rows: Array, c: Array, left: tuple[Array, Array]) -> LevelSlopes:
        """Response to the levels; `left` is the residual and the deviation from the penalties' targets."""
        residual, departure = left
        level = nonlinear_values[self.levels][self.separable.run_of_datum]
        response = self._level_slopes_of(c[self._loaded] @ rows[self._loaded] / level, np.zeros(len(self.levels)))
        gradient = response.products(residual[None])[:, 0] - self._prior_rows[:, self.levels].T @ departure
        return replace(response, gradient=gradient)

    def refine(
        self,
        state: SeparableSolution,
        groups: Iterable[int] | None = None,
        *,
        steps: int = 12,
        enough: float = 1e-5,
        below: float = np.inf,
    ) -> SeparableSolution:
        """Refine the non-linear parameters of some groups and the friction levels by Levenberg-Marquardt.

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
        free = sorted({i for g in chosen for i in self.separable.groups[g].nonlinear_slots}) + self.levels
        changed_groups = [g for g in chosen if self.separable.groups[g].nonlinear_slots]
        damping = FIRST_DAMPING
        normal_equations = self._normal_equations(state, free) if free else None
        for _ in range(steps if free else 0):
            assert normal_equations is not None
            step, predicted_fall = self._step(state, normal_equations, free, damping)
            hopeless = state.misfit - MAX_PROMISE_FACTOR * predicted_fall > below
            if predicted_fall < enough * state.misfit or damping > MAX_DAMPING or hopeless:
                break
            nonlinear_values = state.nonlinear_values.copy()
            nonlinear_values[free] += step
            trial = self.at(nonlinear_values, state, changed_groups, NO_INDICES)
            if trial.misfit < state.misfit:
                state, normal_equations, damping = (
                    trial,
                    self._normal_equations(trial, free),
                    max(0.1 * damping, MIN_DAMPING),
                )
            else:
                damping = max(30 * damping, MIN_DAMPING_AFTER_FAILURE)
        return state

    def _normal_equations(self, state: SeparableSolution, free: list[int]) -> tuple[Array, Array]:
        """Normal matrix (d, d) and gradient (d,) of the free non-linear parameters, coefficients projected out."""
        n_own = len(free) - len(self.levels)
        slope, levels = self._slopes(state, free[:n_own]), state.levels
        normal, gradient = np.zeros((len(free), len(free))), np.zeros(len(free))
        normal[:n_own, :n_own], gradient[:n_own] = slope @ slope.T, slope @ state.residual
        rows = state.rows if state.unconstrained.all() else state.rows[state.unconstrained]
        products = rows @ slope.T
        if self.levels:
            mixed = levels.products(np.concatenate([slope, state.residual[None], rows]))
            normal[n_own:, :n_own], gradient[n_own:] = mixed[:, :n_own], mixed[:, n_own]
            normal[:n_own, n_own:], normal[n_own:, n_own:] = mixed[:, :n_own].T, np.diag(levels.squares)
            products = np.hstack([products, mixed[:, n_own + 1 :].T])
        if len(rows):
            gram = rows @ rows.T
            size = np.sqrt(gram.diagonal())
            unit = gram / (size * size[:, None])
            unit.flat[:: len(size) + 1] += RIDGE
            products /= size[:, None]
            normal -= products.T @ solve_positive(unit, products)
        if len(self._prior_target):
            prior_rows = self._prior_rows[:, free]
            normal += prior_rows.T @ prior_rows
            gradient = gradient - prior_rows.T @ (self._prior_rows @ state.nonlinear_values - self._prior_target)
        return normal, gradient

    def _slopes(self, state: SeparableSolution, free: list[int]) -> Array:
        """Change of the modelled data (d, M) per unit of the non-linear parameters of groups."""
        slope = np.zeros((len(free), self.separable.size))
        for row, i in zip(slope, free, strict=True):
            for change in state.row_derivatives.get(i, []):
                row[change.cut] += np.where(change.at >= 0, state.coefficients[change.at], 0.0) @ change.rows
        return slope

    def _step(
        self, state: SeparableSolution, normal_equations: tuple[Array, Array], free: list[int], damping: float
    ) -> tuple[Array, float]:
        """Damped step (d,) within the bounds, and the predicted fall of the misfit."""
        normal, gradient = normal_equations
        own = normal.diagonal()
        low, high = self.low[free] - state.nonlinear_values[free], self.high[free] - state.nonlinear_values[free]
        fixed_steps = ((low >= 0) & (gradient <= 0)) | ((high <= 0) & (gradient >= 0)) | (own <= 0)
        size = np.sqrt(np.where(own > 0, own, 1.0))
        unit = normal / (size * size[:, None])
        unit.flat[:: len(size) + 1] += damping + RIDGE
        step, beyond = np.clip(0.0, low, high), fixed_steps
        if not fixed_steps.any():
            step = solve_positive(unit, gradient / size) / size
            beyond = (step < low) | (step > high)
        if beyond.any():
            step = bounded_step(unit, gradient / size, (low * size, high * size), fixed_steps) / size
        return step, float(2 * gradient @ step - step @ normal @ step)
