"""Say which parameters of a model a bound holds, where the model alone would explain the misfit beyond it."""

from __future__ import annotations

import numpy as np

from frictrack.fit.least_squares import Solution

MIN_SHARE_OF_FALL = 0.5  # of what the effects found explain


def held_remarks(model: Solution, grown: Solution) -> list[str]:
    """Return one remark if bounds hold parameters of a model that would explain much of the misfit beyond them.

    Parameters
    ----------
    model
        The model that is diagnosed.
    grown
        The model with the effects found.

    Returns
    -------
    list of str
        Empty if no bound matters. Linear coefficients are not named, because another sign of them is no law.

    """
    slots = model.problem.layout.slots
    named = [i for i, held in enumerate(model.held) if held and not slots[i].linear]
    if not named or _fall_beyond_bounds(model) < MIN_SHARE_OF_FALL * (model.objective - grown.objective):
        return []
    names = " and ".join(f"{slots[i].effect}.{slots[i].parameter}" for i in named)
    values = " and ".join(f"{model.p[i]:.3g} {slots[i].unit}".removesuffix(" 1") for i in named)
    are, its_bound, it = ("is", "its bound", "it") if len(named) == 1 else ("are", "their bounds", "them")
    return [
        f"{names} {are} held by {its_bound}, {values}; beyond {it} the model alone would explain much of the misfit: "
        f"where such a value is possible, give {names} wider bounds and fit again"
    ]


def _fall_beyond_bounds(model: Solution) -> float:
    """Fall of the objective by the best step of all unknowns, whatever their bounds."""
    rows, right = model.penalised_rows_and_residual
    step = np.linalg.lstsq(rows, right, rcond=None)[0]
    return float(right @ right - np.sum((right - rows @ step) ** 2))
