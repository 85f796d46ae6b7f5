"""List the explanations between which the next run should decide: effects near the best, and a formula in its place."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from frictrack import effects
from frictrack.diagnose import FIRST_FORMULA
from frictrack.diagnose.experiments import FittedExplanation, explain_by_axes, make_explanation
from frictrack.effects import Effect
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution
from frictrack.fit.stepwise import add_effect, refine_to_end

MAX_BIC_NEAR = 60.0  # from the best, within which an explanation is compared
MAX_EFFECTS = 4  # that are compared


@dataclass(frozen=True)
class Weighted:
    """An explanation and its probability among those listed."""

    explanation: FittedExplanation
    probability: float


def list_explanations(solution: Solution, diagnosis: Mapping[str, Any]) -> list[Weighted]:
    """List the explanations of what a diagnosis leaves open.

    Parameters
    ----------
    solution
        The fit that was diagnosed.
    diagnosis
        JSON of its diagnosis.

    Returns
    -------
    list of Weighted
        Free curves over place, time or speed where nothing explains the misfit; else the effect with rivals, these,
        and a formula that may be the cause in place of one effect. Empty if the effects found have no rival.

    """
    if diagnosis["verdict"] == "unexplained":
        return _weighted(explain_by_axes(solution), None)
    listed = {c["effect"]: c for c in diagnosis["candidates"]}
    missing = diagnosis["missing"]
    formula = _rival_formula(diagnosis) if len(missing) == 1 else None
    doubtful = next((n for n in missing if listed[n]["indistinguishable_from"]), missing[0] if formula else None)
    if doubtful is None:
        return []
    for name in missing:
        if name != doubtful:
            solution = refine_to_end(add_effect(solution, effects.get(name)))
    kept = _effects_near(solution, listed, doubtful)
    fitted = list(_fitted(solution, [formula])) if formula else []
    probability = float(diagnosis["unexplained"]["probability"]) if fitted else None
    return _weighted([*fitted, *kept], probability)


def _effects_near(solution: Solution, listed: Mapping[str, Any], doubtful: str) -> list[FittedExplanation]:
    """The effect with rivals, and the best of its rivals and of all candidates near it."""
    rivals, best = listed[doubtful]["indistinguishable_from"], listed[doubtful]["delta_bic"]
    near = [n for n, c in listed.items() if c["delta_bic"] is not None and best - c["delta_bic"] < MAX_BIC_NEAR]
    names = [n for n in dict.fromkeys([doubtful, *rivals, *near]) if n not in solution.problem.model]
    known = [effects.get(n) for n in names[: 2 * MAX_EFFECTS] if n.partition(":")[0] in effects.LIBRARY]
    return sorted(_fitted(solution, known), key=lambda e: (e.effect != doubtful, -e.gain))[:MAX_EFFECTS]


def _weighted(found: Sequence[FittedExplanation], probability: float | None) -> list[Weighted]:
    """Explanations with their probabilities from BIC; a formula comes first, with its own because of its prior."""
    gains = np.array([e.gain for e in found])
    shares = np.exp((gains - gains.max(initial=0.0)) / 2)
    if probability is not None and len(found) > 1:
        shares[0] = shares[1:].sum() * probability / max(1.0 - probability, 1e-3)
    shares /= max(float(shares.sum()), 1e-300)
    return [Weighted(e, float(share)) for e, share in zip(found, shares, strict=True)]


def _rival_formula(diagnosis: Mapping[str, Any]) -> Effect | None:
    """The formula that may be the cause in place of the effect found, as an effect; None if there is none."""
    unexplained = diagnosis["unexplained"] or {}
    if not unexplained.get("rival"):
        return None
    table = tomllib.loads(unexplained["formulas"][0]["toml"])["effect"][0]
    return replace(effects.definitions([effects.read_settings(table)])[0], name=FIRST_FORMULA)


def _fitted(solution: Solution, tried: Sequence[Effect]) -> Iterator[FittedExplanation]:
    """Explanation by every effect under which a motion can be integrated."""
    for effect in tried:
        with suppress(FrictrackError):
            yield make_explanation(effect.name, refine_to_end(add_effect(solution, effect)), solution)
