"""An acceleration that is known beside the camera: what a sensor says, once it is on the camera's clock and scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frictrack.records import Array


@dataclass(frozen=True, eq=False)
class KnownAcceleration:
    """Acceleration `a` (n,) in m/s^2 at the frames, NaN where unknown, and its white noise `sigma` there.

    A value is the mean over one frame interval; the noise of neighbouring frames is taken as independent.
    """

    a: Array
    sigma: float | Array

    def rows(self, part: slice) -> KnownAcceleration:
        """The same at some of the frames."""
        sigma = self.sigma if np.ndim(self.sigma) == 0 else np.asarray(self.sigma)[part]
        return KnownAcceleration(self.a[part], sigma)
