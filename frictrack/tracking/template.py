"""The template of a target: a band-limited picture, the weights of its pixels, and the products that both imply."""

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
    """Picture of the target as a sum of cosines (`cosine_basis`), with a weight for every pixel.

    The weight of a pixel is one over its variance about the picture. Noisier pixels count less, and background inside
    the
    rectangle hardly counts, because it changes as the target moves.

    Attributes
    ----------
    coefficients : array
        Cosine coefficients of the picture, DN.
    weight : array (h, w)
        Inverse variance of every pixel, 1/DN^2; 0 where it is not used.
    level : float
        Grey value subtracted from every picture before multiplication, to keep single precision, DN.
    bands : tuple of float
        Highest spatial frequencies along y and x, cycles/px.
    mask : array of bool (h, w) or None
        Pixels of the rectangle that belong to the target; None for all.

    """

    coefficients: Array
    weight: Array
    level: float  # DN that is taken off every picture before it is multiplied, for the sake of single precision
    bands: tuple[float, float] = (BAND_LIMIT, BAND_LIMIT)  # cycles/px along y and x, up to which it has waves
    mask: Mask | None = None  # pixels (h, w) of the rectangle that are the target's; None for all

    @property
    def shift_expansion(self) -> ShiftExpansion:
        """The expansion of sub-pixel shifts for this shape and band limit."""
        return shift_expansion((self.weight.shape[0], self.weight.shape[1]), self.bands)

    def widened(self, bands: tuple[float, float]) -> Template:
        """Extend the band of the template to shorter waves; the new coefficients are zero.

        Parameters
        ----------
        bands : tuple of float
            Highest spatial frequencies along y and x, cycles/px.

        Returns
        -------
        Template
            The same picture.

        """
        h, w = shift_expansion((self.weight.shape[0], self.weight.shape[1]), bands).n_coefficients
        coefficients = np.zeros((h, w))
        coefficients[: self.coefficients.shape[0], : self.coefficients.shape[1]] = self.coefficients
        return replace(self, coefficients=coefficients, bands=bands)

    @cached_property
    def basis_images(self) -> Array:
        """Pictures (k, h w) whose sums are the target at any shift and small rotation, and last a picture of ones."""
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
        """Weighted pictures (h w, k) that a frame is multiplied by, single precision; the frame is weighted first."""
        return np.ascontiguousarray((self.basis_images * np.sqrt(self.weight.ravel())).T, dtype=np.float32)

    @cached_property
    def gram(self) -> Array:
        """Weighted products of the pictures with each other (k, k)."""
        return np.asarray((self.basis_images * self.weight.ravel()) @ self.basis_images.T, dtype=np.float64)

    @property
    def n_pixels(self) -> int:
        """Number of pixels with a weight above zero."""
        return int(np.count_nonzero(self.weight))

    @cached_property
    def min_misfit(self) -> float:
        """Misfit below which a film counts as free of noise: the template's own error dominates there."""
        counts = self.weight > 0
        if not counts.any():
            return 0.0
        return MIN_MISFIT_SHARE * float(np.var(self.image[counts]) * np.mean(self.weight[counts]))

    @property
    def image(self) -> Array:
        """Picture (h, w) without shift, DN."""
        at_rest = self.shift_expansion.design(np.zeros((1, 2)))[0]
        k = at_rest.shape[1]
        return (at_rest @ self.basis_images[:k]).reshape(self.weight.shape) + self.level

    def design(self, shift: Array) -> Array:
        """Compute the weights of the basis images in the columns of the least-squares problem.

        Parameters
        ----------
        shift : array (n, 2)
            Shifts along x and y, px.

        Returns
        -------
        array (n, 5, k)
            Weights for gain, offset, shift along x, shift along y and rotation.

        """
        picture, d_dx, d_dy, rotation = self.shift_expansion.design(shift)
        n, k = picture.shape
        design = np.zeros((n, 5, len(self.basis_images)))
        design[:, 0, :k], design[:, 2, :k], design[:, 3, :k] = picture, d_dx, d_dy
        design[:, 1, -1] = 1.0
        design[:, 4, k:-1] = rotation
        return design

    def weighted(self, cuts: Patch) -> Patch:
        """Weight cut-outs: subtract the level and multiply by the root of the weights.

        Parameters
        ----------
        cuts : array (n, h, w)
            Grey values.

        Returns
        -------
        array (n, h w)
            In standard deviations of the pixel noise, single precision.

        """
        pixels = cuts.reshape(len(cuts), -1).astype(np.float32)
        pixels -= np.float32(self.level)
        pixels *= self.root_weight
        return pixels
