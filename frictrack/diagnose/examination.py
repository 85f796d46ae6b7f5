"""Examine one model: what a complete model of these runs would leave, and what every effect of the library gains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictrack.diagnose.hypothesis_tests import (
    SearchTests,
    gains_of_library,
    lack_of_fit,
    list_candidates,
    run_tests,
)
from frictrack.diagnose.model_selection import event_penalty, information_criterion, likelihood_gain
from frictrack.diagnose.null_distribution import NullEnsemble, count_draws, draw_null_ensemble
from frictrack.distributions import chi2_isf
from frictrack.effects import Effect
from frictrack.fit.least_squares import Solution

N_DRAWS_FEW = 299  # which show whether a misfit is left, at a level of 0.005
MIN_P_CLEAR = 0.05  # from which so few draws show that p is not below a level of 0.005, but for one case in a million
ALPHA_LOST = 0.01  # probability with which one amplitude for all runs loses more by chance


@dataclass(frozen=True, eq=False)
class Examination:
    """One model, with draws of the null hypothesis that it is complete, and the tests of these.

    Parameters
    ----------
    solution
        The model.
    draws
        Data and draws of the null hypothesis.
    tests
        Lack of fit and candidates.
    excluded
        Effects that could not be tried, with the reason.

    """

    solution: Solution
    draws: NullEnsemble
    tests: SearchTests
    excluded: dict[str, str]

    @property
    def leaves_misfit(self) -> bool:
        """Whether the misfit is significant."""
        return self.tests.p_lack_of_fit < self.tests.level

    @property
    def something_is_missing(self) -> bool:
        """Whether the misfit or the gain of any effect is significant."""
        return self.tests.something_is_missing

    def p_of_gain(self, effect: Effect, gain: float) -> float:
        """Return the p-value of an effect: of its scan, or of what its fit gains if something is missing.

        A scan holds the shape of the law. Where that imitates what is missing (a Stribeck velocity far too large
        imitates drag), an effect explains nothing until both are fitted. Whether something is missing is decided by
        scans alone.

        Parameters
        ----------
        effect
            The effect.
        gain
            Likelihood ratio of its fit beside the model, less the penalty for its events.

        """
        p = self.tests.p.get(effect.title, 1.0)
        return min(p, self.tests.p_of_gain(effect.title, gain)) if self.something_is_missing else p

    def confirms(self, fitted: Solution, effect: Effect) -> bool:
        """Whether a simulated fit confirms what the scan of an effect promised.

        It does if it lowers the BIC, or if its likelihood ratio reaches the critical value of the search. The second
        condition matters for small effects with many parameters, such as a wave with a phase in every run: there the
        penalty of BIC exceeds the critical value, and BIC alone would discard effects that the search detects at its
        stated level.

        Parameters
        ----------
        fitted
            The model with the effect.
        effect
            The effect.

        """
        if information_criterion(self.solution) > information_criterion(fitted):
            return True
        needed = self.tests.quantiles.get(effect.title)
        if needed is None:
            return False
        gain = likelihood_gain(self.solution, fitted) - event_penalty(fitted.problem, fitted.problem.layout, effect)
        return gain > needed + self.tests.critical - _loss_by_shared_amplitude(fitted, effect)


def examine(solution: Solution, own: Sequence[Effect], rng: np.random.Generator, level: float) -> Examination:
    """Test a model for every effect that it may lack.

    Parameters
    ----------
    solution
        The model.
    own
        Effects beside the library's.
    rng
        Random generator.
    level
        Significance level of the test for lack of fit, and of that of all candidates together.

    Returns
    -------
    Examination

    """
    library, excluded = list_candidates(solution, own)
    draws = draw_null_ensemble(solution, rng, count_draws(level))
    return Examination(solution, draws, run_tests(solution, draws, library, level), excluded)


def examine_again(
    solution: Solution, own: Sequence[Effect], rng: np.random.Generator, before: Examination
) -> Examination:
    """Test a model with the effects found: few draws show its lack of fit, if they decide (sequential Monte Carlo).

    What effects gain by chance is known from the examination of the smaller model. Where a misfit is left, none is
    scanned.

    Parameters
    ----------
    solution
        The model.
    own
        Effects beside the library's.
    rng
        Random generator.
    before
        Examination of the model without these effects.

    Returns
    -------
    Examination

    References
    ----------
    Besag, J. & Clifford, P. (1991). Sequential Monte Carlo p-values. Biometrika 78, 301-304.

    """
    level, library = before.tests.level, list_candidates(solution, own)[0]
    draws = draw_null_ensemble(solution, rng, N_DRAWS_FEW)
    p = lack_of_fit(draws)
    if level <= p < MIN_P_CLEAR:
        draws = draw_null_ensemble(solution, rng, count_draws(level))
        p = lack_of_fit(draws)
    gains = {} if p < level else gains_of_library(draws.law, library)
    tests = replace(before.tests, p_lack_of_fit=p, scanned=[], gains=gains)
    return replace(before, solution=solution, draws=draws, tests=tests)


def _loss_by_shared_amplitude(fitted: Solution, effect: Effect) -> float:
    """Loss of likelihood by chance by one amplitude for all runs, where the scan had one for each run."""
    layout = fitted.problem.layout
    slots = [s for s in layout.slots if s.effect == effect.name]
    phased = any(s.parameter == "phase" and s.run is not None for s in slots)
    shared = any(s.parameter in ("amplitude", "depth") and s.run is None for s in slots)
    more = len(layout.run_names) - 1
    return float(chi2_isf(ALPHA_LOST, more)) if phased and shared and more else 0.0
