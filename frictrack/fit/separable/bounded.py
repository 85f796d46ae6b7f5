"""Solve small systems: positive definite ones, and least squares and Gauss-Newton steps within bounds."""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dposv
from scipy.optimize import lsq_linear

from frictrack.records import Array, Mask

RIDGE = 1e-12  # relative; keeps nearly equal columns solvable


def bounded_coefficients(gram: Array, right: Array, low: Array, high: Array) -> tuple[Array, Mask]:
    """Minimise c' G c - 2 c' u within bounds.

    Parameters
    ----------
    gram : array of shape (K, K)
        G.
    right : array of shape (K,)
        u.
    low, high : array of shape (K,)
        Bounds; equal bounds fix a coefficient.

    Returns
    -------
    coefficients : array of shape (K,)
        The minimum.
    unconstrained : array of bool, shape (K,)
        Coefficients that are not at a bound.

    Examples
    --------
    >>> c, free = bounded_coefficients(np.eye(2), np.array([1.0, -1.0]), np.zeros(2), np.full(2, 9.0))
    >>> c.round(6).tolist(), free.tolist()
    ([1.0, 0.0], [True, False])

    """
    size = np.sqrt(gram.diagonal())
    dead = size == 0
    size[dead] = 1.0
    unit = gram / (size * size[:, None])
    unit.flat[:: len(size) + 1] += RIDGE + dead
    if not (low == high).any():
        c = solve_positive(unit, right / size) / size
        if not ((c < low) | (c > high)).any():
            return c, (c > low) & (c < high) & ~dead
    c = _bounded_solution((unit, size), gram, right, (low, high))
    return c, (c > low) & (c < high) & ~dead


def _bounded_solution(scaled: tuple[Array, Array], gram: Array, right: Array, box: tuple[Array, Array]) -> Array:
    """The minimum within bounds; `scaled` are the Gram matrix of unit diagonal and the sizes of the rows."""
    (unit, size), (low, high) = scaled, box
    fixed = low == high
    free = ~fixed
    c = np.where(fixed, low, 0.0)
    root = np.linalg.cholesky(unit[np.ix_(free, free)]).T
    target = np.linalg.solve(root.T, (right[free] - gram[np.ix_(free, fixed)] @ low[fixed]) / size[free])
    limits = low[free] * size[free], high[free] * size[free]
    c[free] = np.clip(lsq_linear(root, target, limits, method="bvls").x / size[free], low[free], high[free])
    return c


def solve_positive(matrix: Array, right: Array) -> Array:
    """Solve a small symmetric positive definite system; LAPACK is called directly, since checks take longer.

    Examples
    --------
    >>> solve_positive(np.array([[4.0, 0.0], [0.0, 2.0]]), np.array([2.0, 2.0])).round(6).tolist()
    [0.5, 1.0]

    """
    _, solution, info = dposv(matrix, right)
    return np.asarray(solution if info == 0 else np.linalg.solve(matrix, right))


def bounded_step(unit: Array, gradient: Array, bounds: tuple[Array, Array], fixed_steps: Mask) -> Array:
    """The step of scaled equations: the first parameter to leave its bounds is set there, the others solved again."""
    low, high = bounds
    fixed_steps, step = fixed_steps.copy(), np.clip(0.0, low, high)
    while not fixed_steps.all():
        movable = ~fixed_steps
        target = gradient[movable] - unit[np.ix_(movable, fixed_steps)] @ step[fixed_steps]
        step[movable] = solve_positive(unit[np.ix_(movable, movable)], target)
        outside = movable & ((step < low) | (step > high))
        if not outside.any():
            break
        side = np.where(step < low, low, high)
        first = int(np.argmin(np.where(outside, side / np.where(outside, step, 1.0), np.inf)))
        step[first], fixed_steps[first] = side[first], True
    return step
