"""A picture without waves too short to be seen, and all its sub-pixel shifts as a few fixed pictures.

The target is a sum of cosines up to almost the Nyquist frequency of the sensor, or beyond: a sharp edge that no lens
blurs has shorter waves, which one frame cannot tell from longer ones, but many frames at many shifts can,

    T(u) = sum_kl C_kl cos(pi k (u_y + EDGE) / L_y) cos(pi l (u_x + EDGE) / L_x),

so that moving it by any fraction of a pixel is exact: no interpolation, no peak locking. The half-pixel
range of shifts p is expanded once in Chebyshev polynomials of p (Trefethen 2013, Approximation Theory and
Approximation Practice, ch. 3), T(u - p) = sum_ij P_i(p_x) P_j(p_y) B_ij(u). The pictures B_ij do not depend
on p: a film's frames are multiplied by them once, and everything after that is algebra of a few numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from frictrack.records import Array

REFLECTION_PX = 4.0  # px beyond the picture's border at which the cosines turn round
BAND_LIMIT = 0.48  # cycles/px; a wave of 0.5 may pass through zero at every pixel, unseen, and would have any slope
SUPER_RESOLUTION_BAND = (
    2.95  # the same along an axis on which frames show the target at every shift: a third of a pixel
)
MAX_SHIFT_PX = 0.6  # px, reach of the expansion: half a pixel and room for the last step
CHEBYSHEV_DEGREES = {
    BAND_LIMIT: 5,
    SUPER_RESOLUTION_BAND: 21,
}  # of the expansion; one more changes positions by less than 1 % of the noise
# Px up to which a search may step. Outside its range a Chebyshev series grows as the power of its degree (Trefethen
# 2013, ch. 8): of degree 21 it is worth nothing a tenth of a pixel further.
MAX_SEARCH_PX = {BAND_LIMIT: MAX_SHIFT_PX + 0.5, SUPER_RESOLUTION_BAND: MAX_SHIFT_PX + 0.05}
ROTATION_DEGREE = 2


@dataclass(frozen=True, eq=False)
class ShiftExpansion:
    """The expansion of all shifts for pictures of `shape` (h, w) with waves up to `bands` (y, x), cycles/px."""

    shape: tuple[int, int]
    bands: tuple[float, float] = (BAND_LIMIT, BAND_LIMIT)
    _x_by_dtype: dict[Any, list[Array]] = field(default_factory=dict)

    @property
    def degrees(self) -> tuple[int, int]:
        """Degrees of the expansion along y and x."""
        return CHEBYSHEV_DEGREES[self.bands[0]], CHEBYSHEV_DEGREES[self.bands[1]]

    @property
    def max_search_px(self) -> float:
        """Shift along x or y beyond which the expansion says nothing, px."""
        return min(MAX_SEARCH_PX[band] for band in self.bands)

    @cached_property
    def order(self) -> NDArray[np.int64]:
        """Degrees (i, j) along x and y of the pictures B_ij, (k, 2)."""
        return np.array([(i, j) for j, count in enumerate(self._x_counts) for i in range(count)])

    @property
    def _x_counts(self) -> list[int]:
        """For each degree j along y, how many degrees along x go with it: i / d_x + j / d_y <= 1."""
        d_y, d_x = self.degrees
        return [d_x * (d_y - j) // d_y + 1 for j in range(d_y + 1)]

    @cached_property
    def rotation_order(self) -> NDArray[np.int64]:
        """The same for the pictures of the rotation."""
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
        """The pictures B_ij (k, h, w) of the template with coefficients `coefficients`, in the precision of those."""
        h, w = self.shape
        found = []
        for x_rows, y_rows in zip(
            self._stacked_x(coefficients.dtype), self._y[0].astype(coefficients.dtype), strict=False
        ):
            strip = (y_rows @ coefficients) @ x_rows.T  # all degrees along x beside each other
            found.append(strip.reshape(h, -1, w).transpose(1, 0, 2))
        return np.concatenate(found)

    def adjoint(self, pictures: NDArray[Any]) -> NDArray[Any]:
        """Transpose of `basis_images`: (k, h, w) -> coefficients, for least squares."""
        h = self.shape[0]
        total, at = np.zeros(self.n_coefficients, pictures.dtype), 0
        for x_rows, y_rows in zip(self._stacked_x(pictures.dtype), self._y[0].astype(pictures.dtype), strict=False):
            count = len(x_rows) // self.shape[1]
            strip = pictures[at : at + count].transpose(1, 0, 2).reshape(h, -1)
            total += y_rows.T @ (strip @ x_rows)
            at += count
        return total

    def _stacked_x(self, dtype: Any) -> list[Array]:
        """For each degree j along y, the rows of x of all its partners i, one below the other."""
        if np.dtype(dtype) not in self._x_by_dtype:
            x = self._x[0].astype(dtype)
            self._x_by_dtype[np.dtype(dtype)] = [x[:count].reshape(-1, x.shape[2]) for count in self._x_counts]
        return self._x_by_dtype[np.dtype(dtype)]

    def rotation_images(self, coefficients: Array) -> Array:
        """Change per rad of rotation about the picture's centre, x toward y: (k', h, w)."""
        h, w = self.shape
        y, x = np.arange(h)[:, None] - (h - 1) / 2, np.arange(w) - (w - 1) / 2
        rows, slopes = self._y[0] @ coefficients, self._y[1] @ coefficients
        d_dx = (rows[j] @ self._x[1][i].T for i, j in self.rotation_order)
        y_rows = (slopes[j] @ self._x[0][i].T for i, j in self.rotation_order)
        return np.stack([x * dy - y * dx for dx, dy in zip(d_dx, y_rows, strict=True)])

    def design(self, shift: Array) -> tuple[Array, Array, Array, Array]:
        """Weights of the pictures for shifts (n, 2): T, dT/dp_x, dT/dp_y (n, k) and the rotation (n, k')."""
        (i, j), (ti, tj) = self.order.T, self.rotation_order.T
        y, x = (chebyshev.chebvander(shift[:, 1 - k] / MAX_SHIFT_PX, d) for k, d in enumerate(self.degrees))
        dx, dy = (np.asarray(z[:, :-1] @ _derivative(z.shape[1] - 1)) for z in (x, y))
        return x[:, i] * y[:, j], dx[:, i] * y[:, j], x[:, i] * dy[:, j], x[:, ti] * y[:, tj]


@lru_cache(maxsize=8)
def shift_expansion(shape: tuple[int, int], bands: tuple[float, float] = (BAND_LIMIT, BAND_LIMIT)) -> ShiftExpansion:
    """The expansion for pictures of this shape, made once."""
    return ShiftExpansion(shape, bands)


@lru_cache
def _derivative(degree: int) -> Array:
    return np.asarray(chebyshev.chebder(np.eye(degree + 1), axis=0) / MAX_SHIFT_PX, dtype=np.float64)


def _degree_pairs(max_total: int) -> NDArray[np.int64]:
    """Pairs whose sum is at most `max_total`."""
    return np.array([(i, j) for j in range(max_total + 1) for i in range(max_total + 1 - j)])


def _expand_cosines(n: int, band: float) -> tuple[Array, Array]:
    """Chebyshev coefficients (degree, n, waves) of cosines read at n pixels moved by p, and of their d/dp."""
    count = CHEBYSHEV_DEGREES[band] + 3
    nodes = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    solve = np.linalg.inv(chebyshev.chebvander(nodes, count - 1))
    length = n - 1 + 2 * REFLECTION_PX
    q = np.pi * np.arange(int(2 * band * length) + 1) / length
    phase = q * (np.arange(n)[:, None] + REFLECTION_PX - MAX_SHIFT_PX * nodes[:, None, None])
    both = np.cos(phase), q * np.sin(phase)
    cosines, slopes = (np.einsum("ij,jnk->ink", solve, values) for values in both)
    return cosines, slopes
