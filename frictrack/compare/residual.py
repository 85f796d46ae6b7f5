"""The force that a fitted law leaves, read off the displacement's residual, and the force of one of its effects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frictrack.fit.least_squares import PieceResponse, Solution
from frictrack.fit.measured_friction import MeasuredFrictionPiece
from frictrack.models import Model
from frictrack.records import Array


@dataclass(frozen=True)
class ResidualForce:
    """Friction that the model does not explain, at the frames of one piece: F and sigma_F in N, (n,)."""

    t: Array
    x: Array
    v: Array
    F: Array
    sigma_F: Array


def residual_force(response: PieceResponse, scale: float | None = None) -> ResidualForce:
    """Residual displacement of one piece turned into force: -m times its second derivative, with its noise.

    `scale` (s) is the width over which it is smoothed; None takes the one at which it stands out most. Where friction
    itself was measured it is the residual as it stands.
    """
    piece = response.piece
    if isinstance(piece, MeasuredFrictionPiece):
        x, v = piece.path.x[piece.at], piece.path.v[piece.at]
        return ResidualForce(piece.t, x, v, piece.y - response.model_y, piece.noise)
    left = piece.coloured(response.r_full)
    tried = [curvature(left, piece.noise, piece.t, s) for s in ([scale] if scale else _scales(piece.t))]
    a, sigma = max(tried, key=lambda pair: float(np.max(np.abs(pair[0]) / pair[1])))
    return ResidualForce(
        t=piece.t,
        x=response.motion.x_edge[piece.at],
        v=response.motion.v_edge[piece.at],
        F=-piece.mass * a,
        sigma_F=piece.mass * sigma,
    )


def _scales(t: Array) -> Array:
    """Widths from a few frames to a sixth of the piece, s."""
    step, length = float(np.median(np.diff(t))), float(t[-1] - t[0])
    return np.geomspace(4 * step, max(length / 6, 5 * step), 9)


def curvature(y: Array, sigma: Array, t: Array, scale: float) -> tuple[Array, Array]:
    """Second derivative of y (n,) by local quadratics under a Gaussian of width `scale` (s), and its noise.

    Local polynomial regression (Fan & Gijbels 1996, ch. 3) on evenly spaced frames; ends need no padding.
    """
    step = float(np.median(np.diff(t)))
    half = int(np.ceil(4 * scale / step))
    u = np.arange(-half, half + 1) * step / scale
    w = np.exp(-(u**2) / 2)

    def moment(series: Array, kernel: Array) -> Array:
        return np.convolve(series, kernel[::-1], mode="full")[half : half + len(series)]

    one = np.ones_like(y)
    normal = [moment(one, w * u**k) for k in range(5)]
    spread = [moment(sigma**2, w**2 * u**k) for k in range(5)]
    m = np.stack([[normal[i + j] for j in range(3)] for i in range(3)]).transpose(2, 0, 1)
    noise = np.stack([[spread[i + j] for j in range(3)] for i in range(3)]).transpose(2, 0, 1)
    right = np.stack([moment(y, w * u**k) for k in range(3)], axis=1)
    last = np.linalg.inv(m)[:, 2]
    a = 2 * np.einsum("ni,ni->n", last, right) / scale**2
    deviation = 2 * np.sqrt(np.einsum("ni,nij,nj->n", last, noise, last)) / scale**2
    return a, deviation


def effect_force(solution: Solution, response: PieceResponse, name: str) -> Array:
    """Force that one effect adds along the solved motion of one piece, N, (n,); zero for one of the picture."""
    problem, piece = solution.problem, response.piece
    values, level = problem.layout.values(solution.p, piece.run)
    at = piece.at
    without = Model(tuple(e for e in problem.model.effects if e.name != name))
    if isinstance(piece, MeasuredFrictionPiece):
        path = piece.path_at_nodes(piece.path.x, piece.path.v, level)
        return (problem.model.force(path, values) - without.force(path, values))[at]
    path = piece.at_frames(response.motion.x_edge[at], response.motion.v_edge[at], level)
    return problem.model.force(path, values) - without.force(path, values)


def nodes_force(solution: Solution, response: PieceResponse, name: str) -> Array:
    """The same at the nodes of the piece, (3 p,)."""
    problem, piece = solution.problem, response.piece
    values, level = problem.layout.values(solution.p, piece.run)
    without = Model(tuple(e for e in problem.model.effects if e.name != name))
    if isinstance(piece, MeasuredFrictionPiece):
        path = piece.path_at_nodes(piece.path.x, piece.path.v, level)
    elif problem.model.memory:
        motion = response.motion
        x, v = np.append(motion.x_edge[0], motion.x), np.append(motion.v_edge[0], motion.v)
        path = piece.since_start(x, v, np.append(piece.panels.edges[0], piece.panels.t), level)
    else:
        path = piece.path_at_nodes(response.motion.x, response.motion.v, level)
    force = problem.model.force(path, values) - without.force(path, values)
    return np.asarray(force[-len(piece.panels.t) :])
