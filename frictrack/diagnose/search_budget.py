"""Limit the evaluations of a search, and describe what was left out where the limit was reached."""

from __future__ import annotations

from collections.abc import Sequence

from frictrack.diagnose.refined_candidates import RefinedCandidate
from frictrack.evaluation_budget import EvaluationBudget
from frictrack.fit.least_squares import LeastSquaresProblem

# Simulations of all runs, for each effect that may be added. Whole searches of simulated studies (none to two effects,
# or a cause outside the library) took 200 in the median and at most 510.
EVALUATIONS_PER_EFFECT = 250
N_NAMED = 3  # effects that a remark names
N_RUNS_TYPICAL = 10  # more runs have more unknowns of their own (events, phases, clock rates) to be searched


def search_budget(problem: LeastSquaresProblem, max_effects: int) -> EvaluationBudget:
    """Return the budget of a search that may add some effects.

    The evaluations that a fit takes do not depend on the number of frames, only what each of them costs does.

    Parameters
    ----------
    problem
        The problem of the first model.
    max_effects
        Largest number of effects that are added.

    Returns
    -------
    EvaluationBudget

    """
    runs = len(problem.layout.run_names)
    return EvaluationBudget(EVALUATIONS_PER_EFFECT * max_effects * max(1.0, runs / N_RUNS_TYPICAL))


def describe_cut(
    budget: EvaluationBudget, unrefined: Sequence[frozenset[str]], found: Sequence[RefinedCandidate]
) -> str | None:
    """Describe what a search left out because its budget was spent, and how to go on; None if nothing.

    Parameters
    ----------
    budget
        The budget of the search.
    unrefined
        Promising sets of effects that were not simulated.
    found
        Effects found.

    Returns
    -------
    str or None

    """
    if not budget.was_cut:
        return None
    names = [" with ".join(sorted(one)) for one in unrefined]
    others = f" and {len(names) - N_NAMED} others" if len(names) > N_NAMED else ""
    missed = (
        f"{', '.join(names[:N_NAMED])}{others} could be refined, which may explain the misfit as well"
        if names
        else "every effect found was compared again with all others"
    )
    added = [t.effect.title for t in found if not t.objection] or names[:1]
    onward = f"add {' and '.join(added)} to the model and" if added else "leave out some runs and"
    return (
        f"the search stopped at its limit of {budget.granted:.0f} simulations of all runs, before {missed}; "
        f"to go on, {onward} diagnose again"
    )
