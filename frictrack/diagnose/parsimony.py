"""Prefer simple models: few non-linear parameters at equal evidence, pairs of smooth forces before flexible ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, pairwise

from frictrack.diagnose.model_selection import MAX_BIC_BARE_MENTION, information_criterion, parameter_penalty
from frictrack.diagnose.refined_candidates import RefinedCandidate
from frictrack.diagnose.rounds import Round
from frictrack.effects import Effect
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution
from frictrack.fit.stepwise import (
    STRONG_MISFIT_CHI2,
    CandidateTrial,
    baseline_misfit,
    remove_effect,
    simulate_trial,
    try_linear_effects,
)
from frictrack.fit.uncertainty import dispersion

MIN_BIC_DECISIVE = 10.0  # "very strong" evidence (Kass & Raftery 1995)
MIN_CHI2_FALL = 1.0  # of a step of a model that is fitted only for a share of the misfit


def is_smooth(effect: Effect) -> bool:
    """Whether an effect is a force whose free parameters are linear and common to the runs (drag, spring, slope)."""
    free = [p for p in effect.parameters if p.free]
    plain = bool(free) and all(p.linear and not p.per_run for p in free)
    return plain and effect.acts_on == "force" and not effect.modifies and not effect.memory


def simplest_candidate(near: Sequence[RefinedCandidate]) -> RefinedCandidate:
    """Return the candidate with the fewest non-linear parameters among those with the evidence of the first.

    Differences of BIC count in units of the dispersion of the best model, because a flexible effect imitates what
    remains unexplained.

    Parameters
    ----------
    near
        Candidates, best first.

    Returns
    -------
    RefinedCandidate

    """
    best = near[0]
    equal = [t for t in near if best.delta_bic - t.delta_bic < MAX_BIC_BARE_MENTION * dispersion(best.law)]
    return min(equal, key=lambda t: sum(p.free for p in t.effect.nonlinear))


def stronger_of_smooth_pair(tested: Round, best: RefinedCandidate) -> RefinedCandidate | None:
    """Return the stronger of two smooth effects that together explain more than a flexible one.

    A flexible effect imitates the sum of smooth ones. While much misfit remains, a pair that explains as much is
    enough; else it must explain decisively more.

    Parameters
    ----------
    tested
        The last round.
    best
        Its best candidate.

    Returns
    -------
    RefinedCandidate or None
        None if no pair explains as much.

    """
    problem = tested.solution.problem
    if is_smooth(best.effect):
        return None
    unit = dispersion(best.law)
    is_strong = tested.solution.chi2 >= STRONG_MISFIT_CHI2 * problem.n_frames
    margin = MAX_BIC_BARE_MENTION * unit if is_strong else -MIN_BIC_DECISIVE * unit
    law = tested.draws.law
    smooth = [s.effect for s in tested.tests.scanned if is_smooth(s.effect)]
    if len(smooth) < 2:
        return None

    def criterion(trial: CandidateTrial) -> float:
        return trial.misfit + parameter_penalty(trial.layout, problem)

    pair = min(combinations(smooth, 2), key=lambda pair: criterion(try_linear_effects(law, pair, rough=True)))
    trial = try_linear_effects(law, pair)
    if not is_strong and (best.linear_trial is None or criterion(trial) > criterion(best.linear_trial[1]) + margin):
        return None
    try:
        found = simulate_trial(law, trial)
    except FrictrackError:
        return None
    if information_criterion(found) > information_criterion(best.law) + margin:
        return None
    single = {e.name: try_linear_effects(law, [e]) for e in pair}
    stronger = min(pair, key=lambda e: single[e.name].misfit)
    return _candidate_from_pair(tested, stronger, single[stronger.name], best.p)


def _candidate_from_pair(tested: Round, effect: Effect, trial: CandidateTrial, p: float) -> RefinedCandidate | None:
    """One effect of a pair as a candidate; the pair has passed with `p`."""
    existing = next((t for t in tested.tried if t.effect.name == effect.name and t.solution is not None), None)
    if existing is not None:
        return replace(existing, p=min(existing.p, p))
    try:
        law = simulate_trial(tested.draws.law, trial)
    except FrictrackError:
        return None
    gain = information_criterion(tested.solution) - information_criterion(law)
    return RefinedCandidate(effect, law, gain, p, linear_trial=(tested.draws.law, trial))


def explained_shares(tested: Round, tried: Sequence[RefinedCandidate]) -> dict[str, float]:
    """Share of the misfit above the noise that every candidate explains alone, by name."""
    misfit = baseline_misfit(tested.draws.law)
    excess = max(misfit - tested.solution.problem.n_frames, 1e-300)
    out = {}
    for t in tried:
        if t.linear_trial is not None and t.linear_trial[0] is tested.draws.law:
            out[t.effect.name] = min(max((misfit - t.linear_trial[1].misfit) / excess, 0.0), 1.0)
    return out


def nested_models(found: Sequence[RefinedCandidate]) -> list[Solution | None]:
    """Models with the first effect found, the first two, and so on; None where one cannot be integrated."""
    if not found:
        return []
    out: list[Solution | None] = [found[-1].law]
    for smaller, t in reversed(list(pairwise(found))):
        law = out[0]
        try:
            out.insert(0, None if law is None else _model_before(smaller.law, law, t.effect.name))
        except FrictrackError:
            out.insert(0, None)
    return out


def _model_before(known: Solution, law: Solution, name: str) -> Solution:
    """The model without one effect: the one to which it was added, if that is still known, else fitted again."""
    names = set(law.problem.model.names) - {name}
    return known if set(known.problem.model.names) == names else remove_effect(law, name, MIN_CHI2_FALL)
