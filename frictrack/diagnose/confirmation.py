"""Decide whether the simulated fit of a significant candidate confirms what its scan promised.

The p-value comes from a scan along the measured motion. The simulated fit confirms it if it improves the BIC, or if its
likelihood ratio reaches the critical value of the same search. The second condition matters for small effects with many
parameters, such as a wave with a phase in every run: there the penalty of BIC exceeds the critical value, and BIC alone
would discard effects that the search detects at its stated level.
"""

from __future__ import annotations

from frictrack.diagnose.hypothesis_tests import SearchTests
from frictrack.diagnose.model_selection import information_criterion, likelihood_gain
from frictrack.distributions import chi2_isf
from frictrack.effects import Effect
from frictrack.fit.least_squares import LeastSquaresProblem, Solution
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.stepwise import EVENT_PARAMETERS, bic_penalty

ALPHA_LOST = 0.01  # probability with which one amplitude for all runs loses more by chance


def is_confirmed(tests: SearchTests, bare: Solution, fitted: Solution, effect: Effect) -> bool:
    """Whether a simulated fit confirms a candidate that is significant in its scan.

    Parameters
    ----------
    tests
        The tests of the round.
    bare, fitted
        The model that was tested, and its simulated fit with the candidate.
    effect
        The candidate.

    Returns
    -------
    bool

    """
    if information_criterion(bare) > information_criterion(fitted):
        return True
    needed = next((s.quantile for s in tests.scanned if s.effect.name == effect.name), None)
    if needed is None:
        return False
    gain = likelihood_gain(bare, fitted) - event_penalty(fitted.problem, fitted.problem.layout, effect)
    return gain > needed + tests.critical - _loss_by_shared_amplitude(fitted, effect)


def event_penalty(problem: LeastSquaresProblem, layout: ParameterLayout, effect: Effect) -> float:
    """Return the penalty that a scan subtracts for the events of an effect in single runs.

    Parameters
    ----------
    problem
        The runs.
    layout
        A model of them with the effect.
    effect
        The effect.

    """
    if not effect.single:
        return 0.0
    events = sum((effect.name, run) not in layout.absent for run in {p.run for p in problem.pieces})
    return bic_penalty(events * EVENT_PARAMETERS, problem.n_frames)


def _loss_by_shared_amplitude(fitted: Solution, effect: Effect) -> float:
    """Loss of likelihood by chance by one amplitude for all runs, where the scan had one for each run."""
    layout = fitted.problem.layout
    slots = [s for s in layout.slots if s.effect == effect.name]
    phased = any(s.parameter == "phase" and s.run is not None for s in slots)
    shared = any(s.parameter in ("amplitude", "depth") and s.run is None for s in slots)
    more = len(layout.run_names) - 1
    return float(chi2_isf(ALPHA_LOST, more)) if phased and shared and more else 0.0
