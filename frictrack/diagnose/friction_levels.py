"""What the friction levels of the runs multiply: dry friction alone, or other parts of friction too.

It is a choice among laws with equally many parameters, compared by their likelihood.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from frictrack.base.errors import result_or_none
from frictrack.diagnose.examination import Examination, examine, examine_again
from frictrack.diagnose.explanations import Explanation, Explanations
from frictrack.diagnose.model_selection import information_criterion
from frictrack.effects import Effect
from frictrack.effects.models import Model
from frictrack.fit.least_squares import Solution, fit_with_scatter
from frictrack.fit.observations import observation_of
from frictrack.fit.uncertainty import describe_level_outliers
from frictrack.search import EvaluationBudget


def or_levels_differ(
    space: Explanations,
    best: Explanation,
    examined: tuple[Examination, Examination],
    own: Sequence[Effect],
    rng: np.random.Generator,
) -> tuple[Explanation, Examination, Examination, str]:
    """Return what was found, or the first part of it that leaves nothing where the levels multiply other friction.

    Nobody knows whether what changes the dry friction of a run changes its viscous friction too, or a patch. Where a
    law assumes the wrong one, effects imitate what is left. Last comes what the levels multiply, in words.
    """
    first, last = examined
    for part in [*space.chain(best)[:-1], *([best] if last.something_is_missing else [])]:
        law = levels_of_other_parts(part.law)
        fall = information_criterion(part.law) - information_criterion(law)
        if law is part.law or part.criterion - fall >= best.criterion:
            continue
        law = observation_of(law.problem).weighted(law)
        again = examine_again(law, own, rng, first) if part.effects else examine(law, own, rng, first.level)
        if not again.something_is_missing:
            return part, first if part.effects else again, again, describe_levels(law, part.law)
    return best, *examined, ""


def levels_of_other_parts(solution: Solution) -> Solution:
    """The fit in which the friction levels multiply those parts of friction with which the law is most likely."""
    layout = solution.problem.layout
    levels = solution.p[layout.levels]
    if not solution.levels_are_random or any(describe_level_outliers(layout.run_names, levels, np.diag(0 * levels))):
        return solution
    best, left = solution, [e for e in layout.model.effects if e.may_follow_level]
    while others := [(e, law) for e in left if (law := result_or_none(_with_other_level, best, e)) is not None]:
        changed, law = min(others, key=lambda one: information_criterion(one[1]))
        if not information_criterion(law) < information_criterion(best):
            break
        best, left = law, [e for e in left if e is not changed]
    return best


def _with_other_level(solution: Solution, effect: Effect) -> Solution:
    """The fit in which one effect follows the friction levels, or does not follow them, if it did."""
    layout = solution.problem.layout
    effects = tuple(e.with_other_level() if e is effect else e for e in layout.model.effects)
    problem = solution.problem.rebuild(replace(layout, model=Model(effects))).with_budget(EvaluationBudget())
    return fit_with_scatter(problem, solution.p, solution.starts, solution.tau)


def describe_levels(law: Solution, assumed: Solution) -> str:
    """Say which parts of friction the levels multiply, against what a law assumes."""
    pairs = zip(law.problem.layout.model.effects, assumed.problem.layout.model.effects, strict=True)
    changed = [e for e, before in pairs if e.linear and e.linear[0].loaded != before.linear[0].loaded]
    more, less = ([e.title for e in changed if e.linear[0].loaded == follows] for follows in (True, False))
    says = [f"multiplies {' and '.join(more)} too"] if more else []
    says += [f"does not multiply {' and '.join(less)}"] if less else []
    return (
        f"the friction level of a run {' but '.join(says)}: so say the data; where a law assumes otherwise, effects "
        "imitate the difference"
    )
