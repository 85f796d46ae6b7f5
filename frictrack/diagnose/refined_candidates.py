"""Refine the candidates of a model: simulate those whose fit along the measured motion promises most."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from frictrack.diagnose.admissible import objection, physical_objection
from frictrack.diagnose.model_selection import (
    MAX_CHI2_NEAR,
    MIN_CHI2_SEPARATED,
    information_criterion,
    parameter_penalty,
)
from frictrack.effects import Effect, laws_in_place_of
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution, fit_with_scatter
from frictrack.fit.linearised import LinearisedModel, measured_series
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.stepwise import (
    CandidateTrial,
    baseline_misfit,
    gain_by_smaller_scatter,
    refine_to_end,
    scan_effect,
    simulate_trial,
    try_effect,
)

MAX_CANDIDATES_SIMULATED = 6
MAX_MISFIT_RATIO_SIMULATED = 4.0  # to the least misfit that is left along the measured motion by one that was simulated
MIN_BIC_RATIO_SIMULATED = 0.95  # of the best evidence that a linearised candidate must promise


@dataclass(frozen=True)
class RefinedCandidate:
    """A candidate refined on top of a model.

    Parameters
    ----------
    effect
        The effect.
    solution
        The simulated fit; None if it is too far behind to be simulated.
    delta_bic
        Fall of BIC.
    p
        p-value for the whole search.
    indistinguishable_from
        Effects whose best fit predicts the same data.
    objection
        Why it cannot be the cause; empty if it can.
    linear_trial
        The linearised model and the candidate's fit along the measured motion.
    is_unrefined
        Whether the budget of the search was spent before it was simulated to the end; it may explain more.

    """

    effect: Effect
    solution: Solution | None
    delta_bic: float
    p: float
    indistinguishable_from: tuple[str, ...] = ()
    objection: str = ""
    linear_trial: tuple[LinearisedModel, CandidateTrial] | None = None
    is_unrefined: bool = False

    @property
    def misfit(self) -> float:
        """What it leaves along the measured motion."""
        assert self.linear_trial is not None
        return self.linear_trial[1].misfit

    @property
    def law(self) -> Solution:
        """The simulated fit."""
        assert self.solution is not None
        return self.solution


def simulate_promising(
    law: LinearisedModel,
    solution: Solution,
    trials: list[CandidateTrial],
    p: dict[str, float],
    *,
    min_evidence: float = -np.inf,
    simulated: Mapping[str, Solution] = MappingProxyType({}),
) -> list[RefinedCandidate]:
    """Simulate trials in order of their evidence while they are near the best.

    Parameters
    ----------
    law
        The model, linearised.
    solution
        The model.
    trials
        Candidates refined along the measured motion.
    p
        p-value of every candidate.
    min_evidence
        Fall of BIC that another explanation reaches already.
    simulated
        Fits of candidates that are known from before.

    Returns
    -------
    list of RefinedCandidate
        All candidates, best first.

    """
    own = information_criterion(solution)
    out: list[RefinedCandidate] = []
    for candidate in linearised_candidates(law, trials, p):
        if not candidate.objection and _is_worth_simulating(out, candidate, min_evidence):
            out.append(_simulated(candidate, own, simulated.get(candidate.effect.name)))
        else:
            out.append(candidate)
    return sorted((_restart_special_case(t, out, own) for t in out), key=_best_first)


def _restart_special_case(
    candidate: RefinedCandidate, others: Sequence[RefinedCandidate], own: float
) -> RefinedCandidate:
    """The candidate, refined again from an effect that contains it and explains more; `own` is the BIC of the model.

    The larger effect may have found a better minimum. Where that is one of the smaller effect too, this one wins.
    """
    for other in others:
        if candidate.solution is None or other.solution is None or other.delta_bic <= candidate.delta_bic:
            continue
        if candidate.effect.kind in other.effect.special_cases:
            try:
                found = _refined_from(candidate, other)
            except FrictrackError:  # the larger effect is followed there, but not this one
                continue
            gain = own - information_criterion(found)
            if gain > candidate.delta_bic:
                candidate = replace(candidate, solution=found, delta_bic=gain)
                candidate = replace(candidate, objection=objection(found, candidate.effect))
    return candidate


def _refined_from(candidate: RefinedCandidate, other: RefinedCandidate) -> Solution:
    """Fit of a candidate that starts at the parameters of an effect that contains it."""
    problem, law = candidate.law.problem, other.law
    values = {(s.effect, s.parameter, s.run): x for s, x in zip(problem.layout.slots, candidate.law.p, strict=True)}
    pairs = {its.name: mine.name for mine, its in zip(candidate.effect.linear, other.effect.linear, strict=True)}
    pairs |= {q.name: q.name for q in candidate.effect.nonlinear}
    for slot, x in zip(law.problem.layout.slots, law.p, strict=True):
        if slot.effect != other.effect.name:
            values[slot.effect, slot.parameter, slot.run] = x
        elif slot.parameter in pairs:
            values[candidate.effect.name, pairs[slot.parameter], slot.run] = x
    p = np.array([values[s.effect, s.parameter, s.run] for s in problem.layout.slots])
    return fit_with_scatter(problem, p, law.starts, law.tau or 0.03)


def _best_first(candidate: RefinedCandidate) -> tuple[bool, float]:
    """Sort key: plausible candidates before others, then by evidence."""
    return bool(candidate.objection), -candidate.delta_bic


def linearised_candidates(
    law: LinearisedModel, trials: Sequence[CandidateTrial], p: Mapping[str, float]
) -> list[RefinedCandidate]:
    """The candidates as they are along the measured motion, with the evidence that they promise there.

    A candidate promises to take the same share of the simulated misfit, from which the misfit along the measured motion
    differs where the model is far from the data.
    """
    scale = law.solution.objective / baseline_misfit(law)
    out = []
    for t in trials:
        promised = law.solution.objective - scale * t.misfit - _extra_penalty(law, t.layout)
        promised += gain_by_smaller_scatter(law, t)
        new = RefinedCandidate(t.effect, None, promised, p[t.effect.name], linear_trial=(law, t))
        out.append(replace(new, objection=physical_objection(t.layout, t.p, t.effect)))
    return sorted(out, key=_best_first)


def _simulated(candidate: RefinedCandidate, own: float, known: Solution | None) -> RefinedCandidate:
    """The candidate with its simulated fit, if it is known or evaluations are left; `own` is the BIC of the model."""
    assert candidate.linear_trial is not None
    law, trial = candidate.linear_trial
    budget = law.solution.problem.budget
    if known is None and budget.stops():
        return replace(candidate, is_unrefined=True)
    try:
        fitted = known or simulate_trial(law, trial)
    except FrictrackError:  # along the motion it is a law, but not one that can be followed
        return candidate
    candidate = replace(candidate, is_unrefined=known is None and budget.is_spent)
    candidate = replace(candidate, solution=fitted, delta_bic=own - information_criterion(fitted))
    return replace(candidate, objection=objection(fitted, trial.effect))


def _is_worth_simulating(done: list[RefinedCandidate], new: RefinedCandidate, min_evidence: float) -> bool:
    """Whether a trial may be as good as the best so far, and as `min_evidence`."""
    simulated = [t for t in done if t.solution is not None and not t.objection]
    best = max((t.delta_bic for t in simulated), default=-np.inf)
    near = new.delta_bic > MIN_BIC_RATIO_SIMULATED * max(min_evidence, best) - MAX_CHI2_NEAR - 2 * MIN_CHI2_SEPARATED
    least = min((t.misfit for t in simulated), default=np.inf)
    may_win = new.delta_bic > best or new.misfit <= MAX_MISFIT_RATIO_SIMULATED * least
    return near and may_win and len(simulated) < MAX_CANDIDATES_SIMULATED


def _extra_penalty(law: LinearisedModel, layout: ParameterLayout) -> float:
    """BIC penalty for the parameters beyond those of the bare model."""
    return parameter_penalty(layout, law.solution.problem) - parameter_penalty(
        law.solution.problem.layout, law.solution.problem
    )


def refine_fully(best: RefinedCandidate) -> RefinedCandidate:
    """Refine the fit of a candidate until it converges."""
    return replace(best, solution=refine_to_end(best.law))


def law_in_place(
    law: LinearisedModel, solution: Solution, refined: Sequence[RefinedCandidate]
) -> list[RefinedCandidate]:
    """Try the laws that stand in place of the best candidate.

    Parameters
    ----------
    law
        The model, linearised.
    solution
        The model.
    refined
        Its candidates, simulated, best first.

    Returns
    -------
    list of RefinedCandidate
        The law that explains decisively more than that candidate, or none.

    """
    best = next((t for t in refined if t.solution is not None and not t.objection), None)
    if best is None or best.linear_trial is None or not (laws := laws_in_place_of(best.effect)):
        return []
    series = measured_series(law)
    scanned = [(effect, scans) for effect in laws if (scans := scan_effect(law, effect, series))]
    trials = [try_effect(law, effect, scans, series.coordinates[:, 0]) for effect, scans in scanned]
    own = best.linear_trial[1]
    least = own.misfit + parameter_penalty(own.layout, solution.problem)
    ahead = [t for t in trials if t.misfit + parameter_penalty(t.layout, solution.problem) < least]
    p = {t.effect.name: best.p for t in ahead}  # it was tested through the effect that it stands for
    tried = simulate_promising(law, solution, ahead, p, min_evidence=best.delta_bic)
    sure = [t for t in tried if t.solution is not None and not t.objection]
    return [t for t in sure if t.delta_bic > best.delta_bic + MIN_CHI2_SEPARATED][:1]
