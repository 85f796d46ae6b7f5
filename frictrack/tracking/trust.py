"""How far the standard deviation is to be trusted: what the residual picture holds beyond white noise.

The position is a sum over pixels of slope times residual. If neighbours' residuals go together (a codec's blocks,
light that moves over the target, a lens), that sum scatters more than independent noise would. Its variance is
taken from sums over square blocks, each block one draw: the clustered sandwich estimator (White 1980, Econometrica
48:817; Liang & Zeger 1986), averaged over frames.
"""

from __future__ import annotations

import numpy as np

from frictrack.records import Array
from frictrack.tracking.match import Patch
from frictrack.tracking.measure import residual
from frictrack.tracking.refine import Fine
from frictrack.tracking.template import Template

BLOCKS = (4, 8, 16)  # px
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
        if count < 8:
            break
        # Gauss-Newton has made the sum over each frame zero: one of `count` draws is lost.
        ratio = np.sum(sums**2, axis=(0, 2)) / white * count / (count - 1)
        sure = ratio - 1 > SURE * np.sqrt(2 / (len(cuts) * count))
        factor = np.where(sure, np.maximum(factor, ratio), factor)
    return np.sqrt(factor)


def _block_sums(pictures: Array, block: int) -> Array:
    """Sums over squares of `block` px (n, blocks); the last ones may be smaller."""
    rows, cols = (np.arange(0, s, block) for s in pictures.shape[1:])
    return np.add.reduceat(np.add.reduceat(pictures, rows, axis=1), cols, axis=2).reshape(len(pictures), -1)
