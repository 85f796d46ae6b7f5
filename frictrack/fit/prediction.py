"""Predict a run that was not fitted: only its start and its per-run parameters are free.

A per-run phase is tried all around the circle. Other per-run parameters start at their mean over the fitted runs. An
event at an individual time (a collision, a dropped frame) cannot be predicted: it is absent.
"""

from __future__ import annotations

import numpy as np

from frictrack.effects import Effect
from frictrack.fit.displacement import refit_until_stop
from frictrack.fit.least_squares import LeastSquaresProblem, Solution, refine
from frictrack.fit.observations import friction_pieces
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.segments import Piece, Reference, cut_into_segments, sections_of, segment_frames
from frictrack.records import Array, Mask, Run

TRIED_PHASES = np.array([0.0, 0.5, 1.0, 1.5]) * np.pi  # rad, start values of a per-run phase


def predict_run(solution: Solution, run: Run, reference: Reference) -> Solution:
    """Predict a validation run with the fitted model.

    Parameters
    ----------
    solution : Solution
        The fit.
    run : Run
        The validation run.
    reference : Reference
        Mass and load at which newtons are reported.

    Returns
    -------
    Solution
        Shared parameters as fitted; start and per-run parameters from this run.

    Raises
    ------
    FrictrackError
        If the run has no usable stretch.

    """
    old = solution.problem
    events = frozenset((e.name, 0) for e in old.model.effects if _is_event(e))
    layout = ParameterLayout(old.model, (run.name,), (old.layout.span,), events)
    p = _start_unknowns(solution, layout)
    free = np.array([s.run is not None for s in layout.slots], dtype=bool)
    pieces = _pieces(solution, run, reference) if old.simulates else friction_pieces([run], reference.load)
    problem = old.rebuild(layout, pieces)
    return refit_until_stop(refine(problem, _with_best_phases(problem, p), problem.first_starts(), free=free), free)


def _is_event(effect: Effect) -> bool:
    """Whether an effect is an event of single runs; a wrong clock counts as one."""
    return effect.clock is not None or any(p.per_run and p.scan is not None for p in effect.nonlinear)


def _pieces(solution: Solution, run: Run, reference: Reference) -> list[Piece]:
    model = solution.problem.model
    (sections,) = sections_of([run], reference, through_reversals=model.turns)
    fine = max(e.fine for e in model.effects)
    return [piece.refined(fine) for piece in cut_into_segments(sections, segment_frames(model, sections, run))]


def _start_unknowns(solution: Solution, layout: ParameterLayout) -> Array:
    """Unknowns (P,) of the run: shared ones as fitted, its own at their mean over the fitted runs."""
    values: dict[tuple[str, str], list[float]] = {}
    for slot, value in zip(solution.problem.layout.slots, solution.p, strict=True):
        values.setdefault((slot.effect, slot.parameter), []).append(float(value))
    return np.array([np.mean(values[s.effect, s.parameter]) for s in layout.slots])


def _with_best_phases(problem: LeastSquaresProblem, p: Array) -> Array:
    """Unknowns (P,) with every per-run phase at the quarter turn that fits the run best."""
    for i in np.flatnonzero(_phases(problem.layout)):
        candidates = [np.where(np.arange(len(p)) == i, phase, p) for phase in TRIED_PHASES]
        p = candidates[int(np.argmin([_misfit(problem, q) for q in candidates]))]
    return p


def _phases(layout: ParameterLayout) -> Mask:
    """Which unknowns are per-run phases, (P,)."""
    roles = {(e.name, p.name): p.role for e in layout.model.effects for p in e.parameters}
    own = [s.run is not None and roles.get((s.effect, s.parameter)) == "phase" for s in layout.slots]
    return np.array(own, dtype=bool)


def _misfit(problem: LeastSquaresProblem, p: Array) -> float:
    """Chi-squared of the run, its start free."""
    return float(sum(r.r @ r.r for r in problem.evaluate(p, problem.first_starts())))
