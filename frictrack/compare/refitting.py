"""Refit a model whose misfit is large, so that it is linearised near the law that the runs follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import LeastSquaresProblem, Solution, displacement_response, refine
from frictrack.records import Array

MAX_REFIT_STEPS = 6
MIN_LEVEL_SCATTER = 1e-3  # relative, of the friction level from run to run


def fit_at_one_level(solution: Solution) -> Solution:
    """Fit with the same friction level in all runs; the levels stay free in the linearised model."""
    try:
        tied = refine(solution.problem, solution.p, solution.starts, tau=MIN_LEVEL_SCATTER, max_steps=MAX_REFIT_STEPS)
    except FrictrackError:  # a law so wild that its motion cannot be integrated
        return solution
    return replace(tied, tau=solution.tau)


def refit_with_forces(
    solution: Solution, bare: LeastSquaresProblem, forces: Sequence[Array], *, estimate_scatter: bool
) -> Solution:
    """Refit a model together with given forces, and add their traces to its residual again.

    Parameters
    ----------
    solution
        Where to start.
    bare
        The problem without the forces.
    forces
        Forces against the motion at the nodes of every piece, N, (3 p,) each.
    estimate_scatter
        Whether to estimate the scatter of the friction levels again; otherwise that of `solution` is kept.

    Returns
    -------
    Solution
        Linearised where the forces act; its residual is that of the model without them.

    Raises
    ------
    FrictrackError
        If the motion cannot be integrated.

    """
    pieces = [
        replace(piece, known=piece.known - force / piece.mass) for piece, force in zip(bare.pieces, forces, strict=True)
    ]
    problem = bare.rebuild(bare.layout, pieces)
    start, tau = solution, max(solution.tau, MIN_LEVEL_SCATTER)
    if estimate_scatter:
        start = refine(problem, solution.p, solution.starts, tau=MIN_LEVEL_SCATTER, max_steps=MAX_REFIT_STEPS)
        tau = max(start.level_scatter(), MIN_LEVEL_SCATTER)
    refitted = refine(problem, start.p, start.starts, tau=tau, max_steps=MAX_REFIT_STEPS)
    responses = [
        replace(r, r=r.r + displacement_response(r, force[:, None])[:, 0])
        for r, force in zip(refitted.responses, forces, strict=True)
    ]
    return replace(refitted, responses=responses)
