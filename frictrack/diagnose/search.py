"""Search for the effects that a fitted model lacks.

Every effect is tried alone, then pairs, then sets of three, each size best first (`Explanations`). The search ends when
a set leaves no misfit, or when no larger set explains more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from frictrack.base.distributions import RNG
from frictrack.diagnose.auxiliary_signals import AuxiliarySignals, assess_accelerometer
from frictrack.diagnose.examination import Examination, examine, examine_again
from frictrack.diagnose.explanations import (
    MAX_SIZE,
    Explanation,
    Explanations,
    alternatives_of,
    find_rivals,
    names_in_place_of,
)
from frictrack.diagnose.finished_search import FinishedSearch, RefinedCandidate
from frictrack.diagnose.formulas import FormulaSearch, Shape, is_noise
from frictrack.diagnose.model_selection import MAX_CHI2_NEAR, information_criterion, objection
from frictrack.effects import Effect
from frictrack.fit.least_squares import Solution
from frictrack.fit.observations import observation_of
from frictrack.fit.stepwise import baseline_misfit, bic_penalty
from frictrack.records import Run
from frictrack.results.verdicts import join_as_one
from frictrack.search import EvaluationBudget

N_LISTED, MAX_P_LISTED = 2, 0.05  # effects that are always listed; p-value of the others
MIN_BIC_BEATEN = 40.0  # by which one formula explains more than the effects, so that no larger set is searched
MAX_UNKNOWNS_OF_FORMULA = 4
# Simulations of all runs, for each effect that may be added. Whole searches of simulated studies (none to two effects,
# or a cause outside the library) took 200 in the median and at most 510. The number of frames does not matter.
EVALUATIONS_PER_EFFECT = 250
N_RUNS_TYPICAL = 10  # more runs have more unknowns of their own (events, phases, clock rates) to be searched
N_NAMED = 3  # effects that a remark names

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class SearchSettings:
    """What a search may try: further effects, other measurements, level of each test, shapes of formulas."""

    own: Sequence[Effect]
    auxiliary: AuxiliarySignals | None
    rng: RNG
    level: float
    shapes: tuple[Shape, ...]
    notify: Progress


def search_effects(runs: Sequence[Run], start: Solution, settings: SearchSettings) -> FinishedSearch:
    """Search for the effects that a model lacks.

    Parameters
    ----------
    runs
        The fitted runs.
    start
        The model.
    settings
        What may be tried.

    """
    rng, own, notify = np.random.default_rng(settings.rng), settings.own, settings.notify
    generators = rng.spawn(2)
    n_runs = len(start.problem.layout.run_names)
    budget = EvaluationBudget(EVALUATIONS_PER_EFFECT * MAX_SIZE * max(1.0, n_runs / N_RUNS_TYPICAL))
    start = replace(start, problem=start.problem.with_budget(budget))
    observation, simulates = observation_of(start.problem), start.problem.simulates
    sensor = assess_accelerometer(start, runs, settings.auxiliary or {}) if simulates else None
    formulas = FormulaSearch.of(start, settings.shapes)
    notify(0, MAX_SIZE, "testing the model for every effect of the library")
    first = last = examine(start, own, rng, settings.level)
    scanned = sorted(first.scanned, key=lambda s: -s.excess[0])
    space = Explanations(start, own, lambda e: 0.0 if sensor is None or e.acts_on == sensor.acts_on else MAX_CHI2_NEAR)
    best = space.begin(first, scanned if first.something_is_missing else scanned[:N_LISTED])

    def take(new: Explanation) -> tuple[Explanation, Examination]:
        new = space.refine_fully(new)
        law = observation.weighted(new.law)
        space.rebase(new, law)
        return new, examine_again(law, own, rng, first)

    beaten = False
    for size in range(1, MAX_SIZE + 1):
        if not last.something_is_missing:
            break
        if size == MAX_SIZE and simulates and _formula_explains_more(formulas, best):
            beaten = True
            break
        notify(size, MAX_SIZE, _describe_step(best, size))
        space.grow(size)
        new = space.better(best, last)
        if new is not None:
            best, last = take(new)
        elif size > 1 or not last.leaves_misfit:
            break
    if len(best.effects) == 1 and not last.something_is_missing:
        pair = space.pair_instead(best)
        if pair is not best:
            best, last = take(pair)
    misfit = baseline_misfit(first.draws.law)
    tried = [_tried(one, first, space.known[frozenset()], misfit) for one in space.of_size(1)]
    tried = [t for i, t in enumerate(tried) if i < N_LISTED or t.p < MAX_P_LISTED or t.solution is not None]
    found = _found(space, best, first)
    rivals = find_rivals(best, space.all()) if found else []
    found = [replace(t, indistinguishable_from=names_in_place_of(t.effect.title, best, rivals)) for t in found]
    cut = _describe_cut(budget, [one.names for one in space.known.values() if one.is_unrefined], found)
    budget.grant(np.inf)  # what follows from the search takes a bounded number of evaluations
    alternatives = alternatives_of(best, rivals)
    return FinishedSearch(start, first, last, tried, found, generators, formulas, cut, alternatives, is_beaten=beaten)


def _describe_step(best: Explanation, size: int) -> str:
    if size == 1:
        return "refining every effect that may explain the misfit"
    if not best.effects:
        return f"no effect alone passes: trying sets of {size}"
    return f"{join_as_one([e.title for e in best.effects])} leaves misfit: trying sets of {size}"


def _tried(one: Explanation, first: Examination, empty: Explanation, misfit: float) -> RefinedCandidate:
    """An effect alone, with its evidence; `misfit` is what the model leaves without it along the measured motion."""
    assert one.trial is not None
    p = first.p_of_gain(one.last, one.gain(empty, one.last))
    passes = p < first.level and one.is_law and first.confirms(one.law, one.last)
    share = (misfit - one.trial[1].misfit) / max(misfit - first.solution.problem.n_frames, 1e-300)
    return RefinedCandidate(
        one.last, one.solution, one.evidence(empty), p, (), one.objection, float(np.clip(share, 0.0, 1.0)), passes
    )


def _found(space: Explanations, best: Explanation, first: Examination) -> list[RefinedCandidate]:
    """The effects of the best explanation, each added to those before it, the strongest first."""
    found = []
    for before, after in pairwise(space.chain(best)):
        for effect in (e for e in best.effects if e.title in after.names - before.names):
            gain = after.gain(before, effect)
            p = first.p_of_excess(effect.title, gain) if before.effects else first.p_of_gain(effect, gain)
            why = objection(best.law, effect)
            found.append(RefinedCandidate(effect, after.law, after.evidence(before), p, objection=why, passes=True))
    return found


def _formula_explains_more(formulas: FormulaSearch, best: Explanation) -> bool:
    """Whether one formula leaves only noise, and the effects found explain far less by the BIC: they imitate it."""
    start, misfit = formulas.solution, formulas.least_misfit
    n = start.problem.n_frames
    if not is_noise(misfit - n, n):
        return False
    fall = start.objective - misfit - bic_penalty(MAX_UNKNOWNS_OF_FORMULA, n)
    return bool(information_criterion(start) - fall < best.criterion + 2 * best.log_prior - MIN_BIC_BEATEN)


def _describe_cut(
    budget: EvaluationBudget, unrefined: Sequence[frozenset[str]], found: Sequence[RefinedCandidate]
) -> str | None:
    """Describe what a search left out because its budget was spent, and how to go on; None if nothing."""
    if not budget.was_cut:
        return None
    names = [" with ".join(sorted(one)) for one in unrefined]
    others = f" and {len(names) - N_NAMED} others" if len(names) > N_NAMED else ""
    missed = (
        f"{', '.join(names[:N_NAMED])}{others} could be refined, which may explain the misfit as well"
        if names
        else "every effect found was compared again with all others"
    )
    added = [t.effect.title for t in found if not t.objection] or names[:1]
    onward = f"add {' and '.join(added)} to the model and" if added else "leave out some runs and"
    return (
        f"the search stopped at its limit of {budget.granted:.0f} simulations of all runs, before {missed}; "
        f"to go on, {onward} diagnose again"
    )
