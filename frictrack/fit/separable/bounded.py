"""Solve small quadratic problems within bounds, one at a time or for a population at once.

References
----------
Portugal, L. F., Judice, J. J. & Vicente, L. N. (1994). A comparison of block pivoting and interior-point algorithms.
Mathematics of Computation 63, 625-643.

"""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dposv

from frictrack.records import Array, Mask

RIDGE = 1e-12  # relative; keeps nearly equal columns solvable
POPULATION_RIDGE = 1e-9  # the same for a population, whose members may be far from any solution
MAX_BLOCK_ROUNDS, MAX_ROUNDS = 6, 60  # rounds of pivoting: in blocks, and in all
PULL_PRECISION = 1e-12  # relative; a smaller pull does not release a coefficient from its bound


def bounded_coefficients(
    gram: Array, right: Array, low: Array, high: Array, *, damping: float = 0.0
) -> tuple[Array, Mask]:
    """Minimise c' G c - 2 c' u within bounds.

    Parameters
    ----------
    gram : array of shape (K, K)
        G.
    right : array of shape (K,)
        u.
    low, high : array of shape (K,)
        Bounds; equal bounds fix a coefficient.
    damping : float
        Share of the diagonal of G that is added to it.

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
