"""What the target looks like: a band-limited picture, the noise of its pixels, and what both imply."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from frictrack.records import Array, Mask
from frictrack.tracking.correlation import Patch
from frictrack.tracking.cosine_basis import BAND_LIMIT, ShiftExpansion, shift_expansion

MIN_MISFIT_SHARE = 5e-4  # of the picture's variance


@dataclass(frozen=True, eq=False)
class Template:
    """The target's picture as cosines (see `cosine_basis`) and the weight (h, w) of its pixels, 1 / DN^2.

    The weight is one over the variance of a pixel about the picture: light that scatters (shot noise) counts
    by its noise, and background that shows inside the rectangle, which changes as the target moves, hardly counts.
    """

    coefficients: Array
    weight: Array
    level: float  # DN that is taken off every picture before it is multiplied, for the sake of single precision
    bands: tuple[float, float] = (BAND_LIMIT, BAND_LIMIT)  # cycles/px along y and x, up to which it has waves
    mask: Mask | None = None  # pixels (h, w) of the rectangle that are the target's; None for all

    @property
    def shift_expansion(self) -> ShiftExpansion:
        """The expansion of the sub-pixel shifts of this shape."""
        return shift_expansion((self.weight.shape[0], self.weight.shape[1]), self.bands)

    def widened(self, bands: tuple[float, float]) -> Template:
        """The same picture with room for shorter waves."""
        h, w = shift_expansion((self.weight.shape[0], self.weight.shape[1]), bands).n_coefficients
        coefficients = np.zeros((h, w))
        coefficients[: self.coefficients.shape[0], : self.coefficients.shape[1]] = self.coefficients
        return replace(self, coefficients=coefficients, bands=bands)

    @cached_property
    def basis_images(self) -> Array:
        """Pictures (k, h w) whose sums describe the target at any shift and turn, and one of ones."""
        ones = np.ones((1, *self.weight.shape))
        images = (
            self.shift_expansion.basis_images(self.coefficients),
            self.shift_expansion.rotation_images(self.coefficients),
            ones,
        )
        return np.concatenate(images).reshape(-1, self.weight.size)

    @cached_property
    def root_weight(self) -> Patch:
        """Square root of the weights (h w,), single precision."""
        return np.sqrt(self.weight.ravel()).astype(np.float32)

    @cached_property
    def filters(self) -> Patch:
        """What a frame is multiplied by (h w, k), single precision; the frame is weighted by `root_weight` first."""
        return np.ascontiguousarray((self.basis_images * np.sqrt(self.weight.ravel())).T, dtype=np.float32)

    @cached_property
    def gram(self) -> Array:
        """Weighted products of the pictures among each other (k, k)."""
        return np.asarray((self.basis_images * self.weight.ravel()) @ self.basis_images.T, dtype=np.float64)

    @property
    def n_pixels(self) -> int:
        """Pixels that count."""
        return int(np.count_nonzero(self.weight))

    @cached_property
    def min_misfit(self) -> float:
        """Misfit below which a film is as good as without noise: differences are then the template's own."""
        counts = self.weight > 0
        if not counts.any():
            return 0.0
        return MIN_MISFIT_SHARE * float(np.var(self.image[counts]) * np.mean(self.weight[counts]))

    @property
    def image(self) -> Array:
        """The picture (h, w) at rest, DN."""
        at_rest = self.shift_expansion.design(np.zeros((1, 2)))[0]
        k = at_rest.shape[1]
        return (at_rest @ self.basis_images[:k]).reshape(self.weight.shape) + self.level

    def design(self, shift: Array) -> Array:
        """Weights of the pictures in the columns gain, offset, p_x, p_y, turn: (n, 5, k), for shifts (n, 2)."""
        picture, d_dx, d_dy, rotation = self.shift_expansion.design(shift)
        n, k = picture.shape
        design = np.zeros((n, 5, len(self.basis_images)))
        design[:, 0, :k], design[:, 2, :k], design[:, 3, :k] = picture, d_dx, d_dy
        design[:, 1, -1] = 1.0
        design[:, 4, k:-1] = rotation
        return design

    def weighted(self, cuts: Patch) -> Patch:
        """Frames' cut-outs (n, h, w) -> (n, h w), level off and noise made even, single precision."""
        pixels = cuts.reshape(len(cuts), -1).astype(np.float32)
        pixels -= np.float32(self.level)
        pixels *= self.root_weight
        return pixels
