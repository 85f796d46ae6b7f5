"""What a film teaches of its target: the template with the weights of its pixels, and what stands still before it.

Estimate what stands still between target and film: flat-field errors, dirt, highlights, obstacles, uneven light.

Each pixel of the sensor sees many parts of the target as it passes. Its reading is a line in what it should read,

    (I - b) / a = g M + o        M: template there and then, a and b: gain and offset of the frame

The slope g and the level o are fitted by least squares over the frames that cover the pixel: g = 1.01 is a pixel one
percent too sensitive, o a highlight, g = 0 an obstacle. Both are shrunk toward g = 1, o = 0 by the part that noise
makes of them (James & Stein 1961, Proc. 4th Berkeley Symp. 1:361; each pixel has its own prior where it is far off).

Compute sub-pixel shifts of a band-limited picture exactly, as sums of a few fixed pictures.

The template is a sum of cosines up to almost the Nyquist frequency of the sensor, or beyond it. A sharp edge that no
lens blurs holds shorter waves; one frame cannot distinguish them from longer ones, but many frames at many shifts can:

    T(u) = sum_kl C_kl cos(pi k (u_y + REFLECTION_PX) / L_y) cos(pi l (u_x + REFLECTION_PX) / L_x),

so that a shift by a fraction of a pixel is exact: there is no interpolation bias and no peak locking. The half-pixel
range of shifts p is expanded once in Chebyshev polynomials of p, T(u - p) = sum_ij P_i(p_x) P_j(p_y) B_ij(u)
(Trefethen 2013, Approximation Theory and Approximation Practice, ch. 3). The pictures B_ij do not depend on p: the
frames of a film are multiplied by them once, and all further steps work on a few numbers per frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from frictrack.records import Array, Mask
from frictrack.tracking.correlation import Patch

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


MIN_FRAMES = 4  # that must cover a pixel
MIN_VARIANCE_SHARE = 0.1  # of the picture's variance, that must have passed a pixel to separate it from the target
MIN_NOISE_SHARE = 0.01  # of the noise variance; a weaker pattern costs half a percent of accuracy
OUTLIER_CHI2 = 36.0  # of a single pixel
MIN_OUTLIER_SHARE = 0.002  # of the pixels
MAX_RESIDUAL_RATIO = 4.0  # variance about the line over the noise; more is not a fixed pattern
MIN_SLOPE = 0.3  # below it a pixel does not show the target
FULL_WEIGHT_SHARE = 0.7  # squared slope from which a pixel keeps its full weight
MIN_SCATTER_EXCESS = 0.15  # over the expected scatter
CHI2_1_MEDIAN, CHI2_2_MEDIAN = 0.455, 1.386  # median of chi^2 with one and two degrees of freedom
MIN_MISFIT_SHARE = 5e-4  # of the picture's variance


@dataclass(frozen=True, eq=False)
class FixedPattern:
    """Response of every pixel of the picture.

    Attributes
    ----------
    slope : array (H, W)
        Relative sensitivity.
    level : array (H, W)
        Additive light at the film's typical light, DN.
    share : array (H, W)
        Share of its weight that the pixel keeps; 0 behind an obstacle.

    """

    slope: Patch
    level: Patch
    share: Patch

    def corrected(self, cuts: Patch, corner: NDArray[np.int64], gain: Array, offset: Array) -> tuple[Patch, Patch]:
        """Correct cut-outs for the fixed pattern.

        Parameters
        ----------
        cuts : array (n, h, w)
            Grey values.
        corner : array of int (n, 2)
            Corners of the cut-outs, px.
        gain, offset : array (n,)
            Light of the frames.

        Returns
        -------
        cuts, share : array (n, h, w)
            Grey values without the pattern, and the share of its weight that each pixel keeps.

        """
        size = cuts.shape[1:]
        slope, level = (_cut(m, corner, size) for m in (self.slope, self.level))
        a, b = (v[:, None, None].astype(np.float32) for v in (gain, offset))
        return b + (cuts - b - a * level) / slope, self.pixel_shares(corner, size)

    def pixel_shares(self, corner: NDArray[np.int64], size: tuple[int, ...]) -> Patch:
        """Cut the share of the weights out at corners (n, 2): (n, h, w)."""
        return _cut(self.share, corner, size)


def _cut(picture: Patch, corner: NDArray[np.int64], size: tuple[int, ...]) -> Patch:
    h, w = size
    return np.stack([picture[y : y + h, x : x + w] for x, y in corner])


def pattern_sums(
    shape: tuple[int, int], corner: NDArray[np.int64], model: Patch, difference: Patch, inside: Array
) -> Array:
    """Sum over frames for every pixel of the picture: n, M, d, M^2, d M, d^2.

    Parameters
    ----------
    shape : tuple of int
        Height and width of the picture, px.
    corner : array of int (n, 2)
        Corners of the cut-outs, px.
    model, difference : array (n, h, w)
        What the frames should show and how they differ from it, at the same light, DN.
    inside : array (h, w)
        1 for pixels that show the target, 0 for others.

    Returns
    -------
    array (6, H, W)
        The sums.

    """
    h, w = model.shape[1:]
    total, shown = np.zeros((6, *shape), np.float32), inside.astype(np.float32)
    for (x, y), m, d in zip(corner.tolist(), model * shown, difference * shown, strict=True):
        total[:, y : y + h, x : x + w] += (shown, m, d, m * m, d * m, d * d)
    return total.astype(np.float64)


def fit_pattern(sums: Array, noise: float) -> FixedPattern | None:
    """Fit the fixed pattern to sums over frames.

    Parameters
    ----------
    sums : array (6, H, W)
        Sums over all frames (`pattern_sums`).
    noise : float
        Variance of a pixel, DN^2.

    Returns
    -------
    FixedPattern or None
        None where nothing significant stands still.

    """
    n, m, d, mm, dm, dd = sums
    covered, n = n >= MIN_FRAMES, np.maximum(n, 1)
    if not covered.any():
        return None
    mean, level = m / n, d / n
    scatter = np.maximum(mm / n - mean**2, 1e-6)
    covered &= scatter > MIN_VARIANCE_SHARE * float(np.median((mm / n)[covered]))
    if not covered.any():
        return None
    slope = (dm / n - mean * level) / scatter
    residual = np.maximum(dd / n - level**2 - slope**2 * scatter, 0.0)
    # A moving object, such as a hand, scatters more about the line than noise and is no fixed pattern.
    covered &= residual * n < MAX_RESIDUAL_RATIO * noise * np.maximum(n - 2, 1)  # the line has taken two of the n terms
    seen = (q[covered] for q in (level, slope**2 * scatter, noise / n, n))
    if not covered.any() or not _is_significant(*seen):
        return None
    level = _shrink(level, noise / n, covered)
    slope = 1 + _shrink(slope, noise / (n * scatter), covered)
    blind = (slope < MIN_SLOPE) & covered
    share = np.where(blind, 0.0, np.where(slope**2 < FULL_WEIGHT_SHARE, slope**2, 1.0))
    slope = np.where(blind, 1.0, slope)
    level = np.where(blind, 0.0, level - (slope - 1) * mean)
    maps = (np.where(covered, m, default).astype(np.float32) for m, default in ((slope, 1), (level, 0), (share, 1)))
    return FixedPattern(*maps)


def _is_significant(level: Array, tilt: Array, error: Array, n: Array) -> bool:
    """Whether the pattern matters: all over the picture, or in some pixels strongly. All arrays are (pixels,)."""
    chi2 = (level**2 + tilt) / error
    excess = float(np.median(chi2)) / CHI2_2_MEDIAN - 1
    everywhere = excess > max(MIN_SCATTER_EXCESS, MIN_NOISE_SHARE * float(np.median(n)))
    return everywhere or float(np.mean(chi2 > OUTLIER_CHI2)) > MIN_OUTLIER_SHARE


def _shrink(values: Array, error: Array, covered: Mask) -> Array:
    """Shrink each value toward 0 by its probability of being noise; the prior variance is typical or its own."""
    typical = max(float(np.median((values**2)[covered])) / CHI2_1_MEDIAN - float(np.median(error[covered])), 0.0)
    prior = np.maximum(typical, values**2 - 4 * error)
    return np.where(covered, values * prior / np.maximum(prior + error, 1e-300), 0.0)


@dataclass(frozen=True, eq=False)
class Template:
    """Picture of the target as a sum of cosines (`ShiftExpansion`), with a weight for every pixel.

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
        """Extend the band to shorter waves along y and x, cycles/px; the new coefficients are zero."""
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


@dataclass(frozen=True, eq=False)
class TargetModel:
    """What a film has taught about its target.

    Attributes
    ----------
    template : Template
        Band-limited picture of the target and the weights of its pixels.
    pattern : FixedPattern or None
        Flat-field errors, dirt and obstacles that stand still in the picture.
    typical_misfit : float
        Median misfit of a frame; NaN before it is known.
    systematic_covariance : array (2, 2)
        Covariance of slow position errors from a changing appearance, px^2.
    rotates : bool
        Whether the target rotates by more than small angles.
    rotation_seen : bool
        False for a round target without marks.

    """

    template: Template
    pattern: FixedPattern | None = None
    typical_misfit: float = np.nan  # nan: that of the frames at hand
    # px^2, of what the target's changing look adds
    systematic_covariance: Array = field(default_factory=lambda: np.zeros((2, 2)))
    rotates: bool = False  # the target turns by more than small rotations
    rotation_seen: bool = True
