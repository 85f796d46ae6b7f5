"""Run one round of the search: draw, scan every candidate, refine the significant ones and simulate the best."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictrack.diagnose.admissible import objection, physical_objection
from frictrack.diagnose.hypothesis_tests import ALPHA, ScannedCandidate, SearchTests, list_candidates, run_tests
from frictrack.diagnose.model_selection import (
    MAX_BIC_BARE_MENTION,
    MAX_CHI2_NEAR,
    MIN_CHI2_SEPARATED,
    expected_separation,
    information_criterion,
    parameter_penalty,
)
from frictrack.diagnose.null_distribution import NullEnsemble, draw_null_ensemble
from frictrack.effects import Effect
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution
from frictrack.fit.linearised import LinearisedModel, candidate_grids, linearise, measured_series, scan_candidate
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.stepwise import (
    CandidateTrial,
    baseline_misfit,
    deepen_trials,
    effect_for_scan,
    misfit_left_by_other,
    refine_to_end,
    remove_effect,
    simulate_trial,
    try_effect,
)
from frictrack.fit.uncertainty import dispersion
from frictrack.records import Array

MAX_P_REFINED = 0.05  # of a candidate that is refined; the best two always are
MAX_CHI2_PER_FRAME_TRUSTED = 1.2  # above it a model's effects are not trusted
MAX_CHI2_PER_FRAME_EXCHANGED = 10.0  # above it too much is wrong to exchange effects
MAX_CANDIDATES_SIMULATED = 6
MAX_UNKNOWNS_SIMPLE = 3  # of an effect that cannot be a mixture of others
MAX_CANDIDATES_SPLIT = 6  # with which a second simple effect is tried
MIN_BIC_RATIO_SIMULATED = 0.95  # of the best evidence that a linearised candidate must promise

Notify = Callable[[str], None]


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

    """

    effect: Effect
    solution: Solution | None
    delta_bic: float
    p: float
    indistinguishable_from: tuple[str, ...] = ()
    objection: str = ""
    linear_trial: tuple[LinearisedModel, CandidateTrial] | None = None

    @property
    def law(self) -> Solution:
        """The simulated fit."""
        assert self.solution is not None
        return self.solution


@dataclass(frozen=True)
class Round:
    """One test of one model.

    Parameters
    ----------
    solution
        The model.
    draws
        Data and draws of the null hypothesis.
    tests
        Lack of fit and candidates.
    tried
        Refined candidates, best first.
    excluded
        Effects that could not be tried, with the reason.

    """

    solution: Solution
    draws: NullEnsemble
    tests: SearchTests
    tried: list[RefinedCandidate]
    excluded: dict[str, str]  # effects that could not be tried, and why

    @property
    def leaves_misfit(self) -> bool:
        """Whether the misfit is significant."""
        return self.tests.p_lack_of_fit < ALPHA / 2

    @property
    def passing(self) -> list[RefinedCandidate]:
        """Plausible candidates that are significant and simulated, best first."""
        return [t for t in self.tried if t.p < ALPHA / 2 and t.delta_bic > 0 and t.solution and not t.objection]


def run_round(solution: Solution, own: Sequence[Effect], rng: np.random.Generator, notify: Notify) -> Round:
    """Test a model for every effect that it may lack.

    Parameters
    ----------
    solution
        The fitted model.
    own
        Effects beside the library's.
    rng
        Random generator.
    notify
        Called with the current step.

    Returns
    -------
    Round

    """
    notify("drawing data of the null hypothesis")
    draws = draw_null_ensemble(solution, rng)
    notify("scanning every effect of the library")
    library, excluded = list_candidates(solution, own)
    tests = run_tests(solution, draws, library)
    data = draws.series.coordinates[:, 0]
    notify("refining significant candidates")
    trials = [try_effect(draws.law, s.effect, s.scans, data) for s in _select_candidates(tests)]
    found = _simulate_promising(draws.law, solution, deepen_trials(draws.law, trials), tests.p)
    return Round(solution, draws, tests, found, excluded)


def _select_candidates(tests: SearchTests) -> list[ScannedCandidate]:
    """Select candidates that are significant, or nearly as good as the best; at least the best two."""
    order = sorted(tests.scanned, key=lambda s: -s.excess[0])
    top = order[0].statistic[0] if order and tests.p[order[0].effect.name] < ALPHA / 2 else np.inf
    selected = [
        s for s in order if tests.p[s.effect.name] < MAX_P_REFINED or s.statistic[0] > top - _near_margin(s.effect, top)
    ]
    return selected if len(selected) >= 2 else order[:2]


def _near_margin(effect: Effect, top: float) -> float:
    """How far below the best a candidate may scan and still explain as much; scans underrate effects with memory."""
    return max(MAX_CHI2_NEAR, top / 2) if effect.memory or effect.modifies else MAX_CHI2_NEAR


def _simulate_promising(
    law: LinearisedModel,
    solution: Solution,
    trials: list[CandidateTrial],
    p: dict[str, float],
    min_evidence: float = -np.inf,
) -> list[RefinedCandidate]:
    """Simulate trials in order of their evidence while they are near the best and above `min_evidence`."""
    own, misfit = information_criterion(solution), baseline_misfit(law)
    promised = {t.effect.name: misfit - t.misfit - _extra_penalty(law, t.layout) for t in trials}
    out: list[RefinedCandidate] = []
    for t in sorted(trials, key=lambda t: (p[t.effect.name] >= ALPHA / 2, -promised[t.effect.name])):
        name = t.effect.name
        candidate = RefinedCandidate(t.effect, None, promised[name], p[name], linear_trial=(law, t))
        candidate = replace(candidate, objection=physical_objection(t.layout, t.p, t.effect))
        if not candidate.objection and _is_worth_simulating(out, candidate, min_evidence):
            try:
                simulated = simulate_trial(law, t)
                candidate = replace(candidate, solution=simulated, delta_bic=own - information_criterion(simulated))
                candidate = replace(candidate, objection=objection(simulated, t.effect))
            except FrictrackError:  # along the motion it is a law, but not one that can be followed
                pass
        out.append(candidate)
    return sorted(out, key=lambda t: (t.p >= ALPHA / 2, bool(t.objection), -t.delta_bic))


def _is_worth_simulating(done: list[RefinedCandidate], new: RefinedCandidate, min_evidence: float) -> bool:
    """Whether a trial may be as good as the best so far, and as `min_evidence`."""
    simulated_gains = [t.delta_bic for t in done if t.solution is not None and not t.objection]
    near = (
        new.delta_bic
        > MIN_BIC_RATIO_SIMULATED * max([min_evidence, *simulated_gains]) - MAX_CHI2_NEAR - 2 * MIN_CHI2_SEPARATED
    )
    return near and new.p < ALPHA / 2 and len(simulated_gains) < MAX_CANDIDATES_SIMULATED


def _extra_penalty(law: LinearisedModel, layout: ParameterLayout) -> float:
    """BIC penalty for the parameters beyond those of the bare model."""
    return parameter_penalty(layout, law.solution.problem) - parameter_penalty(
        law.solution.problem.layout, law.solution.problem
    )


def find_rivals(best: RefinedCandidate, others: Sequence[RefinedCandidate]) -> tuple[str, ...]:
    """Find the effects whose best fit to the predictions of `best` differs by less than `MIN_CHI2_SEPARATED`.

    An effect that needs decisively more parameters (an amplitude per run) is no equal explanation. A rival need not be
    significant by itself: the true cause may be less significant than its imitation.

    Parameters
    ----------
    best
        The candidate.
    others
        All candidates of its round.

    Returns
    -------
    tuple of str
        Names of the rivals.

    """
    true = next((t.linear_trial for t in others if t.effect.name == best.effect.name), None)
    unit = dispersion(best.law)
    near = [t for t in others if t.effect.name != best.effect.name and not t.objection]
    near = [t for t in near if best.delta_bic - t.delta_bic < 2 * MIN_CHI2_SEPARATED * unit]
    return tuple(t.effect.name for t in near if _explains_as_much(t, best, true, unit))


def _explains_as_much(
    other: RefinedCandidate, best: RefinedCandidate, true: tuple[LinearisedModel, CandidateTrial] | None, unit: float
) -> bool:
    """Whether another effect explains what the best one does, and would if that were true.

    `unit` is the dispersion in which chi-squared is counted: above one while misfit remains.
    """
    if other.solution is not None:
        near = other.law.objective - best.law.objective < MAX_CHI2_NEAR * unit
        return near and (unit > 1 or expected_separation(best.law, other.law) < MIN_CHI2_SEPARATED)
    if true is None or other.linear_trial is None or not best.law.problem.simulates:
        return False
    (law, trial), rival = true, other.linear_trial[1]
    return rival.misfit - trial.misfit < MAX_CHI2_NEAR * unit and (
        unit > 1 or misfit_left_by_other(law, trial, rival) < MIN_CHI2_SEPARATED
    )


def review_found(
    start: Solution, found: list[RefinedCandidate], own: Sequence[Effect], notify: Notify
) -> list[RefinedCandidate]:
    """Test every effect found again beside all others.

    An unnecessary effect is removed. An effect that was a mixture of several gives way to what explains more, also to
    two simpler ones, and its rivals are named. Several effects of one kind are searched again as one, because the
    first was placed while another was missing. While the misfit is large, effects are only removed.

    Parameters
    ----------
    start
        The model before the search.
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
        notify(f"testing {name} again")
        try:
            reduced = remove_effect(full, name)
        except FrictrackError:  # without it there is no law that could be followed
            continue
        if reduced.objective > start.objective + MIN_CHI2_SEPARATED:  # it has more to explain with: it has run away
            continue
        evidence = information_criterion(reduced) - information_criterion(full)
        if evidence <= 0 and len(remaining) > 1:
            remaining = _with_law([k for k in remaining if k.effect.name != name], reduced)
        elif full.objective <= MAX_CHI2_PER_FRAME_EXCHANGED * full.problem.n_frames and name == same_kind[-1]:
            remaining = _exchange_effect(remaining, same_kind, reduced, own)
    return remaining


def _exchange_effect(
    kept: list[RefinedCandidate], same_kind: list[str], reduced: Solution, own: Sequence[Effect]
) -> list[RefinedCandidate]:
    """Try every effect in place of one, or of several of its kind; `rest` is the model without the last of them."""
    full, old = kept[-1].law, next(k for k in kept if k.effect.name == same_kind[0])
    try:
        for name in same_kind[:-1]:
            reduced = remove_effect(reduced, name)
    except FrictrackError:
        return kept
    evidence = information_criterion(reduced) - information_criterion(full)
    tried_again = _alternatives(reduced, own, old, min_evidence=evidence)
    best = tried_again[0]
    if not _is_better(best, old, evidence):
        if len(same_kind) > 1:
            return kept
        best = replace(old, solution=full, delta_bic=evidence)
    best = replace(best, indistinguishable_from=find_rivals(best, tried_again))
    pair = _split_in_two(best, tried_again, own)
    new = pair or [best]
    at = next(i for i, k in enumerate(kept) if k.effect.name == same_kind[0])
    later = [k for k in kept[at:] if k.effect.name not in same_kind]
    return _with_law([*kept[:at], *new, *later], new[-1].law)


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


def _split_in_two(
    best: RefinedCandidate, others: Sequence[RefinedCandidate], own: Sequence[Effect]
) -> list[RefinedCandidate]:
    """Two simple effects that explain decisively more than one flexible one; empty if there are none.

    An effect that is free in every run, such as a wave with phases per run, may imitate the sum of two simple ones.
    """
    found: list[RefinedCandidate] = []
    if _count_unknowns(best.law, best.effect.name) <= MAX_UNKNOWNS_SIMPLE:
        return found
    top = information_criterion(best.law) - MIN_CHI2_SEPARATED
    runs = len(best.law.problem.layout.run_names)
    for one in [t for t in others if t.delta_bic > MIN_CHI2_SEPARATED and _is_simple(t.effect, runs)][
        :MAX_CANDIDATES_SPLIT
    ]:
        try:
            law = _simulated_law(one)
            pairs = _alternatives(law, own, one, lambda e: _is_simple(e, runs), information_criterion(law) - top)
        except FrictrackError:
            continue
        two = next((t for t in pairs if t.solution is not None), None)
        if two is not None and information_criterion(two.law) < top:
            top = information_criterion(two.law)
            found = [replace(one, solution=law), two]
    return found


def _is_simple(effect: Effect, runs: int) -> bool:
    """Whether an effect has few parameters and no memory."""
    return (
        not effect.memory and sum(runs if p.per_run else 1 for p in effect.parameters if p.free) <= MAX_UNKNOWNS_SIMPLE
    )


def _simulated_law(tried: RefinedCandidate) -> Solution:
    """The simulated fit with a candidate."""
    if tried.solution is None and tried.linear_trial is not None:
        return simulate_trial(*tried.linear_trial)
    return tried.law


def _with_law(found: list[RefinedCandidate], law: Solution) -> list[RefinedCandidate]:
    """Let the last effect found hold the whole fit."""
    return [*found[:-1], replace(found[-1], solution=law)]


def _alternatives(
    rest: Solution,
    own: Sequence[Effect],
    old: RefinedCandidate,
    which: Callable[[Effect], bool] = lambda effect: True,
    min_evidence: float = -np.inf,
) -> list[RefinedCandidate]:
    """All effects that could replace one that was removed, best first, without new draws."""
    law = linearise(rest)
    series = measured_series(law)
    data: Array = series.coordinates[:, 0]
    trials = []
    for effect in filter(which, list_candidates(rest, own)[0]):
        e = old.effect if effect.kind == old.effect.kind else effect
        scans = [scan_candidate(law, f, series) for f in candidate_grids(law, effect_for_scan(rest, e))]
        trials.append(try_effect(law, e, scans, data))
    p = dict.fromkeys((t.effect.name for t in trials), old.p)
    return _simulate_promising(law, rest, deepen_trials(law, trials), p, min_evidence)


def refine_fully(best: RefinedCandidate) -> RefinedCandidate:
    """Refine the fit of a candidate until it converges."""
    return replace(best, solution=refine_to_end(best.law))
