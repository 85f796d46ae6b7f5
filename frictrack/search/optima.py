"""Find the distinct optima among the points of a search: the papers' "group of feasible solutions"."""

from __future__ import annotations

import numpy as np

from frictrack.records import Array

MAX_EXCESS_COST_SHARE = 0.01  # of the best cost's size
MIN_OPTIMA_DISTANCE = 0.02  # of the box, in every direction: nearer points are one optimum
MAX_CELLS = 2000  # cells compared pairwise


def distinct_optima(points: Array, costs: Array, lower: Array, width: Array) -> tuple[Array, Array]:
    """Find the distinct optima within 1 % of the best cost.

    A point is an optimum of its own when no better point lies within 2 % of the box around it in every coordinate.
    These are the modes of quick shift, so that the slope of one valley counts once.

    Parameters
    ----------
    points : array of shape (n, d)
        Evaluated points.
    costs : array of shape (n,)
        Their costs.
    lower, width : array of shape (d,)
        Lower bounds and widths of the box.

    Returns
    -------
    points : array of shape (k, d)
        The distinct optima, best first.
    costs : array of shape (k,)
        Their costs.

    References
    ----------
    Vedaldi, A. & Soatto, S. (2008). Quick shift and kernel methods for mode seeking. ECCV, 705-718.

    """
    best = costs.min()
    keep = np.flatnonzero(costs <= best + MAX_EXCESS_COST_SHARE * abs(best))
    keep = keep[np.argsort(costs[keep], kind="stable")]
    unit = (points[keep] - lower) / width
    # one point per half radius is enough, and keeps the pairwise comparison small
    cells = np.floor(unit / (MIN_OPTIMA_DISTANCE / 2)).astype(np.int64)
    first = np.sort(np.unique(cells, axis=0, return_index=True)[1])[:MAX_CELLS]
    unit, keep = unit[first], keep[first]
    mode = [i for i in range(len(unit)) if np.all(np.abs(unit[:i] - unit[i]).max(axis=1) > MIN_OPTIMA_DISTANCE)]
    return points[keep[mode]], costs[keep[mode]]
