"""What the friction levels of the runs multiply: dry friction alone, or other parts of friction too.

It is a choice among laws with equally many parameters, compared by their likelihood; see `law_with_likely_levels`.
"""

from __future__ import annotations

from frictrack.base.errors import result_or_none
from frictrack.diagnose.formula_terms import EFFECT_NAME
from frictrack.diagnose.model_selection import MAX_BIC_EQUAL, information_criterion, leaves_only_noise
from frictrack.effects import Effect
from frictrack.effects.models import Model
from frictrack.fit.least_squares import Solution, fit_with_scatter
from frictrack.fit.linearised import linearise
from frictrack.fit.stepwise import can_choose_levels, likely_levels
from frictrack.fit.uncertainty import dispersion


def law_with_likely_levels(solution: Solution) -> Solution:
    """Return the fit in which the friction levels multiply those parts of friction with which the law is most likely.

    Only where it leaves noise alone: else what is missing chooses, and each effect is tried with its likeliest levels.
    """
    if not can_choose_levels(solution.problem.layout, solution.p):
        return solution
    trial = likely_levels(linearise(solution))
    if trial.layout is solution.problem.layout:
        return solution
    problem = solution.problem.rebuild(trial.layout)
    law = result_or_none(fit_with_scatter, problem, trial.p, solution.starts, solution.tau or 0.03)
    needed = MAX_BIC_EQUAL * dispersion(solution)
    more = law is not None and information_criterion(law) < information_criterion(solution) - needed
    return law if law is not None and more and leaves_only_noise(law) else solution


def chosen_levels(model: Model, fitted: Model) -> list[str]:
    """Addresses to add, as "viscous.level", for what the levels multiply in a model against what was fitted."""
    return [f"{e.title}.level" for e in _changed(model, fitted)]


def describe_levels(model: Model, fitted: Model) -> str:
    """Say which parts of friction the levels multiply, against what was fitted; empty if they are the same."""
    changed = _changed(model, fitted)
    if not changed:
        return ""
    more, less = (" and ".join(e.title for e in changed if e.linear[0].loaded == yes) for yes in (True, False))
    says = f"multiplies {more} too" if more else f"does not multiply {less}"
    says += f" but not {less}" if more and less else ""
    return (
        f"the friction level of a run {says}, as the data show; where a law assumes otherwise, effects imitate what is "
        f"left; add {', '.join(f'{e.title}.level' for e in changed)} to have it in the law"
    )


def _changed(model: Model, fitted: Model) -> list[Effect]:
    """Effects that follow the levels otherwise than in the fitted model, or, if new, in the library."""
    chosen = {e.name: e.level_is_chosen for e in fitted.effects}
    changed = [e for e in model.effects if e.level_is_chosen != chosen.get(e.name, False) and not e.frees]
    return [e for e in changed if not e.name.startswith(EFFECT_NAME)]  # a formula says it in its own table
