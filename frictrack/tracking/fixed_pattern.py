"""Estimate what stands still between target and film: flat-field errors, dirt, highlights, obstacles, uneven light.

Each pixel of the sensor sees many parts of the target as it passes. Its reading is a line in what it should read,

    (I - b) / a = g M + o        M: template there and then, a and b: gain and offset of the frame

The slope g and the level o are fitted by least squares over the frames that cover the pixel: g = 1.01 is a pixel one
percent too sensitive, o a highlight, g = 0 an obstacle. Both are shrunk toward g = 1, o = 0 by the part that noise
makes of them (James & Stein 1961, Proc. 4th Berkeley Symp. 1:361; each pixel has its own prior where it is far off).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array, Mask
from frictrack.tracking.correlation import Patch

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
        """Cut the share of the weights out at given corners.

        Parameters
        ----------
        corner : array of int (n, 2)
            Corners of the cut-outs, px.
        size : tuple of int
            Height and width, px.

        Returns
        -------
        array (n, h, w)
            Share of its weight that each pixel keeps.

        """
        return _cut(self.share, corner, size)


def _cut(picture: Patch, corner: NDArray[np.int64], size: tuple[int, ...]) -> Patch:
    h, w = size
    return np.stack([picture[y : y + h, x : x + w] for x, y in corner])


class PatternSums:
    """Sums over frames for every pixel of the picture: n, M, d, M^2, d M, d^2."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._total = np.zeros((6, *shape), np.float32)

    def add(self, corner: NDArray[np.int64], model: Patch, difference: Patch, inside: Array) -> None:
        """Add frames.

        Parameters
        ----------
        corner : array of int (n, 2)
            Corners of the cut-outs, px.
        model, difference : array (n, h, w)
            What the frames should show and how they differ from it, at the same light, DN.
        inside : array (h, w)
            1 for pixels that show the target, 0 for others.

        """
        h, w = model.shape[1:]
        parts = np.empty((6, h, w), np.float32)
        parts[0] = inside
        for (x, y), m, d in zip(corner.tolist(), model * parts[0], difference * parts[0], strict=True):
            parts[1], parts[2] = m, d
            np.multiply(m, m, out=parts[3])
            np.multiply(d, m, out=parts[4])
            np.multiply(d, d, out=parts[5])
            self._total[:, y : y + h, x : x + w] += parts

    @property
    def totals(self) -> Array:
        """The six sums (6, H, W)."""
        return self._total.astype(np.float64)


def fit_fixed_pattern(sums: PatternSums, noise: float) -> FixedPattern | None:
    """Fit the fixed pattern to sums over frames.

    Parameters
    ----------
    sums : PatternSums
        Sums over all frames.
    noise : float
        Variance of a pixel, DN^2.

    Returns
    -------
    FixedPattern or None
        None where nothing significant stands still.

    """
    n, m, d, mm, dm, dd = sums.totals
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
    if not covered.any() or not _is_significant(
        level[covered], (slope**2 * scatter)[covered], noise / n[covered], n[covered]
    ):
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
