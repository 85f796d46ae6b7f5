"""Run one round of the search: draw, scan every candidate, and refine the significant ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from frictrack.diagnose.confirmation import event_penalty, is_confirmed
from frictrack.diagnose.hypothesis_tests import (
    ALPHA,
    ScannedCandidate,
    SearchTests,
    lack_of_fit,
    list_candidates,
    run_tests,
)
from frictrack.diagnose.model_selection import MAX_CHI2_NEAR
from frictrack.diagnose.null_distribution import NullEnsemble, count_draws, draw_null_ensemble
from frictrack.diagnose.refined_candidates import (
    RefinedCandidate,
    law_in_place,
    linearised_candidates,
    simulate_promising,
)
from frictrack.effects import Effect
from frictrack.fit.least_squares import Solution
from frictrack.fit.stepwise import CandidateTrial, baseline_misfit, deepen_trials, try_effect

MAX_P_REFINED = 0.05  # of a candidate that is refined; the best two always are
N_DRAWS_LATER_ROUND = 199  # of a later round, where they show clearly that nothing is left
MIN_P_CLEAR = 0.05  # from which so few draws show that p is not below a level of 0.005, but for one case in a million

Notify = Callable[[str], None]


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
    p = _p_values(solution, draws, tests, trials)
    significant = deepen_trials(draws.law, [t for t in trials if p[t.effect.name] < tests.level])
    others = [t for t in trials if p[t.effect.name] >= tests.level]  # not to be added whatever they explain
    if is_beaten(min((t.misfit for t in significant), default=0.0)):
        return linearised_candidates(draws.law, [*significant, *others], p)
    refined = simulate_promising(draws.law, solution, significant, p)
    return [*law_in_place(draws.law, solution, refined), *refined, *linearised_candidates(draws.law, others, p)]


def _p_values(
    solution: Solution, draws: NullEnsemble, tests: SearchTests, trials: Sequence[CandidateTrial]
) -> dict[str, float]:
    """Return the p-value of every candidate: of its trial if something is missing and the trial explains more.

    A scan holds the shape of the law. Where that imitates what is missing (a Stribeck velocity far too large imitates
    drag), an effect explains nothing until both are fitted. Whether something is missing is decided by scans alone.
    """
    p = dict(tests.p)
    if tests.something_is_missing:
        misfit = baseline_misfit(draws.law)
        for t in trials:
            name, penalty = t.effect.name, event_penalty(solution.problem, t.layout, t.effect)
            p[name] = min(p[name], tests.p_of_gain(name, misfit - t.misfit - penalty))
    return p


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
    """Select candidates that are significant or, where something is missing, near the best; at least the best two."""
    order = sorted(tests.scanned, key=lambda s: -s.excess[0])
    top = order[0].statistic[0] if order and tests.something_is_missing else np.inf
    selected = [
        s for s in order if tests.p[s.effect.name] < MAX_P_REFINED or s.statistic[0] > top - _near_margin(s.effect, top)
    ]
    return selected if len(selected) >= 2 else order[:2]


def _near_margin(effect: Effect, top: float) -> float:
    """How far below the best a candidate may scan and still explain as much; scans underrate effects with memory."""
    return max(MAX_CHI2_NEAR, top / 2) if effect.memory or effect.modifies else MAX_CHI2_NEAR
