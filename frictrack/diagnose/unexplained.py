"""Describe a force that no effect explains: a smooth curve over its best axis with a band, and formulas that fit it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from frictrack.axes import AXES
from frictrack.diagnose.compressed import is_far_from_data
from frictrack.diagnose.formulas import EFFECT_NAME, FoundFormulas, Shape, search_formulas
from frictrack.diagnose.smooth_forces import ResidualForces, forces_of
from frictrack.fit.least_squares import Solution
from frictrack.fit.observations import keep_compared_frames

FIRST_FORMULA = "formula:1"  # as in `frictrack add STUDY formula:1`


@dataclass(frozen=True)
class UnexplainedForce:
    """A force that no effect explains.

    Attributes
    ----------
    summary
        `axis`; `factor` that multiplies the curve along a run, as in a study file; `curve` [[axis, N], ...]; `band`, N;
        `share` of the excess chi-squared; `delta_bic`; `axes` compared; `formulas`; `probability_none` that none of
        them has the right form.
    formulas
        The formulas, with the fit of the first one.

    """

    summary: dict[str, Any]
    formulas: FoundFormulas

    def as_candidate(self) -> tuple[str, Solution, float] | None:
        """The first formula as a candidate: its name in `frictrack add`, its fit, and its fall of BIC.

        None if there is no formula, or if it is a sum of several terms.
        """
        first = self.formulas.first
        if first is None or len(first.terms) > 1:
            return None
        old = first.solution.problem
        variables = " and ".join(AXES[name].name for name in first.terms[0].variables)
        known = f"the formula depends on {variables} alone"
        effects = tuple(
            replace(e, name=FIRST_FORMULA, invariant=known) if e.name == EFFECT_NAME else e for e in old.model.effects
        )
        layout = replace(old.layout, model=replace(old.layout.model, effects=effects))
        law = replace(first.solution, problem=old.rebuild(layout, old.pieces))
        return FIRST_FORMULA, law, first.delta_bic


def unexplained_force(
    solution: Solution,
    extended: Solution | None = None,
    forces: ResidualForces | None = None,
    functions: Sequence[Shape] = (),
) -> UnexplainedForce:
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
    UnexplainedForce

    """
    law = keep_compared_frames(solution)
    extended = law if extended is None or extended is solution else keep_compared_frames(extended)
    if forces is None or forces.solution is not law or is_far_from_data(law):
        forces = forces_of(law)
    smooth = (forces if extended is law else forces_of(extended)).smooth
    best = smooth[0]
    formulas = search_formulas(forces, extended, functions)
    stated = sum(f["probability"] for f in formulas.entries)
    summary = {
        "axis": best.axis.name,
        "factor": best.axis.factor,
        "curve": np.column_stack([best.at, best.force]).tolist(),
        "band": best.sigma.tolist(),
        "share": best.share,
        "delta_bic": best.gain,
        "axes": len(smooth),
        "probability_none": max(1.0 - stated, 0.0) if formulas.entries else None,
        "formulas": formulas.entries,
    }
    return UnexplainedForce(summary, formulas)
