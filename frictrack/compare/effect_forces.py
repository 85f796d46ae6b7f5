"""Compute the force of one effect along the fitted motion."""

from __future__ import annotations

import numpy as np

from frictrack.fit.least_squares import PieceResponse, Solution
from frictrack.fit.observations import MeasuredFrictionPiece
from frictrack.records import Array


def effect_force(solution: Solution, response: PieceResponse, name: str) -> Array:
    """Force of one effect along the solved motion of a piece, at the frames.

    Parameters
    ----------
    solution
        A fit whose model contains the effect.
    response
        One of its pieces.
    name
        Name of the effect.

    Returns
    -------
    ndarray, shape (n,)
        Force, N; for a measurement effect the picture shift, m.

    """
    problem, piece = solution.problem, response.piece
    values, level = problem.layout.values(solution.p, piece.run)
    at = piece.at
    if isinstance(piece, MeasuredFrictionPiece):
        path = piece.path_at_nodes(piece.path.x, piece.path.v, level)
        return problem.model.effect_contribution(name, path, values)[at]
    path = piece.at_frames(response.motion.x_edge[at], response.motion.v_edge[at], level)
    return problem.model.effect_contribution(name, path, values)


def effect_force_at_nodes(solution: Solution, response: PieceResponse, name: str) -> Array:
    """Force of one effect at the integration nodes of a piece, N, (3 p,)."""
    problem, piece = solution.problem, response.piece
    values, level = problem.layout.values(solution.p, piece.run)
    if isinstance(piece, MeasuredFrictionPiece):
        path = piece.path_at_nodes(piece.path.x, piece.path.v, level)
    elif problem.model.memory:
        motion = response.motion
        x, v = np.append(motion.x_edge[0], motion.x), np.append(motion.v_edge[0], motion.v)
        path = piece.path_since_start(x, v, np.append(piece.panels.edges[0], piece.panels.t), level)
    else:
        path = piece.path_at_nodes(response.motion.x, response.motion.v, level)
    return problem.model.effect_contribution(name, path, values)[-len(piece.panels.t) :]
