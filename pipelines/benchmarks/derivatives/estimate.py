"""What every method returns, and what a method is."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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
