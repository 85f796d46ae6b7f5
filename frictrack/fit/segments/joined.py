"""Lay pieces end to end, so that one evaluation of a model serves them all."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from frictrack.effects import Path, joined_earlier
from frictrack.fit.segments.pieces import Piece
from frictrack.records import Array
from frictrack.simulate.dynamics import CollocationSolution, LinearResponse, MotionResponse, Panels

SERIES = ("drive", "lift", "angle")  # what a run may tell at every node


@dataclass(frozen=True, eq=False)
class JoinedPieces:
    """Pieces laid end to end: their nodes follow each other in every array (3 p,), p panels in all.

    Attributes
    ----------
    pieces : tuple of Piece
        The R pieces.

    """

    pieces: tuple[Piece, ...]

    @cached_property
    def panels(self) -> Panels:
        """The panels of all pieces."""
        return Panels.joined([piece.panels for piece in self.pieces])

    @cached_property
    def known(self) -> Array:
        """Acceleration by drive and incline at the nodes, m/s^2, (3 p,)."""
        return self._concatenated(lambda piece: piece.known)

    @cached_property
    def mass(self) -> float | Array:
        """Mass at the nodes, kg, (3 p,); a number where all pieces have the same."""
        return self.spread([piece.mass for piece in self.pieces])

    @cached_property
    def nodes(self) -> list[slice]:
        """Nodes of every piece."""
        return _slices([3 * len(piece.panels.h) for piece in self.pieces])

    @cached_property
    def edges(self) -> list[slice]:
        """Edges of every piece."""
        return _slices([len(piece.panels.edges) for piece in self.pieces])

    def spread(self, values: Sequence[float]) -> float | Array:
        """One value per piece, for each of its nodes (3 p,); a number where all are the same."""
        first = values[0]
        return first if all(v == first for v in values) else self.panels.per_node(np.array(values))

    def path_at_nodes(self, x: Array, v: Array, levels: Sequence[float]) -> Path:
        """Return the path at the nodes for a motion.

        Parameters
        ----------
        x, v : array of shape (3 p,)
            Position, m, and velocity, m/s, at the nodes.
        levels : sequence of float
            Friction level of the run of every piece.

        Returns
        -------
        Path
            The path with this motion, its load times the level.

        """
        if len(self.pieces) == 1:
            return self.pieces[0].path_at_nodes(x, v, levels[0])
        load = self.spread([float(p.path.load) * level for p, level in zip(self.pieces, levels, strict=True)])
        return replace(self._path, x=x, v=v, s=self._direction(v), load=load)

    def _direction(self, v: Array) -> Array:
        """Direction of motion at the nodes (3 p,)."""
        if not any(piece.turns for piece in self.pieces):
            return self._path.s
        return np.concatenate([piece.direction(v[rows]) for piece, rows in self.each_with_nodes()])

    def each_with_nodes(self) -> Iterator[tuple[Piece, slice]]:
        """Every piece, and its nodes."""
        return zip(self.pieces, self.nodes, strict=True)

    @cached_property
    def _path(self) -> Path:
        """The path of all pieces, without motion."""
        paths = [piece.path for piece in self.pieces]
        joined: dict[str, Any] = {name: self._series([getattr(path, name) for path in paths]) for name in SERIES}
        joined |= {name: self.spread([getattr(path, name) for path in paths]) for name in ("mass_ratio", "gravity")}
        for group in (("mass",), ("travelled", "begins")):  # a run may lack them
            if all(getattr(path, group[-1]) is not None for path in paths):
                joined |= {name: self.spread([getattr(path, name) for path in paths]) for name in group}
        zeros = np.zeros(len(self.panels.t))
        return replace(
            paths[0],
            **joined,
            t=self.panels.t,
            x=zeros,
            v=zeros,
            s=self._concatenated(lambda piece: piece.path.s),
            before=None,
            earlier=joined_earlier(paths),
            starts=tuple(rows.start for rows in self.nodes),
            runs=tuple(paths),
        )

    def _series(self, series: Sequence[Array | None]) -> Array | None:
        """A series of every piece, end to end; zero where a piece has none, None where no piece has it."""
        if all(own is None for own in series):
            return None
        pairs = zip(series, self.nodes, strict=True)
        return np.concatenate([np.zeros(rows.stop - rows.start) if own is None else own for own, rows in pairs])

    def _concatenated(self, of: Callable[[Piece], Array]) -> Array:
        return np.concatenate([of(piece) for piece in self.pieces])


def _slices(counts: Sequence[int]) -> list[slice]:
    return [slice(int(a), int(b)) for a, b in itertools.pairwise(np.cumsum([0, *counts]))]


def split_motions(
    joined: JoinedPieces, motion: CollocationSolution, response: MotionResponse
) -> list[tuple[CollocationSolution, MotionResponse]]:
    """Split motions that were solved together: motion and response of every piece."""
    if len(joined.pieces) == 1 or not isinstance(response, LinearResponse):
        return [(motion, response)]
    return [
        (motion.part(piece.panels, nodes, edges), response.part(piece.panels, nodes))
        for piece, nodes, edges in zip(joined.pieces, joined.nodes, joined.edges, strict=True)
    ]


def group_by_size(sizes: Sequence[int], limit: int, *, alone: bool = False) -> list[tuple[int, ...]]:
    """Group neighbours whose sizes add up to at most `limit`; each `alone` if so wanted.

    Examples
    --------
    >>> group_by_size([2, 2, 3, 9, 1], 5)
    [(0, 1), (2,), (3,), (4,)]

    """
    out: list[tuple[int, ...]] = []
    total = 0
    for i, size in enumerate(sizes):
        if not out or alone or total + size > limit:
            out.append(())
            total = 0
        out[-1] += (i,)
        total += size
    return out
