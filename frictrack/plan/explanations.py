"""List the explanations between which the next run should decide: effects near the best, and a formula in its place."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from frictrack import effects
from frictrack.diagnose.experiments import Explanation, explain_by_axes, make_explanation
from frictrack.effects import Effect
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution
from frictrack.fit.stepwise import add_effect, refine_to_end

MAX_BIC_NEAR = 60.0  # from the best, within which an explanation is compared
MAX_EFFECTS = 4  # that are compared
FORMULA_NAME = "formula:1"  # as in `frictrack add STUDY formula:1`


@dataclass(frozen=True)
class Weighted:
    """An explanation and its probability among those listed."""

    explanation: Explanation
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
    rivals = listed[doubtful]["indistinguishable_from"]
    best = listed[doubtful]["delta_bic"]
    near = [n for n, c in listed.items() if c["delta_bic"] is not None and best - c["delta_bic"] < MAX_BIC_NEAR]
    names = [doubtful, *rivals, *(n for n in near if n not in rivals and n != doubtful)]
    names = [n for n in names if n not in solution.problem.model][: 2 * MAX_EFFECTS]
    found = list(_fitted(solution, [effects.get(n) for n in names if n.partition(":")[0] in effects.LIBRARY]))
    kept = sorted(found, key=lambda e: (e.effect != doubtful, -e.gain))[:MAX_EFFECTS]
    if formula is None:
        return _weighted(kept, None)
    return _weighted([*_fitted(solution, [formula]), *kept], float(diagnosis["unexplained"]["probability"]))


def _weighted(found: Sequence[Explanation], probability: float | None) -> list[Weighted]:
    """Explanations with their probabilities from BIC; the first has a given one, because its prior is smaller."""
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
    return replace(effects.definitions([effects.read_settings(table)])[0], name=FORMULA_NAME)


def _fitted(solution: Solution, tried: Sequence[Effect]) -> Iterator[Explanation]:
    """Explanation by every effect under which a motion can be integrated."""
    for effect in tried:
        with suppress(FrictrackError):
            yield make_explanation(effect.name, refine_to_end(add_effect(solution, effect)), solution)
