"""Linearise a model about the measured motion, where its own motion differs from it.

A model that lacks a strong effect moves differently than the mass did. There a texture has another phase, and an
effect is no longer linear. The measured motion is the model's motion plus its smoothed residual. If nothing is
missing, it is the model's own motion, also near stops. One Newton step from it gives the model's motion to second
order in the smoothed residual.

Level times coefficient is not linear. The sensitivities are those at levels of one, where a deviation of the level is
the relative deviation of the force, whatever the coefficient. Levels far from one, because an effect is missing, then
do no harm.

References
----------
Eilers, P. H. C. (2003). A perfect smoother. Analytical Chemistry 75, 3631-3636.

"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import solveh_banded

from frictrack.fit.least_squares import LeastSquaresProblem, PieceResponse, Solution
from frictrack.fit.pieces import Piece
from frictrack.records import Array
from frictrack.simulate.dynamics import CollocationSolution, linearise_acceleration

# smoothing parameters; bandwidths from a tenth of the frame rate downwards
SMOOTHING_STRENGTHS = np.geomspace(10.0, 1e9, 17)


def linearise_about_measurement(solution: Solution) -> Solution:
    """Return the solution linearised about the measured motion.

    With memory, or with measured friction, it stays linearised about its own motion.

    Parameters
    ----------
    solution : Solution
        The fit.

    Returns
    -------
    Solution
        The same unknowns; residuals and sensitivities about the measured motion.

    """
    problem = solution.problem
    if not is_linearised_about_measurement(problem):
        return solution
    return replace(
        solution, responses=[_response_about_measurement(problem, solution.p, r) for r in solution.responses]
    )


def is_linearised_about_measurement(problem: LeastSquaresProblem) -> bool:
    """Return whether solutions of a problem are linearised about the measured motion, at levels of one."""
    return problem.simulates and not problem.model.memory


def _response_about_measurement(problem: LeastSquaresProblem, p: Array, response: PieceResponse) -> PieceResponse:
    """Response of one piece, linearised about its measured motion."""
    piece, motion, linear = response.piece, response.motion, response.linear
    unit_levels = np.array(p)
    unit_levels[problem.layout.levels] = 1.0
    t, smoothed = smooth_residual(piece, piece.coloured(response.r_full))
    if not smoothed.any():
        return problem.linearised_response(piece, unit_levels, (motion, linear), motion.x_edge[piece.at])
    correction = CubicSpline(t, smoothed)
    nodes, edges = piece.panels.t, piece.panels.edges
    x, v = motion.x + correction(nodes), motion.v + correction(nodes, 1)
    own, linear = linearise_acceleration(problem.acceleration(piece, p), piece.panels, (x, v))
    acceleration = motion.a + correction(nodes, 2)
    about = CollocationSolution(
        piece.panels, x, v, acceleration, motion.x_edge + correction(edges), motion.v_edge + correction(edges, 1)
    )
    start_correction = np.array([[-float(correction(edges[0]))], [-float(correction(edges[0], 1))]])
    _, moved = linear.respond((own - acceleration)[:, None], start_correction)
    return problem.linearised_response(
        piece, unit_levels, (about, linear), about.x_edge[piece.at] + moved[piece.at, 0, 0]
    )


def smooth_residual(piece: Piece, residual: Array) -> tuple[Array, Array]:
    """Smooth a residual with the strength that minimises generalised cross-validation.

    Parameters
    ----------
    piece : Piece
        The piece.
    residual : array of shape (n,)
        Residual at its frames, m.

    Returns
    -------
    t : array of shape (m,)
        Times of all frames, missing ones included, s.
    smoothed : array of shape (m,)
        Smoothed residual, m.

    """
    rows = piece.at // piece.per_frame
    n = int(rows[-1]) + 1
    weight, data = np.zeros(n), np.zeros(n)
    weight[rows], data[rows] = 1.0, residual
    correction = np.array(
        [np.r_[0.0, 0.0, np.ones(n - 2)], np.r_[0.0, -2.0, np.full(n - 3, -4.0), -2.0], _second_difference_diagonal(n)]
    )
    eigenvalues = (2 - 2 * np.cos(np.pi * np.arange(n) / n)) ** 2
    best, out = np.inf, np.zeros(n)
    for strength in SMOOTHING_STRENGTHS[::-1]:
        banded = strength * correction
        banded[2] += weight
        found = solveh_banded(banded, data, check_finite=False)
        degrees_of_freedom = float(np.sum(1 / (1 + strength * eigenvalues))) * len(rows) / n
        score = float(np.sum((residual - found[rows]) ** 2)) / (len(rows) - degrees_of_freedom) ** 2
        if score < best:
            best, out = score, found
    return piece.panels.edges[:: piece.per_frame], out


def _second_difference_diagonal(n: int) -> Array:
    """Diagonal of the squared second differences of n samples."""
    out = np.full(n, 6.0)
    out[[0, -1]], out[[1, -2]] = 1.0, 5.0
    return out
