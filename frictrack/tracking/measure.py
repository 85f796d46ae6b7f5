"""Measure positions with the learnt model, and leave out pixels that do not fit it.

A frame whose residuals exceed the noise is fitted again with outlying pixels weighted down (iteratively reweighted
least squares: Holland & Welsch 1977, Commun. Stat. A 6:813). So a rod, a flash or a shadow over part of the target
does not move the result.

Estimate position errors beyond those of white pixel noise: correlated residuals, and a changing appearance.

A position is a sum over pixels of slope times residual. Where the residuals of neighbours are correlated (blocks of a
codec, light that moves over the target, a lens), this sum scatters more than with independent noise. Its variance comes
from sums over square blocks, each block one draw: the clustered sandwich estimator (White 1980, Econometrica 48:817;
Liang & Zeger 1986, Biometrika 73:13), averaged over frames.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from frictrack.base.distributions import robust_std
from frictrack.recording import Recording
from frictrack.records import Array
from frictrack.tracking.correlation import Patch, nearest_corner
from frictrack.tracking.subpixel_fit import SubpixelFit, refine_positions, template_products
from frictrack.tracking.template import MAX_SHIFT_PX, TargetModel, Template

MISFIT_RATIO = 1.5  # to the typical misfit; above it the frame shows more than the target
MAX_REWEIGHTINGS = 4  # rounds of weighting pixels by their residuals
MIN_REMAINING_SHARE = 0.25  # of the pixels, and of the squared slopes along either axis
# residuals up to which a pixel has full weight, and from which it has none
FULL_WEIGHT_SIGMAS, ZERO_WEIGHT_SIGMAS = 2.5, 4.5
PREDICTION_NOISE_RATIO = 2.0  # residual scale of a predicted position over the noise
NEIGHBOUR_SHARES = 0.5, 0.8  # share of fitting neighbours below which a pixel has no weight, and below which less
BLOCK_SIDES_PX = (4, 8, 16)  # px
MIN_BLOCKS = 8  # whose scatter is an estimate
N_STRETCHES, FRAMES_PER_STRETCH = 12, 8  # of the path, and frames of each stretch whose mean residual is taken
PARTS_PER_SIDE = 3  # light changes over the whole target and not from one small block to the next
MAX_TYPICAL_MISFIT_RATIO = 2.0  # to the typical misfit; above it the frame shows something else
MIN_KEPT_SHARE = 0.95  # of the typical weight, in a frame that shows the whole target
MIN_SIGNIFICANCE = 4.0  # standard errors above one


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
    return replace(fit, sigma=fit.sigma * target_model.sigma_inflation), share


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


Rows = NDArray[np.intp]


def sigma_inflation(cuts: Patch, fit: SubpixelFit, template: Template, share: Patch | None = None) -> Array:
    """Compute how far the standard deviations exceed those of white noise.

    Parameters
    ----------
    cuts : array (n, h, w)
        Grey values.
    fit : SubpixelFit
        Fit on the cut-outs.
    template : Template
        Learnt template.
    share : array (n, h, w), optional
        Share of its weight that each pixel kept.

    Returns
    -------
    array (3,)
        Factors for x, y and the angle; 1 where no excess is significant.

    """
    slopes = template.design(fit.unrotated())[:, 2:5] @ template.basis_images  # (n, 3, h w)
    residuals = residual_images(cuts, fit, template) if share is None else residual_images(cuts, fit, template) * share
    pulls = slopes * (residuals.reshape(len(cuts), 1, -1) * template.root_weight)
    white_variance = np.sum(pulls**2, axis=(0, 2))
    factor = np.ones(3)
    for block in BLOCK_SIDES_PX:
        sums = _block_sums(pulls.reshape(-1, *cuts.shape[1:]), block).reshape(len(cuts), 3, -1)
        count = sums.shape[2]
        if count < MIN_BLOCKS:
            break
        # The fit makes the sum over each frame zero: one of `count` degrees of freedom is lost.
        ratio = np.sum(sums**2, axis=(0, 2)) / white_variance * count / (count - 1)
        significant = ratio - 1 > MIN_SIGNIFICANCE * np.sqrt(2 / (len(cuts) * count))
        factor = np.where(significant, np.maximum(factor, ratio), factor)
    return np.sqrt(factor)


def systematic_covariance(cuts: Patch, fit: SubpixelFit, template: Template, share: Patch | None = None) -> Array:
    """Estimate slow position errors that arise because the appearance of the target changes along its path.

    Light from another direction, a highlight that moves over the body, or background at its edge leaves the same
    residual
    in neighbouring frames. Every part of the target then implies a different position. The scatter over the parts is
    the
    error, as in `sigma_inflation`, but for the mean residual of a stretch of the path. Noise, which the frames of a
    stretch
    do not share, is subtracted: with C of one frame and C_m of the mean of n, the slow part is (n C_m - C) / (n - 1).

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


def _block_sums(pictures: Array, block: int) -> Array:
    """Sums over squares of `block` px (n, blocks); the last ones may be smaller."""
    rows, cols = (np.arange(0, s, block) for s in pictures.shape[1:])
    return np.add.reduceat(np.add.reduceat(pictures, rows, axis=1), cols, axis=2).reshape(len(pictures), -1)
