"""Compare fitted models: Bayesian information criterion, and the expected separation of two rivals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import comb, log

from frictrack.effects import LIBRARY, Effect
from frictrack.fit.least_squares import LeastSquaresProblem, Solution, refine
from frictrack.fit.parameters import ParameterLayout, penalty_residual
from frictrack.fit.stepwise import EVENT_PARAMETERS, bic_penalty

MIN_CHI2_SEPARATED = 10.0  # expected difference below which two causes are indistinguishable
MAX_BIC_EQUAL = 6.0  # evidence of 20 to 1, below which neither of two causes is excluded ("strong" from there on)
MAX_BIC_BARE_MENTION = 2.0  # "not worth more than a bare mention" (Kass & Raftery 1995)
PRIOR_ONE_MORE = 0.3  # prior probability of one effect more, over that of so many
MIN_CHI2_FALL = 0.1  # of a step of a fit whose misfit is only compared with the limits above
MAX_CHI2_NEAR = 40.0  # measured difference above which the expected one is not computed


def expected_separation(best: Solution, rival: Solution) -> float:
    """Expected difference of the objective if one model is true and a rival is fitted to its predictions.

    Parameters
    ----------
    best
        The model taken to be true.
    rival
        The other one.

    Returns
    -------
    float

    References
    ----------
    Hunter & Reiner (1965), Technometrics 7, 307-323; Atkinson & Fedorov (1975), Biometrika 62, 57-70.

    """
    ideal = {(r.piece.run, int(r.piece.frames[0])): r.model_y for r in best.responses}
    pieces = [replace(p, y=ideal[p.run, int(p.frames[0])]) for p in rival.problem.pieces]
    problem = rival.problem.rebuild(rival.problem.layout, pieces)
    tau = best.tau_of_other_runs
    fitted = refine(problem, rival.p, rival.starts, tau=tau, max_steps=15, min_fall=MIN_CHI2_FALL)
    held = penalty_residual(best.problem.layout, best.p, tau)
    return fitted.objective - float(held @ held)


def information_criterion(solution: Solution) -> float:
    """Bayesian information criterion with the friction levels integrated out; smaller is better.

    The likelihood is not the restricted one, which cannot compare models with different fixed effects.

    Parameters
    ----------
    solution
        The fitted model.

    Returns
    -------
    float

    References
    ----------
    Schwarz (1978), Ann. Stat. 6, 461-464.

    """
    penalty = solution.scatter_penalty(solution.tau) + parameter_penalty(solution.problem.layout, solution.problem)
    return solution.objective + penalty


def likelihood_gain(bare: Solution, fitted: Solution) -> float:
    """Compute the fall of minus twice the log-likelihood from a model to a larger one, levels integrated out.

    Parameters
    ----------
    bare, fitted
        The smaller and the larger model.

    Returns
    -------
    float

    """
    gain = information_criterion(bare) - information_criterion(fitted)
    penalties = [parameter_penalty(s.problem.layout, s.problem) for s in (bare, fitted)]
    return gain + penalties[1] - penalties[0]


def parameter_penalty(layout: ParameterLayout, problem: LeastSquaresProblem) -> float:
    """Penalty of BIC for the parameters of a model without its friction levels."""
    return bic_penalty(len(layout.slots) - len(layout.levels), problem.n_frames)


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


def log_prior_of_effects(effects: Sequence[Effect]) -> float:
    """Logarithm of the prior probability of one set of effects, over that of any one effect.

    An origin that runs share is an assumption, not a law: every record may be set up anew. Its own value in every run
    is as likely as all causes of the library together.
    """
    origins = sum(bool(e.frees) and e.parameter(e.frees).per_run for e in effects)
    return (log_prior_of_set(len(effects)) if effects else 0.0) + origins * log(len(LIBRARY))


def log_prior_of_set(count: int) -> float:
    """Logarithm of the prior probability of one set of so many effects, over that of any one effect.

    Each effect more is less likely, and there are more sets of that size; all of a size are alike.

    Examples
    --------
    >>> log_prior_of_set(3) < log_prior_of_set(2) < log_prior_of_set(1)
    True

    """
    return (count - 1) * log(PRIOR_ONE_MORE) - log(comb(len(LIBRARY), count))
