"""An acceleration measured by a sensor, after conversion to the clock and scale of the camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frictrack.records import Array


@dataclass(frozen=True, eq=False)
class KnownAcceleration:
    """Acceleration at the frames, as a mean over one frame interval.

    Attributes
    ----------
    a
        Acceleration, m/s^2, (n,); NaN where unknown.
    sigma
        Standard deviation of its white noise, m/s^2, one number or (n,).

    Examples
    --------
    >>> import frictrack as ft
    >>> run = ft.samples.runs()[0]
    >>> known = ft.KnownAcceleration(run.motion.a, 5.0)
    >>> fused = ft.differentiate(ft.low_pass(run.displacement, acceleration=known))
    >>> bool(fused.sigma_a[75] < run.motion.sigma_a[75])
    True

    """

    a: Array
    sigma: float | Array

    def rows(self, part: slice) -> KnownAcceleration:
        """The same for a part of the frames."""
        sigma = self.sigma if np.ndim(self.sigma) == 0 else np.asarray(self.sigma)[part]
        return KnownAcceleration(self.a[part], sigma)
