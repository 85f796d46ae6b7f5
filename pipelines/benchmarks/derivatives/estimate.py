"""The types that every method shares: what it takes and what it returns."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

Array = NDArray[np.float64]


class Estimate(NamedTuple):
    """Displacement (m), velocity and acceleration of every frame, with deviations where the method states them."""

    x: Array
    v: Array
    a: Array
    sigma_x: Array | None = None
    sigma_v: Array | None = None
    sigma_a: Array | None = None


Method = Callable[[Array, Array], Estimate]  # of t and the measured displacement y


def lowest(cost: Callable[[float], float], low: float, high: float, steps: int = 40, near: float = 0.005) -> float:
    """Setting of least cost: on a logarithmic grid, then between its neighbours to a fraction `near`."""
    grid = np.geomspace(low, high, steps)
    best = int(np.argmin([cost(g) for g in grid]))
    around = np.log(grid[[max(best - 1, 0), min(best + 1, steps - 1)]])
    found = minimize_scalar(lambda u: cost(float(np.exp(u))), bounds=tuple(around), options={"xatol": near})
    return float(np.exp(found.x))
