"""Exchange several effects at once: what was found one by one may imitate a set of other effects.

Effects are fitted together along the measured motion, where a set takes milliseconds: one effect in place of each
found while that explains more, then two of those that did best in place of one, two or three, and every other effect
beside the best few. Sets that explain as much as the effects found are simulated. In place of one effect found, two
are tried that each explain much alone: a third may imitate their sum.

References
----------
Miller, A. (2002). Subset Selection in Regression, ch. 3 (exchange algorithms). Chapman & Hall.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np

from frictrack.diagnose.admissible import objection
from frictrack.diagnose.model_selection import (
    MAX_BIC_BARE_MENTION,
    MIN_CHI2_SEPARATED,
    information_criterion,
    log_prior_of_set,
    parameter_penalty,
)
from frictrack.diagnose.refined_candidates import RefinedCandidate
from frictrack.diagnose.rounds import Round, RoundOutcome
from frictrack.effects import Effect
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution
from frictrack.fit.linearised import LinearisedModel
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.stepwise import (
    CandidateTrial,
    gain_by_smaller_scatter,
    remove_effect,
    simulate_trial,
    try_effect,
    try_together,
)
from frictrack.records import Array
from frictrack.verdicts import join_as_one

N_PAIRED = 4  # effects, in place of each found, that are paired with every other
MIN_SHARE_PAIRED = 0.5  # of the evidence of one effect found, that each of two in its place has alone
N_EXCHANGED, N_EXCHANGED_FOR_ONE = 10, 16  # effects of which pairs are tried; if one effect was found
MAX_EXCHANGES = 4  # of one effect for another, one after the other
MAX_SETS_SIMULATED = 6
MAX_DELTA_BIC_SIMULATED = 2 * MIN_CHI2_SEPARATED  # behind the effects found, along the measured motion

Names = frozenset[str]


@dataclass(frozen=True)
class AlternativeSet:
    """A set of effects that explains as much as those named, its BIC over theirs (with priors of sets), and its fit."""

    effects: tuple[str, ...]
    delta_bic: float
    law: Solution

    @property
    def name(self) -> str:
        """The set in words."""
        return join_as_one(self.effects)

    def summary(self) -> dict[str, Any]:
        """Return the entry of the JSON of `frictrack diagnose`."""
        return {"effects": list(self.effects), "delta_bic": self.delta_bic}


def exchange_effects(
    first: Round,
    tested: Sequence[RoundOutcome],
    found: list[RefinedCandidate],
    is_allowed: Callable[[Effect], bool] = lambda effect: True,
) -> tuple[list[RefinedCandidate], list[AlternativeSet]]:
    """Look for other sets of effects that explain as much as those found, or more.

    Parameters
    ----------
    first
        The first round of the search.
    tested
        The models that were tested, with their candidates.
    found
        Effects found; the last one's fit contains them all.
    is_allowed
        Whether an effect may take part.

    Returns
    -------
    found : list of RefinedCandidate
        The best set.
    alternatives : list of AlternativeSet
        The other sets that these runs cannot exclude, best first.

    """
    law = found[-1].law
    members = _members(first, tested, found, is_allowed)
    if not members or not law.problem.simulates or law.problem.budget.is_spent:
        return found, []
    search = _SetSearch(
        first.draws.law, _fitted_effects(first, tested, found, members), _values(law.problem.layout, law.p)
    )
    names = frozenset(t.effect.name for t in found)
    laws = {names: law} | _simulated(search, names)
    criteria = {one: information_criterion(solution) - 2 * log_prior_of_set(len(one)) for one, solution in laws.items()}
    best = min(criteria, key=criteria.__getitem__)
    if criteria[names] < criteria[best] + MAX_BIC_BARE_MENTION:
        best = names
    near = [one for one in sorted(criteria, key=criteria.__getitem__) if one != best]
    near = [one for one in near if criteria[one] < criteria[best] + MIN_CHI2_SEPARATED]
    near = [one for one in near if not any(other < one for other in (best, *near))]  # others without what adds nothing
    near = [one for one in near if not _contains(search, one - best, best - one)]
    if best == names and len(found) == 1:  # another one effect is judged by `find_rivals`
        near = [one for one in near if len(one) > 1]
    chosen = found if best == names else _with_set(search, found, laws[best])
    alternatives = [AlternativeSet(tuple(sorted(one)), criteria[one] - criteria[best], laws[one]) for one in near]
    return chosen, alternatives


def with_rivals_of_sets(
    found: Sequence[RefinedCandidate], alternatives: Sequence[AlternativeSet]
) -> list[RefinedCandidate]:
    """Return the effects found, with the effects that stand in their place in other sets as rivals.

    A set in place of one effect is its rival as a whole: none of its members would explain as much.
    """
    if len(found) == 1:
        return list(found)
    names, out = {t.effect.name for t in found}, []
    for t in found:
        others = [one.effects for one in alternatives if t.effect.name not in one.effects]
        rivals = [name for one in others for name in one if name not in names]
        out.append(replace(t, indistinguishable_from=tuple(dict.fromkeys((*t.indistinguishable_from, *rivals)))))
    return out


@dataclass(frozen=True)
class _FittedEffect:
    """An effect with the values that it had in an earlier fit, and the runs in which it is absent."""

    effect: Effect
    values: dict[tuple[str, str, int | None], float]
    absent: frozenset[tuple[str, int]]


@dataclass(frozen=True)
class _SetSearch:
    """Fits sets of effects along the measured motion; every set once."""

    law: LinearisedModel
    effects: dict[str, _FittedEffect]
    values: dict[tuple[str, str, int | None], float]  # of the model with the effects found
    trials: dict[Names, CandidateTrial] = field(default_factory=dict)

    def criterion(self, names: Names, limit: float = np.inf) -> float:
        """BIC of a set along the measured motion, but for a constant; only roughly if it cannot fall below a limit."""
        if names not in self.trials:
            self.trials[names] = self._fitted(names, limit)
        return self._bic(self.trials[names])

    def _fitted(self, names: Names, limit: float) -> CandidateTrial:
        members = [known for name, known in self.effects.items() if name in names]
        values = dict(self.values)
        for known in members:
            values |= known.values
        absent = frozenset[tuple[str, int]]().union(*(known.absent for known in members))
        below = limit - parameter_penalty(self.law.solution.problem.layout, self.law.solution.problem)
        return try_together(self.law, [known.effect for known in members], values, absent, below=below)

    def _bic(self, trial: CandidateTrial) -> float:
        return trial.misfit + parameter_penalty(trial.layout, self.law.solution.problem)

    def best(self, found: Names) -> list[Names]:
        """The sets that are near the effects found, or better, without what adds nothing; best first."""
        centre = self._descend(found)
        count = N_EXCHANGED if len(centre) > 1 else N_EXCHANGED_FOR_ONE
        near = sorted(self._others(centre), key=lambda name: self._rank(centre, name))[:count]
        limit = self.criterion(found) + MAX_DELTA_BIC_SIMULATED
        for out in _subsets(centre):
            if out < centre:
                self.criterion(centre - out)
            for pair in combinations(near, 2):
                self.criterion(centre - out | frozenset(pair), limit)
        for one in centre:
            self._pair_up(centre - {one}, limit)
        promises = {names: self._promise(names) for names in self.trials if self.criterion(names) < limit}
        order = sorted(promises, key=promises.__getitem__)
        return [names for names in order if names != found and not _adds_nothing(names, promises)]

    def _promise(self, names: Names) -> float:
        """BIC of a set if the scatter of the friction levels is estimated beside it."""
        return self.criterion(names) - gain_by_smaller_scatter(self.law, self.trials[names])

    def _pair_up(self, rest: Names, limit: float) -> None:
        """Try every effect beside those that explain most alone: two may explain what neither of them does."""
        others = self._others(rest)
        for name in sorted(others, key=lambda name: self.criterion(rest | {name}))[:N_PAIRED]:
            for other in others:
                self.criterion(rest | {name, other}, limit)

    def _descend(self, names: Names) -> Names:
        """Exchange one effect after the other while that explains more."""
        for _ in range(MAX_EXCHANGES):
            exchanged = [names - {out} | {name} for out in names for name in self._others(names)]
            best = min([names, *exchanged], key=self.criterion)
            if best == names:
                break
            names = best
        return names

    def _others(self, names: Names) -> list[str]:
        return [name for name in self.effects if name not in names]

    def _rank(self, names: Names, other: str) -> float:
        """BIC of the best set in which another effect stands in place of one."""
        return min(self.criterion(names - {out} | {other}) for out in names)


def _adds_nothing(names: Names, criteria: Mapping[Names, float]) -> bool:
    """Whether a set explains less, by the BIC, than one of some others that lacks part of it."""
    limit = criteria[names] - MAX_BIC_BARE_MENTION
    return any(other < names and criterion < limit for other, criterion in criteria.items())


def _subsets(found: Names) -> Iterator[Names]:
    """Sets of one to three effects."""
    for size in (1, 2, 3):
        yield from map(frozenset, combinations(sorted(found), size))


def _simulated(search: _SetSearch, found: Names) -> dict[Names, Solution]:
    """The best other sets, simulated; those that are no law or have a physical objection left out."""
    out: dict[Names, Solution] = {}
    for one in search.best(found):
        if len(out) == MAX_SETS_SIMULATED or search.law.solution.problem.budget.is_spent:
            break
        try:
            law = simulate_trial(search.law, search.trials[one])
        except FrictrackError:
            continue
        if not any(objection(law, search.effects[name].effect) for name in one):
            out[one] = law
    return out


def _members(
    first: Round,
    tested: Sequence[RoundOutcome],
    found: Sequence[RefinedCandidate],
    is_allowed: Callable[[Effect], bool],
) -> list[str]:
    """Effects of which sets are made in place of those found; in place of one, those that explain much alone."""
    allowed = [s.effect.name for s in first.tests.scanned if is_allowed(s.effect)]
    if len(found) > 1:
        return allowed
    least = MIN_SHARE_PAIRED * found[0].delta_bic
    strong = {t.effect.name for t in tested[0].tried if t.delta_bic > least}
    return [name for name in allowed if name in strong]


def _fitted_effects(
    first: Round, tested: Sequence[RoundOutcome], found: Sequence[RefinedCandidate], members: Sequence[str]
) -> dict[str, _FittedEffect]:
    """Effects with the values of their latest fit; a clock error is no force along the motion."""
    data: Array = first.draws.series.coordinates[:, 0]
    latest: dict[str, tuple[ParameterLayout, Array]] = {}
    for t in (t for outcome in tested for t in outcome.tried if not t.objection):
        if t.solution is not None:
            latest[t.effect.name] = t.solution.problem.layout, t.solution.p
        elif t.linear_trial is not None:
            latest[t.effect.name] = t.linear_trial[1].layout, t.linear_trial[1].p
    whole = found[-1].law
    latest |= {t.effect.name: (whole.problem.layout, whole.p) for t in found}
    for s in first.tests.scanned:
        if s.effect.name not in latest and s.effect.name in members:
            trial = try_effect(first.draws.law, s.effect, s.scans, data)
            latest[s.effect.name] = trial.layout, trial.p
    added = {t.effect.name for t in found}
    out: dict[str, _FittedEffect] = {}
    for name in dict.fromkeys((*members, *(t.effect.name for t in found))):  # no second effect of a kind that was found
        layout, p = latest[name]
        effect = next(e for e in layout.model.effects if e.name == name)
        values = {key: value for key, value in _values(layout, p).items() if key[0] == name}
        if effect.clock is None or name in added:
            out[name] = _FittedEffect(effect, values, frozenset(a for a in layout.absent if a[0] == name))
    return out


def _values(layout: ParameterLayout, p: Array) -> dict[tuple[str, str, int | None], float]:
    """Unknowns by effect, parameter and run."""
    return {(s.effect, s.parameter, s.run): float(value) for s, value in zip(layout.slots, p, strict=True)}


def _contains(search: _SetSearch, others: Names, replaced: Names) -> bool:
    """Whether one of some effects contains one that it replaces as a special case: it fits whatever the data are."""
    kinds = {search.effects[name].effect.kind for name in replaced}
    return any(kinds & set(search.effects[name].effect.special_cases) for name in others)


def _with_set(search: _SetSearch, found: Sequence[RefinedCandidate], law: Solution) -> list[RefinedCandidate]:
    """The effects of another set as those found: first those that stay."""
    names = [name for name in search.effects if name in law.problem.model]
    kept = [t for t in found if t.effect.name in names]
    out = [replace(t, solution=law) for t in kept]
    p = max(t.p for t in found)
    for name in names:
        if name not in {t.effect.name for t in kept}:
            try:
                evidence = information_criterion(remove_effect(law, name)) - information_criterion(law)
            except FrictrackError:
                evidence = 0.0
            out.append(RefinedCandidate(search.effects[name].effect, law, evidence, p))
    return out
