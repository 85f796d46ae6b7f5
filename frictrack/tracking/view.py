"""What stands still between the target and the film: flat-field errors, dirt, a highlight, a rod, uneven light.

Each pixel of the sensor sees many parts of the target as it passes. What it records is a line in what it
should record,

    (I - b) / a = g M + o        M the target's picture there and then, a and b the frame's light,

and the slope g and the level o, least squares over the frames that cover the pixel, say what stands before it:
g = 1.01 is a pixel one percent too sensitive, o a highlight, g = 0 a rod. The line is shrunk toward g = 1, o = 0
by what noise alone would make of it (James & Stein 1961; each pixel's own prior variance where it is far off).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array, Mask
from frictrack.tracking.match import Patch

LEAST_FRAMES = 4  # that must cover a pixel before anything is said of it
VARIED = 0.1  # of the picture's variance, that a pixel must have seen pass: else it cannot tell itself from the target
WORTH = 0.01  # of the noise variance: what stands still below that costs half a percent of accuracy
ODD = 36.0  # squared standard errors from which a single pixel is odd
ODD_SHARE = 0.002  # of the pixels
PASSES = 4.0  # times the noise: what a pixel shows beyond its line is then not still
BLIND = 0.3  # slope below which a pixel does not see the target
FULL = 0.7  # share of its weight from which a pixel counts as whole
SURE = 0.15  # excess over the expected scatter from which it is no accident
CHI2_MEDIAN, CHI2_2_MEDIAN = 0.455, 1.386  # median of chi^2 with one and two degrees of freedom


@dataclass(frozen=True, eq=False)
class View:
    """Slope, level (DN at the film's usual light) and remaining weight of every pixel of the picture (H, W)."""

    slope: Patch
    level: Patch
    share: Patch

    def cleaned(self, cuts: Patch, corner: NDArray[np.int64], gain: Array, offset: Array) -> tuple[Patch, Patch]:
        """Cut-outs (n, h, w) as they would be without what stands still, and the share of each pixel's weight."""
        size = cuts.shape[1:]
        slope, level = (_cut(m, corner, size) for m in (self.slope, self.level))
        a, b = (v[:, None, None].astype(np.float32) for v in (gain, offset))
        return b + (cuts - b - a * level) / slope, self.shares(corner, size)

    def shares(self, corner: NDArray[np.int64], size: tuple[int, ...]) -> Patch:
        """Share of each pixel's weight in cut-outs (n, h, w) at these corners."""
        return _cut(self.share, corner, size)


def _cut(picture: Patch, corner: NDArray[np.int64], size: tuple[int, ...]) -> Patch:
    h, w = size
    return np.stack([picture[y : y + h, x : x + w] for x, y in corner])


class Sums:
    """Sums over frames, pixel by pixel of the picture: n, M, d, M^2, d M, d^2."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._total = np.zeros((6, *shape), np.float32)

    def add(self, corner: NDArray[np.int64], model: Patch, differs: Patch, counts: Array) -> None:
        """Frames whose target should look like `model` (n, h, w) and differs from it by `differs`, at even light.

        `counts` (h, w) is 1 for pixels that show the target, 0 for others.
        """
        h, w = model.shape[1:]
        parts = np.empty((6, h, w), np.float32)
        parts[0] = counts
        for (x, y), m, d in zip(corner.tolist(), model * parts[0], differs * parts[0], strict=True):
            parts[1], parts[2] = m, d
            np.multiply(m, m, out=parts[3])
            np.multiply(d, m, out=parts[4])
            np.multiply(d, d, out=parts[5])
            self._total[:, y : y + h, x : x + w] += parts

    @property
    def totals(self) -> Array:
        """The six sums (6, H, W)."""
        return self._total.astype(np.float64)


def view_of(sums: Sums, noise: float) -> View | None:
    """What stands still, from the sums; None where nothing does. `noise` is the variance of a pixel, DN^2."""
    n, m, d, mm, dm, dd = sums.totals
    seen, n = n >= LEAST_FRAMES, np.maximum(n, 1)
    if not seen.any():
        return None
    mean, level = m / n, d / n
    scatter = np.maximum(mm / n - mean**2, 1e-6)
    seen &= scatter > VARIED * float(np.median((mm / n)[seen]))
    if not seen.any():
        return None
    slope = (dm / n - mean * level) / scatter
    left = np.maximum(dd / n - level**2 - slope**2 * scatter, 0.0)
    # Only what explains itself stands still: a hand that passes leaves more about the line than noise.
    seen &= left * n < PASSES * noise * np.maximum(n - 2, 1)  # the line has taken two of the n terms
    if not seen.any() or not _worth(level[seen], (slope**2 * scatter)[seen], noise / n[seen], n[seen]):
        return None
    level = _shrunk(level, noise / n, seen)
    slope = 1 + _shrunk(slope, noise / (n * scatter), seen)
    blind = (slope < BLIND) & seen
    share = np.where(blind, 0.0, np.where(slope**2 < FULL, slope**2, 1.0))
    slope = np.where(blind, 1.0, slope)
    level = np.where(blind, 0.0, level - (slope - 1) * mean)
    maps = (np.where(seen, m, default).astype(np.float32) for m, default in ((slope, 1), (level, 0), (share, 1)))
    return View(*maps)


def _worth(level: Array, tilt: Array, error: Array, n: Array) -> bool:
    """Whether what stands still matters: all over the picture, or in some pixels badly. All (pixels,)."""
    both = (level**2 + tilt) / error
    excess = float(np.median(both)) / CHI2_2_MEDIAN - 1
    everywhere = excess > max(SURE, WORTH * float(np.median(n)))
    return everywhere or float(np.mean(both > ODD)) > ODD_SHARE


def _shrunk(values: Array, error: Array, seen: Mask) -> Array:
    """Each value toward 0 by its chance of being noise; the prior variance is the usual one, or its own if larger."""
    usual = max(float(np.median((values**2)[seen])) / CHI2_MEDIAN - float(np.median(error[seen])), 0.0)
    prior = np.maximum(usual, values**2 - 4 * error)
    return np.where(seen, values * prior / np.maximum(prior + error, 1e-300), 0.0)
