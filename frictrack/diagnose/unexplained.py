"""Describe a force that no effect explains, and compare formulas that fit it with the effects found.

Formulas are compared with effects where a smooth force over one variable is about as likely as these, or where effects
with parameters of their own in every run, which imitate much, were found though the misfit repeats over one axis. Both
are compared by their evidence. Every form has a smaller prior probability than an effect of the library, because there
are more of them and a cause outside of the library is rarer. Of sets of effects there are even more, and several causes
at once are rarer, too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import expit, logsumexp

from frictrack.base.number_format import format_probability
from frictrack.diagnose.formulas import (
    AXIS_SYMBOLS,
    EFFECT_NAME,
    SHAPES,
    FittedFormula,
    FormulaSearch,
    formula_axes,
)
from frictrack.diagnose.model_selection import MAX_BIC_EQUAL, information_criterion, is_special_case, log_prior_of_set
from frictrack.diagnose.repeatability import Repeatability
from frictrack.diagnose.smooth_forces import candidate_axes, forces_of, smooth_forces
from frictrack.fit.least_squares import Solution
from frictrack.fit.observations import keep_compared_frames
from frictrack.records import Array
from frictrack.results.motion_axes import AXES

FIRST_FORMULA = "formula:1"  # as in `frictrack add STUDY formula:1`
PRIOR_NONE = 0.1  # prior probability of a cause outside of the library
MAX_PROBABILITY_UNLIKELY, MIN_PROBABILITY_DECISIVE = 0.05, 0.95


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
        The formulas, with their fits.

    """

    summary: dict[str, Any]
    formulas: Sequence[FittedFormula]

    def as_candidate(self) -> tuple[str, Solution, float] | None:
        """The first formula as a candidate: its name in `frictrack add`, its fit, and its fall of BIC.

        None if there is no formula, or if it is a sum of several terms.
        """
        if not self.formulas or len(self.formulas[0].terms) > 1:
            return None
        first = self.formulas[0]
        old = first.solution.problem
        known = f"the formula depends on {_names_of(first.terms[0].variables)} alone"
        effects = tuple(
            replace(e, name=FIRST_FORMULA, invariant=known) if e.name == EFFECT_NAME else e for e in old.model.effects
        )
        layout = replace(old.layout, model=replace(old.layout.model, effects=effects))
        return FIRST_FORMULA, replace(first.solution, problem=old.rebuild(layout, old.pieces)), first.delta_bic


def unexplained_force(search: FormulaSearch, extended: Solution | None = None) -> UnexplainedForce:
    """Describe what a fitted model leaves unexplained.

    `search`: the search of formulas added to the model; `extended`: the fit with the effects found so far; the curve is
    what that leaves. Formulas are added to the model itself if possible.
    """
    extended = None if extended is None or extended is search.solution else keep_compared_frames(extended)
    smooth = (search.forces if extended is None else forces_of(extended)).smooth
    best, formulas = smooth[0], search.found(extended)
    entries = [one.entry for one in formulas]
    summary = {
        "axis": best.axis.name,
        "factor": best.axis.factor,
        "curve": np.column_stack([best.at, best.force]).tolist(),
        "band": best.sigma.tolist(),
        "share": best.share,
        "delta_bic": best.gain,
        "axes": len(smooth),
        "probability_none": max(1.0 - sum(one["probability"] for one in entries), 0.0) if entries else None,
        "formulas": entries,
    }
    return UnexplainedForce(summary, formulas)


def compare_with_formulas(
    search: FormulaSearch, found: Solution, repeats: Callable[[], Repeatability]
) -> UnexplainedForce | None:
    """Find formulas of one variable that explain as much as the effects found.

    `search`: the search of formulas added to the model without the effects; `found`: the model with the effects found;
    `repeats`: computes whether the misfit repeats, and over which axis; called only where that matters. Its
    summary has besides `probability` that one of the formulas is the cause and the effects are not, `decisive` if that
    is at least `MIN_PROBABILITY_DECISIVE`, `rival` in words if it is neither that nor unlikely, and `words`. None if no
    formula explains as much.
    """
    start = search.solution
    evidence = information_criterion(start) - information_criterion(found)
    count = max(len(found.problem.model.names) - len(start.problem.model.names), 1)
    prior = _log_prior_odds(len(candidate_axes(search.forces.compressed)), count)
    margin = MAX_BIC_EQUAL + 2 * max(prior, 0.0)  # with less evidence, a formula is unlikely
    if not _is_worth_searching(search, found, repeats, evidence - margin):
        return None
    unexplained = unexplained_force(search)
    formulas: list[FittedFormula] = []
    for one in unexplained.formulas:
        if is_special_case(one.solution, found):
            evidence = max(evidence, one.delta_bic)  # of the effect, which it is
        else:
            formulas.append(one)
    listed, advantages = [one.entry for one in formulas], np.array([one.delta_bic - evidence for one in formulas])
    if advantages.max(initial=-np.inf) < -margin:
        return None
    probability = _probability(advantages, np.array([entry["probability"] for entry in listed]), prior)
    decisive = probability > MIN_PROBABILITY_DECISIVE
    is_rival = MAX_PROBABILITY_UNLIKELY < probability <= MIN_PROBABILITY_DECISIVE
    compared = {
        "probability": probability,
        "decisive": decisive,
        "rival": f"a formula of {_names_of(listed[0]['variables'])}" if is_rival else None,
        "words": _words(listed[0], len(found.problem.layout.slots) - len(start.problem.layout.slots), probability),
    }
    return UnexplainedForce(unexplained.summary | compared | {"formulas": listed}, formulas)


def _is_worth_searching(
    search: FormulaSearch, found: Solution, repeats: Callable[[], Repeatability], evidence: float
) -> bool:
    """Whether a smooth force of any variable of the formulas explains more, or effects may imitate one."""
    own = {s.effect for s in found.problem.layout.slots if s.run is not None}
    start, compressed = search.solution.problem, search.forces.compressed
    several = len({p.run for p in start.pieces}) > 1
    may_imitate = several and any(name in own for name in found.problem.model.names if name not in start.model)
    best_axis = repeats().best if may_imitate else None
    if best_axis is not None and best_axis.axis in AXIS_SYMBOLS:
        return True
    return smooth_forces(compressed, formula_axes(compressed))[0].gain > evidence


def _probability(advantages: Array, shares: Array, prior: float) -> float:
    """Probability that one of the forms is the cause and not the effects found.

    `advantages` (n,) are the BIC of the listed forms over that of the effects, `shares` (n,) the probabilities of these
    forms among all, and `prior` the logarithm of the prior odds of one form.
    """
    return float(expit(logsumexp(advantages / 2) - np.log(shares.sum()) + prior))


def _log_prior_odds(axes: int, count: int) -> float:
    """Logarithm of the prior probability of one form over that of a set of `count` effects; all of a kind are alike."""
    forms = len(SHAPES) * len(AXIS_SYMBOLS) * max(axes, 1)
    return float(np.log(PRIOR_NONE / forms) - np.log(1 - PRIOR_NONE) - log_prior_of_set(count))


def _words(first: Mapping[str, Any], added: int, probability: float) -> str:
    decisive = probability > MIN_PROBABILITY_DECISIVE
    much, than = ("more", "than") if decisive else ("as much", "as")
    count = "one parameter" if first["unknowns"] == 1 else f"{first['unknowns']} parameters"
    instead = f"; the probability that it is the cause instead is {format_probability(probability)}"
    return (
        f"a force that depends only on {_names_of(first['variables'])} explains {much} with {count}, common to all "
        f"runs, {than} the effects found with {added}: {first['formula']}{'' if decisive else instead}"
    )


def _names_of(variables: tuple[str, ...] | list[str]) -> str:
    return " and ".join(AXES[name].name for name in variables)
