"""Central differences: five points inside, six at the ends, exact for polynomials of fourth order throughout."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array

NODES = 6  # frames a stencil may take
REACH = 2  # frames that it looks to either side


def stencils(n: int, interval: float) -> tuple[NDArray[np.int64], Array]:
    """First frame (n,) and weights (3, n, NODES) of the stencils of order 0, 1, 2 of all frames."""
    frame = np.arange(n)
    start = np.clip(frame - REACH, 0, n - NODES)
    return start, _table()[:, frame - start] / interval ** np.arange(3.0)[:, None, None]


def derived(y: Array, interval: float) -> Array:
    """Derivatives of order 0, 1, 2 (3, n) of a series (n,)."""
    start, table = stencils(len(y), interval)
    out: Array = np.sum(table * y[start[:, None] + np.arange(NODES)], axis=-1)
    return out


def differences(y: Array, order: int) -> Array:
    """Derivative of an order of columns (n, ...), per frame."""
    start, table = stencils(len(y), 1.0)
    out: Array = np.einsum("nk,nk...->n...", table[order], y[start[:, None] + np.arange(NODES)])
    return out


@lru_cache(maxsize=1)
def _table() -> Array:
    """Weights (3, NODES, NODES) of the derivatives at every node."""
    return np.array([[_stencil(p, order) for p in range(NODES)] for order in range(3)])


def _stencil(place: int, order: int) -> Array:
    """Weights (NODES,) of the derivative at node `place`; five nodes where these lie symmetric about it."""
    m = NODES - 1 if place == REACH else NODES
    powers = np.vander(np.arange(m) - float(place), increasing=True).T
    wanted = np.array([1.0, 1.0, 2.0])[order] * (np.arange(m) == order)
    return np.pad(np.linalg.solve(powers, wanted), (0, NODES - m))
