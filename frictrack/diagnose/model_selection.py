"""Compare fitted models, and judge whether a fitted effect can be the cause of a misfit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import comb, log

import numpy as np

from frictrack.effects import LIBRARY, Effect
from frictrack.fit.least_squares import LeastSquaresProblem, Solution, inverse_normal_matrix, refine
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.penalties import penalty_jacobian, penalty_residual
from frictrack.fit.stepwise import EVENT_PARAMETERS, bic_penalty, physical_objection
from frictrack.records import Array

MIN_CHI2_SEPARATED = 10.0  # expected difference below which two causes are indistinguishable
MAX_BIC_EQUAL = 6.0  # evidence of 20 to 1, below which neither of two causes is excluded ("strong" from there on)
MAX_BIC_BARE_MENTION = 2.0  # "not worth more than a bare mention" (Kass & Raftery 1995)
PRIOR_CAMERA = 0.3  # prior probability of an error of a camera where only tables are known, over that of a cause
PRIOR_ONE_MORE = 0.3  # prior probability of one effect more, over that of so many
MIN_CHI2_FALL = 0.1  # of a step of a fit whose misfit is only compared with the limits above
EVIDENCE_PRECISION = 0.02  # of an expected difference of chi-squared: share of it below which a step is not taken
MAX_STEPS = 12  # Gauss-Newton steps of such a fit
MAX_CHI2_NEAR = 40.0  # measured difference above which the expected one is not computed
MIN_SIGMAS_MISFIT = 5.0  # standard deviations of chi-squared above which misfit is significant
MIN_SIGNIFICANCE = 3.0  # standard deviations that an effect's size must exceed


def expected_separation(best: Solution, rival: Solution) -> float:
    """Expected difference of the objective if one model is true and a rival is fitted to its predictions.

    `best`: the model taken to be true.

    References
    ----------
    Hunter & Reiner (1965), Technometrics 7, 307-323; Atkinson & Fedorov (1975), Biometrika 62, 57-70.

    """
    fitted = fitted_to_predictions(rival, best)
    held = penalty_residual(best.problem.layout, best.p, best.tau_of_other_runs)
    return fitted.objective - float(held @ held)


def fitted_to_predictions(rival: Solution, truth: Solution) -> Solution:
    """Fit a rival to what another fit predicts of the same runs, without noise."""
    true_y = {(r.piece.run, int(r.piece.frames[0])): r.model_y for r in truth.responses}
    pieces = [replace(p, y=true_y[p.run, int(p.frames[0])]) for p in rival.problem.pieces]
    problem = rival.problem.rebuild(rival.problem.layout, pieces)
    return fitted_without_noise(problem, rival.p, rival.starts, truth.tau_of_other_runs)


def fitted_without_noise(problem: LeastSquaresProblem, p: Array, starts: Sequence[Array], tau: float) -> Solution:
    """Fit data without noise: what is left of them is evidence, and needed no more exactly than evidence is judged."""
    return refine(
        problem, p, starts, tau=tau, max_steps=MAX_STEPS, min_fall=MIN_CHI2_FALL, min_share=EVIDENCE_PRECISION
    )


def information_criterion(solution: Solution) -> float:
    """Bayesian information criterion with the friction levels integrated out; smaller is better.

    The likelihood is not the restricted one, which cannot compare models with different fixed effects.

    References
    ----------
    Schwarz (1978), Ann. Stat. 6, 461-464.

    """
    return _deviance(solution) + parameter_penalty(solution.problem.layout, solution.problem)


def likelihood_gain(bare: Solution, fitted: Solution) -> float:
    """Compute the fall of minus twice the log-likelihood from a model to a larger one, levels integrated out.

    `bare`, `fitted`: the smaller and the larger model.
    """
    return _deviance(bare) - _deviance(fitted)


def _deviance(solution: Solution) -> float:
    """Minus twice the log-likelihood, but for a constant, with the friction levels integrated out."""
    return solution.objective + solution.scatter_penalty(solution.tau)


def excess_chi2(solution: Solution) -> float:
    """Chi-squared above its expectation."""
    frames, free = solution.problem.n_frames, 2 * len(solution.responses) + len(solution.p)
    return solution.chi2 - (frames - free)


def leaves_only_noise(solution: Solution) -> bool:
    """Return whether chi-squared exceeds its expectation by no more than noise does."""
    return bool(excess_chi2(solution) < MIN_SIGMAS_MISFIT * np.sqrt(2 * solution.problem.n_frames))


def parameter_penalty(layout: ParameterLayout, problem: LeastSquaresProblem) -> float:
    """Penalty of BIC for the parameters of a model without its friction levels."""
    return bic_penalty(len(layout.slots) - len(layout.levels), problem.n_frames)


def event_penalty(problem: LeastSquaresProblem, layout: ParameterLayout, effect: Effect) -> float:
    """Return the penalty that a scan subtracts for the events of an effect in single runs.

    `layout`: a model of them with the effect.
    """
    if not effect.single:
        return 0.0
    events = sum((effect.name, run) not in layout.absent for run in {p.run for p in problem.pieces})
    return bic_penalty(events * EVENT_PARAMETERS, problem.n_frames)


def log_prior_of_effects(effects: Sequence[Effect]) -> float:
    """Logarithm of the prior probability of one set of effects, over that of any one effect.

    The incline, and an origin that runs share, are settings of a record and no causes: that one is wrong is as likely
    as all causes of the library together, and changes nothing in how likely the causes are.
    """
    causes = sum(not e.of_record for e in effects)
    return log_prior_of_set(causes) if causes else 0.0


def log_prior_of_set(count: int) -> float:
    """Logarithm of the prior probability of one set of so many effects, over that of any one effect.

    Each effect more is less likely, and there are more sets of that size; all of a size are alike.

    Examples
    --------
    >>> log_prior_of_set(3) < log_prior_of_set(2) < log_prior_of_set(1)
    True

    """
    return (count - 1) * log(PRIOR_ONE_MORE) - log(comb(len(LIBRARY), count))


def objection(solution: Solution, effect: Effect) -> str:
    """Return why a fitted effect cannot be the cause.

    The effect's own check (`Effect.plausible`) must pass in at least one run where it acts. At least one of its sizes
    must exceed three standard deviations with its shape held: a narrow strong patch and a wide weak one are
    interchangeable, although a patch is there.

    Empty if there is no objection.
    """
    return physical_objection(solution.problem.layout, solution.p, effect) or _insignificant(solution, effect)


def _insignificant(solution: Solution, effect: Effect) -> str:
    """Objection that no size of the effect is significant."""
    layout = solution.problem.layout
    sizes = {p.name: p.unit for p in effect.parameters if p.linear or p.role == "depth"}
    at = [i for i, s in enumerate(layout.slots) if s.effect == effect.name and s.parameter in sizes]
    if not at:
        return ""
    std = _std_in_shape(solution, effect, at)
    value = solution.p[at]
    if np.any(np.abs(value) > MIN_SIGNIFICANCE * std):
        return ""
    k = int(np.argmax(np.abs(value) / np.maximum(std, 1e-300)))
    slot = layout.slots[at[k]]
    return (
        f"{slot.parameter} = {value[k]:.2g} +/- {std[k]:.2g} {sizes[slot.parameter]} is not larger than "
        f"{MIN_SIGNIFICANCE:g} of its standard deviations"
    )


def _std_in_shape(solution: Solution, effect: Effect, at: list[int]) -> Array:
    """Standard deviations of some parameters while the others of their effect, and those at a bound, are held."""
    layout = solution.problem.layout
    others = [s.effect != effect.name and not held for s, held in zip(layout.slots, solution.held, strict=True)]
    free = [i for i, is_free in enumerate(others) if is_free or i in at]
    rows = np.vstack([solution.few_rows, penalty_jacobian(layout, solution.tau or 0.03, solution.p)])
    covariance, _ = inverse_normal_matrix(rows[:, free])
    return np.sqrt(np.maximum(np.diag(covariance)[[free.index(i) for i in at]], 0.0))
