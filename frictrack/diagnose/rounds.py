"""Run one round of the search: draw, scan every candidate, refine the significant ones and simulate the best."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from frictrack.diagnose.admissible import objection, physical_objection
from frictrack.diagnose.confirmation import is_confirmed
from frictrack.diagnose.hypothesis_tests import (
    ALPHA,
    ScannedCandidate,
    SearchTests,
    lack_of_fit,
    laws_in_place_of,
    list_candidates,
    run_tests,
)
from frictrack.diagnose.model_selection import (
    MAX_CHI2_NEAR,
    MIN_CHI2_SEPARATED,
    information_criterion,
    parameter_penalty,
)
from frictrack.diagnose.null_distribution import NullEnsemble, count_draws, draw_null_ensemble
from frictrack.effects import Effect
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution, fit_with_scatter
from frictrack.fit.linearised import LinearisedModel, candidate_grids, measured_series, scan_candidate
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.stepwise import (
    CandidateTrial,
    baseline_misfit,
    deepen_trials,
    effect_for_scan,
    gain_by_smaller_scatter,
    refine_to_end,
    simulate_trial,
    try_effect,
)

MAX_P_REFINED = 0.05  # of a candidate that is refined; the best two always are
N_DRAWS_LATER_ROUND = 199  # of a later round, where they show clearly that nothing is left
MIN_P_CLEAR = 0.05  # from which so few draws show that p is not below a level of 0.005, but for one case in a million
MAX_CANDIDATES_SIMULATED = 6
MAX_MISFIT_RATIO_SIMULATED = 4.0  # to the least misfit that is left along the measured motion by one that was simulated
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


@dataclass(frozen=True, eq=False)
class RoundOutcome:
    """A model that was tested, and its refined candidates, best first."""

    solution: Solution
    tried: list[RefinedCandidate]


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
        return self.tests.p_lack_of_fit < self.tests.level

    def is_significant(self, candidate: RefinedCandidate) -> bool:
        """Whether a candidate is significant in the whole search."""
        return candidate.p < self.tests.level

    @property
    def tested(self) -> RoundOutcome:
        """The model and its candidates, without the draws."""
        return RoundOutcome(self.solution, self.tried)

    @property
    def unrefined(self) -> list[str]:
        """Names of promising candidates that were not simulated to the end, because the budget was spent."""
        return [t.effect.name for t in self.tried if t.is_unrefined]

    @property
    def passing(self) -> list[RefinedCandidate]:
        """Plausible candidates that are significant, and confirmed by their simulated fit, best first."""
        plausible = [t for t in self.tried if self.is_significant(t) and t.solution and not t.objection]
        return [t for t in plausible if is_confirmed(self.tests, self.solution, t.law, t.effect)]


def run_round(
    solution: Solution,
    own: Sequence[Effect],
    rng: np.random.Generator,
    notify: Notify,
    level: float = ALPHA / 2,
) -> Round:
    """Test a model for every effect that it may lack, with all draws.

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
    level
        Significance level of the test for lack of fit, and of that of all candidates together.

    Returns
    -------
    Round

    """
    draws, tests, excluded = _run_all_tests(solution, own, rng, notify, level)
    return Round(solution, draws, tests, _refine_candidates(solution, draws, tests, notify), excluded)


def _run_all_tests(
    solution: Solution, own: Sequence[Effect], rng: np.random.Generator, notify: Notify, level: float
) -> tuple[NullEnsemble, SearchTests, dict[str, str]]:
    """Test a model with all draws; also return the effects that could not be tried."""
    notify("drawing data of the null hypothesis")
    draws = draw_null_ensemble(solution, rng, count_draws(level))
    notify("scanning every effect of the library")
    return draws, *_test_library(solution, own, draws, level)


def _test_library(
    solution: Solution, own: Sequence[Effect], draws: NullEnsemble, level: float
) -> tuple[SearchTests, dict[str, str]]:
    """Test a model for every effect; also return those that could not be tried."""
    library, excluded = list_candidates(solution, own)
    return run_tests(solution, draws, library, level), excluded


def _refine_candidates(
    solution: Solution,
    draws: NullEnsemble,
    tests: SearchTests,
    notify: Notify,
    is_beaten: Callable[[float], bool] = lambda misfit: False,
) -> list[RefinedCandidate]:
    """Refine the significant candidates, and simulate the best unless the misfit that it leaves is beaten."""
    data = draws.series.coordinates[:, 0]
    notify("refining significant candidates")
    trials = [try_effect(draws.law, s.effect, s.scans, data) for s in _select_candidates(tests)]
    significant = deepen_trials(draws.law, [t for t in trials if tests.p[t.effect.name] < tests.level])
    others = [t for t in trials if tests.p[t.effect.name] >= tests.level]  # not to be added whatever they explain
    if is_beaten(min((t.misfit for t in significant), default=0.0)):
        return _linearised(draws.law, [*significant, *others], tests.p)
    refined = simulate_promising(draws.law, solution, significant, tests.p)
    return [*_law_in_place(draws.law, solution, refined), *refined, *_linearised(draws.law, others, tests.p)]


def _law_in_place(
    law: LinearisedModel, solution: Solution, refined: Sequence[RefinedCandidate]
) -> list[RefinedCandidate]:
    """The law that stands in place of the best candidate, where it explains decisively more; else none."""
    best = next((t for t in refined if t.solution is not None and not t.objection), None)
    if best is None or not (laws := laws_in_place_of(best.effect, solution)):
        return []
    series, trials = measured_series(law), []
    for effect in laws:
        scans = [scan_candidate(law, f, series) for f in candidate_grids(law, effect_for_scan(solution, effect))]
        trials.append(try_effect(law, effect, scans, series.coordinates[:, 0]))
    assert best.linear_trial is not None
    own = best.linear_trial[1]
    least = own.misfit + parameter_penalty(own.layout, solution.problem)
    ahead = [t for t in trials if t.misfit + parameter_penalty(t.layout, solution.problem) < least]
    p = {t.effect.name: best.p for t in ahead}  # it was tested through the effect that it stands for
    tried = simulate_promising(law, solution, ahead, p, min_evidence=best.delta_bic)
    sure = [t for t in tried if t.solution is not None and not t.objection]
    return [t for t in sure if t.delta_bic > best.delta_bic + MIN_CHI2_SEPARATED][:1]


def run_later_round(
    solution: Solution,
    own: Sequence[Effect],
    rng: np.random.Generator,
    notify: Notify,
    level: float = ALPHA / 2,
    is_beaten: Callable[[float], bool] = lambda misfit: False,
) -> Round:
    """Test a model with the effects found; few draws do where these show clearly that nothing is left.

    Of such a round only the decision matters that nothing is significant. A sequential Monte Carlo test reaches it with
    the draws that exceed the data early. Everything else takes all draws. Without a significant candidate none is
    refined, because none can be added.

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
    level
        Significance level of the test for lack of fit, and of that of all candidates together.
    is_beaten
        Whether another explanation in place of all effects leaves far less than a given misfit. If the best candidate
        promises no better, none is simulated, so that none can be added.

    Returns
    -------
    Round
        Without refined candidates if none is significant.

    References
    ----------
    Besag, J. & Clifford, P. (1991). Sequential Monte Carlo p-values. Biometrika 78, 301-304.

    """
    draws = draw_null_ensemble(solution, rng, N_DRAWS_LATER_ROUND)
    if lack_of_fit(draws) >= MIN_P_CLEAR:
        tests, excluded = _test_library(solution, own, draws, level)
        if min(tests.p.values(), default=1.0) >= MIN_P_CLEAR:
            return Round(solution, draws, tests, [], excluded)
    draws, tests, excluded = _run_all_tests(solution, own, rng, notify, level)
    significant = min(tests.p.values(), default=1.0) < level
    refined = _refine_candidates(solution, draws, tests, notify, is_beaten) if significant else []
    return Round(solution, draws, tests, refined, excluded)


def _select_candidates(tests: SearchTests) -> list[ScannedCandidate]:
    """Select candidates that are significant, or nearly as good as the best; at least the best two."""
    order = sorted(tests.scanned, key=lambda s: -s.excess[0])
    top = order[0].statistic[0] if order and tests.p[order[0].effect.name] < tests.level else np.inf
    selected = [
        s for s in order if tests.p[s.effect.name] < MAX_P_REFINED or s.statistic[0] > top - _near_margin(s.effect, top)
    ]
    return selected if len(selected) >= 2 else order[:2]


def _near_margin(effect: Effect, top: float) -> float:
    """How far below the best a candidate may scan and still explain as much; scans underrate effects with memory."""
    return max(MAX_CHI2_NEAR, top / 2) if effect.memory or effect.modifies else MAX_CHI2_NEAR


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
    for candidate in _linearised(law, trials, p):
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


def _linearised(
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
