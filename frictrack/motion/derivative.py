"""The stage low-passed displacement -> velocity and acceleration, with standard deviations."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from frictrack.motion.grid import Grid, frame_grid
from frictrack.motion.smoother import MISSING, deviations, lost_share, penalty, smooth, weights
from frictrack.records import Array, Filtered, Motion

NODES = 6  # frames a derivative stencil may take


def differentiate(filtered: Filtered) -> Motion:
    """Velocity and acceleration of a low-passed displacement by central differences.

    Five-point stencils inside, six-point ones at the ends, exact for polynomials of fourth order throughout.
    The standard deviations are those of the stencils under the covariance of the smoother: the noise that it
    lets through, and the signal that it takes away on average over the record. `guard`
    is half a period of the cut-off, in which an abrupt event is smeared down to a fifth, or the end frames in
    which sigma_a exceeds twice its median, if these are more; never more than an eighth of the record.
    """
    bounds = [*filtered.breaks, len(filtered)]
    cutoffs = filtered.cutoffs or (filtered.cutoff,)
    cutoffs_y = filtered.cutoffs_y or (filtered.cutoff_y,)
    stretches = [slice(i, j) for i, j in pairwise(bounds)]
    made = [_stretch(filtered, s, f, f_y) for s, f, f_y in zip(stretches, cutoffs, cutoffs_y, strict=True)]
    x, v, a, a_y = np.concatenate(made, axis=2)
    slide = stretches[cutoffs.index(filtered.cutoff)]
    period = 1.0 / (filtered.cutoff * frame_grid(filtered.t).interval)
    return Motion(
        t=filtered.t,
        x=x[0],
        v=v[0],
        a=a[0],
        a_y=a_y[0],
        sigma_x=x[1],
        sigma_v=v[1],
        sigma_a=a[1],
        sigma_a_y=a_y[1],
        guard=_guard(a[1][slide][filtered.sigma_x[slide] < MISSING], period),
        cutoff=filtered.cutoff,
        breaks=filtered.breaks,
    )


def _stretch(filtered: Filtered, s: slice, cutoff: float, cutoff_y: float) -> Array:
    """x, v, a and a_y of one stretch with their standard deviations, (4, 2, n)."""
    grid = frame_grid(filtered.t[s])
    along = _derive(filtered.x[s], filtered.sigma_x[s], cutoff, grid)
    across = np.full((1, 2, along.shape[2]), np.nan)
    if np.isfinite(cutoff_y):
        across = _derive(filtered.y[s], filtered.sigma_y[s], cutoff_y, grid)[2:]
    return np.concatenate([along, across])


def _derive(x: Array, sigma: Array, cutoff: float, grid: Grid) -> Array:
    """Derivatives of order 0, 1, 2 of the rows, with their standard deviations (3, 2, n)."""
    known = sigma < MISSING
    w = grid.spread(weights(sigma, known))
    noise = float(np.mean(sigma[known] ** -2.0) ** -0.5)  # of a frame of weight 1
    lam, whole = penalty(cutoff, grid.interval), _whole(x, grid)
    start, stencils = _stencils(grid)
    values = np.sum(stencils * whole[start[:, None] + np.arange(NODES)], axis=-1)
    spread = noise * deviations(w, lam, lost_share(whole, lam, noise**2), start, stencils)
    return np.stack([values, spread], axis=1)[:, :, grid.frames]


def _whole(x: Array, grid: Grid) -> Array:
    """Smoothed rows on the grid; frames without a row are bridged with the least third differences."""
    if grid.n == len(x):
        return x
    w = grid.spread(np.full(len(x), 1e6))  # so much that the rows, smooth as they are, stay in place
    return smooth(grid.spread(x), w, 1.0)


def _stencils(grid: Grid) -> tuple[NDArray[np.int64], Array]:
    """First frame (n,) and weights (3, n, NODES) of the stencils of order 0, 1, 2 of every frame of the grid."""
    frame = np.arange(grid.n)
    start = np.clip(frame - 2, 0, grid.n - NODES)
    place = frame - start
    table = np.array([[_stencil(p, order) for p in range(NODES)] for order in range(3)])
    return start, table[:, place] / grid.interval ** np.arange(3.0)[:, None, None]


def _stencil(place: int, order: int) -> Array:
    """Weights (NODES,) of the derivative at node `place`; five nodes where these lie symmetric about it."""
    m = NODES - 1 if place == 2 else NODES
    powers = np.vander(np.arange(m) - float(place), increasing=True).T
    wanted = np.array([1.0, 1.0, 2.0])[order] * (np.arange(m) == order)
    return np.pad(np.linalg.solve(powers, wanted), (0, NODES - m))


def _guard(sigma_a: Array, period: float) -> int:
    """Frames not to be trusted at an end; `period` of the cut-off in frames."""
    good = np.flatnonzero(sigma_a <= 2.0 * np.median(sigma_a))
    ragged = max(good[0], len(sigma_a) - 1 - good[-1])
    return int(min(max(np.ceil(period / 2.0), ragged), len(sigma_a) // 8))
