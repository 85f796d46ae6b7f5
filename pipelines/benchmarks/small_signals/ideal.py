"""Name a hidden effect as an ideal detector does: every effect of the library is fitted from the truth.

The ideal detector knows the base law, the form of every effect, and for each effect the place, frequency and time at
which it fits the data without noise best. From there it fits every effect to the noisy data, and takes the one with the
best likelihood, each parameter at its price (BIC). Its threshold is that of `validation.blind.ideal_detector`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from frictrack.base.errors import FrictrackError
from frictrack.diagnose.model_selection import information_criterion, parameter_penalty
from frictrack.fit.least_squares import Solution, fit_with_scatter
from frictrack.validation.blind.ideal_detector import IdealDetector
from frictrack.validation.blind.outcome import MAX_CHI2_EXCESS, replacements, solution_at_truth
from frictrack.validation.blind.truth import Truth, effect_named

MAX_CHI2_RIVAL = 30.0  # separation beyond which noise puts a rival before the truth in less than one of 300 studies


@dataclass(frozen=True)
class IdealNaming:
    """What the ideal detector says of one study.

    `detected`: the true effect passes the threshold; `first`: it also explains the data best; `named`: the one that
    explains the data best is the true effect, or these runs cannot tell the two apart (`equivalents`).
    """

    detected: bool
    first: bool
    named: bool
    best: str
    equivalents: list[str]


def name_ideally(truth: Truth, base: Solution) -> IdealNaming:
    """Name the hidden effect of a study; `base` is the fit of the base law to the noisy data."""
    (name,) = truth.hidden
    full = solution_at_truth(truth, base)
    without_noise = replacements(full, name, MAX_CHI2_RIVAL)
    near = [n for n, fitted in without_noise.items() if fitted.objective - full.objective < MAX_CHI2_EXCESS]
    fits = {name: _with_noise(full, base)}
    for other, fitted in without_noise.items():
        if fitted.objective - full.objective > MAX_CHI2_RIVAL:
            continue
        try:
            fits[other] = _with_noise(fitted, base)
        except FrictrackError:  # too far from this noise to be followed
            continue
    best = min(fits, key=lambda n: information_criterion(fits[n]))
    ratio = _log_likelihood_fall(base) - _log_likelihood_fall(fits[name])
    detected = ratio > IdealDetector(_bare(truth)).threshold(effect_named(name))
    return IdealNaming(detected, detected and best == name, detected and best in (name, *near), best, near)


def _with_noise(fitted: Solution, base: Solution) -> Solution:
    """The same model fitted to the noisy data, from its parameters without noise."""
    problem = base.problem.rebuild(fitted.problem.layout, base.problem.pieces)
    return fit_with_scatter(problem, fitted.p, fitted.starts, fitted.tau)


def _log_likelihood_fall(solution: Solution) -> float:
    """Minus twice the logarithm of the likelihood, the friction levels integrated out."""
    return information_criterion(solution) - parameter_penalty(solution.problem.layout, solution.problem)


def _bare(truth: Truth) -> Truth:
    """The study without its hidden effect."""
    return replace(truth, hidden=(), runs=tuple(replace(run, values={}) for run in truth.runs))
