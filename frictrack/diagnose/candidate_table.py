"""Tabulate the candidates of a finished search: evidence, held-out errors and shares of the misfit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from frictrack.diagnose.diagnosis import Candidate, Importance
from frictrack.diagnose.effect_description import describe_effect
from frictrack.diagnose.finished_search import FinishedSearch, RefinedCandidate
from frictrack.fit.least_squares import Solution, heldout_rms
from frictrack.fit.observations import observation_of

MAX_ERROR_RATIO_ADDED = 0.99  # of held-out errors, for an effect to be worth adding
MIN_SHARE_LISTED = 0.01  # of the misfit, of further effects in the table of importance
MAX_OTHERS_LISTED = 6  # further effects in the table of importance


class HeldOutErrors:
    """Held-out errors of models and, held out in the same way, of the bare model; each is computed once."""

    def __init__(self, bare: Solution) -> None:
        self._bare = bare
        self._of_bare: dict[str, float] = {}
        self._of_models: list[tuple[Solution, float, str]] = []

    def __call__(self, solution: Solution) -> tuple[float, float, str]:
        """Return the held-out errors of the bare model and of this one, and the hold-out method."""
        known = next((one for one in self._of_models if one[0] is solution), None)
        if known is None:
            known = (solution, *heldout_rms(solution))
            self._of_models.append(known)
        _, after, how = known
        if how not in self._of_bare:
            self._of_bare[how] = heldout_rms(self._bare, how)[0]
        return self._of_bare[how], after, how


def tabulate_candidates(search: FinishedSearch, heldout: HeldOutErrors) -> list[Candidate]:
    """Return all candidates with their evidence: those found first, then the others alone, best first."""
    found, problem = {t.effect.title for t in search.found}, search.start.problem
    observation = observation_of(problem)
    out = []
    for t in [*search.found, *(t for t in search.tried if t.effect.title not in found)]:
        before = after = how = None
        parameters: dict[str, Any] = {}
        if t.solution is not None:
            parameters = {
                name.split(".", 1)[1]: {"value": e.value, "std": e.std, "unit": e.unit}
                for name, e in observation.estimates_of_candidate(t.solution).parameters.items()
                if name.rsplit(".", 1)[0] == t.effect.name
            }
            if t.p < search.first.level:
                before, after, how = heldout(t.solution)
        out.append(
            Candidate(
                effect=t.effect.title,
                acts_on=t.effect.acts_on,
                parameters=parameters,
                p=t.p,
                delta_bic=float(t.delta_bic),
                heldout_before=before,
                heldout_after=after,
                heldout=how,
                indistinguishable_from=t.indistinguishable_from,
                implausible=t.objection,
                words=describe_effect(t.effect, t.solution if problem.simulates else None),
                unit=observation.unit,
                passes=t.passes and not t.objection,
            )
        )
    return out


def importance_of_effects(
    search: FinishedSearch, named: Sequence[RefinedCandidate], listed: Sequence[Candidate], heldout: HeldOutErrors
) -> list[Importance]:
    """Return the share of the misfit that each named effect, and each plausible other one that passed, explains."""
    alone = {t.effect.title: t.share for t in search.tried}
    bare = search.first.solution
    unit = observation_of(bare.problem).unit
    excess = max(bare.chi2 - bare.problem.n_frames, 1e-300)
    out: list[Importance] = []
    chi2, error, last_worth_adding = bare.chi2, None, -1
    for i, t in enumerate(named):
        before, after, _ = heldout(t.law)
        share, chi2 = float(np.clip((chi2 - t.law.chi2) / excess, -1.0, 1.0)), t.law.chi2
        if after < MAX_ERROR_RATIO_ADDED * (before if error is None else error):
            last_worth_adding = i
        error = after
        out.append(Importance(t.effect.title, alone.get(t.effect.title), share, after, unit))
    out = [replace(row, stop=i == last_worth_adding) for i, row in enumerate(out)]
    names, level = {t.effect.title for t in named}, search.first.level
    others = [c.effect for c in listed if c.p < level and c.effect not in names and not c.implausible]
    shown = [name for name in others if (alone.get(name) or 0.0) > MIN_SHARE_LISTED][:MAX_OTHERS_LISTED]
    return out + [Importance(name, alone[name], None, None, unit) for name in shown]
