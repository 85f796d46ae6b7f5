"""Central differences: five points inside, six at the ends, exact for polynomials of fourth order throughout."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array

STENCIL_FRAMES = 6  # frames a stencil may take
STENCIL_REACH = 2  # frames that it looks to either side


def stencils(n: int, interval: float) -> tuple[NDArray[np.int64], Array]:
    """First frame (n,) and weights (3, n, STENCIL_FRAMES) of the stencils of order 0, 1, 2 of all frames."""
    frame = np.arange(n)
    start = np.clip(frame - STENCIL_REACH, 0, n - STENCIL_FRAMES)
    return start, _table()[:, frame - start] / interval ** np.arange(3.0)[:, None, None]


def stencil_derivatives(y: Array, interval: float) -> Array:
    """Derivatives of order 0, 1, 2 (3, n) of a series (n,)."""
    start, table = stencils(len(y), interval)
    out: Array = np.sum(table * y[start[:, None] + np.arange(STENCIL_FRAMES)], axis=-1)
    return out


def stencil_derivative(y: Array, order: int) -> Array:
    """Derivative of an order of columns (n, ...), per frame."""
    start, table = stencils(len(y), 1.0)
    out: Array = np.einsum("nk,nk...->n...", table[order], y[start[:, None] + np.arange(STENCIL_FRAMES)])
    return out


@lru_cache(maxsize=1)
def _table() -> Array:
    """Weights (3, STENCIL_FRAMES, STENCIL_FRAMES) of the derivatives at every node."""
    return np.array([[_stencil(p, order) for p in range(STENCIL_FRAMES)] for order in range(3)])


def _stencil(place: int, order: int) -> Array:
    """Weights (STENCIL_FRAMES,) of the derivative at node `place`; five nodes where these lie symmetric about it."""
    m = STENCIL_FRAMES - 1 if place == STENCIL_REACH else STENCIL_FRAMES
    powers = np.vander(np.arange(m) - float(place), increasing=True).T
    wanted = np.array([1.0, 1.0, 2.0])[order] * (np.arange(m) == order)
    return np.pad(np.linalg.solve(powers, wanted), (0, STENCIL_FRAMES - m))
