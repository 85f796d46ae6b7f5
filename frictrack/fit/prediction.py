"""Predict a run that was not fitted: what runs share as fitted, what is a run's own from the run itself."""

from __future__ import annotations

import numpy as np

from frictrack.effects import Effect
from frictrack.fit.cutting import Reference, cut_into_pieces, piece_frames, pieces_of
from frictrack.fit.least_squares import LeastSquaresProblem, Solution, refine
from frictrack.fit.observations import friction_pieces
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.stepwise.growth import refit_until_stop
from frictrack.records import Array, Run

TRIED_PHASES = np.array([0.0, 0.5, 1.0, 1.5]) * np.pi  # rad, start values of a per-run phase


def predict_run(solution: Solution, run: Run, reference: Reference) -> Solution:
    """Predict a validation run: shared parameters as fitted, start and per-run parameters from this run.

    Newtons are reported at the mass and load of `reference`. Raises FrictrackError if the run has no usable part.
    """
    old, model = solution.problem, solution.problem.model
    events = frozenset((e.name, 0) for e in model.effects if _is_event(e))
    layout = ParameterLayout(model, (run.name,), (old.layout.span,), events)
    if old.simulates:
        (whole,) = pieces_of([run], reference, through_reversals=model.turns)
        problem = old.rebuild(layout, cut_into_pieces(whole, piece_frames(model, whole, run)))
    else:
        problem = old.rebuild(layout, friction_pieces([run], reference.load))
    own = np.array([s.run is not None for s in layout.slots], dtype=bool)
    found = refine(problem, _start_unknowns(solution, problem), problem.first_starts(), free=own)
    return refit_until_stop(found, own) if old.simulates else found


def _is_event(effect: Effect) -> bool:
    """Whether an effect is an event of single runs; a wrong clock counts as one."""
    return effect.clock is not None or any(p.per_run and p.scan is not None for p in effect.nonlinear)


def _start_unknowns(fitted: Solution, problem: LeastSquaresProblem) -> Array:
    """Unknowns (P,) of a run: shared ones as fitted, its own at their mean, phases at the best quarter turn."""
    slots, p = problem.layout.slots, problem.layout.unknowns(fitted.problem.layout.by_address(fitted.p))
    phases = {(e.name, q.name) for e in problem.model.effects for q in e.parameters if q.role == "phase"}
    for i, s in enumerate(slots):
        if s.run is not None and (s.effect, s.parameter) in phases:
            candidates = [np.where(np.arange(len(p)) == i, phase, p) for phase in TRIED_PHASES]
            p = min(candidates, key=lambda q: _chi2(problem, q))
    return p


def _chi2(problem: LeastSquaresProblem, p: Array) -> float:
    """Chi-squared of the run, its start free."""
    return float(sum(r.r @ r.r for r in problem.evaluate(p, problem.first_starts())))
