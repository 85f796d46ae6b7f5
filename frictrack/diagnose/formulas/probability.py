"""Estimate the probability that a formula has the right form.

Posterior weights of forms follow from BIC (Schwarz 1978; Kass & Raftery 1995) and a prior that halves with every
unknown and is shared by all forms of the same size. "None of these" competes with them: its weight rises with what a
smooth force still explains beside the best formula, or explains better in its place, and with misfit that is left.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np
from scipy.special import logsumexp

from frictrack.diagnose.compressed import compress_residual
from frictrack.diagnose.formulas.terms import FittedFormula, Term
from frictrack.diagnose.smooth_forces import LENGTH_RATIOS, smooth_forces
from frictrack.fit.least_squares import Solution

PRIOR_NONE = 0.1  # prior odds of a cause outside of the grammar
LOG_PRIOR_PER_UNKNOWN = float(np.log(0.5))


def family_probabilities(
    formulas: Sequence[FittedFormula], tried: Iterable[Term], unfitted: Sequence[tuple[Term, float]], bare_gain: float
) -> list[float]:
    """Probability that each formula has the right form.

    Parameters
    ----------
    formulas
        Fitted formulas, best first.
    tried
        All forms of the scan, by which the prior is shared.
    unfitted
        Terms that were not fitted in full, with the fall of BIC that is expected of them.
    bare_gain
        Gain of the best smooth force in place of a formula.

    Returns
    -------
    list of float
        One per formula; what is missing to 1 belongs to other forms and to none of them.

    """
    counts = Counter(t.size for t in tried)

    def log_prior(terms: Sequence[Term]) -> float:
        return sum(LOG_PRIOR_PER_UNKNOWN * t.size - float(np.log(max(counts[t.size], 1))) for t in terms)

    best = max(formulas, key=lambda f: f.delta_bic)
    unit = max(best.solution.chi2 / max(best.solution.problem.n_frames - len(best.solution.p), 1), 1.0)
    listed = [f.delta_bic / (2 * unit) + log_prior(f.terms) for f in formulas]
    others = [bic / (2 * unit) + log_prior([term]) for term, bic in unfitted]
    alone = bare_gain - best.delta_bic
    evidence = max(0.0, alone, remaining_evidence(best.solution)) / 2
    none = float(logsumexp([*listed, *others])) + float(np.log(PRIOR_NONE)) + evidence
    total = float(logsumexp([*listed, *others, none]))
    return [float(np.exp(one - total)) for one in listed]


def remaining_evidence(solution: Solution) -> float:
    """Evidence, as a fall of BIC, that something is left beside a model: a smooth force, or misfit of any kind."""
    smooth = smooth_forces(compress_residual(solution))
    force = smooth[0].gain - 2 * float(np.log(len(smooth) * len(LENGTH_RATIOS)))
    n = solution.problem.n_frames
    ratio = max(solution.chi2 / max(n - 2 * len(solution.responses) - len(solution.p), 1), 1.0)
    return max(force, n * (ratio - 1 - float(np.log(ratio))) - float(np.log(n)))
