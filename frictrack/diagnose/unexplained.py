"""Describe a force that no effect explains: a smooth curve over its best axis with a band, and formulas that fit it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from frictrack.diagnose.formulas import Shape, search_formulas
from frictrack.diagnose.smooth_forces import ResidualForces
from frictrack.fit.least_squares import Solution
from frictrack.fit.measured_friction import keep_compared_frames


def unexplained_force(
    solution: Solution,
    extended: Solution | None = None,
    forces: ResidualForces | None = None,
    functions: Sequence[Shape] = (),
) -> dict[str, Any]:
    """Describe what a fitted model leaves unexplained.

    Parameters
    ----------
    solution
        The fit.
    extended
        The fit with the effects found so far; the curve is what that leaves. Formulas are added to `solution` if
        possible.
    forces
        Smooth forces in the residual of `solution`, if they were computed before.

    functions
        Further shapes of formulas.

    Returns
    -------
    dict
        `axis`; `factor` that multiplies the curve along a run, as in a study file; `curve` [[axis, N], ...]; `band`, N;
        `share` of the excess chi-squared; `delta_bic`; `axes` compared; `formulas`; `probability_none` that none of
        them has the right form.

    """
    law = keep_compared_frames(solution)
    extended = law if extended is None or extended is solution else keep_compared_frames(extended)
    forces = forces if forces is not None and forces.solution is law else ResidualForces(law)
    smooth = (forces if extended is law else ResidualForces(extended)).smooth
    best = smooth[0]
    formulas = search_formulas(forces, extended, functions)
    stated = sum(f["probability"] for f in formulas)
    return {
        "axis": best.axis.name,
        "factor": best.axis.factor,
        "curve": np.column_stack([best.at, best.force]).tolist(),
        "band": best.sigma.tolist(),
        "share": best.share,
        "delta_bic": best.gain,
        "axes": len(smooth),
        "probability_none": max(1.0 - stated, 0.0) if formulas else None,
        "formulas": formulas,
    }
