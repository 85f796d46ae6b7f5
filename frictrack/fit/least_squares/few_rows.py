"""Compress the whitened rows of every piece to the few that its own columns span: block angular least squares.

Most unknowns of many runs (starts, levels) belong to single runs, and a piece of n frames spans only as many directions
as it has active unknowns. An orthonormal rotation of its frames leaves that many rows different from zero. Normal
matrix, singular values and right singular vectors stay the same; the left ones are rotated back.

References
----------
Bjorck, A. (1996). Numerical Methods for Least Squares Problems, section 6.3. SIAM.
Golub, G. H. & Van Loan, C. F. (2013). Matrix Computations, section 5.2. Johns Hopkins.

"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frictrack.fit.least_squares.problem import PieceResponse
from frictrack.records import Array


@dataclass(frozen=True)
class RotatedJacobian:
    """The Jacobian (N, P) of all pieces as a rotation of few rows.

    Attributes
    ----------
    rows : array of shape (M, P)
        The rows that differ from zero after the rotation.
    frames : list of array of shape (n, m)
        Orthonormal columns of every piece: its frames per unit of its own rows.

    """

    rows: Array
    frames: list[Array]

    def expanded(self, few: Array) -> Array:
        """Rotate columns (M, k) back to the frames of all pieces, (N, k)."""
        ends = np.cumsum([0, *(q.shape[1] for q in self.frames)])
        return np.concatenate([q @ few[a:b] for q, (a, b) in zip(self.frames, itertools.pairwise(ends), strict=True)])


def stacked_jacobian(responses: Sequence[PieceResponse], n_unknowns: int) -> Array:
    """Stack the Jacobians of all pieces, (N, n_unknowns)."""
    return np.concatenate([_spread(r.jac, r.active, n_unknowns) for r in responses])


def rotated_jacobian(responses: Sequence[PieceResponse], n_unknowns: int) -> RotatedJacobian:
    """Rotate the Jacobian of every piece to triangular form."""
    factors = [np.linalg.qr(r.jac) for r in responses]
    blocks = [_spread(upper, r.active, n_unknowns) for (_, upper), r in zip(factors, responses, strict=True)]
    return RotatedJacobian(np.vstack(blocks), [q for q, _ in factors])


def triangular(responses: Sequence[PieceResponse], n_unknowns: int) -> tuple[Array, Array]:
    """The same least-squares problem in few rows: R factors of (Jacobian, residual) of every piece.

    Parameters
    ----------
    responses : sequence of PieceResponse
        The pieces.
    n_unknowns : int
        Number of unknowns P.

    Returns
    -------
    rows : array of shape (M, P)
        Jacobian.
    right : array of shape (M,)
        Residual.

    """
    rows, right = [], []
    for r in responses:
        upper = np.asarray(np.linalg.qr(np.column_stack([r.jac, r.r]), mode="r"))
        rows.append(_spread(upper[:, :-1], r.active, n_unknowns))
        right.append(upper[:, -1])
    return np.vstack(rows), np.concatenate(right)


def _spread(rows: Array, active: Sequence[int], n_unknowns: int) -> Array:
    """Rows (m, A) with the columns of all unknowns, (m, P)."""
    out = np.zeros((len(rows), n_unknowns))
    out[:, active] = rows
    return out
