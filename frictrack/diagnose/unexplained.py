"""Structure that no effect explains: a smooth force over its best axis with a band, and the formulas that fit it."""

from __future__ import annotations

from typing import Any

import numpy as np

from frictrack.diagnose.compressed import compress_residual
from frictrack.diagnose.formulas import search_formulas
from frictrack.diagnose.smooth_forces import smooth_forces
from frictrack.fit.least_squares import Solution
from frictrack.fit.measured_friction import keep_compared_frames


def unexplained_force(solution: Solution, beside: Solution | None = None) -> dict[str, Any]:
    """What a fitted law leaves, over its best axis: curve [[axis, N], ...], band (N), share of the excess, formulas.

    `factor` is what multiplies the curve along a run, as a study file writes it. `beside` is the law with what was
    found so far: the curve is what that leaves; the formulas stand beside the law itself where they can.
    """
    law = keep_compared_frames(solution)
    beside = law if beside is None or beside is solution else keep_compared_frames(beside)
    smooth = smooth_forces(compress_residual(beside))
    best = smooth[0]
    return {
        "axis": best.axis.name,
        "factor": best.axis.factor,
        "curve": np.column_stack([best.at, best.force]).tolist(),
        "band": best.sigma.tolist(),
        "share": best.share,
        "delta_bic": best.gain,
        "axes": len(smooth),
        "formulas": search_formulas(law, beside),
    }
