"""Estimate position errors beyond those of white pixel noise: correlated residuals, and a changing appearance.

A position is a sum over pixels of slope times residual. Where the residuals of neighbours are correlated (blocks of a
codec, light that moves over the target, a lens), this sum scatters more than with independent noise. Its variance comes
from sums over square blocks, each block one draw: the clustered sandwich estimator (White 1980, Econometrica 48:817;
Liang & Zeger 1986, Biometrika 73:13), averaged over frames.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array
from frictrack.tracking.correlation import Patch
from frictrack.tracking.measure import residual_images
from frictrack.tracking.subpixel_fit import SubpixelFit
from frictrack.tracking.template import Template

Rows = NDArray[np.intp]

BLOCK_SIDES_PX = (4, 8, 16)  # px
MIN_BLOCKS = 8  # whose scatter is an estimate
N_STRETCHES, FRAMES_PER_STRETCH = 12, 8  # of the path, and frames of each stretch whose mean residual is taken
PARTS_PER_SIDE = 3  # light changes over the whole target and not from one small block to the next
MAX_MISFIT_RATIO = 2.0  # to the typical misfit; above it the frame shows something else
MIN_KEPT_SHARE = 0.95  # of the typical weight, in a frame that shows the whole target
MIN_SIGNIFICANCE = 4.0  # standard errors above one


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
    unoccluded = fit.misfit < MAX_MISFIT_RATIO * np.median(fit.misfit)
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
