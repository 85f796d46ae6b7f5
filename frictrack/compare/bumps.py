"""Gaussian bumps as local forces: their traces in the residual of a fit, and how significant the best of many is.

Tests along a continuous setting, such as the place of a bump, form a smooth random process. The probability that it
exceeds a level u is at most the probability that it starts above u, plus the expected number of upcrossings. The latter
is the Gaussian tail factor of u times the length of the curve that the normalised traces draw on the unit sphere, over
pi. Bumps of one width are one such curve; curves add up (Bonferroni). An estimated noise level makes the tail that of
Student's t.

References
----------
Hotelling (1939), Am. J. Math. 61, 440-460.
Knowles & Siegmund (1989), Int. Statist. Rev. 57, 205-220.

"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from frictrack.distributions import student_sf
from frictrack.effects import Path
from frictrack.fit.least_squares import ModelProjection, position_and_velocity
from frictrack.fit.linearised import LinearisedPiece
from frictrack.motion.noise import CORRELATION_COST
from frictrack.records import Array

MIN_WIDTH_FRAMES = 2.0  # frames; a narrower bump leaves the same trace
MAX_WIDTH_DURATION_SHARE = 1 / 12  # of a piece's duration; a wider bump is no local force
MIN_WIDTH_COURSE_SHARE, MAX_WIDTH_COURSE_SHARE = 1 / 120, 1 / 8  # of the course, for bumps in place
WIDTH_RATIO = 2.5  # between two widths of the search
MAX_CENTRES = 250  # along a piece or along the course
MIN_SPACING_FRAMES = 4.0  # frames between two centres; a displacement has no sharper bend
MIN_VISIBLE_SHARE = 1e-3  # of a trace's square that must remain outside the model


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
    size: float = 0.0
    z: float = 0.0

    @property
    def at_place(self) -> bool:
        """Whether it is a bump at a place of the course."""
        return self.piece is None

    def acts_in(self, piece: int) -> bool:
        """Whether it acts in a piece."""
        return self.piece in (None, piece)

    def derivatives(self, path: Path) -> Array:
        """Force of a bump of size one along a path, and its derivatives by centre and by log width, (3, m)."""
        u = ((path.x if self.at_place else path.t) - self.centre) / self.width
        force = np.exp(-(u**2) / 2) * (path.load * path.s if self.at_place else 1.0)
        return np.stack([force, force * u / self.width, force * u**2])


@dataclass(frozen=True)
class GlobalSignificance:
    """Significance of a whole search.

    Parameters
    ----------
    length
        Total length of the curves that the normalised traces of all families draw on the unit sphere.
    families
        Number of families.
    dof
        Degrees of freedom of the noise estimate.

    Examples
    --------
    >>> single = GlobalSignificance(length=0.0, families=1, dof=1e6)
    >>> round(single(3.0), 4)
    0.0027

    """

    length: float
    families: int
    dof: float

    def __call__(self, z: float) -> float:
        """Return an upper bound on the probability that noise alone reaches |z| standard deviations anywhere."""
        rising = self.length / np.pi * float(np.exp(-(self.dof - 1) / 2 * np.log1p(z**2 / self.dof)))
        begun = 2 * self.families * float(student_sf(abs(z), self.dof))
        return float(min(1.0, max(rising + begun, np.finfo(float).tiny)))


@dataclass(frozen=True, eq=False)
class BumpGrid:
    """Bumps at all times of one piece, or at all places of the course, with their traces, a model projected out.

    Parameters
    ----------
    bumps
        The K bumps, one width after the other.
    traces
        By piece in which they act: its rows, and the traces (K, n) there.
    model
        Residual and directions of the model.

    """

    bumps: list[Bump]
    traces: list[tuple[slice, Array]]
    model: ModelProjection

    def products(self, columns: Array) -> Array:
        """Inner products (K, c) of the traces with columns (N + m, c)."""
        return np.asarray(np.sum([traces @ columns[rows] for rows, traces in self.traces], axis=0))

    @cached_property
    def _on_model(self) -> Array:
        return self.products(self.model.u)

    @cached_property
    def _squares(self) -> Array:
        return np.asarray(np.sum([np.einsum("kn,kn->k", traces, traces) for _, traces in self.traces], axis=0))

    def norms(self, law: ModelProjection) -> Array:
        """Norms (K,) of the traces outside a model with further columns, `law`; 0 where little is left of a trace."""
        further = self.products(law.u[:, self.model.u.shape[1] :])
        left = self._squares - np.sum(self._on_model**2, axis=1) - np.sum(further**2, axis=1)
        return np.where(left > MIN_VISIBLE_SHARE * self._squares, np.sqrt(np.maximum(left, 0.0)), 0.0)

    def significances(self, law: ModelProjection) -> Array:
        """Sizes (K,) of all bumps added to a model, each alone, in standard deviations."""
        norms = self.norms(law)
        dots = self.products(law.r[:, None])[:, 0]
        return np.divide(dots, norms, out=np.zeros_like(dots), where=norms > 0)

    @property
    def families(self) -> list[slice]:
        """Slices of consecutive bumps of equal width."""
        cuts = [k for k in range(1, len(self.bumps)) if self.bumps[k].width != self.bumps[k - 1].width]
        return [slice(a, b) for a, b in itertools.pairwise([0, *cuts, len(self.bumps)])]

    @cached_property
    def significance(self) -> GlobalSignificance:
        """Significance of a search over these bumps."""
        norms = self.norms(self.model)
        parts = [(traces, 1.0) for _, traces in self.traces] + [(self._on_model, -1.0)]
        length = sum(curve_length([(p[s], sign) for p, sign in parts], norms[s]) for s in self.families)
        frames = float(np.mean([rows.stop - rows.start for rows in self.model.rows]))
        return GlobalSignificance(length, len(self.families), max(frames / CORRELATION_COST, 3.0))


def curve_length(parts: Sequence[tuple[Array, float]], norms: Array) -> float:
    """Length of the curve that normalised traces draw on the unit sphere: the sum of angles between neighbours, rad.

    Parameters
    ----------
    parts
        Blocks (k, n_i) of the traces, each with the sign with which it enters the inner products.
    norms
        Norms (k,) of the traces; a trace of norm 0 is left out.

    Returns
    -------
    float

    Examples
    --------
    >>> round(curve_length([(np.eye(2), 1.0)], np.ones(2)), 4)
    1.5708

    """
    kept = np.flatnonzero(norms > 0)
    inner = sum(sign * np.einsum("kn,kn->k", rows[kept[1:]], rows[kept[:-1]]) for rows, sign in parts)
    return float(np.sum(np.arccos(np.clip(inner / (norms[kept[1:]] * norms[kept[:-1]]), -1.0, 1.0))))


def force_traces(piece: LinearisedPiece, forces: Array) -> Array:
    """Traces (k, n) in one piece, start projected out, of forces (k, m) along its path, N."""
    return piece.data_of(forces, is_measurement=False)


def bump_grid(law: ModelProjection, pieces: Sequence[LinearisedPiece], bumps: list[Bump]) -> BumpGrid:
    """Trace bumps of one kind, in time of one piece or in place."""
    traces, place = [], bumps[0].at_place
    centre, width = np.array([[b.centre, b.width] for b in bumps]).T[:, :, None]
    for i, (rows, piece) in enumerate(zip(law.rows, pieces, strict=True)):
        if bumps[0].acts_in(i):
            shapes = np.exp(-((((piece.path.x if place else piece.path.t) - centre) / width) ** 2) / 2)
            traces.append((rows, force_traces(piece, shapes * (piece.path.load * piece.path.s) if place else shapes)))
    return BumpGrid(bumps, traces, law)


def bump_grids(law: ModelProjection, pieces: Sequence[LinearisedPiece]) -> list[BumpGrid]:
    """Make the grids of bumps at all times of every piece, and after them that of bumps at all places."""
    in_time = [_bumps_in_time(i, piece.response.piece.t) for i, piece in enumerate(pieces)]
    return [bump_grid(law, pieces, bumps) for bumps in (*in_time, _bumps_in_place(*course_ends(law)))]


def _widths(narrowest: float, widest: float) -> list[float]:
    count = max(1, 1 + int(np.floor(np.log(max(widest / narrowest, 1.0)) / np.log(WIDTH_RATIO))))
    return [narrowest * WIDTH_RATIO**k for k in range(count)]


def _bumps_in_time(i: int, t: Array) -> list[Bump]:
    """Bumps at all times of a piece of frames at t (n,), at several widths."""
    step, length = float(np.median(np.diff(t))), float(t[-1] - t[0])
    out = []
    for width in _widths(MIN_WIDTH_FRAMES * step, MAX_WIDTH_DURATION_SHARE * length):
        apart = max(width, MIN_SPACING_FRAMES * step, length / MAX_CENTRES)
        inside = t[0] + MIN_SPACING_FRAMES * step, t[-1] - MIN_SPACING_FRAMES * step
        out += [Bump(i, float(c), width) for c in np.arange(*inside, apart)]
    return out or [Bump(i, float(t[0] + t[-1]) / 2, MIN_WIDTH_FRAMES * step)]  # a piece of a few frames


def _bumps_in_place(low: float, high: float) -> list[Bump]:
    """Bumps at all places of the course, at several widths."""
    widths = _widths(MIN_WIDTH_COURSE_SHARE * (high - low), MAX_WIDTH_COURSE_SHARE * (high - low))
    spacing = (high - low) / MAX_CENTRES
    return [Bump(None, float(c), width) for width in widths for c in np.arange(low, high, max(width, spacing))]


def course_ends(law: ModelProjection) -> tuple[float, float]:
    """Smallest and largest position of all runs, m."""
    x = np.concatenate([position_and_velocity(r)[0] for r in law.responses])
    return float(x.min()), float(x.max())


def width_limits(law: ModelProjection, bump: Bump) -> tuple[float, float]:
    """Smallest and largest width to which a bump may be refined."""
    if bump.piece is None:
        low, high = course_ends(law)
        return MIN_WIDTH_COURSE_SHARE * (high - low), MAX_WIDTH_COURSE_SHARE * (high - low)
    t = law.responses[bump.piece].piece.t
    return MIN_WIDTH_FRAMES * float(np.median(np.diff(t))), 2 * MAX_WIDTH_DURATION_SHARE * float(t[-1] - t[0])
