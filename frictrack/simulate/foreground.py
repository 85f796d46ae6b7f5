"""What lies between the block and the camera: a rod across the course, and a highlight on the window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from frictrack.errors import gather
from frictrack.records import Array


@dataclass(frozen=True)
class Rod:
    """An upright rod in front of the course, sharp to the part of a pixel; it shakes with the scene.

    What an edge of the rod leaves free of a pixel shows that pixel's mean light: of the two columns that the
    edges cut, the texture within a pixel is not resolved.
    """

    x: float  # px, its axis
    width: float = 14.0  # px
    reflectance: float = 0.06

    def __post_init__(self) -> None:
        faults = [] if self.width > 0 else [f"expected a width above 0 px but got {self.width:g} px"]
        if not self.reflectance >= 0:
            faults.append(f"expected a reflectance of at least 0 but got {self.reflectance:g}")
        gather(faults, "rod")

    def cover(self, x_edges: Array) -> Array:
        """Share of each pixel that it hides between the borders x_edges (..., n + 1): (..., n)."""
        return np.diff(np.clip(x_edges - self.x, -self.width / 2, self.width / 2))


@dataclass(frozen=True)
class Highlight:
    """Light of the lamp, reflected by a window, added to whatever is there; fixed in the picture.

    A Gaussian: amplitude (1 = white) at x, y (px), `radius` px its standard deviation.
    """

    x: float
    y: float
    radius: float = 14.0
    amplitude: float = 0.25

    def __post_init__(self) -> None:
        faults = [] if self.radius > 0 else [f"expected a radius above 0 px but got {self.radius:g} px"]
        if not self.amplitude >= 0:
            faults.append(f"expected an amplitude of at least 0 but got {self.amplitude:g}")
        gather(faults, "highlight")

    def light(self, x_edges: Array, y_edges: Array) -> Array:
        """Added light of each pixel between the borders (nx + 1,), (ny + 1,): (ny, nx), averaged over the pixel."""
        along_x, along_y = (self._part(x_edges - self.x), self._part(y_edges - self.y))
        return self.amplitude * np.outer(along_y, along_x)

    def _part(self, edges: Array) -> Array:
        """Integral of exp(-z^2 / 2 radius^2) from one border to the next."""
        return np.sqrt(np.pi / 2) * self.radius * np.diff(erf(edges / (np.sqrt(2) * self.radius)))
