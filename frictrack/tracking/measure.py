"""Measure positions with the learnt model, and leave out pixels that do not fit it.

A frame whose residuals exceed the noise is fitted again with outlying pixels weighted down (iteratively reweighted
least squares: Holland & Welsch 1977, Commun. Stat. A 6:813). So a rod, a flash or a shadow over part of the target
does not move the result.
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
