"""Build the dictionary of local forces: Gaussian bumps at all times of each run and all places of the course."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from frictrack.compare.bumps import Bump
from frictrack.compare.force_traces import ForceTraces
from frictrack.compare.global_significance import GlobalSignificance, curve_length
from frictrack.fit.least_squares import ModelProjection, PieceResponse, position_and_velocity
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
class BumpDictionary:
    """All bumps of a search and their traces in the displacement.

    Parameters
    ----------
    maps
        Map from forces to traces of every piece.
    time_columns
        Traces of the bumps in time, (n_i, k_i) for piece i.
    time_bumps
        Those bumps.
    place_columns
        Traces of the bumps in place in every piece, (n_i, k).
    place_bumps
        Those bumps.
    model
        Residual and the P' directions of the model.

    """

    maps: list[ForceTraces]
    time_columns: list[Array]
    time_bumps: list[list[Bump]]
    place_columns: list[Array]
    place_bumps: list[Bump]
    model: ModelProjection

    @cached_property
    def time_on_model(self) -> list[Array]:
        """Components (P', k_i) of the traces in time on the model, per piece."""
        return self._on_directions_in_time(self.model.u)

    @cached_property
    def place_on_model(self) -> Array:
        """Components (P', k) of the traces in place on the model, over all pieces."""
        return self._on_directions_in_place(self.model.u)

    def time_norms(self, law: ModelProjection) -> list[Array]:
        """Norms (k_i,) of the traces in time beside the model with further columns, `law`, per piece.

        They are 0 where the model absorbs nearly all of a trace. Only its further directions are multiplied.
        """
        further = self._on_directions_in_time(law.u[:, self.model.u.shape[1] :])
        return [_norm(*of, more) for of, more in zip(self._time_squares, further, strict=True)]

    def place_norms(self, law: ModelProjection) -> Array:
        """The same norms (k,) of the traces in place."""
        return _norm(*self._place_squares, self._on_directions_in_place(law.u[:, self.model.u.shape[1] :]))

    @cached_property
    def _time_squares(self) -> list[tuple[Array, Array]]:
        """Squares (k_i,) of the traces in time, and what the model leaves of them, per piece."""
        whole = [_squares(c) for c in self.time_columns]
        return [(full, full - np.sum(on**2, axis=0)) for full, on in zip(whole, self.time_on_model, strict=True)]

    @cached_property
    def _place_squares(self) -> tuple[Array, Array]:
        """The same of the traces in place, (k,)."""
        whole = np.sum([_squares(c) for c in self.place_columns], axis=0)
        return whole, whole - np.sum(self.place_on_model**2, axis=0)

    def _on_directions_in_time(self, u: Array) -> list[Array]:
        return [u[rows].T @ c for rows, c in zip(self.model.rows, self.time_columns, strict=True)]

    def _on_directions_in_place(self, u: Array) -> Array:
        return np.asarray(np.sum([u[rows].T @ c for rows, c in zip(self.model.rows, self.place_columns, strict=True)],
                                 axis=0))  # fmt: skip


def build_dictionary(law: ModelProjection) -> BumpDictionary:
    """Build all bumps of the search with their traces.

    Parameters
    ----------
    law
        Residual and directions of the model.

    Returns
    -------
    BumpDictionary

    """
    time_bumps = [_bumps_in_time(i, r) for i, r in enumerate(law.responses)]
    place_bumps = _bumps_in_place(law.responses)
    maps = [ForceTraces.of(law.solution, r) for r in law.responses]
    time_columns = [trace_bumps(q, bumps).T for q, bumps in zip(maps, time_bumps, strict=True)]
    place_columns = [trace_bumps(q, place_bumps).T for q in maps]
    return BumpDictionary(maps, time_columns, time_bumps, place_columns, place_bumps, law)


def trace_bumps(traces: ForceTraces, bumps: Sequence[Bump]) -> Array:
    """Traces (k, n) in one piece of bumps of one kind, of size one."""
    at_place = bumps[0].at_place
    axis = traces.x if at_place else traces.t
    centre, width = np.array([b.centre for b in bumps]), np.array([b.width for b in bumps])
    shapes = np.exp(-(((axis - centre[:, None]) / width[:, None]) ** 2) / 2)
    return traces(shapes * traces.dry_factor if at_place else shapes)


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


def _squares(columns: Array) -> Array:
    """Squared norms (k,) of columns (n, k)."""
    return np.asarray(np.einsum("kn,kn->k", columns.T, columns.T))


def _norm(whole: Array, left: Array, on_law: Array) -> Array:
    """Norms (k,) of columns with these squares, of which is `left` before removing components (P, k)."""
    left = left - np.sum(on_law**2, axis=0)
    return np.where(left > MIN_VISIBLE_SHARE * whole, np.sqrt(np.maximum(left, 0)), 0.0)


def search_significance(dictionary: BumpDictionary) -> tuple[GlobalSignificance, list[GlobalSignificance]]:
    """Global significance of the whole search beside the model, and of the search in each piece alone."""
    law = dictionary.model
    frames = float(np.mean([len(r.r) for r in law.responses]))
    dof = max(frames / CORRELATION_COST, 3.0)
    columns = zip(dictionary.time_columns, dictionary.time_on_model, strict=True)
    own = [
        _combine_significance([(c, 1.0), (on, -1.0)], norms, bumps, dof)
        for (c, on), norms, bumps in zip(columns, dictionary.time_norms(law), dictionary.time_bumps, strict=True)
    ]
    parts = [*((c, 1.0) for c in dictionary.place_columns), (dictionary.place_on_model, -1.0)]
    every = [*own, _combine_significance(parts, dictionary.place_norms(law), dictionary.place_bumps, dof)]
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
