"""What the target looks like: a band-limited picture, the noise of its pixels, and what both imply."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from frictrack.records import Array, Mask
from frictrack.tracking.match import Patch
from frictrack.tracking.waves import BAND, Shifts, shifts

NOISELESS = 5e-4  # of the picture's variance


@dataclass(frozen=True, eq=False)
class Template:
    """The target's picture as cosines (see `waves`) and the weight (h, w) of its pixels, 1 / DN^2.

    The weight is one over the variance of a pixel about the picture: light that scatters (shot noise) counts
    by its noise, and background that shows inside the rectangle, which changes as the target moves, hardly counts.
    """

    waves: Array
    weight: Array
    level: float  # DN that is taken off every picture before it is multiplied, for the sake of single precision
    bands: tuple[float, float] = (BAND, BAND)  # cycles/px along y and x, up to which it has waves
    belongs: Mask | None = None  # pixels (h, w) of the rectangle that are the target's; None for all

    @property
    def shifts(self) -> Shifts:
        """The expansion of the sub-pixel shifts of this shape."""
        return shifts((self.weight.shape[0], self.weight.shape[1]), self.bands)

    def widened(self, bands: tuple[float, float]) -> Template:
        """The same picture with room for shorter waves."""
        h, w = shifts((self.weight.shape[0], self.weight.shape[1]), bands).n_waves
        waves = np.zeros((h, w))
        waves[: self.waves.shape[0], : self.waves.shape[1]] = self.waves
        return replace(self, waves=waves, bands=bands)

    @cached_property
    def pictures(self) -> Array:
        """Pictures (k, h w) whose sums describe the target at any shift and turn, and one of ones."""
        ones = np.ones((1, *self.weight.shape))
        every = (self.shifts.pictures(self.waves), self.shifts.turned(self.waves), ones)
        return np.concatenate(every).reshape(-1, self.weight.size)

    @cached_property
    def root(self) -> Patch:
        """Square root of the weights (h w,), single precision."""
        return np.sqrt(self.weight.ravel()).astype(np.float32)

    @cached_property
    def filters(self) -> Patch:
        """What a frame is multiplied by (h w, k), single precision; the frame is weighted by `root` first."""
        return np.ascontiguousarray((self.pictures * np.sqrt(self.weight.ravel())).T, dtype=np.float32)

    @cached_property
    def gram(self) -> Array:
        """Weighted products of the pictures among each other (k, k)."""
        return np.asarray((self.pictures * self.weight.ravel()) @ self.pictures.T, dtype=np.float64)

    @property
    def n_pixels(self) -> int:
        """Pixels that count."""
        return int(np.count_nonzero(self.weight))

    @cached_property
    def least_misfit(self) -> float:
        """Misfit below which a film is as good as without noise: differences are then the template's own."""
        counts = self.weight > 0
        if not counts.any():
            return 0.0
        return NOISELESS * float(np.var(self.image[counts]) * np.mean(self.weight[counts]))

    @property
    def image(self) -> Array:
        """The picture (h, w) at rest, DN."""
        still = self.shifts.design(np.zeros((1, 2)))[0]
        k = still.shape[1]
        return (still @ self.pictures[:k]).reshape(self.weight.shape) + self.level

    def columns(self, shift: Array) -> Array:
        """Weights of the pictures in the columns gain, offset, p_x, p_y, turn: (n, 5, k), for shifts (n, 2)."""
        picture, along, across, turn = self.shifts.design(shift)
        n, k = picture.shape
        columns = np.zeros((n, 5, len(self.pictures)))
        columns[:, 0, :k], columns[:, 2, :k], columns[:, 3, :k] = picture, along, across
        columns[:, 1, -1] = 1.0
        columns[:, 4, k:-1] = turn
        return columns

    def weighted(self, cuts: Patch) -> Patch:
        """Frames' cut-outs (n, h, w) -> (n, h w), level off and noise made even, single precision."""
        pixels = cuts.reshape(len(cuts), -1).astype(np.float32)
        pixels -= np.float32(self.level)
        pixels *= self.root
        return pixels
