"""Build the dictionary of local forces: Gaussian bumps at all times of each run and all places of the course."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from frictrack.compare.global_significance import GlobalSignificance, curve_length
from frictrack.fit.least_squares import (
    ModelProjection,
    PieceResponse,
    Solution,
    displacement_response,
    position_and_velocity,
)
from frictrack.fit.measured_friction import MeasuredFrictionPiece
from frictrack.motion.noise import CORRELATION_COST
from frictrack.records import Array

MIN_WIDTH_FRAMES = 2.0  # frames; a narrower bump leaves the same trace
MAX_WIDTH_DURATION_SHARE = 1 / 12  # of a piece's duration; a wider bump is no local force
MIN_WIDTH_COURSE_SHARE, MAX_WIDTH_COURSE_SHARE = 1 / 120, 1 / 8  # of the course, for bumps in place
WIDTH_RATIO = 2.5  # between two widths of the search
MAX_CENTRES = 250  # along a piece or along the course
MIN_SPACING_FRAMES = 4.0  # frames between two centres; a displacement has no sharper bend
MIN_VISIBLE_SHARE = 1e-3  # of a trace's square that must remain beside the model


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


@dataclass(frozen=True)
class BumpDictionary:
    """All bumps of a search and their traces in the displacement.

    Parameters
    ----------
    time_columns
        Traces of the bumps in time, (n_i, k_i) for piece i.
    time_bumps
        Those bumps.
    place_columns
        Traces of the bumps in place in every piece, (n_i, k).
    place_bumps
        Those bumps.

    """

    time_columns: list[Array]
    time_bumps: list[list[Bump]]
    place_columns: list[Array]
    place_bumps: list[Bump]

    @cached_property
    def time_squares(self) -> list[Array]:
        """Squared norms of the traces in time, (k_i,) per piece."""
        return [np.einsum("nk,nk->k", c, c) for c in self.time_columns]

    @cached_property
    def place_squares(self) -> Array:
        """Squared norms of the traces in place over all pieces, (k,)."""
        return np.asarray(np.sum([np.einsum("nk,nk->k", c, c) for c in self.place_columns], axis=0))


def build_dictionary(law: ModelProjection, at: Sequence[NodeMotion]) -> BumpDictionary:
    """Build all bumps of the search with their traces.

    Parameters
    ----------
    law
        Residual and directions of the model.
    at
        Motion of every piece at its nodes.

    Returns
    -------
    BumpDictionary

    """
    time_bumps = [_bumps_in_time(i, r) for i, r in enumerate(law.responses)]
    place_bumps = _bumps_in_place(law.responses)
    time_columns = [
        displacement_response(r, np.stack([n.force(b) for b in bumps], axis=1))
        for r, n, bumps in zip(law.responses, at, time_bumps, strict=True)
    ]
    place_columns = [
        displacement_response(r, np.stack([n.force(b) for b in place_bumps], axis=1))
        for r, n in zip(law.responses, at, strict=True)
    ]
    return BumpDictionary(time_columns, time_bumps, place_columns, place_bumps)


def _widths(shortest: float, widest: float) -> Array:
    count = max(1, 1 + int(np.floor(np.log(max(widest / shortest, 1.0)) / np.log(WIDTH_RATIO))))
    return np.asarray(shortest * WIDTH_RATIO ** np.arange(count), dtype=np.float64)


def _bumps_in_time(i: int, response: PieceResponse) -> list[Bump]:
    """Bumps at all times of piece `i`, at several widths."""
    t = response.piece.t
    step, length = float(np.median(np.diff(t))), float(t[-1] - t[0])
    out = []
    for width in _widths(MIN_WIDTH_FRAMES * step, MAX_WIDTH_DURATION_SHARE * length):
        apart = max(width, MIN_SPACING_FRAMES * step, length / MAX_CENTRES)
        inside = t[0] + MIN_SPACING_FRAMES * step, t[-1] - MIN_SPACING_FRAMES * step
        out += [Bump(i, float(c), float(width)) for c in np.arange(*inside, apart)]
    return out or [Bump(i, float(t[0] + t[-1]) / 2, MIN_WIDTH_FRAMES * step)]  # a piece of a few frames


def _bumps_in_place(responses: Sequence[PieceResponse]) -> list[Bump]:
    """Bumps at all places of the course, at several widths."""
    low, high = course_ends(responses)
    out = []
    for width in _widths(MIN_WIDTH_COURSE_SHARE * (high - low), MAX_WIDTH_COURSE_SHARE * (high - low)):
        apart = max(width, (high - low) / MAX_CENTRES)
        out += [Bump(None, float(c), float(width)) for c in np.arange(low, high, apart)]
    return out


def course_ends(responses: Sequence[PieceResponse]) -> tuple[float, float]:
    """Extent of the course.

    Parameters
    ----------
    responses
        Pieces of all runs.

    Returns
    -------
    tuple of float
        Smallest and largest position, m.

    """
    ends = [(float(x.min()), float(x.max())) for x, _ in map(position_and_velocity, responses)]
    return min(low for low, _ in ends), max(high for _, high in ends)


def width_limits(responses: Sequence[PieceResponse], bump: Bump) -> tuple[float, float]:
    """Smallest and largest width to which a bump may be refined."""
    if bump.piece is None:
        low, high = course_ends(responses)
        return MIN_WIDTH_COURSE_SHARE * (high - low), MAX_WIDTH_COURSE_SHARE * (high - low)
    t = responses[bump.piece].piece.t
    return MIN_WIDTH_FRAMES * float(np.median(np.diff(t))), 2 * MAX_WIDTH_DURATION_SHARE * float(t[-1] - t[0])


def column_norms(law: ModelProjection, dictionary: BumpDictionary) -> tuple[list[Array], Array]:
    """Norms of all traces after projection off the model.

    Parameters
    ----------
    law
        Residual and directions of the model.
    dictionary
        The bumps.

    Returns
    -------
    time_norms : list of ndarray
        Norms (k_i,) of the bumps in time of every piece; 0 where the model absorbs nearly all of a trace.
    place_norms : ndarray, shape (k,)
        The same of the bumps in place.

    """
    time_norms = [
        _norm(full, law.u[rows].T @ c)
        for rows, c, full in zip(law.rows, dictionary.time_columns, dictionary.time_squares, strict=True)
    ]
    on_place = np.sum([law.u[rows].T @ c for rows, c in zip(law.rows, dictionary.place_columns, strict=True)], axis=0)
    return time_norms, _norm(dictionary.place_squares, on_place)


def _norm(squares: Array, on_law: Array) -> Array:
    """Norms (k,) of columns with these squares after removing their components (P', k) on the model."""
    left = squares - np.sum(on_law**2, axis=0)
    return np.where(left > MIN_VISIBLE_SHARE * squares, np.sqrt(np.maximum(left, 0)), 0.0)


def search_significance(
    law: ModelProjection, dictionary: BumpDictionary
) -> tuple[GlobalSignificance, list[GlobalSignificance]]:
    """Global significance of the whole search, and of the search in each piece alone."""
    time_norms, place_norms = column_norms(law, dictionary)
    frames = float(np.mean([len(r.r) for r in law.responses]))
    dof = max(frames / CORRELATION_COST, 3.0)
    own = []
    for i, rows in enumerate(law.rows):
        on = law.u[rows].T @ dictionary.time_columns[i]
        parts = [(dictionary.time_columns[i], 1.0), (on, -1.0)]
        own.append(_combine_significance(parts, time_norms[i], dictionary.time_bumps[i], dof))
    on = np.sum([law.u[rows].T @ c for rows, c in zip(law.rows, dictionary.place_columns, strict=True)], axis=0)
    parts = [*((c, 1.0) for c in dictionary.place_columns), (on, -1.0)]
    every = [*own, _combine_significance(parts, place_norms, dictionary.place_bumps, dof)]
    return GlobalSignificance(sum(c.length for c in every), sum(c.families for c in every), dof), own


def _combine_significance(
    parts: Sequence[tuple[Array, float]], norms: Array, bumps: Sequence[Bump], dof: float
) -> GlobalSignificance:
    """Significance of a search over bumps whose inner products are a signed sum of parts."""
    stretches = families(bumps)
    length = sum(curve_length([(p[:, s], sign) for p, sign in parts], norms[s]) for s in stretches)
    return GlobalSignificance(length, len(stretches), dof)


def families(bumps: Sequence[Bump]) -> list[slice]:
    """Slices of consecutive bumps of equal width."""
    cuts = [0, *(k for k in range(1, len(bumps)) if bumps[k].width != bumps[k - 1].width), len(bumps)]
    return [slice(a, b) for a, b in itertools.pairwise(cuts) if b > a]


def quotients(dots: Array, norms: Array) -> Array:
    """Quotients (k,); 0 where the norm is 0."""
    return np.divide(dots, norms, out=np.zeros_like(dots), where=norms > 0)
