"""Every local force that a search looks at: Gaussian bumps at all times of each run and at all places of the course."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from frictrack.compare.global_significance import Chance, arc
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

SHORTEST = 2.0  # frames: no narrower bump can be told from it
LONGEST = 1 / 12  # of a piece's duration: more is no moment
NARROWEST, BROADEST = 1 / 120, 1 / 8  # of the way: places on a course
STEPS = 2.5  # from one width of the search to the next
FINEST = 250  # centres along a piece or along the course
NEAREST = 4.0  # frames between two centres: a kink in a displacement is no sharper
SEEN = 1e-3  # of a trace that must be left beside the law to count


@dataclass(frozen=True)
class Bump:
    """A Gaussian force: at a time of one piece (s, since release), or at a place of the course (piece None, m)."""

    piece: int | None
    centre: float
    width: float
    size: float = 0.0  # N, at the reference load for a place
    z: float = 0.0

    @property
    def at_place(self) -> bool:
        """Whether it belongs to the course."""
        return self.piece is None

    def shape(self, axis: Array) -> Array:
        """Its height, one at the centre, along an axis (n,)."""
        return np.exp(-(((axis - self.centre) / self.width) ** 2) / 2)


@dataclass(frozen=True)
class Nodes:
    """Where one piece is at its nodes: t s, x m, v m/s, and by what a dry force of 1 N counts there, all (3 p,)."""

    t: Array
    x: Array
    v: Array
    dry: Array

    def axis(self, bump: Bump) -> Array:
        """The axis along which a bump stands."""
        return self.x if bump.at_place else self.t

    def force(self, bump: Bump) -> Array:
        """Force of a bump of size one."""
        return bump.shape(self.axis(bump)) * (self.dry if bump.at_place else 1.0)

    def moved(self, bump: Bump) -> Array:
        """The same and its derivatives in centre and in the logarithm of the width, (3 p, 3)."""
        u = (self.axis(bump) - bump.centre) / bump.width
        f = self.force(bump)
        return np.stack([f, f * u / bump.width, f * u**2], axis=1)


def nodes(solution: Solution, response: PieceResponse) -> Nodes:
    """Nodes of one piece along its solved motion."""
    piece = response.piece
    _, level = solution.problem.layout.values(solution.p, piece.run)
    x, v = (
        (piece.path.x, piece.path.v)
        if isinstance(piece, MeasuredFrictionPiece)
        else (response.motion.x, response.motion.v)
    )
    path = piece.path_at_nodes(x, v, level)
    return Nodes(piece.panels.t, path.x, path.v, path.load * path.s)


@dataclass(frozen=True)
class Looks:
    """All bumps of a search and their traces: `own[i]` (n_i, k_i) at the times of piece i, `common[i]` (n_i, k)."""

    own: list[Array]
    own_bumps: list[list[Bump]]
    common: list[Array]
    common_bumps: list[Bump]

    @cached_property
    def own_squares(self) -> list[Array]:
        """Squared traces of the moments of every piece, (k_i,)."""
        return [np.einsum("nk,nk->k", c, c) for c in self.own]

    @cached_property
    def common_squares(self) -> Array:
        """Squared traces of the places, (k,)."""
        return np.asarray(np.sum([np.einsum("nk,nk->k", c, c) for c in self.common], axis=0))


def looks_of(law: ModelProjection, at: Sequence[Nodes]) -> Looks:
    """All bumps of the search, and what each would leave in the runs."""
    own_bumps = [_times(i, r) for i, r in enumerate(law.responses)]
    common_bumps = _places(law.responses)
    own = [
        displacement_response(r, np.stack([n.force(b) for b in bumps], axis=1))
        for r, n, bumps in zip(law.responses, at, own_bumps, strict=True)
    ]
    common = [
        displacement_response(r, np.stack([n.force(b) for b in common_bumps], axis=1))
        for r, n in zip(law.responses, at, strict=True)
    ]
    return Looks(own, own_bumps, common, common_bumps)


def _widths(shortest: float, widest: float) -> Array:
    count = max(1, 1 + int(np.floor(np.log(max(widest / shortest, 1.0)) / np.log(STEPS))))
    return np.asarray(shortest * STEPS ** np.arange(count), dtype=np.float64)


def _times(i: int, response: PieceResponse) -> list[Bump]:
    t = response.piece.t
    step, length = float(np.median(np.diff(t))), float(t[-1] - t[0])
    out = []
    for width in _widths(SHORTEST * step, LONGEST * length):
        apart = max(width, NEAREST * step, length / FINEST)
        inside = t[0] + NEAREST * step, t[-1] - NEAREST * step
        out += [Bump(i, float(c), float(width)) for c in np.arange(*inside, apart)]
    return out or [Bump(i, float(t[0] + t[-1]) / 2, SHORTEST * step)]  # a piece of a few frames


def _places(responses: Sequence[PieceResponse]) -> list[Bump]:
    low, high = course(responses)
    out = []
    for width in _widths(NARROWEST * (high - low), BROADEST * (high - low)):
        apart = max(width, (high - low) / FINEST)
        out += [Bump(None, float(c), float(width)) for c in np.arange(low, high, apart)]
    return out


def course(responses: Sequence[PieceResponse]) -> tuple[float, float]:
    """Where the runs begin and end, m."""
    ends = [(float(x.min()), float(x.max())) for x, _ in map(position_and_velocity, responses)]
    return min(low for low, _ in ends), max(high for _, high in ends)


def limits(responses: Sequence[PieceResponse], bump: Bump) -> tuple[float, float]:
    """Narrowest and widest that a bump may become."""
    if bump.piece is None:
        low, high = course(responses)
        return NARROWEST * (high - low), BROADEST * (high - low)
    t = responses[bump.piece].piece.t
    return SHORTEST * float(np.median(np.diff(t))), 2 * LONGEST * float(t[-1] - t[0])


def norms(law: ModelProjection, looks: Looks) -> tuple[list[Array], Array]:
    """Norms of all traces beside the law; 0 where the law takes up nearly all of one."""
    own = [_norm(full, law.u[rows].T @ c) for rows, c, full in zip(law.rows, looks.own, looks.own_squares, strict=True)]
    on_common = np.sum([law.u[rows].T @ c for rows, c in zip(law.rows, looks.common, strict=True)], axis=0)
    return own, _norm(looks.common_squares, on_common)


def _norm(squares: Array, on_law: Array) -> Array:
    """Norms (k,) of traces of these squares beside the law on which they have components (P', k)."""
    left = squares - np.sum(on_law**2, axis=0)
    return np.where(left > SEEN * squares, np.sqrt(np.maximum(left, 0)), 0.0)


def chances(law: ModelProjection, looks: Looks) -> tuple[Chance, list[Chance]]:
    """The chance of the whole search, and of that in every piece alone."""
    own_norms, common_norms = norms(law, looks)
    frames = float(np.mean([len(r.r) for r in law.responses]))
    freedom = max(frames / CORRELATION_COST, 3.0)
    own = []
    for i, rows in enumerate(law.rows):
        on = law.u[rows].T @ looks.own[i]
        parts = [(looks.own[i], 1.0), (on, -1.0)]
        own.append(_summed(parts, own_norms[i], looks.own_bumps[i], freedom))
    on = np.sum([law.u[rows].T @ c for rows, c in zip(law.rows, looks.common, strict=True)], axis=0)
    parts = [*((c, 1.0) for c in looks.common), (on, -1.0)]
    every = [*own, _summed(parts, common_norms, looks.common_bumps, freedom)]
    return Chance(sum(c.length for c in every), sum(c.families for c in every), freedom), own


def _summed(parts: Sequence[tuple[Array, float]], norms: Array, bumps: Sequence[Bump], freedom: float) -> Chance:
    stretches = families(bumps)
    length = sum(arc([(p[:, s], sign) for p, sign in parts], norms[s]) for s in stretches)
    return Chance(length, len(stretches), freedom)


def families(bumps: Sequence[Bump]) -> list[slice]:
    """Stretches of one width."""
    cuts = [0, *(k for k in range(1, len(bumps)) if bumps[k].width != bumps[k - 1].width), len(bumps)]
    return [slice(a, b) for a, b in itertools.pairwise(cuts) if b > a]


def over(dots: Array, norms: Array) -> Array:
    """Quotients (k,), 0 where a norm is."""
    return np.divide(dots, norms, out=np.zeros_like(dots), where=norms > 0)
