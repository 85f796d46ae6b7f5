"""Test every effect found again beside all others: remove it, or exchange it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from frictrack.diagnose.hypothesis_tests import list_candidates
from frictrack.diagnose.model_selection import MAX_BIC_BARE_MENTION, MIN_CHI2_SEPARATED, information_criterion
from frictrack.diagnose.refined_candidates import RefinedCandidate, simulate_promising
from frictrack.diagnose.rivals import find_rivals
from frictrack.diagnose.rounds import Notify, RoundOutcome
from frictrack.effects import Effect
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution
from frictrack.fit.linearised import CandidateScan, linearise, measured_series
from frictrack.fit.stepwise import (
    deepen_trials,
    remove_effect,
    rename_effects,
    scan_effect,
    try_effect,
    try_known_effect,
)
from frictrack.models import Model
from frictrack.records import Array

MAX_CHI2_PER_FRAME_TRUSTED = 1.2  # above it a model's effects are not trusted
MAX_CHI2_PER_FRAME_EXCHANGED = 10.0  # above it too much is wrong to exchange effects
MAX_UNKNOWNS_SIMPLE = 3  # of an effect that cannot be a mixture of others
MIN_SCAN_SHARE = 0.25  # of the evidence to exceed; the nearest grid point of an effect gains most of what it can


def review_found(
    tested: Sequence[RoundOutcome], found: list[RefinedCandidate], own: Sequence[Effect], notify: Notify
) -> list[RefinedCandidate]:
    """Test every effect found again beside all others.

    An unnecessary effect is removed. An effect that was a mixture of several gives way to what explains more, and its
    rivals are named. Several effects of one kind are searched again as one, because the first was placed while another
    was missing. While the misfit is large, effects are only removed.

    Parameters
    ----------
    tested
        The models that were tested so far; first the one before the search.
    found
        Effects found, in order; the last one's fit contains them all.
    own
        Effects beside the library's.
    notify
        Called with the current step.

    Returns
    -------
    list of RefinedCandidate

    """
    remaining = list(found)
    for old in found:
        same_kind = [k.effect.name for k in remaining if k.effect.kind == old.effect.kind]
        full, name = remaining[-1].law, old.effect.name
        if len(remaining) < 2 and _count_unknowns(full, name) <= MAX_UNKNOWNS_SIMPLE:
            break
        if full.problem.budget.stops():
            break
        notify(f"testing {name} again")
        try:
            reduced = _without(full, [name], tested)
        except FrictrackError:  # without it there is no law that could be followed
            continue
        # it has more to explain with: it has run away
        if reduced.objective > tested[0].solution.objective + MIN_CHI2_SEPARATED:
            continue
        evidence = information_criterion(reduced) - information_criterion(full)
        if evidence <= 0 and len(remaining) > 1:
            remaining = _with_law([k for k in remaining if k.effect.name != name], reduced)
        elif full.objective <= MAX_CHI2_PER_FRAME_EXCHANGED * full.problem.n_frames and name == same_kind[-1]:
            remaining = _exchange_effect(remaining, same_kind, (reduced, tested), own)
    return _named_in_order(remaining) if remaining else []


def _named_in_order(found: Sequence[RefinedCandidate]) -> list[RefinedCandidate]:
    """Close gaps that removed effects leave in the names: ``patch:2`` is ``patch`` once the first patch is gone."""
    mine = [k.effect.name for k in found]
    model, names = Model(tuple(e for e in found[-1].law.problem.model.effects if e.name not in mine)), dict[str, str]()
    for effect in sorted((k.effect for k in found), key=lambda e: (len(e.name), e.name)):
        names[effect.name] = model.next_instance(effect.kind)
        model += effect.called(names[effect.name])
    if all(old == new for old, new in names.items()):
        return list(found)
    removed = {new: old for old, new in names.items() if new not in names}  # earlier laws may still hold it
    return [_renamed(k, names | removed) for k in found]


def _renamed(found: RefinedCandidate, names: Mapping[str, str]) -> RefinedCandidate:
    """The same effect found, in a law with other names."""
    return replace(
        found,
        effect=found.effect.called(names[found.effect.name]),
        solution=None if found.solution is None else rename_effects(found.solution, names),
        indistinguishable_from=tuple(names.get(name, name) for name in found.indistinguishable_from),
        linear_trial=None,
    )


def _without(full: Solution, names: Sequence[str], tested: Sequence[RoundOutcome]) -> Solution:
    """The model without some effects: the one before the search, one to which the effect was added, or a new fit."""
    if set(full.problem.model.names) - set(names) == set(tested[0].solution.problem.model.names):
        return tested[0].solution
    for name in names:
        known = next((t.solution for t in tested if _leads_to(t, full, name)), None)
        full = known or remove_effect(full, name)
    return full


def _leads_to(test: RoundOutcome, full: Solution, name: str) -> bool:
    """Whether a model was fitted by adding one effect to a model that was tested."""
    if {*test.solution.problem.model.names, name} != set(full.problem.model.names):
        return False
    fits = [t.solution for t in test.tried if t.effect.name == name and t.solution is not None]
    return any(abs(fit.objective - full.objective) < MIN_CHI2_SEPARATED for fit in fits)


def _exchange_effect(
    kept: list[RefinedCandidate],
    same_kind: list[str],
    without: tuple[Solution, Sequence[RoundOutcome]],
    own: Sequence[Effect],
) -> list[RefinedCandidate]:
    """Try every effect in place of one, or of several of its kind.

    `without` is the model without the last of them, and the models that were tested.
    """
    full, old = kept[-1].law, next(k for k in kept if k.effect.name == same_kind[0])
    reduced, tested = without
    try:
        if len(same_kind) > 1:
            reduced = _without(reduced, same_kind[:-1], tested)
    except FrictrackError:
        return kept
    evidence = information_criterion(reduced) - information_criterion(full)
    tried_again = (
        _alternatives_tested(known_test, old, evidence)
        if (known_test := next((t for t in tested if t.solution is reduced), None)) is not None
        else _alternatives(reduced, own, old, min_evidence=evidence, known=full)
    )
    best = tried_again[0] if tried_again else old
    if not _is_better(best, old, evidence):
        if len(same_kind) > 1:
            return kept
        best = replace(old, solution=full, delta_bic=evidence)
    best = replace(best, indistinguishable_from=find_rivals(best, tried_again))
    at = next(i for i, k in enumerate(kept) if k.effect.name == same_kind[0])
    later = [k for k in kept[at:] if k.effect.name not in same_kind]
    return _with_law([*kept[:at], best, *later], best.law)


def _is_better(best: RefinedCandidate, old: RefinedCandidate, evidence: float) -> bool:
    """Whether a new candidate may replace one of given evidence; for the same kind a small gain suffices."""
    if best.solution is None:
        return False
    if best.effect.kind == old.effect.kind:
        return best.delta_bic > evidence + MAX_BIC_BARE_MENTION
    clearly = best.delta_bic >= evidence + MIN_CHI2_SEPARATED
    return clearly and best.law.objective <= MAX_CHI2_PER_FRAME_TRUSTED * best.law.problem.n_frames


def _count_unknowns(law: Solution, name: str) -> int:
    """Number of parameters that an effect adds to a model."""
    return sum(s.effect == name for s in law.problem.layout.slots)


def _with_law(found: list[RefinedCandidate], law: Solution) -> list[RefinedCandidate]:
    """Let the last effect found hold the whole fit."""
    return [*found[:-1], replace(found[-1], solution=law)]


def _alternatives_tested(test: RoundOutcome, old: RefinedCandidate, min_evidence: float) -> list[RefinedCandidate]:
    """The candidates of an earlier test again, best first, where the model that it tested is left."""
    pairs = [t.linear_trial for t in test.tried if t.linear_trial is not None]
    simulated = {t.effect.name: t.solution for t in test.tried if t.solution is not None}
    p = dict.fromkeys((trial.effect.name for _, trial in pairs), old.p)
    trials = [trial for _, trial in pairs]
    return simulate_promising(pairs[0][0], test.solution, trials, p, min_evidence=min_evidence, simulated=simulated)


def _alternatives(
    rest: Solution,
    own: Sequence[Effect],
    old: RefinedCandidate,
    *,
    min_evidence: float,
    known: Solution | None = None,
) -> list[RefinedCandidate]:
    """Effects that could replace one that was removed, best first, without new draws; `known` is the fit with it."""
    law = linearise(rest)
    series = measured_series(law)
    data: Array = series.coordinates[:, 0]
    trials = []
    for effect in list_candidates(rest, own)[0]:
        if rest.problem.budget.stops():
            break
        e = old.effect if effect.kind == old.effect.kind else effect
        scans = scan_effect(law, e, series)
        if _may_reach(e, scans, min_evidence):
            trials.append(try_effect(law, e, scans, data))
            if known is not None and e is old.effect:  # where it was, it explains something already
                trials[-1] = min(trials[-1], try_known_effect(law, known, e), key=lambda t: t.misfit)
    p = dict.fromkeys((t.effect.name for t in trials), old.p)
    trials = deepen_trials(law, trials, min_evidence)
    return simulate_promising(law, rest, trials, p, min_evidence=min_evidence)


def _may_reach(effect: Effect, scans: Sequence[CandidateScan], evidence: float) -> bool:
    """Whether an effect may reach some evidence, by its scan; scans underrate effects with memory."""
    gain = sum(float(s.gains.max()) for s in scans)
    return effect.memory or bool(effect.modifies) or gain > MIN_SCAN_SHARE * evidence
