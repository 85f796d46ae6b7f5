"""Targets sharper than the sensor resolves: a picture with waves shorter than two pixels, learnt along a smooth path.

One frame cannot tell such waves from longer ones; many frames at many shifts can (Stark & Oskoui 1989, J. Opt. Soc.
Am. A 6:1715). But pictures alone would let the places within a pixel be renamed, the template along with them: so it
is learnt where a smooth path has the target (Anderson & King 2000, PASP 112:1360, average over shifts likewise).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import comb

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array, Mask
from frictrack.tracking.cosine_basis import BAND_LIMIT, SUPER_RESOLUTION_BAND
from frictrack.tracking.subpixel_fit import SubpixelFit
from frictrack.tracking.template import Template

STRETCH_PX = 8.0  # px, over which errors that repeat from pixel to pixel average out
MIN_HALF_STRETCH, MAX_STRETCH_FRAMES = (
    12,
    160,
)  # frames to either side, and from first to last, of a stretch that a parabola follows
MIN_FRAMES = 100  # frames, from which short waves can be learnt
MAX_ROUGHNESS_RATIO = 2.0  # times the usual misfit of a parabola: there the path is not smooth
DIFFERENCE_ORDER, MIN_NOISE_PX = (
    5,
    5e-4,
)  # of the differences that tell the noise of places, and px of it that any film has
MAX_SAMPLED_FRAMES = 2000  # frames whose places tell how far all are drawn to the pixels
MAX_CONDITION = 3.0  # condition of the pixel's waves up to which every shift was seen
MIN_SMOOTH_SHARE = 0.5  # of the frames in which the path must be smooth
MAX_SIGMA_RATIO = 0.95  # times the standard deviation that comes out with them, for them to be kept
MIN_MEDIAN_MOVE_SIGMAS = 0.4  # standard deviations by which half of the places move, for the same


@dataclass(frozen=True, eq=False)
class SmoothPath:
    """Where the target was in some frames (n, 2), px: not a number where no parabola follows it over `STRETCH_PX`."""

    frames: NDArray[np.int64]
    position: Array

    @property
    def axes(self) -> Mask:
        """Axes (x, y) along which the path is smooth and shows every shift."""
        known = np.isfinite(self.position)
        return np.asarray((known.mean(axis=0) > MIN_SMOOTH_SHARE) & (known.sum(axis=0) >= MIN_FRAMES))

    def updated(self, at: Array) -> SmoothPath:
        """The same from better places (n, 2), px, where these stand close enough to each other."""
        better = smooth_path(self.frames, at, self.frames).position
        return replace(self, position=np.where(np.isfinite(better), better, self.position))

    def with_path_positions(self, fit: SubpixelFit, corner: NDArray[np.int64], template: Template) -> SubpixelFit:
        """The places at which a template is learnt: the smooth path's along the axes of its short waves."""
        short = np.array(template.bands[::-1]) > BAND_LIMIT
        return replace(fit, position=np.where(short & np.isfinite(self.position), self.position - corner, fit.position))

    def widened(self, template: Template) -> Template:
        """The template with room for short waves along the path's axes."""
        x, y = (SUPER_RESOLUTION_BAND if axis else BAND_LIMIT for axis in self.axes)
        return template.widened((y, x))


def improves_positions(super_resolved: SubpixelFit, fit: SubpixelFit, axes: Mask) -> bool:
    """Whether places found with short waves are surer, or stand elsewhere by more than noise would move them."""
    sigma_new, sigma_old = (float(np.median(np.hypot(*f.sigma[:, :2].T))) for f in (super_resolved, fit))
    moved = (super_resolved.position - fit.position)[:, axes] / fit.sigma[:, :2][:, axes]
    return (
        sigma_new < MAX_SIGMA_RATIO * sigma_old
        or float(np.median(np.abs(moved - np.median(moved, axis=0)))) > MIN_MEDIAN_MOVE_SIGMAS
    )


def smooth_path(frames: NDArray[np.int64], at: Array, wanted: NDArray[np.int64]) -> SmoothPath:
    """Parabolas through stretches of places (n, 2), px, in these frames, where one fits as well as elsewhere.

    The path is given in the `wanted` ones of the frames.
    """
    rows = np.searchsorted(frames, wanted)
    each = [_smooth_axis(frames, at[:, axis], rows) for axis in range(2)]
    return SmoothPath(wanted, np.stack(each, axis=1))


def _smooth_axis(frames: NDArray[np.int64], at: Array, rows: NDArray[np.int64]) -> Array:
    """Parabolas through places (n,) in some rows (m,); not a number where more than noise and pixels is about them."""
    series = np.column_stack([at, _pixel_harmonics(at)])
    path = _parabolas(frames, at, series, rows)
    deviations = series[rows] - path
    deviations = deviations[np.isfinite(deviations[:, 0])]
    is_shaken = len(deviations) > deviations.shape[1] and not _is_noise_only(_without_harmonics(deviations), at)
    return np.full(len(rows), np.nan) if is_shaken else path[:, 0]


def peak_locking_correction(frames: NDArray[np.int64], at: Array) -> tuple[Array, Array]:
    """By how much places (n, 2), px, are off towards the pixels, and the amplitude of that along x and y, px.

    What repeats from pixel to pixel along a smooth path is no motion; it is taken as far as it stands out of the noise
    (James & Stein 1961). Zero along an axis without one.
    """
    rows = np.arange(0, len(frames), -(-len(frames) // MAX_SAMPLED_FRAMES))
    locking_error, amplitude = np.zeros_like(at), np.zeros(2)
    for axis in range(2):
        series = np.column_stack([at[:, axis], _pixel_harmonics(at[:, axis])])
        deviations = series[rows] - _parabolas(frames, at[:, axis], series, rows)
        deviations = deviations[np.isfinite(deviations[:, 0])]
        is_determined = (
            len(deviations) >= max(MIN_FRAMES, MIN_SMOOTH_SHARE * len(rows))
            and np.linalg.cond(deviations[:, 1:]) < MAX_CONDITION
        )
        if is_determined and _is_noise_only(_without_harmonics(deviations), at[:, axis]):
            coefficients = _shrunk_fit(deviations[:, 1:], deviations[:, 0])
            locking_error[:, axis], amplitude[axis] = series[:, 1:] @ coefficients, np.hypot(*coefficients[:2])
    return locking_error, amplitude


def _without_harmonics(deviations: Array) -> Array:
    """What its waves, the further columns, leave of what is rough, the first (n,)."""
    return np.asarray(
        deviations[:, 0] - deviations[:, 1:] @ np.linalg.lstsq(deviations[:, 1:], deviations[:, 0], rcond=None)[0]
    )


def _is_noise_only(residuals: Array, at: Array) -> bool:
    """Whether hardly more than the noise of places (n,) is left about a path: no shake of target or camera."""
    noise = np.median(np.abs(np.diff(at, DIFFERENCE_ORDER))) / (
        0.6745 * np.sqrt(comb(2 * DIFFERENCE_ORDER, DIFFERENCE_ORDER))
    )
    return bool(np.std(residuals) < MAX_ROUGHNESS_RATIO * max(noise, MIN_NOISE_PX))


def _shrunk_fit(harmonics: Array, deviations: Array) -> Array:
    """Least squares of what is rough (n,) on waves (n, k), shrunk by the chance that it is all noise."""
    coefficients = np.linalg.lstsq(harmonics, deviations, rcond=None)[0]
    is_determined = harmonics @ coefficients
    strength = (
        float(is_determined @ is_determined)
        * (len(deviations) - len(coefficients))
        / max(float(np.sum((deviations - is_determined) ** 2)), 1e-300)
    )
    return np.asarray(coefficients * max(1 - len(coefficients) / max(strength, 1e-300), 0.0))


def _parabolas(frames: NDArray[np.int64], at: Array, series: Array, rows: NDArray[np.int64]) -> Array:
    """Series (n, k) in some rows (m, k), by parabolas in time through `STRETCH_PX` px of the places `position` (n,).

    Not a number where the stretch is not there, or where the first series follows no parabola: a blow or a start.
    """
    out, residuals = np.full((len(rows), series.shape[1]), np.nan), np.full(len(rows), np.inf)
    travelled = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(at)))])
    first = np.minimum(
        np.searchsorted(travelled, travelled[rows] - STRETCH_PX / 2, side="right") - 1, rows - MIN_HALF_STRETCH
    )
    last = np.maximum(np.searchsorted(travelled, travelled[rows] + STRETCH_PX / 2), rows + MIN_HALF_STRETCH)
    inside = np.flatnonzero((first >= 0) & (last < len(at)))
    for i in inside[frames[last[inside]] - frames[first[inside]] < MAX_STRETCH_FRAMES]:
        part = slice(first[i], last[i] + 1)
        powers = np.vander((frames[part] - frames[rows[i]]) / MAX_STRETCH_FRAMES, 3)
        parabola = np.linalg.lstsq(powers, series[part], rcond=None)[0]
        out[i], residuals[i] = parabola[2], np.std(series[part, 0] - powers @ parabola[:, 0])
    coefficients = np.isfinite(residuals)
    if coefficients.any():
        out[residuals > MAX_ROUGHNESS_RATIO * np.median(residuals[coefficients])] = np.nan
    return out


def _pixel_harmonics(at: Array) -> Array:
    """Two harmonics of the pixel, (n, 4)."""
    turns = [2 * np.pi * k * at for k in (1, 2)]
    return np.column_stack([f(u) for u in turns for f in (np.sin, np.cos)])
