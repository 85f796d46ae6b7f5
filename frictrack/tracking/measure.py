"""Measure positions with the learnt model, leave out pixels that do not fit it, and estimate errors beyond noise."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from frictrack.base.distributions import robust_std
from frictrack.recording import Recording
from frictrack.records import Array, Mask, Track
from frictrack.sampling import noise_of_smooth
from frictrack.tracking.correlation import Patch, nearest_corner
from frictrack.tracking.subpixel_fit import RawTrack, SubpixelFit, refine_positions, template_products
from frictrack.tracking.template import MAX_SHIFT_PX, TargetModel, Template
from frictrack.tracking.template_learning import pixel_harmonics

MISFIT_RATIO = 1.5  # to the typical misfit; above it the frame shows more than the target
MAX_REWEIGHTINGS = 4  # rounds of weighting pixels by their residuals
MIN_REMAINING_SHARE = 0.25  # of the pixels, and of the squared slopes along either axis
# residuals up to which a pixel has full weight, and from which it has none
FULL_WEIGHT_SIGMAS, ZERO_WEIGHT_SIGMAS = 2.5, 4.5
PREDICTION_NOISE_RATIO = 2.0  # residual scale of a predicted position over the noise
NEIGHBOUR_SHARES = 0.5, 0.8  # share of fitting neighbours below which a pixel has no weight, and below which less


def measure_frames(
    cuts: Patch, corner: NDArray[np.int64], guess: SubpixelFit, target_model: TargetModel
) -> tuple[SubpixelFit, Patch | None]:
    """Measure the position in cut-outs with a learnt model.

    Parameters
    ----------
    cuts : array (n, h, w)
        Grey values.
    corner : array of int (n, 2)
        Corners (x, y) of the cut-outs, px.
    guess : SubpixelFit
        Fit of an earlier round on the same cut-outs.
    target_model : TargetModel
        Learnt model of the target.

    Returns
    -------
    fit : SubpixelFit
        Positions with their standard deviations.
    share : array (n, h, w) or None
        Share of its weight that each pixel kept; None where all kept all.

    """
    share, template = None, target_model.template
    if target_model.pattern is not None:
        cuts, share = target_model.pattern.corrected(cuts, corner, guess.gain, guess.offset)
    fit = refine_positions(template_products(cuts, template), guess.position, template)
    covered = np.zeros(len(cuts), np.bool_) if share is None else np.any(share < 1, axis=(1, 2))
    typical_misfit = (
        float(np.median(fit.misfit)) if np.isnan(target_model.typical_misfit) else target_model.typical_misfit
    )
    typical_misfit = max(typical_misfit, template.min_misfit)
    suspect = np.flatnonzero((covered | (fit.misfit > MISFIT_RATIO * typical_misfit)) & guess.converged)
    if len(suspect):
        share = np.ones(cuts.shape, np.float32) if share is None else share
        better, kept_share = refine_robust(cuts[suspect], guess[suspect], template, share[suspect], typical_misfit)
        # Where the robust fit fails, the fit to all pixels is kept, with the larger deviation of its misfit.
        refitted = suspect[better.converged]
        share[refitted] = kept_share[better.converged]
        fit.put(refitted, better[better.converged])
    return fit, share


def refine_robust(
    cuts: Patch,
    guess: SubpixelFit,
    template: Template,
    initial_share: Patch | None = None,
    typical_misfit: float = np.nan,
) -> tuple[SubpixelFit, Patch]:
    """Fit cut-outs with pixels weighted by how well they agree with a guess, then with each better fit.

    Parameters
    ----------
    cuts : array (n, h, w)
        Grey values.
    guess : SubpixelFit
        Initial fit.
    template : Template
        Template of the target.
    initial_share : array (n, h, w), optional
        Share of their weight that pixels have at first.
    typical_misfit : float
        Misfit of a frame that shows only target and noise. If it is given, the guess is trusted even against most of
        the
        pixels; by default (NaN) the scale of the residuals comes from the frame itself.

    Returns
    -------
    fit : SubpixelFit
        `converged` is false where too few pixels remain.
    share : array (n, h, w)
        Share of its weight that each pixel kept.

    """
    counts = (template.weight > 0).astype(np.float32)
    initial_share = np.broadcast_to(counts, cuts.shape) if initial_share is None else initial_share * counts
    fit, scale = guess, np.full(len(cuts), PREDICTION_NOISE_RATIO * np.sqrt(typical_misfit))
    enough_pixels, share = np.ones(len(cuts), np.bool_), np.array(initial_share)
    texture = np.stack([slope**2 * template.weight for slope in np.gradient(template.image)]).reshape(2, -1)
    least = MIN_REMAINING_SHARE * (initial_share.reshape(len(cuts), -1) @ texture.T)  # a plain middle fits anywhere
    for k in range(MAX_REWEIGHTINGS):
        residuals = residual_images(cuts, fit, template)
        if k or np.isnan(typical_misfit):
            scale = _residual_scale(residuals, share)
        share = initial_share * inlier_weights(residuals / scale[:, None, None].astype(np.float32), initial_share)
        enough_pixels &= share.mean(axis=(1, 2)) > MIN_REMAINING_SHARE * float(counts.mean())
        enough_pixels &= np.all(share.reshape(len(cuts), -1) @ texture.T >= least, axis=1)
        start = np.clip(np.nan_to_num(fit.unrotated()), -MAX_SHIFT_PX, MAX_SHIFT_PX)
        lost = ~enough_pixels  # nothing sensible is left; the whole picture is as good as any
        share[lost] = initial_share[lost]
        better = refine_positions(template_products(cuts, template, share), start, template)
        failed = ~better.converged  # what went nowhere is no ground to stand on: the last place is
        better.put(failed, replace(fit[failed], converged=better.converged[failed]))
        fit = better
    return replace(fit, converged=fit.converged & enough_pixels), share


def refine_predicted(
    film: Recording,
    frames: NDArray[np.int64],
    predicted: Array,
    guess: SubpixelFit,
    target_model: TargetModel,
    typical_misfit: float,
) -> tuple[NDArray[np.int64], SubpixelFit]:
    """Fit frames robustly from predicted positions (n, 2) px, with the light of a guess; return corners and fit."""
    size = target_model.template.weight.shape
    corner = nearest_corner(predicted, film.shape, size)
    guess = replace(guess, position=np.clip(predicted - corner, -MAX_SHIFT_PX, MAX_SHIFT_PX))
    cuts, share = film.cut(frames, corner, size), None
    if target_model.pattern is not None:
        cuts, share = target_model.pattern.corrected(cuts, corner, guess.gain, guess.offset)
    return corner, refine_robust(cuts, guess, target_model.template, share, typical_misfit)[0]


def _residual_scale(residuals: Patch, share: Patch) -> Array:
    """Standard deviation (n,) of the residuals where pixels count, from their median."""
    scale = [robust_std(p[s > 0.5]) if np.any(s > 0.5) else 1.0 for p, s in zip(residuals, share, strict=True)]
    return np.maximum(scale, 1e-6)


def unexplained_share(score: Any, misfit: Any, typical_misfit: float) -> Any:
    """Compute the share of a picture's variance that neither the target nor the typical noise explains.

    Parameters
    ----------
    score, misfit : float or array
        Match score and misfit of the frames.
    typical_misfit : float
        Misfit of a frame that shows only target and noise.

    Returns
    -------
    float or array
        Between 0 and 1.

    Examples
    --------
    >>> round(float(unexplained_share(0.8, 4.0, 1.0)), 6)
    0.27

    """
    return (1 - score**2) * (1 - typical_misfit / np.maximum(misfit, typical_misfit))


def residual_images(cuts: Patch, fit: SubpixelFit, template: Template) -> Array:
    """Compute what the target does not explain of cut-outs (n, h, w), in standard deviations of the pixel noise."""
    return (template.weighted(cuts) - model_images(fit, template) * template.root_weight).reshape(cuts.shape)


def model_images(fit: SubpixelFit, template: Template) -> Array:
    """Compute what cut-outs should show: grey values above the level of the template (n, h w), DN."""
    columns = template.design(fit.unrotated())
    ones = np.ones_like(fit.gain)
    parts = np.stack([fit.gain, fit.offset - template.level, 0 * ones, 0 * ones, fit.gain * fit.angle], axis=1)
    weights = np.einsum("ni,nik->nk", parts, columns).astype(np.float32)
    return np.asarray(weights @ template.basis_images.astype(np.float32))


def inlier_weights(standardised: Patch, initial_share: Patch) -> Patch:
    """Weight pixels by their own residual and by those of their neighbours.

    Parameters
    ----------
    standardised : array (n, h, w)
        Residuals in standard deviations.
    initial_share : array (n, h, w)
        Share of their weight that pixels have at first.

    Returns
    -------
    array (n, h, w)
        1 for pixels that fit, 0 for outliers, linear in between.

    """
    weights, (low, high) = np.empty_like(standardised), NEIGHBOUR_SHARES
    for k, picture in enumerate(standardised):
        local_mean = 3 * np.abs(cv2.blur(picture, (3, 3)))  # the mean of nine: a standard deviation of one third
        deviation = np.maximum(np.abs(picture), local_mean)
        fitting = np.clip((ZERO_WEIGHT_SIGMAS - deviation) / (ZERO_WEIGHT_SIGMAS - FULL_WEIGHT_SIGMAS), 0, 1)
        # A fitting pixel among many outliers fits by chance.
        around = np.maximum(cv2.blur(initial_share[k], (5, 5)), 0.1)
        neighbour_share = cv2.blur(fitting * (initial_share[k] > 0), (5, 5)) / around
        weights[k] = fitting * np.clip((neighbour_share - low) / (high - low), 0, 1)
    return weights


N_STRETCHES, FRAMES_PER_STRETCH = 12, 8  # of the path, and frames of each stretch whose mean residual is taken
PARTS_PER_SIDE = 3  # light changes over the whole target and not from one small block to the next
MAX_TYPICAL_MISFIT_RATIO = 2.0  # to the typical misfit; above it the frame shows something else
LEAST_QUANTILE = 0.1  # of the deviations in all frames: that of a frame which shows the whole target
MIN_KEPT_SHARE = 0.95  # of the typical weight, in a frame that shows the whole target
MIN_SIGNIFICANCE = 4.0  # standard errors above one
# Rms shift of the target over the shift whose picture differs by as much as the residuals: 0.15 to 0.3 in films of
# known truth by MPEG-4, H.264 and H.265, whatever their quality, texture, noise and speed.
CODEC_SHIFT_SHARE = 0.19
LASTING_SHARE = 0.5  # of that shift, the least that lasts for many frames: with less, laws err beyond their deviations
MAX_PAIRS, MIN_PAIRS = 48, 16  # of neighbouring frames whose residuals are compared
LATER_FRAMES = 16  # after which a codec repeats little, and light, dirt or a poor template as much as before
MIN_REPEATED_SHARE = 0.2  # of the residual power; frames that are coded alone, as MJPEG, repeat 0.1 at most
MAX_SCATTER_ERROR = 0.2  # relative standard deviation of a scatter that is believed; of fewer frames it may be motion
MIN_SCATTER_SIGMAS = 2.0  # standard deviations of the scatter by which it exceeds the stated one


def codec_shift(film: Recording, raw_track: RawTrack, target_model: TargetModel, counts: Mask) -> Array:
    """Rms shift along x and y (2,) px by which a codec that repeats frames leaves the target displaced; else zeros."""
    found, template = raw_track.found & counts & _is_whole(raw_track.fit), target_model.template
    first = np.flatnonzero(found[:-LATER_FRAMES] & found[1 : 1 - LATER_FRAMES] & found[LATER_FRAMES:])
    if target_model.rotates or len(first) < MIN_PAIRS:
        return np.zeros(2)
    first = first[np.unique(np.linspace(0, len(first) - 1, MAX_PAIRS).astype(int))]
    used, at = np.unique(first + np.array([[0], [1], [LATER_FRAMES]]), return_inverse=True)
    shown = template.weight > 0
    cuts = film.cut(used, raw_track.corner[used], template.weight.shape)
    left = residual_images(cuts, raw_track.fit[used], template) / np.sqrt(np.where(shown, template.weight, np.inf))
    # light that changes over the target is smooth
    fine = np.array([cv2.Laplacian(picture.astype(np.float32), cv2.CV_32F)[1:-1, 1:-1].ravel() for picture in left])
    fine -= _of_pixel_phase(raw_track.position[used], fine)
    fine /= np.maximum(np.linalg.norm(fine, axis=1, keepdims=True), 1e-30)
    now, after, later = fine[at.reshape(3, -1)]
    repeated = float(np.median(np.sum(now * after, axis=1)) - np.median(np.sum(now * later, axis=1)))
    if repeated < MIN_REPEATED_SHARE:
        return np.zeros(2)
    power = np.median(np.mean(left[:, shown] ** 2, axis=1))
    slopes = np.array([np.mean(np.gradient(template.image, axis=axis)[shown] ** 2) for axis in (1, 0)])
    return np.asarray(CODEC_SHIFT_SHARE * np.sqrt(power / np.maximum(slopes, 1e-30)))


def _is_whole(fit: SubpixelFit) -> Mask:
    """Frames in which the whole target is seen: what hides a part of it leaves residuals of its own."""
    formal = fit.sigma[:, 0] / np.sqrt(np.maximum(fit.misfit, 1e-30))  # goes with the root of the weight that is left
    return np.asarray(formal <= np.nanquantile(formal, LEAST_QUANTILE) / np.sqrt(MIN_KEPT_SHARE))


def _of_pixel_phase(position: Array, residuals: Array) -> Array:
    """What of residuals (n, pixels) depends on the place (n, 2) px between the pixels: of too sharp a target."""
    x, y = (pixel_harmonics(position[:, axis]) for axis in (0, 1))
    products = (x[:, :2, None] * y[:, None, :2]).reshape(len(x), -1)
    columns = np.column_stack([np.ones(len(x)), x, y, products])
    return np.asarray(columns @ np.linalg.lstsq(columns, residuals, rcond=None)[0])


def with_scatter(track: Track, direction: Array, shift: Array, counts: Mask) -> Track:
    """Raise the stated deviations of a track to the scatter of its positions and the shift (2,) px of a codec.

    Only frames that count (n,) scatter, not those that show the picture before once more. What of the shift does not
    scatter from frame to frame along the path, whose `direction` is a unit vector (2,), is its slow error.
    """
    columns: dict[str, Any] = {}
    for name, series in (("sigma_px", track.x_px), ("sigma_y_px", track.y_px), ("sigma_angle", track.angle)):
        stated = getattr(track, name)
        usual = float(np.nanmedian(stated))
        scatter, error = noise_of_smooth(series[counts], track.t[: np.sum(counts)])
        exceeds = error < MAX_SCATTER_ERROR and scatter * (1 - MIN_SCATTER_SIGMAS * error) > usual
        columns[name] = stated * (scatter / usual) if exceeds else stated
    level = [float(np.nanmedian(columns[name])) for name in ("sigma_px", "sigma_y_px")]
    slow = np.sqrt(float(direction**2 @ np.maximum(shift**2 - np.square(level), (LASTING_SHARE * shift) ** 2)))
    for name, usual, whole in zip(("sigma_px", "sigma_y_px"), level, shift, strict=True):
        columns[name] = columns[name] * max(np.sqrt(max(whole**2 - slow**2, 0.0)) / usual, 1.0)
    before, after = (
        float(direction**2 @ [np.nanmedian(one) ** 2 for one in pair])
        for pair in ((track.sigma_px, track.sigma_y_px), (columns["sigma_px"], columns["sigma_y_px"]))
    )
    notes = track.notes
    if np.any(shift):
        notes += (
            "the codec of the film makes frames from the ones before, as MPEG-4 and H.264 do: it leaves the target "
            f"displaced by {np.hypot(slow, level[0]):.2g} px rms, of which {slow:.2g} px last for many frames; an "
            "uncompressed film, or one by MJPEG, has no such errors",
        )
    slow_error = float(np.hypot(track.systematic, slow))
    return replace(track, **columns, systematic=slow_error, raised=float(np.sqrt(after / before)), notes=notes)


Rows = NDArray[np.intp]


def systematic_covariance(cuts: Patch, fit: SubpixelFit, template: Template, share: Patch | None = None) -> Array:
    """Estimate slow position errors that arise because the appearance of the target changes along its path.

    Light from another direction, a highlight that moves over the body, or background at its edge leaves the same
    residual in neighbouring frames. Every part of the target then implies a different position. The scatter over the
    parts is the error (the clustered sandwich estimator: White 1980, Econometrica 48:817), for the mean residual of a
    stretch of the path. Noise, which the frames of a stretch do not share, is subtracted: with C of one frame and C_m
    of the mean of n, the slow part is (n C_m - C) / (n - 1).

    Parameters
    ----------
    cuts : array (n, h, w)
        Grey values in the order of time.
    fit : SubpixelFit
        Fit on the cut-outs.
    template : Template
        Learnt template.
    share : array (n, h, w), optional
        Share of its weight that each pixel kept.

    Returns
    -------
    array (2, 2)
        Covariance of x and y, px^2; zero where it is not significant.

    """
    stretches = [rows for rows in np.array_split(_unoccluded_frames(fit, share), N_STRETCHES) if len(rows) > 1]
    if len(stretches) < N_STRETCHES:
        return np.zeros((2, 2))
    subset = [rows[np.unique(np.linspace(0, len(rows) - 1, FRAMES_PER_STRETCH).astype(int))] for rows in stretches]
    pulls = [_pixel_pulls(cuts[rows], fit[rows], template, None if share is None else share[rows]) for rows in subset]
    single_frame, mean = (
        np.mean([_block_covariance(part, of_mean) for part in pulls], axis=0) for of_mean in (False, True)
    )
    n = min(len(part) for part in pulls)
    standard_error = np.trace(single_frame) / (n - 1) * np.sqrt(2 / (N_STRETCHES * PARTS_PER_SIDE**2))
    slow_part = (n * mean - single_frame) / (n - 1)
    return np.asarray(slow_part if np.trace(slow_part) > MIN_SIGNIFICANCE * standard_error else np.zeros((2, 2)))


def _unoccluded_frames(fit: SubpixelFit, share: Patch | None) -> Rows:
    """Frames that show the whole target: an occluding object leaves residuals of its own."""
    unoccluded = fit.misfit < MAX_TYPICAL_MISFIT_RATIO * np.median(fit.misfit)
    if share is not None:
        kept = share.mean(axis=(1, 2))
        unoccluded &= kept > MIN_KEPT_SHARE * np.median(kept)
    return np.flatnonzero(unoccluded)


def _pixel_pulls(cuts: Patch, fit: SubpixelFit, template: Template, share: Patch | None) -> Array:
    """Shift of the position along x and y that each pixel causes, (n, 2, h, w) px."""
    design = template.design(fit.unrotated()) @ template.basis_images  # (n, 5, h w)
    root_weight = (
        template.root_weight if share is None else template.root_weight * np.sqrt(share.reshape(len(cuts), -1))
    )
    weighted = design * root_weight[..., None, :]
    normal = weighted @ weighted.transpose(0, 2, 1)
    operator = np.linalg.pinv(normal, hermitian=True)[:, 2:4] @ weighted
    residuals = residual_images(cuts, fit, template).reshape(len(cuts), 1, -1)
    residuals = residuals if share is None else residuals * np.sqrt(share.reshape(len(cuts), 1, -1))
    return np.asarray(operator * residuals / fit.gain[:, None, None]).reshape(len(cuts), 2, *cuts.shape[1:])


def _block_covariance(pulls: Array, of_mean: bool) -> Array:
    """Covariance (2, 2) of the position, each ninth of the target one draw: per frame, or of the mean of frames."""
    pulls = pulls.mean(axis=0, keepdims=True) if of_mean else pulls
    rows, cols = (np.arange(PARTS_PER_SIDE) * side // PARTS_PER_SIDE for side in pulls.shape[2:])
    sums = np.add.reduceat(np.add.reduceat(pulls, rows, axis=2), cols, axis=3).reshape(len(pulls), 2, -1)
    count = sums.shape[2]
    return np.asarray(np.einsum("nib,njb->ij", sums, sums) / len(pulls) * count / (count - 1))
