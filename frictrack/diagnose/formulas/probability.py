"""Estimate the probability that a formula has the right form.

The evidence of a form is its likelihood averaged over its coefficients and parameters (Laplace's approximation; MacKay
1992). Its prior halves with every coefficient, parameter and further operator. "None of these" competes with the forms:
a smooth force of any shape in their place, and what a smooth force still explains after the best of them.

References
----------
MacKay (1992), Neural Computation 4, 415-447; Zellner (1986), in Bayesian Inference and Decision Techniques, 233-243;
Rasmussen & Williams (2006), Gaussian Processes for Machine Learning, ch. 5.

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import logsumexp

from frictrack.diagnose.compressed import CompressedResidual, compress_residual
from frictrack.diagnose.formulas.terms import Term, parameter_ranges
from frictrack.diagnose.smooth_forces import LENGTH_RATIOS, smooth_forces
from frictrack.fit.least_squares import Solution
from frictrack.records import Array

PRIOR_NONE = 0.1  # prior probability of a cause outside of the grammar
LOG_PRIOR_PER_UNKNOWN = float(np.log(0.5))
CREDIBLE_PROBABILITY = 0.95  # that the right form is in the group, if the grammar has it


def log_prior(size: int, sizes: Sequence[int]) -> float:
    """Logarithm of the prior probability of a form of a size among those of a grammar.

    Examples
    --------
    >>> round(log_prior(1, [1, 2, 2]), 3)
    -0.693

    """
    return LOG_PRIOR_PER_UNKNOWN * size - float(logsumexp(LOG_PRIOR_PER_UNKNOWN * np.array(sizes)))


def log_volume(term: Term, jacobian: Array) -> float:
    """Logarithm of the share of the prior range of its parameters that the data leave to a form.

    `jacobian` (M, q) is the derivative of the whitened residual. Parameters that the data do not determine keep all.
    """
    ranges, logarithmic = parameter_ranges(term)
    per_step = jacobian * np.where(logarithmic, np.abs(term.parameters), 1.0)
    precision = per_step.T @ per_step + np.diag(2 * np.pi / ranges**2)
    sign, log_det = np.linalg.slogdet(precision)
    whole = 0.5 * (len(ranges) * float(np.log(2 * np.pi)) - float(log_det)) - float(np.sum(np.log(ranges)))
    return min(whole, 0.0) if sign > 0 else 0.0


def relative_evidence(term: Term, power: float, unit: float = 1.0) -> float:
    """Logarithm of the evidence of a form times its relative prior, over that of no force.

    The prior of the size of a force is taken from `power`, the fall of chi-squared by the best form (Zellner 1986).
    `unit` is the reduced chi-squared, if it is above 1.
    """
    coefficients = 0.5 * len(term.shape.columns) * float(np.log1p(power / unit))
    return 0.5 * term.gain / unit - coefficients + term.log_volume + LOG_PRIOR_PER_UNKNOWN * term.size


def smooth_evidence(compressed: CompressedResidual, power: float, unit: float = 1.0) -> float:
    """Logarithm of the evidence of a smooth force of any shape over the best axis, as `relative_evidence` of a form."""
    smooth = smooth_forces(compressed)
    tried = float(np.log(len(smooth) * len(LENGTH_RATIOS)))
    return smooth[0].gain / (2 * unit) - tried - 0.5 * float(np.log1p(power / unit))


def remaining_evidence(solution: Solution) -> float:
    """Logarithm of the evidence that something is left by a model: a smooth force, or misfit of any kind."""
    n = solution.problem.n_frames
    ratio = max(solution.chi2 / max(n - 2 * len(solution.responses) - len(solution.p), 1), 1.0)
    misfit = 0.5 * (n * (ratio - 1 - float(np.log(ratio))) - float(np.log(n)))
    return max(smooth_evidence(compress_residual(solution), 0.0), misfit, 0.0)


def form_probabilities(weights: Mapping[str, float], none: float) -> dict[str, float]:
    """Probability of every form, highest first; what is missing to 1 belongs to none of them.

    The weights are logarithms, `none` that of a cause outside of the grammar.

    Examples
    --------
    >>> {form: round(p, 2) for form, p in form_probabilities({"a": 0.0, "b": 0.0}, 0.0).items()}
    {'a': 0.33, 'b': 0.33}

    """
    total = float(logsumexp([*weights.values(), none]))
    order = sorted(weights.items(), key=lambda pair: -pair[1])
    return {form: float(np.exp(weight - total)) for form, weight in order}


def credible_forms(probabilities: Mapping[str, float]) -> list[str]:
    """The most probable forms, which hold `CREDIBLE_PROBABILITY` of all forms of the grammar together.

    Examples
    --------
    >>> credible_forms({"a": 0.5, "b": 0.3, "c": 0.01})
    ['a', 'b']

    """
    forms = sorted(probabilities, key=lambda form: -probabilities[form])
    before = np.cumsum([0.0, *(probabilities[form] for form in forms)])
    return [form for form, p in zip(forms, before, strict=False) if p < CREDIBLE_PROBABILITY * before[-1]]
