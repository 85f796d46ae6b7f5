"""Determine the order in which effects enter a fit from scratch, and the penalty that each must outweigh."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from frictrack.effects import Effect, Tie
from frictrack.effects.models import Model
from frictrack.fit.least_squares import Solution
from frictrack.fit.parameters import reported_value

EVENT_PARAMETERS = 2.0  # as which an event in one run counts, its moment in addition to its size


def bic_penalty(count: float, frames: int) -> float:
    """Return the fall of chi-squared that `count` further parameters must exceed to lower the BIC.

    Parameters
    ----------
    count : float
        Number of further parameters.
    frames : int
        Number of frames that are fitted.

    Returns
    -------
    float
        Natural logarithm of the frames for every parameter.

    Examples
    --------
    >>> round(bic_penalty(2, 1000), 2)  # 2 ln 1000
    13.82

    References
    ----------
    Schwarz (1978), Annals of Statistics 6, 461-464.

    """
    return count * float(np.log(frames))


def entry_order(model: Model) -> tuple[list[Effect], list[Effect]]:
    """Split the effects of a model into those to start from and those to add later.

    Parameters
    ----------
    model : Model
        The model.

    Returns
    -------
    first : list of Effect
        Effects without scanned parameters.
    later : list of Effect
        The others; none is tied to an effect that comes after it, if possible.

    """
    without_scan: list[Effect] = []
    plain = [e for e in model.effects if e.clock is None and not any(p.free for p in e.nonlinear)]
    while ready := [e for e in plain if e not in without_scan and ties_are_resolved(e, without_scan)]:
        without_scan += ready
    later: list[Effect] = []
    while left := [e for e in model.effects if e not in without_scan and e not in later]:
        later.append(next((e for e in left if ties_are_resolved(e, [*without_scan, *later])), left[0]))
    return [e for e in model.effects if e in without_scan], later


def ties_are_resolved(effect: Effect, known_values: Sequence[Effect]) -> bool:
    """Return whether all effects that an effect is tied to are present."""
    leaders = {Tie.read(p.tie).effect for p in effect.parameters if p.tie}
    return leaders <= {effect.name, *(e.name for e in known_values)}


def reversed_ties(model: Model) -> list[Model]:
    """Return the same model with each tie between two scanned effects reversed, one model per tie.

    A scan sees the leading effect first and alone, so the other direction may find a better start.
    """
    out = []
    for e in model.effects:
        for p in (p for p in e.nonlinear if p.tie):
            tie = Tie.read(str(p.tie))
            leader = next(other for other in model.effects if other.name == tie.effect)
            leader_parameter = leader.parameter(tie.parameter)
            if leader is e or not leader_parameter.free or leader_parameter.scan is None or tie.factor == 0:
                continue
            reversed_tie = f"{1 / tie.factor!r}*{e.name}.{p.name}"
            reversed_effects = {
                leader.name: leader.adjusted(**{leader_parameter.name: {"tie": reversed_tie, "prior": None}}),
                e.name: e.adjusted(**{p.name: {"tie": None}}),
            }
            out.append(Model(tuple(reversed_effects.get(o.name, o) for o in model.effects)))
    return out


def model_without(solution: Solution, name: str) -> Model:
    """Return the model without one effect; parameters tied to it are fixed at their current values."""
    model = solution.problem.model
    values, _ = solution.problem.layout.values(solution.p, 0)
    return Model(
        tuple(
            e.adjusted(
                **{
                    p.name: {"tie": None, "fixed": float(reported_value(model, values, e.name, p.name))}
                    for p in e.parameters
                    if p.tie and Tie.read(p.tie).effect == name
                }
            )
            for e in (model - name).effects
        )
    )
