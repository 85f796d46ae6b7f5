"""Learn the template of a target from the film, with the noise of every pixel.

One noisy frame as the template costs accuracy (Clement et al. 2018, arXiv:1809.05583). The template is therefore fitted
to frames from the whole path. For known shifts this is linear least squares, and the frames enter it by sums alone:
with h_i the expansion of the shift of frame i (`ShiftExpansion`), sum h_i h_i' and sum h_i I_i represent all frames.

Learn the template of a target that is sharper than the sensor resolves, with waves shorter than two pixels.

One frame cannot distinguish such waves from longer ones; many frames at many shifts can (Stark & Oskoui 1989, J. Opt.
Soc. Am. A 6:1715). The frames alone leave positions and template ambiguous: an error that repeats from pixel to pixel
(peak locking) can be moved from one to the other. The template is therefore learnt at the positions of a smooth path
(compare Anderson & King 2000, PASP 112:1360, who average over shifts).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.signal import savgol_filter
from scipy.sparse.linalg import LinearOperator, cg

from frictrack.base.distributions import noise_of_differences
from frictrack.records import Array, Mask
from frictrack.tracking.correlation import Patch
from frictrack.tracking.subpixel_fit import SubpixelFit
from frictrack.tracking.template import BAND_LIMIT, SUPER_RESOLUTION_BAND, ShiftExpansion, Template, shift_expansion

MAX_CG_STEPS = 15  # of conjugate gradients
# Border without weight, px: of a single frame, and where all frames show the same part of the target. There slopes
# are off by 0.4 % two pixels from the border of a target of 24 x 40 px, by 0.1 % four pixels from it.
RIM_PX, WIDE_RIM_PX = (2,), (2, 4)
PRIOR_GROUP_SIZE = 16  # neighbouring waves along either axis that share a prior
MAX_PRIOR_PRECISION = 10.0  # over the precision of the data; more would only slow the conjugate gradients
CG_TOLERANCE = 3e-5  # of the right-hand side; less is below the noise
RIDGE_FRAMES = 2.5e-4  # weight of a flat picture in frames: keeps what lies outside the rectangle finite
MIN_MOVING_SHARE = 0.2  # of the rectangle, before pixels are masked
MIN_VARIANCE_RATIO = 4.0  # of static scene to target, for that share: noise makes a fifth twice better
MEDIAN_FRAMES = 60  # of which medians are taken
MIN_VISIBLE_SHARE = 0.5  # of the frames in which a pixel of the target must be visible
LEAK_PX = 2  # from the background, over which lens and sub-pixel shifts mix it in
MIN_INSIDE_CONTRAST = 0.5  # share of the contrast inside; with less the outline is used as well
MAX_NOISE_RATIO = 1.5  # variance of a pixel over the photon transfer line; above it the scene changes there
ROUNDING_VARIANCE = 1 / 12  # of rounding to whole grey values, which a film without noise still has
STRETCH_PX = 8.0  # over which errors that repeat from pixel to pixel average out
MIN_STRETCH_FRAMES, MAX_STRETCH_FRAMES = 25, 160  # of a stretch that a parabola follows
MIN_FRAMES = 100  # from which short waves can be learnt
MAX_ROUGHNESS_RATIO = 2.0  # to the typical misfit of a parabola; elsewhere the path is not smooth
# of the differences that show the noise of positions, and the least noise in px
DIFFERENCE_ORDER, MIN_NOISE_PX = (5, 5e-4)
MAX_SAMPLED_FRAMES = 2000  # from which peak locking is estimated
MAX_CONDITION = 3.0  # of the pixel harmonics, up to which all shifts are covered
MIN_SMOOTH_SHARE = 0.5  # of the frames in which the path must be smooth


def template_from_frame(cut: Patch, mask: Mask | None = None) -> Template:
    """Make a first template from one cut-out.

    Parameters
    ----------
    cut : array (h, w)
        Grey values.
    mask : array of bool (h, w), optional
        Pixels that belong to the target; all by default.

    Returns
    -------
    Template
        All pixels have the same weight.

    """
    pixels_shown = cut if mask is None else cut[mask]
    weight = np.ones(cut.shape) / max(float(np.var(pixels_shown)), 1.0)
    weight = weight if mask is None else weight * mask
    level = float(np.mean(pixels_shown))
    grid = shift_expansion((cut.shape[0], cut.shape[1]))
    at_rest = grid.design(np.zeros((1, 2)))[0]
    coefficients = _solve_coefficients(
        grid,
        at_rest,
        (cut - level).reshape(1, -1),
        weight,
        np.zeros(grid.n_coefficients),
        _min_prior_precision(weight, 1),
    )
    return Template(coefficients, weight, level, mask=mask)


def without_border(template: Template, rims: Sequence[int] = RIM_PX) -> Template:
    """Set the weight of the template's border to zero: the first frame has not seen what appears there.

    Parameters
    ----------
    template : Template
        Template of the target.
    rims : sequence of int
        Possible widths, px. The widest that leaves three quarters of a side is used, else one pixel.

    Returns
    -------
    Template
        The same picture with other weights.

    """
    shape = template.weight.shape
    rim = [max((r for r in rims if 8 * r <= side), default=1) for side in shape]
    whole = np.ones(shape, np.uint8) if template.mask is None else template.mask.astype(np.uint8)
    around = np.ones([2 * r + 1 for r in rim], np.uint8)
    counts = cv2.erode(whole, around, borderType=cv2.BORDER_CONSTANT, borderValue=0.0)
    return replace(template, weight=template.weight * counts)


def learn_template(
    cuts: Patch, fit: SubpixelFit, template: Template, scene: Patch | None = None, share: Patch | None = None
) -> Template:
    """Fit a template to cut-outs in which the target has been located.

    Parameters
    ----------
    cuts : array (n, h, w)
        Grey values.
    fit : SubpixelFit
        Positions of the target on the cut-outs, with gain and offset.
    template : Template
        Template of the last round: band limit, mask and starting values.
    scene : array (n, h, w), optional
        Static background behind each cut-out, where it is known.
    share : array (n, h, w), optional
        How much of each pixel shows the target; the remainder is taken to be as expected.

    Returns
    -------
    Template
        Picture at the typical light of the frames, with the inverse variance of every pixel as weight.

    """
    fit = replace(fit, gain=fit.gain / np.median(fit.gain))  # the picture is that of the usual light
    pixels = cuts.reshape(len(cuts), -1).astype(np.float32) - fit.offset.astype(np.float32)[:, None]
    columns, rotation = _columns(template, fit)
    pixels -= rotation
    k = columns.shape[1]
    pixels_used = pixels
    if share is not None:
        expected = columns.astype(np.float32) @ template.basis_images[:k].astype(np.float32)
        pixels_used = expected + share.reshape(pixels.shape) * (pixels - expected)
    coefficients, n_parameters = _fit_coefficients(template, columns, pixels_used)
    learnt = replace(template, coefficients=coefficients, level=float(np.median(fit.offset)))
    residual = pixels - columns.astype(np.float32) @ learnt.basis_images[:k].astype(np.float32)
    residual = (residual / fit.gain.astype(np.float32)[:, None]).reshape(cuts.shape)
    moving = None if scene is None else _moving_pixels(cuts, scene, residual, learnt.image)
    variance = _pixel_variance(residual, share, n_parameters)
    variance = variance if template.mask is None else np.where(template.mask, variance, np.inf)
    return replace(learnt, weight=_pixel_weights(variance, learnt.image, moving))


def short_wave_evidence(cuts: Patch, fit: SubpixelFit, template: Template, wide: Template, half: Mask) -> float:
    """Compute how far two halves of the frames agree about waves that the template lacks.

    The slope of the squared residuals with respect to each missing coefficient is noise of zero mean where the picture
    has no such wave (score test, Rao 1948, Proc. Camb. Phil. Soc. 44:50). With a wave, it is the same in both halves.

    Parameters
    ----------
    cuts : array (n, h, w)
        Grey values.
    fit : SubpixelFit
        Positions of the target on the cut-outs, with gain and offset.
    template, wide : Template
        Learnt template, and the same with the missing waves, whose coefficients are zero.
    half : array of bool (n,)
        Frames of the first half.

    Returns
    -------
    float
        Correlation of the slopes of both halves in standard deviations of the correlation without waves.

    """
    fit = replace(fit, gain=fit.gain / np.median(fit.gain))
    columns, rotation = _columns(template, fit)
    expected = columns.astype(np.float32) @ template.basis_images[: columns.shape[1]].astype(np.float32)
    pixels = cuts.reshape(len(cuts), -1) - fit.offset.astype(np.float32)[:, None]
    residual = (pixels - rotation - expected) * template.weight.ravel().astype(np.float32)
    design = (wide.shift_expansion.design(fit.unrotated())[0] * fit.gain[:, None]).astype(np.float32)
    h, w = template.coefficients.shape
    slopes = []
    for rows in (half, ~half):
        sums = (design[rows].T @ residual[rows]).reshape(-1, *template.weight.shape)
        slope = wide.shift_expansion.adjoint(sums)
        slope[:h, :w] = 0.0  # waves that the template has
        slopes.append(slope.astype(np.float64))
    size = np.sqrt(np.sum(slopes[0] ** 2) * np.sum(slopes[1] ** 2))
    return float(np.sum(slopes[0] * slopes[1]) / max(size, 1e-300) * np.sqrt(slopes[0].size - h * w))


def _pixel_variance(residual: Patch, share: Patch | None, n_parameters: float) -> Array:
    """Variance (h, w) of each pixel about the template, DN^2; infinite where it rarely shows the target."""
    n, size = len(residual), residual[0].size
    lost_frames = min(n_parameters / size, 0.5 * n)  # frames' worth of noise that the picture has taken up
    if share is None:
        return np.mean(residual**2, axis=0) * (n / (n - lost_frames)) + ROUNDING_VARIANCE
    counted = np.sum(share, axis=0)
    variance = (
        np.einsum("nij,nij,nij->ij", share, residual, residual) / np.maximum(counted, 1.0) * (n / (n - lost_frames))
    )
    return np.where(counted > MIN_VISIBLE_SHARE * n, variance + ROUNDING_VARIANCE, np.inf)


def _columns(template: Template, fit: SubpixelFit) -> tuple[Array, Patch]:
    """Gain times the expansion of every frame's shift (n, k), and the change by its rotation (n, h w)."""
    picture, _, _, rotation = template.shift_expansion.design(fit.unrotated())
    k = picture.shape[1]
    rotation_weights = (rotation * (fit.gain * fit.angle)[:, None]).astype(np.float32)
    return picture * fit.gain[:, None], rotation_weights @ template.basis_images[k:-1].astype(np.float32)


def _fit_coefficients(template: Template, columns: Array, pixels: Patch) -> tuple[Array, float]:
    """Fit coefficients to pixels (n, h w) with columns (n, k); also return the effective number of parameters.

    Waves shorter than two pixels get a prior: they have steep slopes, and their noise is common to all frames.
    """
    n, weight = len(columns), template.weight
    min_precision = _min_prior_precision(weight, n)
    coefficients = _solve_coefficients(
        template.shift_expansion, columns, pixels, weight, template.coefficients, min_precision
    )
    if max(template.bands) <= BAND_LIMIT:
        return coefficients, coefficients.size
    prior_precision = _prior_precision(coefficients, weight, n)
    coefficients = _solve_coefficients(template.shift_expansion, columns, pixels, weight, coefficients, prior_precision)
    return coefficients, float(np.sum(1 / (1 + prior_precision / _data_precision(weight, n))))


def _min_prior_precision(weight: Array, n: int) -> float:
    """Smallest precision of the prior, 1/DN^2."""
    return RIDGE_FRAMES * n * float(weight.mean())


def _data_precision(weight: Array, n: int) -> float:
    """Inverse variance of a coefficient that n frames determine, 1/DN^2."""
    return n * float(weight.sum()) / 4  # the squares of two cosines


def _prior_precision(coefficients: Array, weight: Array, n: int) -> Array:
    """Inverse expected square of every coefficient, 1/DN^2, from coefficients fitted without a prior.

    Neighbouring waves share it: their mean square less the part that noise makes (Wiener filter with an empirical Bayes
    prior, Efron & Morris 1973, J. Am. Stat. Assoc. 68:117).
    """
    down, across = (_group_mean_matrix(count) for count in coefficients.shape)
    power, pixels_shown = down @ coefficients**2 @ across, _data_precision(weight, n)
    return np.clip(
        1 / np.maximum(power - 1 / pixels_shown, 1e-300),
        _min_prior_precision(weight, n),
        MAX_PRIOR_PRECISION * pixels_shown,
    )


def _group_mean_matrix(count: int) -> Array:
    """Matrix (count, count) that averages over each `PRIOR_GROUP_SIZE` neighbours."""
    group = np.arange(count) // PRIOR_GROUP_SIZE
    same = group[:, None] == group
    return same / same.sum(axis=0)


def _solve_coefficients(
    grid: ShiftExpansion, columns: Array, pixels: Patch, weight: Array, start: Array, prior_precision: Array | float
) -> Array:
    """Solve the weighted least squares of pixels (n, h w) = columns (n, k) B for the coefficients.

    `prior_precision`, 1/DN^2, shrinks each of them toward zero. Conjugate gradients work on as many pseudo-frames as
    there
    are shifts to distinguish; they represent all frames, since columns' columns = L L'.
    """
    values, vectors = np.linalg.eigh(columns.T @ columns)
    keep = values > 1e-7 * values[-1]
    mix = vectors[:, keep] * np.sqrt(values[keep])
    sums = (columns.T.astype(np.float32) @ pixels.astype(np.float32)).astype(np.float64)
    pseudo = ((vectors[:, keep] / np.sqrt(values[keep])).T @ sums).astype(np.float32)
    mix, rate = mix.astype(np.float32), weight.ravel().astype(np.float32)
    ridge = np.float32(prior_precision)

    def forward(coefficients: Patch) -> Patch:
        return mix.T @ grid.basis_images(coefficients).reshape(len(mix), -1)

    def back(pictures: Patch) -> Patch:
        return grid.adjoint((mix @ (pictures * rate)).reshape(-1, *weight.shape))

    def normal(v: Patch) -> Patch:
        coefficients = v.reshape(start.shape)
        return (back(forward(coefficients)) + ridge * coefficients).ravel()

    equations = LinearOperator((start.size, start.size), matvec=normal, dtype=np.float32)
    first, right = start.astype(np.float32).ravel(), back(pseudo).ravel()
    found = cg(equations, right, first, rtol=CG_TOLERANCE, maxiter=MAX_CG_STEPS)[0]
    return np.asarray(found.reshape(start.shape), dtype=np.float64)


def _moving_pixels(cuts: Patch, scene: Patch, residual: Patch, image: Array) -> Mask | None:
    """Pixels that move with the target: it explains them better than the static scene; None where too few do.

    Medians over some of the frames are compared, because an object before the target is not background.
    """
    subset = slice(None, None, -(-len(cuts) // MEDIAN_FRAMES))
    variance = np.median(residual[subset] ** 2, axis=0)
    differs = np.median((cuts[subset].astype(np.float32) - scene[subset]) ** 2, axis=0)
    if np.quantile(differs / np.maximum(variance, ROUNDING_VARIANCE), 1 - MIN_MOVING_SHARE) < MIN_VARIANCE_RATIO:
        return None
    moving = _trim_edge((variance < 0.5 * differs).astype(np.uint8), image)
    return moving if moving.mean() > MIN_MOVING_SHARE else None


def _trim_edge(moving: Array, picture: Array) -> Mask:
    """Moving pixels without the edge into which background leaks; with it where the edge holds most of the contrast."""
    moving = np.asarray(cv2.medianBlur(moving, 3))
    framed = cv2.copyMakeBorder(moving, LEAK_PX, LEAK_PX, LEAK_PX, LEAK_PX, cv2.BORDER_REPLICATE)
    eroded = cv2.erode(framed, np.ones((2 * LEAK_PX + 1, 2 * LEAK_PX + 1), np.uint8))
    inside = np.asarray(eroded[LEAK_PX:-LEAK_PX, LEAK_PX:-LEAK_PX]) > 0
    outlined = np.asarray(cv2.dilate(moving, np.ones((3, 3), np.uint8))) > 0
    energy = np.sum(np.square(np.gradient(picture)), axis=0)
    return inside if energy[inside].sum() > MIN_INSIDE_CONTRAST * energy[outlined].sum() else outlined


def _pixel_weights(variance: Array, image: Array, moving: Mask | None) -> Array:
    """Inverse variance of each pixel (h, w): that of the photon transfer line, or its own where it scatters more.

    Shot noise grows with the light: variance = read noise + light / (electrons per DN) (Janesick 2007, Photon
    Transfer).
    """
    line = _photon_transfer_line(variance, image)
    noisy = variance > MAX_NOISE_RATIO * line
    weight = 1 / np.where(noisy, variance, line)
    return weight if moving is None else weight * moving


def _photon_transfer_line(variance: Array, image: Array) -> Array:
    """Variance on the line against light through the pixels that follow one, at least half their median."""
    good = np.isfinite(variance)
    line = np.full(variance.shape, np.median(variance[good]) if good.any() else 1.0)
    for _ in range(3):
        good = variance < MAX_NOISE_RATIO * line
        if np.count_nonzero(good) < 20 or np.ptp(image[good]) <= 0:
            break
        slope, level = np.polynomial.Polynomial.fit(image[good], variance[good], 1).convert().coef[::-1]
        line = np.maximum(level + max(slope, 0.0) * image, 0.5 * np.median(variance[good]))
    return line


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
        """Compute the path again from better positions (n, 2) px; old values stay where the new ones are NaN."""
        better = smooth_path(self.frames, at, self.frames).position
        return replace(self, position=np.where(np.isfinite(better), better, self.position))

    def with_path_positions(self, fit: SubpixelFit, corner: NDArray[np.int64], template: Template) -> SubpixelFit:
        """Replace positions by those of the path, along the axes on which the template has short waves."""
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
    rows, path = np.searchsorted(frames, wanted), np.full((len(wanted), 2), np.nan)
    for axis in range(2):
        series, smooth, deviations = _deviations(frames, at[:, axis], rows)
        if len(deviations) <= deviations.shape[1] or _is_noise_only(deviations, series[:, 0]):
            path[:, axis] = smooth
    return SmoothPath(wanted, path)


def _deviations(frames: NDArray[np.int64], at: Array, rows: NDArray[np.int64]) -> tuple[Array, Array, Array]:
    """Positions (n,) with their pixel harmonics (n, 5), their smooth path in some rows (m,), and what differs from it.

    The deviations of positions and harmonics (k, 5) are those of the rows in which there is a path.
    """
    series = np.column_stack([at, pixel_harmonics(at)])
    path = _parabolas(frames, at)[rows]
    known = np.isfinite(path[:, 0])
    return series, path[:, 0], (series[rows] - path)[known]


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
        series, _, deviations = _deviations(frames, at[:, axis], rows)
        is_determined = (
            len(deviations) >= max(MIN_FRAMES, MIN_SMOOTH_SHARE * len(rows))
            and np.linalg.cond(deviations[:, 1:]) < MAX_CONDITION
        )
        if is_determined and _is_noise_only(deviations, at[:, axis]):
            coefficients = _shrunk_fit(deviations[:, 1:], deviations[:, 0])
            locking_error[:, axis], amplitude[axis] = series[:, 1:] @ coefficients, np.hypot(*coefficients[:2])
    return locking_error, amplitude


def _is_noise_only(deviations: Array, at: Array) -> bool:
    """Whether hardly more than the noise of the positions (n,) remains about a path: no shake of target or camera.

    The part of the deviations that the harmonics, in the further columns, explain does not count.
    """
    harmonics = deviations[:, 1:]
    residuals = deviations[:, 0] - harmonics @ np.linalg.lstsq(harmonics, deviations[:, 0], rcond=None)[0]
    noise = noise_of_differences(np.diff(at, DIFFERENCE_ORDER), DIFFERENCE_ORDER)
    return bool(np.std(residuals) < MAX_ROUGHNESS_RATIO * max(noise, MIN_NOISE_PX))


def _shrunk_fit(harmonics: Array, deviations: Array) -> Array:
    """Coefficients (k,) of deviations (n,) on harmonics (n, k), shrunk by the probability that all is noise."""
    coefficients = np.linalg.lstsq(harmonics, deviations, rcond=None)[0]
    explained = harmonics @ coefficients
    left = max(float(np.sum((deviations - explained) ** 2)), 1e-300)
    strength = float(explained @ explained) * (len(deviations) - len(coefficients)) / left
    return np.asarray(coefficients * max(1 - len(coefficients) / max(strength, 1e-300), 0.0))


def _parabolas(frames: NDArray[np.int64], at: Array) -> Array:
    """Smooth positions (n,) and their pixel harmonics, (n, 5), by parabolas through `STRETCH_PX` of the path.

    NaN at the ends, where the path is too slow, and where positions follow no parabola: at an impact or a start.
    """
    even = np.interp(np.arange(frames[0], frames[-1] + 1), frames, at)
    series = np.column_stack([even, pixel_harmonics(even)])
    steps = np.abs(np.diff(even, prepend=even[0]))
    half = int(max(STRETCH_PX / max(float(np.median(steps)), 1e-9), MIN_STRETCH_FRAMES)) // 2
    if 2 * half >= min(MAX_STRETCH_FRAMES, len(even)):
        return np.full((len(at), series.shape[1]), np.nan)
    smooth = savgol_filter(series, 2 * half + 1, 2, axis=0)
    squares = uniform_filter1d((even - smooth[:, 0]) ** 2, 2 * half + 1)
    rough = np.sqrt(np.maximum(squares, 0.0))  # a running sum may come out below zero
    travelled = np.cumsum(steps)
    known = np.pad(travelled[2 * half :] - travelled[: -2 * half] > STRETCH_PX / 2, half)
    known &= rough < MAX_ROUGHNESS_RATIO * np.median(rough)
    return np.where(known[:, None], smooth, np.nan)[frames - frames[0]]


def pixel_harmonics(at: Array) -> Array:
    """Sine and cosine of one and two cycles per pixel, (n, 4)."""
    turns = [2 * np.pi * k * at for k in (1, 2)]
    return np.column_stack([f(u) for u in turns for f in (np.sin, np.cos)])
