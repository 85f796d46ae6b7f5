"""Join the segments into which a fit divided its runs: a missing effect shows over the whole run."""

from __future__ import annotations

from frictrack.errors import FrictrackError
from frictrack.fit import Fit
from frictrack.fit.least_squares import Solution, fit_with_scatter
from frictrack.fit.parameters import MASS
from frictrack.fit.pieces import pieces_of

MAX_CHI2_PER_FRAME = 30.0  # chi-squared per frame beyond which no law can be judged along the motion


def join_segments(fit: Fit) -> Solution | None:
    """Refit a model to whole runs.

    A fit divides driven runs into segments so that it forgets unmodelled forces; a search for these must not. A long
    record that is followed through its reversals stays divided: its segments hold many of them.

    Parameters
    ----------
    fit
        The fit.

    Returns
    -------
    Solution or None
        None if no run was divided, or if the model cannot be followed that far.

    """
    old = fit.solution.problem
    if not any(fit.lengths) or MASS in old.model or any(p.turns for p in old.pieces):
        return None
    fine = max(e.fine for e in old.model.effects)
    whole = pieces_of(fit.runs, fit.reference, through_reversals=old.model.turns)
    pieces = [p.refined(fine) for own in whole for p in own]
    problem = old.rebuild(old.layout, pieces)
    try:
        solution = fit_with_scatter(problem, fit.solution.p, problem.first_starts(), fit.solution.tau or 0.03)
    except FrictrackError:
        return None
    return solution if solution.objective < MAX_CHI2_PER_FRAME * problem.n_frames else None
