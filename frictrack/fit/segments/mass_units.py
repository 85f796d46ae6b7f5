"""Guess an unknown mass from the smoothed motion, and convert pieces to units of another mass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from frictrack.fit.segments.pieces import Piece
from frictrack.records import Array


def guess_mass(pieces: Sequence[Piece]) -> float:
    """Guess the mass by least squares of the smoothed acceleration on drive, direction and speed.

    Parameters
    ----------
    pieces : sequence of Piece
        Pieces in units of any mass.

    Returns
    -------
    float
        A first mass, kg. If drive and acceleration are not positively related: the ratio of their sizes.

    """
    drive = np.concatenate([_drive(p) for p in pieces])
    friction_acceleration = np.concatenate([p.a_hat - p.known + _drive(p) / p.mass for p in pieces])
    other_regressors = np.concatenate([np.column_stack([p.path.s, p.v_hat]) for p in pieces])
    inverse = float(
        np.linalg.lstsq(np.column_stack([drive, other_regressors]), friction_acceleration, rcond=1e-10)[0][0]
    )
    if inverse > 0 and np.isfinite(inverse):
        return 1.0 / inverse
    return float(np.sqrt(np.mean(drive**2) / np.mean(friction_acceleration**2))) or 1.0


def _drive(piece: Piece) -> Array:
    return np.zeros_like(piece.known) if piece.path.drive is None else piece.path.drive


def in_mass_units(piece: Piece, mass: float) -> Piece:
    """Return the same piece with its equation of motion in units of another mass (kg)."""
    drive = _drive(piece)
    known = piece.known - drive / piece.mass + drive / mass
    return replace(piece, mass=mass, known=known)
