"""Explanations of a misfit: sets of effects added to one model, compared by one evidence and refined best first.

A set is proposed by the fit along the measured motion, which takes milliseconds, and refined in simulation. It may be
left unrefined only if the evidence that it promises, with the error of such promises seen so far, cannot reach that of
the best set refined.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from frictrack.base.errors import FrictrackError, result_or_none
from frictrack.diagnose.examination import Examination, ScannedCandidate, list_candidates
from frictrack.diagnose.model_selection import (
    MAX_BIC_BARE_MENTION,
    MAX_BIC_EQUAL,
    MAX_CHI2_NEAR,
    MIN_CHI2_SEPARATED,
    event_penalty,
    expected_separation,
    information_criterion,
    log_prior_of_effects,
    objection,
    parameter_penalty,
)
from frictrack.diagnose.pairs import gains_of_pairs, try_pair
from frictrack.effects import Effect, laws_in_place_of
from frictrack.fit.least_squares import Solution, fit_with_scatter
from frictrack.fit.linearised import CandidateScan, LinearisedModel, linearise, measured_series
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.penalties import prior_residual
from frictrack.fit.stepwise import (
    CandidateTrial,
    baseline_misfit,
    deepen_trials,
    misfit_left_by_other,
    most_by_smaller_scatter,
    physical_objection,
    refine_to_end,
    scan_effects,
    simulate_trial,
    try_effects,
    with_levels,
    with_likely_levels,
    with_smaller_scatter,
)
from frictrack.fit.uncertainty import dispersion
from frictrack.records import Array

N_CENTRES = 2  # best sets of one size to which every effect is added in turn
N_PAIRS = 10  # pairs that are fitted at most: true ones are among the first that linear approximation ranks
MAX_P_ONE_MORE = 0.05  # p-value above which one effect more is chance where a set leaves nothing, whatever the BIC
MAX_SIZE = 3  # effects in a set
MIN_ERROR_OF_PROMISE = 0.02  # first estimate of the error of a promised misfit, over its part above the noise
Names = frozenset[str]
Scanned = Sequence[tuple[Effect, list[CandidateScan]]]


@dataclass(frozen=True, eq=False)
class Explanation:
    """A set of effects added to the model that is diagnosed.

    Attributes
    ----------
    effects
        The effects, in the order in which they were added.
    criterion
        BIC with the prior of such a set; smaller is better. That of the simulated fit, or what the trial promises.
    centre
        The smaller set to which the last effect was added; None for the model that is diagnosed.
    trial
        The model with that smaller set, linearised, and the larger model fitted along the measured motion; None for the
        model that is diagnosed.
    excess
        Misfit above the noise that the trial promises to leave in simulation.
    solution
        The simulated fit; None if it was not simulated.
    objection
        Why one of the effects cannot be a cause; empty if all can.
    is_unrefined
        Whether the budget of the search was spent before it was simulated; it may explain more.

    """

    effects: tuple[Effect, ...]
    criterion: float
    centre: Explanation | None = None
    trial: tuple[LinearisedModel, CandidateTrial] | None = None
    excess: float = 0.0
    solution: Solution | None = None
    objection: str = ""
    is_unrefined: bool = False

    @property
    def names(self) -> Names:
        """Names of the effects."""
        return frozenset(e.title for e in self.effects)

    @property
    def law(self) -> Solution:
        """The simulated fit."""
        assert self.solution is not None
        return self.solution

    @property
    def is_law(self) -> bool:
        """Whether it was simulated, and all its effects can be causes."""
        return self.solution is not None and not self.objection

    @property
    def n_causes(self) -> int:
        """Effects that are causes, and no settings of a record."""
        return sum(not e.of_record for e in self.effects)

    @property
    def last(self) -> Effect:
        """The effect that was added last."""
        return self.effects[-1]

    @property
    def log_prior(self) -> float:
        """Logarithm of the prior probability of the set."""
        return log_prior_of_effects(self.effects)

    def evidence(self, before: Explanation) -> float:
        """Fall of BIC from a smaller set, without the priors."""
        return before.criterion - self.criterion - 2 * (self.log_prior - before.log_prior)

    def gain(self, before: Explanation, effect: Effect) -> float:
        """Likelihood ratio from a set without an effect, less the penalty for its events in single runs."""
        problem, its = before.law.problem, before.law.problem.layout
        own = self.trial[1].layout if self.solution is None and self.trial is not None else self.law.problem.layout
        penalty = parameter_penalty(own, problem) - parameter_penalty(its, problem)
        return self.evidence(before) + penalty - event_penalty(problem, own, effect)


@dataclass(frozen=True, eq=False)
class Expansion:
    """A set to which single effects were added along the measured motion, where its own model leaves `misfit`."""

    centre: Explanation
    law: LinearisedModel
    misfit: float
    trials: Sequence[CandidateTrial]

    def fall(self, left: float) -> float:
        """Return the fall of the simulated misfit that a larger set promises, of which `left` is left along the motion.

        Far from the data the two misfits differ. A set that leaves only noise along the measured motion does so in
        simulation, and one that takes a share of the excess over noise takes that share of the other.
        """
        solution, n = self.law.solution, self.law.solution.problem.n_frames
        simulated = solution.objective - _misfit_of_priors(solution.problem.layout, solution.p)
        noise = np.sqrt(2 * n)
        return max(simulated - n, noise) / max(self.misfit - n, noise) * (self.misfit - left)


class Explanations:
    """All sets of effects that were added to one model, by the names of their effects.

    Parameters
    ----------
    start
        The model.
    own
        Further effects to try.
    handicap
        What an effect adds to the criterion, such as one that an accelerometer contradicts.

    """

    def __init__(
        self, start: Solution, own: Sequence[Effect] = (), handicap: Callable[[Effect], float] = lambda effect: 0.0
    ) -> None:
        self._own, self._handicap, self._budget = own, handicap, start.problem.budget
        self._expanded: dict[Names, Expansion] = {}
        self._rebased: dict[Names, Explanation] = {}
        self._error = MIN_ERROR_OF_PROMISE
        self.known = {frozenset[str](): Explanation((), information_criterion(start), solution=start)}

    def of_size(self, size: int) -> list[Explanation]:
        """All sets of some effects, best first; those with an objection at the end."""
        return [one for one in self.all() if len(one.effects) == size]

    def all(self) -> list[Explanation]:
        """All sets, best first; those with an objection at the end."""
        return sorted(self.known.values(), key=lambda one: (bool(one.objection), one.criterion))

    def laws(self, size: int) -> list[Explanation]:
        """Those of a size that were simulated and have no objection, best first."""
        return [one for one in self.of_size(size) if one.is_law]

    def subsets(self, whole: Explanation) -> Iterator[Explanation]:
        """The sets without one of its effects that are known."""
        for name in sorted(whole.names):
            if (rest := self.known.get(whole.names - {name})) is not None:
                yield rest

    def begin(self, tested: Examination, scanned: Sequence[ScannedCandidate]) -> Explanation:
        """Propose some of the effects that the examination of the model scanned, each alone; return the empty set."""
        empty = self.known[frozenset()]
        own = [(s.effect, s.scans) for s in scanned]
        self._propose(empty, tested.draws.law, own, search_again=tested.something_is_missing)
        return empty

    def grow(self, size: int) -> None:
        """Propose and refine the sets of a size: one effect more than the best that are one smaller, or two more.

        The sets that the best of this size contains are expanded too: each of its effects may give way to another.
        """
        for centre in self.laws(size - 1)[:N_CENTRES]:
            self.expand(centre)
        rivals = [one.criterion for one in [*self.of_size(size), *self.laws(size - 1)] if not one.objection]
        limit = min(rivals, default=np.inf) + MIN_CHI2_SEPARATED
        for centre in self.laws(size - 2)[:1]:
            self._propose_pairs(centre, lambda effects: limit)
        self.refine(size)
        self._exchange_law(size)
        while True:
            best = next(iter(self.laws(size)), None)
            rests = [] if best is None else [r for r in self.subsets(best) if r.names not in self._expanded]
            rests = [one for one in map(self._simulated, rests) if one.is_law]
            if not rests or self._budget.is_spent:
                break
            for rest in rests:
                self.expand(rest)
            self.refine(size)

    def better(self, best: Explanation, examined: Examination) -> Explanation | None:
        """Return the simplest of the sets that explain most, if it explains more than the best so far.

        A set with one effect more must be significant in the examination of the best. Any other set must explain
        decisively more than the best.
        """
        for size in range(len(best.effects) + 1, MAX_SIZE + 1):
            laws = self.laws(size)
            if not laws:
                continue
            unit = dispersion(laws[0].law)
            equal = [one for one in laws if one.criterion - laws[0].criterion < MAX_BIC_BARE_MENTION * unit]
            equal.sort(key=lambda one: sum(p.free for e in one.effects for p in e.nonlinear))
            for one in [*equal, *laws[len(equal) :]]:
                if self._is_better(one, best, examined):
                    return self._without_needless(one, best)
        return None

    def _is_better(self, one: Explanation, best: Explanation, examined: Examination) -> bool:
        new = [e for e in one.effects if e.title not in best.names]
        if len(new) > 1 or not one.names > best.names:
            return one.criterion < best.criterion - MIN_CHI2_SEPARATED
        p = examined.p_of_gain(new[0], one.gain(best, new[0]))
        return p < examined.level and examined.confirms(one.law, new[0])

    def _without_needless(self, one: Explanation, best: Explanation) -> Explanation:
        """The set without effects that explain nothing more than the others do."""
        while smaller := [
            rest for rest in self.subsets(one) if rest.effects and rest.is_law and rest.criterion <= one.criterion
        ]:
            rest = min(smaller, key=lambda rest: rest.criterion)
            if rest.names == best.names:
                break
            one = rest
        return one

    def chain(self, whole: Explanation) -> list[Explanation]:
        """Return sets from the empty one to `whole`, each with one effect more, the best of their size.

        Where no smaller set can be simulated, several effects enter at once.
        """
        if not whole.effects:
            return [whole]
        parts = [one for one in self.subsets(whole) if not one.objection]
        for one in sorted(parts, key=lambda one: (one.solution is None, one.criterion)):
            part = one if one.solution is not None else self._refined(one)
            if part.is_law:
                return [*self.chain(part), whole]
        return [*self.chain(whole.centre or self.known[frozenset()]), whole]

    def rebase(self, one: Explanation, solution: Solution) -> None:
        """Add further effects to a set as another problem has it, with other weights."""
        if solution is not one.solution:
            self._rebased[one.names] = replace(one, solution=solution)

    def expand(self, centre: Explanation) -> None:
        """Propose every set with one effect more than a law has."""
        if centre.names in self._expanded or not centre.is_law or self._budget.stops():
            return
        centre = self._rebased.get(centre.names, centre)
        law = result_or_none(linearise, centre.law)
        if law is None:
            return
        library, _ = list_candidates(centre.law, self._own)
        self._propose(centre, law, scan_effects(law, library, measured_series(law)))

    def _exchange_law(self, size: int) -> None:
        """Try the laws that contain the last effect of the best set and stand in place of others, with the rest."""
        best = next(iter(self.laws(size)), None)
        if best is None or best.trial is None or best.centre is None or len(best.centre.effects) < size - 1:
            return
        if laws := laws_in_place_of(best.last):
            law, _ = best.trial
            self._propose(best.centre, law, scan_effects(law, laws, measured_series(law)))
            self.refine(size)

    def _propose(
        self, centre: Explanation, law: LinearisedModel, scanned: Scanned, *, search_again: bool = True
    ) -> None:
        """Try scanned effects with a centre along the measured motion, and enter the sets that they make."""
        tried = try_effects(law, scanned, measured_series(law).coordinates[:, 0])
        # beside other effects the law imitates little more
        tried = deepen_trials(law, tried, every=not centre.effects) if search_again else tried
        misfit = baseline_misfit(law)
        trials = with_levels(law, tried, misfit)
        expansion = Expansion(centre, law, misfit, trials)
        for t in trials:
            self._enter(expansion, t)
        self._expanded.setdefault(centre.names, expansion)

    def _propose_pairs(self, centre: Explanation, limit: Callable[[Sequence[Effect]], float]) -> None:
        """Try pairs of effects with a centre, those first that promise most, that may reach the limit of such a set.

        Sets with an effect to which all others have been added are known already.
        """
        if centre.names not in self._expanded:
            return
        expansion = self._expanded[centre.names]
        centre, law, problem = expansion.centre, expansion.law, expansion.law.solution.problem
        trials = {
            t.effect.title: t
            for t in expansion.trials
            if not physical_objection(t.layout, t.p, t.effect) and centre.names | {t.effect.title} not in self._expanded
        }
        error, by_scatter = MIN_ERROR_OF_PROMISE, most_by_smaller_scatter(law.solution)
        penalty = {name: parameter_penalty(t.layout, problem) for name, t in trials.items()}
        own = parameter_penalty(problem.layout, problem)
        promised: list[tuple[float, float, float, tuple[str, str]]] = []
        for pair, gain in gains_of_pairs(law, list(trials.values())).items():
            left, start = expansion.misfit - gain, centre.criterion + sum(penalty[name] - own for name in pair)
            promised.append((start - expansion.fall(left), left, start, pair))
        for _, left, start, (first, second) in sorted(promised)[:N_PAIRS]:
            excess = max(left - problem.n_frames, 0.0)
            effects = [*centre.effects, trials[first].effect, trials[second].effect]
            if start - expansion.fall(left - error * excess) - by_scatter > limit(effects):
                continue
            if self._budget.stops():
                break
            both = with_likely_levels(law, try_pair(law, trials[first], trials[second]))
            self._enter(expansion, both, trials[first].effect)
            error = max(error, min((left - both.misfit) / max(excess, 1e-300), 1.0))

    def _enter(self, expansion: Expansion, trial: CandidateTrial, *others: Effect) -> None:
        """Enter the set that a trial of an effect, and others, makes of a centre, if it promises more than before."""
        centre, law, added = expansion.centre, expansion.law, (*others, trial.effect)
        solution, problem = law.solution, law.solution.problem
        trial, gain = with_smaller_scatter(law, trial)
        gain += expansion.fall(trial.misfit)
        gain += _misfit_of_priors(problem.layout, solution.p) - _misfit_of_priors(trial.layout, trial.p)
        gain += parameter_penalty(problem.layout, problem) - parameter_penalty(trial.layout, problem)
        why = next(filter(None, (physical_objection(trial.layout, trial.p, e) for e in added)), "")
        excess = max(expansion.fall(problem.n_frames) - expansion.fall(trial.misfit), 0.0)
        effects = (*centre.effects, *added)
        new = Explanation(effects, centre.criterion - gain, centre, (law, trial), excess, objection=why)
        handicap = sum(map(self._handicap, added))
        new = replace(new, criterion=new.criterion + handicap - 2 * (new.log_prior - centre.log_prior))
        old = self.known.get(new.names)
        if old is None or (old.solution is None and (bool(why), new.criterion) < (bool(old.objection), old.criterion)):
            self.known[new.names] = new

    def pair_instead(self, best: Explanation, examined: Examination) -> Explanation:
        """Return a set in which two effects, in place of one, explain decisively more than the best one, or that one.

        An effect with another incline is one cause too, and only has to explain a little more. None of its effects is
        one that chance adds as well to the rest, in the draws of its examination.
        """
        decisive, near = best.criterion - MIN_CHI2_SEPARATED, best.criterion + MAX_BIC_EQUAL

        def limit(effects: Sequence[Effect]) -> float:
            in_its_place = not best.names <= {e.title for e in effects}
            return near if in_its_place and sum(not e.of_record for e in effects) <= best.n_causes else decisive

        def is_chance(one: Explanation) -> bool:
            rests = [(r, e) for r in self.subsets(one) if r.is_law for e in one.effects if e.title not in r.names]
            return any(examined.p_of_excess(e.title, one.gain(r, e)) > MAX_P_ONE_MORE for r, e in rests)

        size = len(best.effects) + 1
        for rest in self.subsets(best):
            self._propose_pairs(rest, limit)
        self.refine(size, below=lambda one: limit(one.effects))
        needed = best.criterion - MAX_BIC_BARE_MENTION * dispersion(best.law)
        better = [o for o in self.laws(size) if o.criterion < min(limit(o.effects), needed) and not is_chance(o)]
        return better[0] if better else best

    def refine(self, size: int, below: Callable[[Explanation], float] = lambda one: np.inf) -> None:
        """Simulate the sets of a size, best first, until no other may explain as much as the best, and fall `below`."""
        while True:
            laws = self.laws(size)
            waiting = [one for one in self.of_size(size) if one.solution is None and not one.objection]
            if laws:
                reach = MIN_CHI2_SEPARATED * dispersion(laws[0].law)
                waiting = [o for o in waiting if self._may_reach(o, o.criterion - behind(o, laws[0]) + reach)]
            waiting = [one for one in waiting if self._may_reach(one, below(one))]
            if not waiting:
                break
            if self._budget.stops():
                self.known |= {one.names: replace(one, is_unrefined=True) for one in waiting}
                break
            self.known[waiting[0].names] = self._refined(waiting[0])
        for best in self.laws(size)[:1]:  # whatever a special case of it promises, it has fewer parameters
            for one in [one for one in self.of_size(size) if _special_case(one, best)]:
                self._simulated(one)
        for one in self.laws(size):
            self.known[one.names] = self._restarted(one)

    def _may_reach(self, one: Explanation, limit: float) -> bool:
        """Whether a set may reach a criterion, with the largest error of a promise seen so far."""
        return one.criterion - self._error * one.excess < limit

    def _simulated(self, one: Explanation) -> Explanation:
        """A set with its simulated fit, whatever it promises, unless it is no plausible one."""
        if one.solution is None and not one.objection and not self._budget.stops():
            self.known[one.names] = self._refined(one)
        return self.known[one.names]

    def _refined(self, one: Explanation) -> Explanation:
        """Simulate a set."""
        assert one.trial is not None
        solution = result_or_none(simulate_trial, *one.trial)
        if solution is None:  # along the motion it is a law, but not one that can be followed
            return replace(one, objection="its motion cannot be followed")
        found = self._with_solution(one, solution)
        if one.excess > 0:
            self._error = max(self._error, min((one.criterion - found.criterion) / one.excess, 1.0))
        return found

    def refine_fully(self, one: Explanation) -> Explanation:
        """Simulate a set to convergence."""
        found = self._with_solution(one, refine_to_end(one.law))
        if found.criterion < one.criterion:
            self.known[one.names] = one = found
        return one

    def _with_solution(self, one: Explanation, solution: Solution) -> Explanation:
        assert one.centre is not None
        fall = information_criterion(one.centre.law) - information_criterion(solution)
        fall -= sum(self._handicap(e) for e in one.effects if e.title not in one.centre.names)
        criterion = one.centre.criterion - fall - 2 * (one.log_prior - one.centre.log_prior)
        objections = (objection(solution, e) or self._only_levels(one, solution, e) for e in one.effects)
        return replace(one, solution=solution, criterion=criterion, objection=next(filter(None, objections), ""))

    def _only_levels(self, one: Explanation, solution: Solution, effect: Effect) -> str:
        """Objection that an effect of single runs shows in the friction levels alone: another surface does the same."""
        rest = self.known.get(one.names - {effect.title})
        if rest is None or rest.solution is None or not any(p.per_run and p.is_size for p in effect.parameters):
            return ""
        if rest.law.chi2 - solution.chi2 >= MIN_CHI2_SEPARATED:
            return ""
        return "it explains why the dry friction of runs differs, as another surface, load or scale does, and no more"

    def _restarted(self, one: Explanation) -> Explanation:
        """The set, refined again from one with an effect that contains one of its own and explains more.

        The larger effect may have found a better minimum. Where that is one of the smaller effect too, this one wins.
        """
        for other in self.laws(len(one.effects)):
            pair = _special_case(one, other)
            if pair is None or other.criterion >= one.criterion:
                continue
            small, large = pair
            try:
                again = self._with_solution(one, _refined_from(one.law, small, other.law, large))
            except FrictrackError:  # the larger effect is followed there, but not this one
                continue
            one = again if again.criterion < one.criterion else one
        return one


def _special_case(one: Explanation, other: Explanation) -> tuple[Effect, Effect] | None:
    """The only effects in which two sets differ, if the first one's is a special case of the other one's."""
    small, large = ([e for e in a.effects if e.title not in b.names] for a, b in ((one, other), (other, one)))
    if len(small) != 1 or len(large) != 1 or small[0].kind not in large[0].special_cases:
        return None
    return small[0], large[0]


def _misfit_of_priors(layout: ParameterLayout, p: Array) -> float:
    """What unknowns add to the objective by their departure from their priors."""
    return float(np.sum(prior_residual(layout, p) ** 2))


def _refined_from(fitted: Solution, small: Effect, found: Solution, large: Effect) -> Solution:
    """Fit with an effect that starts at the parameters of one that contains it."""
    problem = fitted.problem
    values = {(s.effect, s.parameter, s.run): x for s, x in zip(problem.layout.slots, fitted.p, strict=True)}
    pairs = {its.name: mine.name for mine, its in zip(small.linear, large.linear, strict=True)}
    pairs |= {q.name: q.name for q in small.nonlinear}
    for slot, x in zip(found.problem.layout.slots, found.p, strict=True):
        if slot.effect != large.name:
            values[slot.effect, slot.parameter, slot.run] = x
        elif slot.parameter in pairs:
            values[small.name, pairs[slot.parameter], slot.run] = x
    p = np.array([values[s.effect, s.parameter, s.run] for s in problem.layout.slots])
    return fit_with_scatter(problem, p, found.starts, found.tau or 0.03)


def find_rivals(best: Explanation, others: Sequence[Explanation]) -> list[Explanation]:
    """Find the sets of as many effects, or causes, that may be the explanation in place of the best one.

    They explain the runs about as well (BIC within `MAX_BIC_EQUAL`), or their best fit to the predictions of `best`
    differs by less than `MIN_CHI2_SEPARATED`. An effect that needs decisively more parameters (an amplitude per run) is
    no equal explanation. Neither is one that contains the best one as a special case: it predicts the same data
    whatever these are, with more parameters. A rival need not be significant by itself: the true cause may be less
    significant than its imitation. A set that was promising but not refined, because the budget was spent, counts as a
    rival: how much it explains is not known. That a wrong incline is more likely than a cause makes it the best, but
    excludes no other.

    Parameters
    ----------
    best
        The explanation.
    others
        Explanations.

    Returns
    -------
    list of Explanation
        The rivals, best first.

    """
    unit = dispersion(best.law)
    size, causes = len(best.effects), best.n_causes
    near = [one for one in others if len(one.effects) == size or (one.is_law and one.n_causes == causes)]
    near = [one for one in near if not (one.objection or _contains(one, best))]
    near = [one for one in near if not (best.names <= one.names or one.names < best.names)]
    near = [one for one in near if one.is_unrefined or behind(one, best) < MIN_CHI2_SEPARATED * unit]
    return [one for one in near if behind(one, best) < MAX_BIC_EQUAL * unit or _would_explain(one, best, unit)]


def behind(one: Explanation, best: Explanation) -> float:
    """How much less a set explains than the best one; a prior that prefers an incline is left out."""
    gap = one.criterion - best.criterion
    return min(gap, -one.evidence(best)) if any(e.same_cause_as for e in best.effects) else gap


def names_in_place_of(name: str, best: Explanation, rivals: Sequence[Explanation]) -> tuple[str, ...]:
    """Effects that stand in place of one of the best set in its rivals of as many effects."""
    rivals = [one for one in rivals if name not in one.names and len(one.effects) == len(best.effects)]
    others = [e.title for one in rivals for e in one.effects if e.title not in best.names]
    return tuple(dict.fromkeys(others))


def _contains(other: Explanation, best: Explanation) -> bool:
    """Whether an effect contains one that it replaces as a special case: it fits whatever the data are."""
    replaced = {e.kind for e in best.effects if e.title not in other.names}
    return any(replaced & set(e.special_cases) for e in other.effects if e.title not in best.names)


def _would_explain(other: Explanation, best: Explanation, unit: float) -> bool:
    """Whether a set explains what the best one does, and would if that were true.

    `unit` is the dispersion in which chi-squared is counted: above one while misfit remains.
    """
    if other.is_unrefined:
        return True
    if other.solution is not None:
        near = other.law.objective - best.law.objective < MAX_CHI2_NEAR * unit
        unknown = unit > 1 or other.law.problem.budget.is_spent
        return near and (unknown or expected_separation(best.law, other.law) < MIN_CHI2_SEPARATED)
    if best.trial is None or other.trial is None or best.trial[0] is not other.trial[0]:
        return False
    (law, true), rival = best.trial, other.trial[1]
    return rival.misfit - true.misfit < MAX_CHI2_NEAR * unit and (
        unit > 1 or misfit_left_by_other(law, true, rival) < MIN_CHI2_SEPARATED
    )


def alternatives_of(best: Explanation, rivals: Sequence[Explanation]) -> list[dict[str, Any]]:
    """Return the sets that stand in place of the best, where one of both has several effects.

    Another single effect is named with the single one found.
    """
    return [
        {"effects": sorted(one.names), "delta_bic": one.criterion - best.criterion}
        for one in rivals
        if one.solution is not None and max(len(one.effects), len(best.effects)) > 1
    ]
