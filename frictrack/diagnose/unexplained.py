"""Structure that no effect explains, shown as a smooth curve over the axis on which it repeats best."""

from __future__ import annotations

from typing import Any

import numpy as np

from frictrack.compare import residual_force
from frictrack.fit.simulated.solve import Solution
from frictrack.records import Array

BINS = 24


def unexplained_force(solution: Solution) -> dict[str, Any]:
    """Residual force against t, x or v, whichever collects most of its variance: axis, curve [[axis, N], ...]."""
    parts = [residual_force(r) for r in solution.responses]
    force = np.concatenate([p.F for p in parts])
    axes = {
        "x": np.concatenate([r.motion.x_edge[r.piece.at] for r in solution.responses]),
        "t": np.concatenate([r.piece.t for r in solution.responses]),
        "v": np.concatenate([r.motion.v_edge[r.piece.at] for r in solution.responses]),
    }
    curves = {name: _binned(axis, force) for name, axis in axes.items()}
    best = max(curves, key=lambda name: curves[name][1])
    return {"axis": best, "curve": curves[best][0].tolist(), "formulas": []}


def _binned(axis: Array, force: Array) -> tuple[Array, float]:
    """Means of the force in equal bins of the axis, (k, 2), and the share of its variance that they explain."""
    edges = np.linspace(axis.min(), axis.max(), BINS + 1)
    which = np.clip(np.digitize(axis, edges) - 1, 0, BINS - 1)
    filled = [k for k in range(BINS) if np.any(which == k)]
    means = np.array([force[which == k].mean() for k in filled])
    counts = np.array([np.sum(which == k) for k in filled])
    share = float(np.sum(counts * (means - force.mean()) ** 2) / max(np.sum((force - force.mean()) ** 2), 1e-300))
    centres = np.array([axis[which == k].mean() for k in filled])
    return np.column_stack([centres, means]), share
