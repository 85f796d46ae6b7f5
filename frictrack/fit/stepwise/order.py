"""Determine the order in which effects enter a fit from scratch, and what is known of an effect before its scan."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from frictrack.effects import Effect, Parameter, Tie, Within
from frictrack.fit.least_squares import Solution
from frictrack.fit.parameters import reported_value
from frictrack.models import Model

PRIOR_HALF_WIDTH_STD = 4.0  # range of a scan about a prior, standard deviations


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
    while ready := [
        e for e in model.effects if e not in without_scan and not _needs_scan(e) and ties_are_resolved(e, without_scan)
    ]:
        without_scan += ready
    later: list[Effect] = []
    while left := [e for e in model.effects if e not in without_scan and e not in later]:
        later.append(next((e for e in left if ties_are_resolved(e, [*without_scan, *later])), left[0]))
    return [e for e in model.effects if e in without_scan], later


def _needs_scan(effect: Effect) -> bool:
    return effect.clock is not None or any(p.free for p in effect.nonlinear)


def ties_are_resolved(effect: Effect, known_values: Sequence[Effect]) -> bool:
    """Return whether all effects that an effect is tied to are present."""
    leaders = {Tie.read(p.tie).effect for p in effect.parameters if p.tie}
    return leaders <= {effect.name, *(e.name for e in known_values)}


def effect_for_scan(solution: Solution, effect: Effect) -> Effect:
    """Prepare an effect for a scan beside a fitted model.

    Tied parameters are fixed at their current values; priors narrow the range of the scan.

    Parameters
    ----------
    solution : Solution
        The fitted model.
    effect : Effect
        The candidate.

    Returns
    -------
    Effect
        The effect to scan.

    """
    changes: dict[str, dict[str, Any]] = {}
    values, _ = solution.problem.layout.values(solution.p, 0)
    for p in effect.nonlinear:
        tie = Tie.read(p.tie) if p.tie else None
        if tie is not None and tie.effect != effect.name:
            known_values = tie.factor * float(reported_value(solution.problem.model, values, tie.effect, tie.parameter))
            changes[p.name] = {"fixed": known_values, "tie": None, "per_run": False}
        elif p.fixed is not None and p.per_run:
            changes[p.name] = {"per_run": False}
        elif p.prior is not None and p.scan is not None:
            changes[p.name] = {"scan": _scan_near_prior(p, p.prior)}
    return effect.adjusted(**changes)


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
    out = []
    for e in (model - name).effects:
        followers = [p for p in e.parameters if p.tie and Tie.read(p.tie).effect == name]
        known_values = {
            p.name: {"tie": None, "fixed": float(reported_value(model, values, e.name, p.name))} for p in followers
        }
        out.append(e.adjusted(**known_values) if known_values else e)
    return Model(tuple(out))


def _scan_near_prior(p: Parameter, prior: tuple[float, float]) -> Within:
    """The scan of a parameter within `PRIOR_HALF_WIDTH_STD` standard deviations of its prior."""
    mean, std = prior
    low, high = max(p.bounds[0], mean - PRIOR_HALF_WIDTH_STD * std), min(p.bounds[1], mean + PRIOR_HALF_WIDTH_STD * std)
    return Within((float(low), float(np.nextafter(max(high, low), np.inf))), p.scan)
