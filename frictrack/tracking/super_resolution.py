"""Learn the template of a target that is sharper than the sensor resolves, with waves shorter than two pixels.

One frame cannot distinguish such waves from longer ones; many frames at many shifts can (Stark & Oskoui 1989, J. Opt.
Soc. Am. A 6:1715). The frames alone leave positions and template ambiguous: an error that repeats from pixel to pixel
(peak locking) can be moved from one to the other. The template is therefore learnt at the positions of a smooth path
(compare Anderson & King 2000, PASP 112:1360, who average over shifts).
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

STRETCH_PX = 8.0  # over which errors that repeat from pixel to pixel average out
# frames to either side, and from first to last, of a stretch that a parabola follows
MIN_HALF_STRETCH, MAX_STRETCH_FRAMES = (12, 160)
PARABOLAS_AT_ONCE = 128  # so that their arrays stay short
MIN_FRAMES = 100  # from which short waves can be learnt
MAX_ROUGHNESS_RATIO = 2.0  # to the typical misfit of a parabola; elsewhere the path is not smooth
# of the differences that show the noise of positions, and the least noise in px
DIFFERENCE_ORDER, MIN_NOISE_PX = (5, 5e-4)
MAX_SAMPLED_FRAMES = 2000  # from which peak locking is estimated
MAX_CONDITION = 3.0  # of the pixel harmonics, up to which all shifts are covered
MIN_SMOOTH_SHARE = 0.5  # of the frames in which the path must be smooth
MAX_SIGMA_RATIO = 0.95  # standard deviation with short waves over that without, for them to be kept
MIN_MEDIAN_MOVE_SIGMAS = 0.4  # median change of the positions, for them to be kept


@dataclass(frozen=True, eq=False)
class SmoothPath:
    """Smooth path of the target in some frames.

    Attributes
    ----------
    frames : array of int (n,)
        Numbers of the frames.
    position : array (n, 2)
        Positions, px; NaN where no parabola follows the path over `STRETCH_PX`.

    """

    frames: NDArray[np.int64]
    position: Array

    @property
    def axes(self) -> Mask:
        """Axes (x, y) along which the path is smooth in most frames."""
        known = np.isfinite(self.position)
        return np.asarray((known.mean(axis=0) > MIN_SMOOTH_SHARE) & (known.sum(axis=0) >= MIN_FRAMES))

    def updated(self, at: Array) -> SmoothPath:
        """Compute the smooth path again from better positions.

        Parameters
        ----------
        at : array (n, 2)
            Positions in the same frames, px.

        Returns
        -------
        SmoothPath
            Old values stay where the new ones are NaN.

        """
        better = smooth_path(self.frames, at, self.frames).position
        return replace(self, position=np.where(np.isfinite(better), better, self.position))

    def with_path_positions(self, fit: SubpixelFit, corner: NDArray[np.int64], template: Template) -> SubpixelFit:
        """Replace measured positions by those of the path, along the axes on which the template has short waves.

        Parameters
        ----------
        fit : SubpixelFit
            Fit on cut-outs of the same frames.
        corner : array of int (n, 2)
            Corners of the cut-outs, px.
        template : Template
            Template with its band limits.

        Returns
        -------
        SubpixelFit
            Positions at which the template is learnt.

        """
        short = np.array(template.bands[::-1]) > BAND_LIMIT
        return replace(fit, position=np.where(short & np.isfinite(self.position), self.position - corner, fit.position))

    def widened(self, template: Template) -> Template:
        """Extend the band of a template to short waves along the axes of the path.

        Parameters
        ----------
        template : Template
            Template of the target.

        Returns
        -------
        Template
            The same picture.

        """
        x, y = (SUPER_RESOLUTION_BAND if axis else BAND_LIMIT for axis in self.axes)
        return template.widened((y, x))


def improves_positions(super_resolved: SubpixelFit, fit: SubpixelFit, axes: Mask) -> bool:
    """Decide whether short waves make the positions more precise, or move them by more than noise would.

    Parameters
    ----------
    super_resolved, fit : SubpixelFit
        Fits with and without short waves.
    axes : array of bool (2,)
        Axes (x, y) that have short waves.

    Returns
    -------
    bool
        True where the template with short waves should be kept.

    """
    sigma_new, sigma_old = (float(np.median(np.hypot(*f.sigma[:, :2].T))) for f in (super_resolved, fit))
    moved = (super_resolved.position - fit.position)[:, axes] / fit.sigma[:, :2][:, axes]
    return (
        sigma_new < MAX_SIGMA_RATIO * sigma_old
        or float(np.median(np.abs(moved - np.median(moved, axis=0)))) > MIN_MEDIAN_MOVE_SIGMAS
    )


def smooth_path(frames: NDArray[np.int64], at: Array, wanted: NDArray[np.int64]) -> SmoothPath:
    """Fit parabolas to stretches of a path, where one fits as well as elsewhere.

    Parameters
    ----------
    frames : array of int (n,)
        Numbers of the frames.
    at : array (n, 2)
        Positions in these frames, px.
    wanted : array of int (m,)
        Frames in which the path is computed.

    Returns
    -------
    SmoothPath
        Path in the wanted frames.

    """
    rows = np.searchsorted(frames, wanted)
    each = [_smooth_axis(frames, at[:, axis], rows) for axis in range(2)]
    return SmoothPath(wanted, np.stack(each, axis=1))


def _smooth_axis(frames: NDArray[np.int64], at: Array, rows: NDArray[np.int64]) -> Array:
    """Smooth positions (n,) in some rows (m,); NaN where more than noise and pixel harmonics remains."""
    series = np.column_stack([at, _pixel_harmonics(at)])
    path = _parabolas(frames, at, series, rows)
    deviations = series[rows] - path
    deviations = deviations[np.isfinite(deviations[:, 0])]
    is_shaken = len(deviations) > deviations.shape[1] and not _is_noise_only(_without_harmonics(deviations), at)
    return np.full(len(rows), np.nan) if is_shaken else path[:, 0]


def peak_locking_correction(frames: NDArray[np.int64], at: Array) -> tuple[Array, Array]:
    """Estimate the errors of positions that repeat from pixel to pixel (peak locking).

    Deviations from a smooth path that are periodic in the pixel are no motion. They are fitted by two harmonics and
    shrunk
    by the part that noise makes of them (James & Stein 1961, Proc. 4th Berkeley Symp. 1:361).

    Parameters
    ----------
    frames : array of int (n,)
        Numbers of the frames.
    at : array (n, 2)
        Positions in these frames, px.

    Returns
    -------
    error : array (n, 2)
        To be subtracted from the positions, px; zero along an axis on which it is not determined.
    amplitude : array (2,)
        Amplitude of the first harmonic along x and y, px.

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
    """Deviations (n,) without the part that the harmonics, in the further columns, explain."""
    return np.asarray(
        deviations[:, 0] - deviations[:, 1:] @ np.linalg.lstsq(deviations[:, 1:], deviations[:, 0], rcond=None)[0]
    )


def _is_noise_only(residuals: Array, at: Array) -> bool:
    """Whether hardly more than the noise of the positions (n,) remains about a path: no shake of target or camera."""
    noise = np.median(np.abs(np.diff(at, DIFFERENCE_ORDER))) / (
        0.6745 * np.sqrt(comb(2 * DIFFERENCE_ORDER, DIFFERENCE_ORDER))
    )
    return bool(np.std(residuals) < MAX_ROUGHNESS_RATIO * max(noise, MIN_NOISE_PX))


def _shrunk_fit(harmonics: Array, deviations: Array) -> Array:
    """Coefficients (k,) of deviations (n,) on harmonics (n, k), shrunk by the probability that all is noise."""
    coefficients = np.linalg.lstsq(harmonics, deviations, rcond=None)[0]
    is_determined = harmonics @ coefficients
    strength = (
        float(is_determined @ is_determined)
        * (len(deviations) - len(coefficients))
        / max(float(np.sum((deviations - is_determined) ** 2)), 1e-300)
    )
    return np.asarray(coefficients * max(1 - len(coefficients) / max(strength, 1e-300), 0.0))


def _parabolas(frames: NDArray[np.int64], at: Array, series: Array, rows: NDArray[np.int64]) -> Array:
    """Smooth series (n, k) in some rows (m, k) by parabolas in time through `STRETCH_PX` of the positions `at` (n,).

    NaN where the stretch is incomplete, or where the first series follows no parabola: at an impact or a start.
    """
    out, residuals = np.full((len(rows), series.shape[1]), np.nan), np.full(len(rows), np.inf)
    travelled = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(at)))])
    first = np.minimum(
        np.searchsorted(travelled, travelled[rows] - STRETCH_PX / 2, side="right") - 1, rows - MIN_HALF_STRETCH
    )
    last = np.maximum(np.searchsorted(travelled, travelled[rows] + STRETCH_PX / 2), rows + MIN_HALF_STRETCH)
    inside = np.flatnonzero((first >= 0) & (last < len(at)))
    short = inside[frames[last[inside]] - frames[first[inside]] < MAX_STRETCH_FRAMES]
    for some in np.array_split(short, -(-len(short) // PARABOLAS_AT_ONCE)) if len(short) else ():
        stretches = rows[some], first[some], last[some]
        out[some], residuals[some] = _fit_parabolas(frames, series, stretches)
    coefficients = np.isfinite(residuals)
    if coefficients.any():
        out[residuals > MAX_ROUGHNESS_RATIO * np.median(residuals[coefficients])] = np.nan
    return out


def _fit_parabolas(
    frames: NDArray[np.int64], series: Array, stretches: tuple[NDArray[np.int64], ...]
) -> tuple[Array, Array]:
    """Fit parabolas in time to series (n, k) in stretches: middle, first and last row, (m,) each.

    Values (m, k) in the middle rows, and standard deviations (m,) of the residuals of the first series.
    """
    middle, first, last = stretches
    places = first[:, None] + np.arange(np.max(last - first) + 1)
    inside = (places <= last[:, None])[..., None]
    places = np.minimum(places, last[:, None])
    time = frames[places] - frames[middle][:, None]
    # In units of each stretch, so that the normal equations are well conditioned.
    powers = inside * (time / np.max(np.abs(time), axis=1, keepdims=True))[..., None] ** np.arange(3)
    values = inside * (series[places] - series[middle][:, None])
    across = powers.swapaxes(1, 2)
    parabolas = np.linalg.solve(across @ powers, across @ values)
    left = values[..., 0] - (powers @ parabolas[..., :1])[..., 0]
    count = np.sum(inside[..., 0], axis=1)
    variance = np.sum(left**2, axis=1) / count - (np.sum(left, axis=1) / count) ** 2
    return series[middle] + parabolas[:, 0], np.sqrt(np.maximum(variance, 0.0))


def _pixel_harmonics(at: Array) -> Array:
    """Sine and cosine of one and two cycles per pixel, (n, 4)."""
    turns = [2 * np.pi * k * at for k in (1, 2)]
    return np.column_stack([f(u) for u in turns for f in (np.sin, np.cos)])
