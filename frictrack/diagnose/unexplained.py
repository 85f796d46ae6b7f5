"""Describe a force that no effect explains: a smooth curve over its best axis with a band, and formulas that fit it."""

from __future__ import annotations

from typing import Any

import numpy as np

from frictrack.diagnose.compressed import compress_residual
from frictrack.diagnose.formulas import search_formulas
from frictrack.diagnose.smooth_forces import smooth_forces
from frictrack.fit.least_squares import Solution
from frictrack.fit.measured_friction import keep_compared_frames


def unexplained_force(solution: Solution, extended: Solution | None = None) -> dict[str, Any]:
    """Describe what a fitted model leaves unexplained.

    Parameters
    ----------
    solution
        The fit.
    extended
        The fit with the effects found so far; the curve is what that leaves. Formulas are added to `solution` if
        possible.

    Returns
    -------
    dict
        `axis`; `factor` that multiplies the curve along a run, as in a study file; `curve` [[axis, N], ...]; `band`, N;
        `share` of the excess chi-squared; `delta_bic`; `axes` compared; `formulas`.

    """
    law = keep_compared_frames(solution)
    extended = law if extended is None or extended is solution else keep_compared_frames(extended)
    smooth = smooth_forces(compress_residual(extended))
    best = smooth[0]
    return {
        "axis": best.axis.name,
        "factor": best.axis.factor,
        "curve": np.column_stack([best.at, best.force]).tolist(),
        "band": best.sigma.tolist(),
        "share": best.share,
        "delta_bic": best.gain,
        "axes": len(smooth),
        "formulas": search_formulas(law, extended),
    }
