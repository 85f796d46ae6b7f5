"""How far the standard deviation is to be trusted: what the residual picture holds beyond white noise.

The position is a sum over pixels of slope times residual. If neighbours' residuals go together (a codec's blocks,
light that moves over the target, a lens), that sum scatters more than independent noise would. Its variance is
taken from sums over square blocks, each block one draw: the clustered sandwich estimator (White 1980, Econometrica
48:817; Liang & Zeger 1986), averaged over frames.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array
from frictrack.tracking.match import Patch
from frictrack.tracking.measure import residual
from frictrack.tracking.refine import Fine
from frictrack.tracking.template import Template

Rows = NDArray[np.intp]

BLOCKS = (4, 8, 16)  # px
LEAST_BLOCKS = 8  # whose scatter tells anything
STRETCHES, STRETCH_FRAMES = 12, 8  # of the path, and frames of each, whose mean residual pictures are looked at
THIRDS = 3  # parts of a side: light changes over the whole target, not from one small block to the next
POOR = 2.0  # times the usual misfit, from which something else than the target is in a frame
WHOLE = 0.95  # of the usual share of its weight, that a frame which shows the whole target keeps
SURE = 4.0  # standard errors above one from which it is no accident


def inflation(cuts: Patch, fine: Fine, template: Template, share: Patch | None = None) -> Array:
    """Factors (3,) by which the deviations of x, y and the angle exceed those of white noise; 1 where none is seen.

    `share` (n, h, w) is the share of its weight that each pixel has kept.
    """
    slopes = template.columns(fine.turned_back())[:, 2:5] @ template.pictures  # (n, 3, h w)
    left = residual(cuts, fine, template) if share is None else residual(cuts, fine, template) * share
    parts = slopes * (left.reshape(len(cuts), 1, -1) * template.root)
    white = np.sum(parts**2, axis=(0, 2))
    factor = np.ones(3)
    for block in BLOCKS:
        sums = _block_sums(parts.reshape(-1, *cuts.shape[1:]), block).reshape(len(cuts), 3, -1)
        count = sums.shape[2]
        if count < LEAST_BLOCKS:
            break
        # Gauss-Newton has made the sum over each frame zero: one of `count` draws is lost.
        ratio = np.sum(sums**2, axis=(0, 2)) / white * count / (count - 1)
        sure = ratio - 1 > SURE * np.sqrt(2 / (len(cuts) * count))
        factor = np.where(sure, np.maximum(factor, ratio), factor)
    return np.sqrt(factor)


def slow_error(cuts: Patch, fine: Fine, template: Template, share: Patch | None = None) -> Array:
    """Covariance (2, 2), px^2, of what places are off slowly because the target's look changes along its path.

    Light that falls from elsewhere, a highlight that wanders over the body or a background that shows at its edge
    leaves the same residual picture in neighbouring frames. Frame by frame the place is the best one all the same, but
    parts of the target would have it elsewhere: their scatter is the deviation, as in `inflation`, of the mean
    residual picture of a stretch of the path instead of a single frame's. What frames do not share is noise, and
    taken off: with C of one frame and C_m of the mean of n, the slow part is (n C_m - C) / (n - 1).

    Parameters
    ----------
    cuts, fine, share
        Cut-outs (n, h, w) in the order of time, the places in them and the share of each pixel's weight.
    template
        The learnt picture.

    Returns
    -------
    Array
        Zero where no more is seen than noise leaves.

    """
    stretches = [rows for rows in np.array_split(_whole(fine, share), STRETCHES) if len(rows) > 1]
    if len(stretches) < STRETCHES:
        return np.zeros((2, 2))
    few = [rows[np.unique(np.linspace(0, len(rows) - 1, STRETCH_FRAMES).astype(int))] for rows in stretches]
    each = [_parts(cuts[rows], fine[rows], template, None if share is None else share[rows]) for rows in few]
    single, mean = (np.mean([_scatter(part, of_mean) for part in each], axis=0) for of_mean in (False, True))
    n = min(len(part) for part in each)
    chance = np.trace(single) / (n - 1) * np.sqrt(2 / (STRETCHES * THIRDS**2))
    found = (n * mean - single) / (n - 1)
    return np.asarray(found if np.trace(found) > SURE * chance else np.zeros((2, 2)))


def _whole(fine: Fine, share: Patch | None) -> Rows:
    """Frames that show the whole target: what hides part of it leaves a picture of its own, and changes no target."""
    shown = fine.misfit < POOR * np.median(fine.misfit)
    if share is not None:
        kept = share.mean(axis=(1, 2))
        shown &= kept > WHOLE * np.median(kept)
    return np.flatnonzero(shown)


def _parts(cuts: Patch, fine: Fine, template: Template, share: Patch | None) -> Array:
    """By how much each pixel alone moves the places, px along x and y: (n, 2, h, w)."""
    columns = template.columns(fine.turned_back()) @ template.pictures  # (n, 5, h w)
    root = template.root if share is None else template.root * np.sqrt(share.reshape(len(cuts), -1))
    weighted = columns * root[..., None, :]
    normal = weighted @ weighted.transpose(0, 2, 1)
    pull = np.linalg.pinv(normal, hermitian=True)[:, 2:4] @ weighted
    left = residual(cuts, fine, template).reshape(len(cuts), 1, -1)
    left = left if share is None else left * np.sqrt(share.reshape(len(cuts), 1, -1))
    return np.asarray(pull * left / fine.gain[:, None, None]).reshape(len(cuts), 2, *cuts.shape[1:])


def _scatter(parts: Array, of_mean: bool) -> Array:
    """Covariance (2, 2) of places, each ninth of the target one draw: of the mean of frames, or the mean of theirs."""
    parts = parts.mean(axis=0, keepdims=True) if of_mean else parts
    rows, cols = (np.arange(THIRDS) * side // THIRDS for side in parts.shape[2:])
    sums = np.add.reduceat(np.add.reduceat(parts, rows, axis=2), cols, axis=3).reshape(len(parts), 2, -1)
    count = sums.shape[2]
    return np.asarray(np.einsum("nib,njb->ij", sums, sums) / len(parts) * count / (count - 1))


def _block_sums(pictures: Array, block: int) -> Array:
    """Sums over squares of `block` px (n, blocks); the last ones may be smaller."""
    rows, cols = (np.arange(0, s, block) for s in pictures.shape[1:])
    return np.add.reduceat(np.add.reduceat(pictures, rows, axis=1), cols, axis=2).reshape(len(pictures), -1)
