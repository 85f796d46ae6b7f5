"""Judge whether a fitted candidate is physically plausible."""

from __future__ import annotations

import numpy as np

from frictrack.effects import Effect
from frictrack.fit.least_squares import Solution, inverse_normal_matrix
from frictrack.fit.parameters import ParameterLayout, penalty_jacobian
from frictrack.records import Array

MIN_SIGNIFICANCE = 3.0  # standard deviations that an effect's size must exceed


def objection(solution: Solution, effect: Effect) -> str:
    """Return why a fitted effect cannot be the cause.

    The effect's own check (`Effect.plausible`) must pass in at least one run where it acts. At least one of its sizes
    must exceed three standard deviations with its shape held: a narrow strong patch and a wide weak one are
    interchangeable, although a patch is there.

    Parameters
    ----------
    solution
        The fit with the effect.
    effect
        The effect.

    Returns
    -------
    str
        Empty if there is no objection.

    """
    return physical_objection(solution.problem.layout, solution.p, effect) or _insignificant(solution, effect)


def physical_objection(layout: ParameterLayout, p: Array, effect: Effect) -> str:
    """Return the effect's own objection to its fitted values, if it holds in every run in which it acts."""
    if effect.plausible is None:
        return ""
    found = []
    for run in range(len(layout.run_names)):
        values, _ = layout.values(p, run)
        if effect.name not in values or (effect.name, run) in layout.absent:
            continue
        span = layout.spans[run] if any(p.per_run for p in effect.parameters if p.linear) else layout.span
        found.append(effect.plausible(values[effect.name], span))
    return found[0] if found and all(found) else ""


def _insignificant(solution: Solution, effect: Effect) -> str:
    """Objection that no size of the effect is significant."""
    layout = solution.problem.layout
    sizes = {p.name: p.unit for p in effect.parameters if p.linear or p.role == "depth"}
    at = [i for i, s in enumerate(layout.slots) if s.effect == effect.name and s.parameter in sizes]
    if not at:
        return ""
    std = _std_in_shape(solution, effect, at)
    value = solution.p[at]
    if np.any(np.abs(value) > MIN_SIGNIFICANCE * std):
        return ""
    k = int(np.argmax(np.abs(value) / np.maximum(std, 1e-300)))
    slot = layout.slots[at[k]]
    return (
        f"{slot.parameter} = {value[k]:.2g} +/- {std[k]:.2g} {sizes[slot.parameter]} is not larger than "
        f"{MIN_SIGNIFICANCE:g} of its standard deviations"
    )


def _std_in_shape(solution: Solution, effect: Effect, at: list[int]) -> Array:
    """Standard deviations of some parameters while the others of their effect, and those at a bound, are held."""
    layout = solution.problem.layout
    others = [s.effect != effect.name and not held for s, held in zip(layout.slots, solution.held, strict=True)]
    free = [i for i, is_free in enumerate(others) if is_free or i in at]
    rows = np.vstack([solution.few_rows, penalty_jacobian(layout, solution.tau or 0.03, solution.p)])
    covariance, _ = inverse_normal_matrix(rows[:, free])
    return np.sqrt(np.maximum(np.diag(covariance)[[free.index(i) for i in at]], 0.0))
