"""Find the explanations that a diagnosis cannot distinguish from the best one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from frictrack.diagnose.explanations import Explanation
from frictrack.diagnose.model_selection import MAX_BIC_EQUAL, MAX_CHI2_NEAR, MIN_CHI2_SEPARATED, expected_separation
from frictrack.fit.stepwise import misfit_left_by_other
from frictrack.fit.uncertainty import dispersion


@dataclass(frozen=True)
class AlternativeSet:
    """A set of effects that explains as much as those named, and its BIC over theirs (with priors of sets)."""

    effects: tuple[str, ...]
    delta_bic: float

    def summary(self) -> dict[str, Any]:
        """Return the entry of the JSON of `frictrack diagnose`."""
        return {"effects": list(self.effects), "delta_bic": self.delta_bic}


def find_rivals(best: Explanation, others: Sequence[Explanation]) -> list[Explanation]:
    """Find the sets of as many effects that may be the cause in place of the best one.

    They explain the runs about as well (BIC within `MAX_BIC_EQUAL`), or their best fit to the predictions of `best`
    differs by less than `MIN_CHI2_SEPARATED`. An effect that needs decisively more parameters (an amplitude per run) is
    no equal explanation. Neither is one that contains the best one as a special case: it predicts the same data
    whatever these are, with more parameters. A rival need not be significant by itself: the true cause may be less
    significant than its imitation. A set that was promising but not refined, because the budget was spent, counts as a
    rival: how much it explains is not known.

    Parameters
    ----------
    best
        The explanation.
    others
        Explanations of the same size.

    Returns
    -------
    list of Explanation
        The rivals, best first.

    """
    unit = dispersion(best.law)
    near = [one for one in others if one.names != best.names and not one.objection and not _contains(one, best)]
    near = [one for one in near if one.is_unrefined or one.criterion - best.criterion < MIN_CHI2_SEPARATED * unit]
    return [
        one for one in near if one.criterion - best.criterion < MAX_BIC_EQUAL * unit or _would_explain(one, best, unit)
    ]


def names_in_place_of(name: str, best: Explanation, rivals: Sequence[Explanation]) -> tuple[str, ...]:
    """Effects that stand in place of one of the best set in its rivals."""
    others = [e.title for one in rivals if name not in one.names for e in one.effects if e.title not in best.names]
    return tuple(dict.fromkeys(others))


def _contains(other: Explanation, best: Explanation) -> bool:
    """Whether an effect contains one that it replaces as a special case: it fits whatever the data are."""
    replaced = {e.kind for e in best.effects if e.title not in other.names}
    return any(replaced & set(e.special_cases) for e in other.effects if e.title not in best.names)


def _would_explain(other: Explanation, best: Explanation, unit: float) -> bool:
    """Whether a set explains what the best one does, and would if that were true.

    `unit` is the dispersion in which chi-squared is counted: above one while misfit remains.
    """
    if other.is_unrefined:
        return True
    if other.solution is not None:
        near = other.law.objective - best.law.objective < MAX_CHI2_NEAR * unit
        unknown = unit > 1 or other.law.problem.budget.is_spent
        return near and (unknown or expected_separation(best.law, other.law) < MIN_CHI2_SEPARATED)
    if best.trial is None or other.trial is None or best.trial[0] is not other.trial[0]:
        return False
    (law, true), rival = best.trial, other.trial[1]
    return rival.misfit - true.misfit < MAX_CHI2_NEAR * unit and (
        unit > 1 or misfit_left_by_other(law, true, rival) < MIN_CHI2_SEPARATED
    )


def alternatives_of(best: Explanation, rivals: Sequence[Explanation]) -> list[AlternativeSet]:
    """Return the sets that stand in place of several effects; another single effect is named beside the one found."""
    if len(best.effects) < 2:
        return []
    return [
        AlternativeSet(tuple(sorted(one.names)), one.criterion - best.criterion)
        for one in rivals
        if one.solution is not None
    ]
