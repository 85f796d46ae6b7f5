"""Compare the effects found with formulas, which may describe the cause better than any effect of the library.

Formulas are fitted where a smooth force over one variable is about as likely as the effects found, or where effects
with parameters of their own in every run, which imitate much, were found though the misfit repeats over one axis. Both
are compared by their evidence. Every form has a smaller prior probability than an effect of the library, because there
are more of them and a cause outside of the library is rarer. Of sets of effects there are even more, and several causes
at once are rarer, too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.special import expit, logsumexp

from frictrack.axes import AXES
from frictrack.diagnose.admissible import is_special_case
from frictrack.diagnose.formulas import AXIS_SYMBOLS, SHAPES, Shape, formula_axes
from frictrack.diagnose.model_selection import MAX_BIC_EQUAL, information_criterion, log_prior_of_set
from frictrack.diagnose.repeatability import Repeatability
from frictrack.diagnose.smooth_forces import ResidualForces, candidate_axes, smooth_forces
from frictrack.diagnose.unexplained import UnexplainedForce, unexplained_force
from frictrack.fit.least_squares import Solution
from frictrack.number_format import format_probability
from frictrack.records import Array

PRIOR_NONE = 0.1  # prior probability of a cause outside of the library
MAX_PROBABILITY_UNLIKELY, MIN_PROBABILITY_DECISIVE = 0.05, 0.95


def compare_with_formulas(
    forces: ResidualForces,
    found: Solution,
    repeats: Callable[[], Repeatability],
    functions: Sequence[Shape] = (),
) -> UnexplainedForce | None:
    """Find formulas of one variable that explain as much as the effects found.

    Parameters
    ----------
    forces
        Smooth forces in the residual of the model before the search.
    found
        The model with the effects found.
    repeats
        Computes whether the misfit repeats, and over which axis; called only where that matters.
    functions
        Further shapes of formulas.

    Returns
    -------
    UnexplainedForce or None
        Its summary has besides `probability` that one of the formulas is the cause and the effects are not,
        `decisive` if that is at least `MIN_PROBABILITY_DECISIVE`, `rival` in words if it is neither that nor
        unlikely, and `words`. None if no formula explains as much.

    """
    start = forces.solution
    evidence = information_criterion(start) - information_criterion(found)
    count = max(len(found.problem.model.names) - len(start.problem.model.names), 1)
    prior = _log_prior_odds(len(candidate_axes(forces.compressed)), count)
    margin = MAX_BIC_EQUAL + 2 * max(prior, 0.0)  # with less evidence, a formula is unlikely
    if not _is_worth_searching(forces, found, repeats, evidence - margin):
        return None
    unexplained = unexplained_force(start, forces=forces, functions=functions)
    special = [one for one in unexplained.formulas.fitted if is_special_case(one.solution, found)]
    evidence = max([evidence, *(one.delta_bic for one in special)])  # of the effect, if it is one of them
    formulas = unexplained.formulas.without(special)
    listed = formulas.entries
    if not listed:
        return None
    first, advantages = listed[0], np.array([entry["delta_bic"] - evidence for entry in listed])
    if advantages.max() < -margin:
        return None
    probability = _probability(advantages, np.array([entry["probability"] for entry in listed]), prior)
    decisive = probability > MIN_PROBABILITY_DECISIVE
    rival = f"a formula of {' and '.join(AXES[name].name for name in first['variables'])}"
    is_rival = MAX_PROBABILITY_UNLIKELY < probability <= MIN_PROBABILITY_DECISIVE
    compared = {"probability": probability, "decisive": decisive, "rival": rival if is_rival else None}
    added = len(found.problem.layout.slots) - len(start.problem.layout.slots)
    compared |= {"words": _words(first, added, compared)}
    return UnexplainedForce(unexplained.summary | compared | {"formulas": listed}, formulas)


def _is_worth_searching(
    forces: ResidualForces, found: Solution, repeats: Callable[[], Repeatability], evidence: float
) -> bool:
    """Whether a smooth force of any variable of the formulas explains more, or effects may imitate one."""
    own = {s.effect for s in found.problem.layout.slots if s.run is not None}
    start = forces.solution.problem
    several = len({p.run for p in start.pieces}) > 1
    may_imitate = several and any(name in own for name in found.problem.model.names if name not in start.model)
    best_axis = repeats().best if may_imitate else None
    if best_axis is not None and best_axis.axis in AXIS_SYMBOLS:
        return True
    return smooth_forces(forces.compressed, formula_axes(forces.compressed))[0].gain > evidence


def _probability(advantages: Array, shares: Array, prior: float) -> float:
    """Probability that one of the forms is the cause and not the effects found.

    `advantages` (n,) are the BIC of the listed forms over that of the effects, `shares` (n,) the probabilities of these
    forms among all, and `prior` the logarithm of the prior odds of one form.
    """
    return float(expit(logsumexp(advantages / 2) - np.log(shares.sum()) + prior))


def _log_prior_odds(axes: int, count: int) -> float:
    """Logarithm of the prior probability of one form over that of a set of `count` effects; all of a kind are alike."""
    forms = len(SHAPES) * len(AXIS_SYMBOLS) * max(axes, 1)
    return float(np.log(PRIOR_NONE / forms) - np.log(1 - PRIOR_NONE) - log_prior_of_set(count))


def _words(first: Mapping[str, Any], added: int, compared: Mapping[str, Any]) -> str:
    much, than = ("more", "than") if compared["decisive"] else ("as much", "as")
    count = "one parameter" if first["unknowns"] == 1 else f"{first['unknowns']} parameters"
    variables = " and ".join(AXES[name].name for name in first["variables"])
    chance = format_probability(compared["probability"])
    instead = "" if compared["decisive"] else f"; the probability that it is the cause instead is {chance}"
    return (
        f"a force that depends only on {variables} explains {much} with {count}, common to all runs, "
        f"{than} the effects found with {added}: {first['formula']}{instead}"
    )
