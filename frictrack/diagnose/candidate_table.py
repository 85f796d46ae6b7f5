"""Tabulate the candidates of a finished search: evidence, held-out errors and shares of the misfit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from frictrack.diagnose.effect_description import describe_effect
from frictrack.diagnose.finished_search import FinishedSearch
from frictrack.diagnose.refined_candidates import RefinedCandidate
from frictrack.diagnose.verdict import Candidate, Importance
from frictrack.fit.least_squares import LeastSquaresProblem, Solution, heldout_rms
from frictrack.fit.observations import observation_of

MAX_ERROR_RATIO_ADDED = 0.99  # of held-out errors, for an effect to be worth adding
MIN_SHARE_LISTED = 0.01  # of the misfit, of further effects in the table of importance
MAX_OTHERS_LISTED = 6  # further effects in the table of importance


def importance_of_effects(
    search: FinishedSearch, named: Sequence[RefinedCandidate], listed: Sequence[Candidate], heldout: HeldOutErrors
) -> list[Importance]:
    """Return the share of the misfit that each named effect, and each plausible other one that passed, explains."""
    alone = {t.effect.title: t.share for t in search.tried}
    bare = search.first.solution
    unit = observation_of(bare.problem).unit
    excess = max(bare.chi2 - bare.problem.n_frames, 1e-300)
    out: list[Importance] = []
    chi2, error = bare.chi2, None
    for t in named:
        before, heldout_error, _ = heldout(t.law)
        share, chi2 = float(np.clip((chi2 - t.law.chi2) / excess, -1.0, 1.0)), t.law.chi2
        improves = heldout_error < MAX_ERROR_RATIO_ADDED * (before if error is None else error)
        out, error = (_without_stop(out) if improves else out), heldout_error
        out.append(Importance(t.effect.title, alone.get(t.effect.title), share, heldout_error, unit, stop=improves))
    names = {t.effect.title for t in named}
    level = search.first.tests.level
    others = [c.effect for c in listed if c.p < level and c.effect not in names and not c.implausible]
    shown = [name for name in others if (alone.get(name) or 0.0) > MIN_SHARE_LISTED][:MAX_OTHERS_LISTED]
    return out + [Importance(name, alone[name], None, None, unit) for name in shown]


def _without_stop(rows: Sequence[Importance]) -> list[Importance]:
    """Return the same rows with `stop` cleared: the last effect worth adding is marked once."""
    return [replace(row, stop=False) for row in rows]


def tabulate_candidates(search: FinishedSearch, heldout: HeldOutErrors) -> list[Candidate]:
    """Return all candidates with their evidence: those found first, then the others alone, best first."""
    level = search.first.tests.level
    found, out = {t.effect.title for t in search.found}, []
    for t in [*search.found, *(t for t in search.tried if t.effect.title not in found)]:
        listed = _candidate(t, heldout if t.p < level else None, search.first.solution.problem)
        out.append(replace(listed, passes=t.passes and not t.objection))
    return out


class HeldOutErrors:
    """Held-out errors of models and of the bare model; the latter is computed once per hold-out method."""

    def __init__(self, bare: Solution) -> None:
        self._bare = bare
        self._bare_errors: dict[str, float] = {}

    def __call__(self, solution: Solution) -> tuple[float, float, str]:
        """Return the held-out errors of the bare model and of this one, and the hold-out method."""
        after, how = heldout_rms(solution)
        if how not in self._bare_errors:
            self._bare_errors[how] = heldout_rms(self._bare, how)[0]
        return self._bare_errors[how], after, how


def _candidate(tried: RefinedCandidate, heldout: HeldOutErrors | None, problem: LeastSquaresProblem) -> Candidate:
    """Convert a refined candidate to its entry in the diagnosis."""
    effect, solution, observation = tried.effect, tried.solution, observation_of(problem)
    before = after = how = None
    parameters: dict[str, Any] = {}
    if solution is not None:
        if heldout is not None:
            before, after, how = heldout(solution)
        parameters = {
            name.split(".", 1)[1]: {"value": e.value, "std": e.std, "unit": e.unit}
            for name, e in observation.estimates_of_candidate(solution).parameters.items()
            if name.rsplit(".", 1)[0] == effect.name
        }
    return Candidate(
        effect=effect.title,
        acts_on=effect.acts_on,
        parameters=parameters,
        p=tried.p,
        delta_bic=float(tried.delta_bic),
        heldout_before=before,
        heldout_after=after,
        heldout=how,
        indistinguishable_from=tried.indistinguishable_from,
        implausible=tried.objection,
        words=describe_effect(effect, solution if problem.simulates else None),
        unit=observation.unit,
    )
