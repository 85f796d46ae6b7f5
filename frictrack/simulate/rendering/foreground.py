"""The model of what lies between the block and the camera: a rod across the course, a highlight on the window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from frictrack.base.errors import raise_faults
from frictrack.records import Array


@dataclass(frozen=True)
class Rod:
    """Upright rod in front of the course, with sub-pixel edges; it shakes with the scene.

    In the two columns that its edges cut, the free part of a pixel shows the mean light of that pixel.

    Attributes
    ----------
    x, width
        Place of the axis and width, px.
    reflectance
        Light of the rod; 1 is white.

    """

    x: float
    width: float = 14.0
    reflectance: float = 0.06

    def __post_init__(self) -> None:
        faults = [] if self.width > 0 else [f"expected a width above 0 px but got {self.width:g} px"]
        if not self.reflectance >= 0:
            faults.append(f"expected a reflectance of at least 0 but got {self.reflectance:g}")
        raise_faults(faults, "rod")

    def cover(self, x_edges: Array) -> Array:
        """Share of each pixel that the rod hides, (..., n), for pixel borders x_edges (..., n + 1)."""
        return np.diff(np.clip(x_edges - self.x, -self.width / 2, self.width / 2))


@dataclass(frozen=True)
class Highlight:
    """Reflection of the lamp in a window, added to the picture and fixed in it: a Gaussian.

    Attributes
    ----------
    x, y
        Centre, px.
    radius
        Standard deviation, px.
    amplitude
        Light at the centre; 1 is white.

    """

    x: float
    y: float
    radius: float = 14.0
    amplitude: float = 0.25

    def __post_init__(self) -> None:
        faults = [] if self.radius > 0 else [f"expected a radius above 0 px but got {self.radius:g} px"]
        if not self.amplitude >= 0:
            faults.append(f"expected an amplitude of at least 0 but got {self.amplitude:g}")
        raise_faults(faults, "highlight")

    def light(self, x_edges: Array, y_edges: Array) -> Array:
        """Added light (ny, nx), averaged over each pixel, for pixel borders x_edges (nx + 1,) and y_edges (ny + 1,)."""
        profile_x, profile_y = (self._profile(x_edges - self.x), self._profile(y_edges - self.y))
        return self.amplitude * np.outer(profile_y, profile_x)

    def _profile(self, edges: Array) -> Array:
        """Integral of exp(-z^2 / (2 radius^2)) from one border to the next."""
        return np.sqrt(np.pi / 2) * self.radius * np.diff(erf(edges / (np.sqrt(2) * self.radius)))
