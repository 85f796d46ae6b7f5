"""Describe a local force: a Gaussian bump at one time of one run, or at one place of the course."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frictrack.fit.least_squares import PieceResponse, Solution
from frictrack.fit.observations import MeasuredFrictionPiece
from frictrack.records import Array


@dataclass(frozen=True)
class Bump:
    """A Gaussian force in time or in place.

    Parameters
    ----------
    piece
        Index of its piece for a bump in time; None for a bump at a place, common to all runs.
    centre, width
        Centre and standard deviation: s since release, or m.
    size
        Peak force, N; for a place at the reference load.
    z
        Size in units of its standard deviation.

    """

    piece: int | None
    centre: float
    width: float
    size: float = 0.0  # N, at the reference load for a place
    z: float = 0.0

    @property
    def at_place(self) -> bool:
        """Whether it is a bump at a place of the course."""
        return self.piece is None

    def shape(self, axis: Array) -> Array:
        """Its shape along an axis (n,), one at the centre."""
        return np.exp(-(((axis - self.centre) / self.width) ** 2) / 2)


@dataclass(frozen=True)
class NodeMotion:
    """Motion of one piece at its integration nodes, all (3 p,).

    Parameters
    ----------
    t, x, v
        Time since release s, position m, velocity m/s.
    dry_factor
        Force of a dry friction of 1 N at the reference load: load ratio times direction of motion.

    """

    t: Array
    x: Array
    v: Array
    dry_factor: Array

    def axis(self, bump: Bump) -> Array:
        """Times or positions, whichever the bump depends on."""
        return self.x if bump.at_place else self.t

    def force(self, bump: Bump) -> Array:
        """Force of a bump of size one, (3 p,)."""
        return bump.shape(self.axis(bump)) * (self.dry_factor if bump.at_place else 1.0)

    def force_derivatives(self, bump: Bump) -> Array:
        """Force of a bump of size one, with its derivatives by centre and by log width, (3 p, 3)."""
        u = (self.axis(bump) - bump.centre) / bump.width
        f = self.force(bump)
        return np.stack([f, f * u / bump.width, f * u**2], axis=1)


def motion_at_nodes(solution: Solution, response: PieceResponse) -> NodeMotion:
    """Motion of one piece at its integration nodes.

    Parameters
    ----------
    solution
        A fit.
    response
        One of its pieces.

    Returns
    -------
    NodeMotion
        The motion as the fit solved it; for measured friction the measured motion.

    """
    piece = response.piece
    _, level = solution.problem.layout.values(solution.p, piece.run)
    x, v = (
        (piece.path.x, piece.path.v)
        if isinstance(piece, MeasuredFrictionPiece)
        else (response.motion.x, response.motion.v)
    )
    path = piece.path_at_nodes(x, v, level)
    return NodeMotion(piece.panels.t, path.x, path.v, path.load * path.s)
