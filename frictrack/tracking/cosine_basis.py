"""Compute sub-pixel shifts of a band-limited picture exactly, as sums of a few fixed pictures.

The template is a sum of cosines up to almost the Nyquist frequency of the sensor, or beyond it. A sharp edge that no
lens blurs holds shorter waves; one frame cannot distinguish them from longer ones, but many frames at many shifts can:

    T(u) = sum_kl C_kl cos(pi k (u_y + REFLECTION_PX) / L_y) cos(pi l (u_x + REFLECTION_PX) / L_x),

so that a shift by a fraction of a pixel is exact: there is no interpolation bias and no peak locking. The half-pixel
range of shifts p is expanded once in Chebyshev polynomials of p, T(u - p) = sum_ij P_i(p_x) P_j(p_y) B_ij(u)
(Trefethen 2013, Approximation Theory and Approximation Practice, ch. 3). The pictures B_ij do not depend on p: the
frames of a film are multiplied by them once, and all further steps work on a few numbers per frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from frictrack.records import Array

REFLECTION_PX = 4.0  # beyond the border of the picture, where the cosines are reflected
BAND_LIMIT = 0.48  # cycles/px; a wave of 0.5 may be zero at every pixel, so that its slope is undetermined
# cycles/px, for axes along which frames show the target at every shift: a third of a pixel
SUPER_RESOLUTION_BAND = 2.95
MAX_SHIFT_PX = 0.6  # range of the expansion: half a pixel and a margin for the last step
# one more changes positions by less than 1 % of the noise
CHEBYSHEV_DEGREES = {BAND_LIMIT: 5, SUPER_RESOLUTION_BAND: 21}
# Outside its range a Chebyshev series grows as the power of its degree (Trefethen 2013, ch. 8): of degree 21 it is
# useless a tenth of a pixel further.
MAX_SEARCH_PX = {BAND_LIMIT: MAX_SHIFT_PX + 0.5, SUPER_RESOLUTION_BAND: MAX_SHIFT_PX + 0.05}
ROTATION_DEGREE = 2  # the rotation is small, so that a low degree is enough


@dataclass(frozen=True, eq=False)
class ShiftExpansion:
    """Chebyshev expansion of all sub-pixel shifts, for pictures of one shape and band limit.

    Parameters
    ----------
    shape : tuple of int
        Height and width of the picture, px.
    bands : tuple of float
        Highest spatial frequencies along y and x, cycles/px: `BAND_LIMIT` or `SUPER_RESOLUTION_BAND`.

    """

    shape: tuple[int, int]
    bands: tuple[float, float] = (BAND_LIMIT, BAND_LIMIT)
    _x_by_dtype: dict[Any, list[Array]] = field(default_factory=dict)

    @property
    def degrees(self) -> tuple[int, int]:
        """Degrees of the expansion along y and x."""
        return CHEBYSHEV_DEGREES[self.bands[0]], CHEBYSHEV_DEGREES[self.bands[1]]

    @property
    def max_search_px(self) -> float:
        """Shift along x or y beyond which the expansion is not valid, px."""
        return min(MAX_SEARCH_PX[band] for band in self.bands)

    @cached_property
    def order(self) -> NDArray[np.int64]:
        """Degrees (i, j) along x and y of the pictures B_ij, (k, 2)."""
        return np.array([(i, j) for j, count in enumerate(self._x_counts) for i in range(count)])

    @property
    def _x_counts(self) -> list[int]:
        """Number of degrees along x that go with each degree j along y: i / d_x + j / d_y <= 1."""
        d_y, d_x = self.degrees
        return [d_x * (d_y - j) // d_y + 1 for j in range(d_y + 1)]

    @cached_property
    def rotation_order(self) -> NDArray[np.int64]:
        """Degrees (i, j) along x and y of the pictures of the rotation, (k', 2)."""
        return _degree_pairs(ROTATION_DEGREE)

    @cached_property
    def _x(self) -> tuple[Array, Array]:
        return _expand_cosines(self.shape[1], self.bands[1])

    @cached_property
    def _y(self) -> tuple[Array, Array]:
        return _expand_cosines(self.shape[0], self.bands[0])

    @property
    def n_coefficients(self) -> tuple[int, int]:
        """Shape of the coefficients C of a picture."""
        return self._y[0].shape[2], self._x[0].shape[2]

    def basis_images(self, coefficients: NDArray[Any]) -> NDArray[Any]:
        """Compute the pictures B_ij of a template.

        Parameters
        ----------
        coefficients : array `n_coefficients`
            Cosine coefficients C, DN.

        Returns
        -------
        array (k, h, w)
            Pictures in the precision of the coefficients.

        """
        h, w = self.shape
        found = []
        for x_rows, y_rows in zip(
            self._stacked_x(coefficients.dtype), self._y[0].astype(coefficients.dtype), strict=False
        ):
            strip = (y_rows @ coefficients) @ x_rows.T  # all degrees along x beside each other
            found.append(strip.reshape(h, -1, w).transpose(1, 0, 2))
        return np.concatenate(found)

    def adjoint(self, pictures: NDArray[Any]) -> NDArray[Any]:
        """Apply the transpose of `basis_images`, for least squares.

        Parameters
        ----------
        pictures : array (k, h, w)
            One picture for each B_ij.

        Returns
        -------
        array `n_coefficients`
            Sums over all pixels and pictures.

        """
        h = self.shape[0]
        total, at = np.zeros(self.n_coefficients, pictures.dtype), 0
        for x_rows, y_rows in zip(self._stacked_x(pictures.dtype), self._y[0].astype(pictures.dtype), strict=False):
            count = len(x_rows) // self.shape[1]
            strip = pictures[at : at + count].transpose(1, 0, 2).reshape(h, -1)
            total += y_rows.T @ (strip @ x_rows)
            at += count
        return total

    def _stacked_x(self, dtype: Any) -> list[Array]:
        """Rows of x of all degrees i that go with each degree j along y, one below the other."""
        if np.dtype(dtype) not in self._x_by_dtype:
            x = self._x[0].astype(dtype)
            self._x_by_dtype[np.dtype(dtype)] = [x[:count].reshape(-1, x.shape[2]) for count in self._x_counts]
        return self._x_by_dtype[np.dtype(dtype)]

    def rotation_images(self, coefficients: Array) -> Array:
        """Compute the change of a template per rad of rotation about its centre, x toward y.

        Parameters
        ----------
        coefficients : array `n_coefficients`
            Cosine coefficients C, DN.

        Returns
        -------
        array (k', h, w)
            Pictures for the degrees in `rotation_order`, DN/rad.

        """
        h, w = self.shape
        y, x = np.arange(h)[:, None] - (h - 1) / 2, np.arange(w) - (w - 1) / 2
        rows, slopes = self._y[0] @ coefficients, self._y[1] @ coefficients
        d_dx = (rows[j] @ self._x[1][i].T for i, j in self.rotation_order)
        y_rows = (slopes[j] @ self._x[0][i].T for i, j in self.rotation_order)
        return np.stack([x * dy - y * dx for dx, dy in zip(d_dx, y_rows, strict=True)])

    def design(self, shift: Array) -> tuple[Array, Array, Array, Array]:
        """Compute the weights of the pictures for given shifts.

        Parameters
        ----------
        shift : array (n, 2)
            Shifts along x and y, px.

        Returns
        -------
        value, d_dx, d_dy : array (n, k)
            Weights of the pictures B_ij for T and for its derivatives with respect to the shift.
        rotation : array (n, k')
            Weights of the pictures of the rotation.

        """
        (i, j), (ti, tj) = self.order.T, self.rotation_order.T
        y, x = (chebyshev.chebvander(shift[:, 1 - k] / MAX_SHIFT_PX, d) for k, d in enumerate(self.degrees))
        dx, dy = (np.asarray(z[:, :-1] @ _derivative(z.shape[1] - 1)) for z in (x, y))
        return x[:, i] * y[:, j], dx[:, i] * y[:, j], x[:, i] * dy[:, j], x[:, ti] * y[:, tj]


@lru_cache(maxsize=8)
def shift_expansion(shape: tuple[int, int], bands: tuple[float, float] = (BAND_LIMIT, BAND_LIMIT)) -> ShiftExpansion:
    """Return the expansion for pictures of this shape and band limit; it is computed once.

    Parameters
    ----------
    shape : tuple of int
        Height and width, px.
    bands : tuple of float
        Highest spatial frequencies along y and x, cycles/px.

    Returns
    -------
    ShiftExpansion
        Shared by all callers.

    Examples
    --------
    >>> shift_expansion((24, 40)).n_coefficients
    (30, 46)

    """
    return ShiftExpansion(shape, bands)


@lru_cache
def _derivative(degree: int) -> Array:
    """Matrix from Chebyshev coefficients of one degree to those of the derivative with respect to the shift, 1/px."""
    return np.asarray(chebyshev.chebder(np.eye(degree + 1), axis=0) / MAX_SHIFT_PX, dtype=np.float64)


def _degree_pairs(max_total: int) -> NDArray[np.int64]:
    """Pairs of degrees whose sum is at most `max_total`."""
    return np.array([(i, j) for j in range(max_total + 1) for i in range(max_total + 1 - j)])


def _expand_cosines(n: int, band: float) -> tuple[Array, Array]:
    """Chebyshev coefficients (degree, n, waves) of cosines at n pixels shifted by p, and of their derivatives."""
    count = CHEBYSHEV_DEGREES[band] + 3
    nodes = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    solve = np.linalg.inv(chebyshev.chebvander(nodes, count - 1))
    length = n - 1 + 2 * REFLECTION_PX
    q = np.pi * np.arange(int(2 * band * length) + 1) / length
    phase = q * (np.arange(n)[:, None] + REFLECTION_PX - MAX_SHIFT_PX * nodes[:, None, None])
    both = np.cos(phase), q * np.sin(phase)
    cosines, slopes = (np.einsum("ij,jnk->ink", solve, values) for values in both)
    return cosines, slopes
