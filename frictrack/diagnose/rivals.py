"""Find the candidates that a diagnosis cannot distinguish from the best one."""

from __future__ import annotations

from collections.abc import Sequence

from frictrack.diagnose.model_selection import MAX_BIC_EQUAL, MAX_CHI2_NEAR, MIN_CHI2_SEPARATED, expected_separation
from frictrack.diagnose.refined_candidates import RefinedCandidate
from frictrack.fit.linearised import LinearisedModel
from frictrack.fit.stepwise import CandidateTrial, misfit_left_by_other
from frictrack.fit.uncertainty import dispersion


def find_rivals(best: RefinedCandidate, others: Sequence[RefinedCandidate]) -> tuple[str, ...]:
    """Find the effects that may be the cause in place of the best one.

    They explain the runs about as well (BIC within `MAX_BIC_EQUAL`), or their best fit to the predictions of `best`
    differs by less than `MIN_CHI2_SEPARATED`. An effect that needs decisively more parameters (an amplitude per run) is
    no equal explanation. Neither is one that contains the best one as a special case: it predicts the same data
    whatever these are, with more parameters. A rival need not be significant by itself: the true cause may be less
    significant than its imitation. An effect that was promising but not refined, because the budget was spent, counts
    as a rival: how much it explains is not known.

    Parameters
    ----------
    best
        The candidate.
    others
        All candidates of its round.

    Returns
    -------
    tuple of str
        Names of the rivals.

    """
    true = next((t.linear_trial for t in others if t.effect.name == best.effect.name), None)
    unit = dispersion(best.law)
    near = [t for t in others if t.effect.name != best.effect.name and not t.objection]
    near = [t for t in near if best.effect.kind not in t.effect.special_cases]
    behind = {t.effect.name: (best.delta_bic - t.delta_bic) / unit for t in near}
    near = [t for t in near if t.is_unrefined or behind[t.effect.name] < MIN_CHI2_SEPARATED]
    return tuple(
        t.effect.name for t in near if behind[t.effect.name] < MAX_BIC_EQUAL or _explains_as_much(t, best, true, unit)
    )


def _explains_as_much(
    other: RefinedCandidate, best: RefinedCandidate, true: tuple[LinearisedModel, CandidateTrial] | None, unit: float
) -> bool:
    """Whether another effect explains what the best one does, and would if that were true.

    `unit` is the dispersion in which chi-squared is counted: above one while misfit remains.
    """
    if other.is_unrefined:
        return True
    if other.solution is not None:
        near = other.law.objective - best.law.objective < MAX_CHI2_NEAR * unit
        unknown = unit > 1 or other.law.problem.budget.is_spent
        return near and (unknown or expected_separation(best.law, other.law) < MIN_CHI2_SEPARATED)
    if true is None or other.linear_trial is None or not best.law.problem.simulates:
        return False
    (law, trial), rival = true, other.linear_trial[1]
    return rival.misfit - trial.misfit < MAX_CHI2_NEAR * unit and (
        unit > 1 or misfit_left_by_other(law, trial, rival) < MIN_CHI2_SEPARATED
    )
