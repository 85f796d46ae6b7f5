"""The papers' "group of feasible solutions": the distinct optima that a search met."""

from __future__ import annotations

import numpy as np

from frictrack.records import Array

WITHIN = 0.01  # of the best cost's size
RADIUS = 0.02  # of the box, in every direction: nearer points are one optimum
MOST = 2000  # cells compared pairwise


def distinct_optima(points: Array, costs: Array, lower: Array, width: Array) -> tuple[Array, Array]:
    """Points (k, d) and costs (k,) of the distinct optima within 1 % of the best cost, best first.

    A point is an optimum of its own when no better point that was met lies within 2 % of the box around it (in
    every coordinate): the modes of quick shift (Vedaldi & Soatto 2008), so the slope of one valley counts once.
    """
    best = costs.min()
    keep = np.flatnonzero(costs <= best + WITHIN * abs(best))
    keep = keep[np.argsort(costs[keep], kind="stable")]
    unit = (points[keep] - lower) / width
    # one point per half radius is enough, and keeps the pairwise comparison small
    cells = np.floor(unit / (RADIUS / 2)).astype(np.int64)
    first = np.sort(np.unique(cells, axis=0, return_index=True)[1])[:MOST]
    unit, keep = unit[first], keep[first]
    mode = [i for i in range(len(unit)) if np.all(np.abs(unit[:i] - unit[i]).max(axis=1) > RADIUS)]
    return points[keep[mode]], costs[keep[mode]]
