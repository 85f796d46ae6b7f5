"""Map forces along several pieces at once to whitened displacements at their frames, the starts projected out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from frictrack.fit.pieces import Piece, Rows, joined_whitening
from frictrack.fit.separable import BlockStack, DataBlock, are_stackable, joined_path
from frictrack.records import Array
from frictrack.simulate.dynamics import EdgeResponse, StackedEdgeResponse

MIN_FILLED_SHARE = 0.6  # of the samples of a stack that belong to its pieces; the others are computed in vain


@dataclass(frozen=True, eq=False)
class ForceMap:
    """What maps forces along one piece to its data.

    Attributes
    ----------
    piece : Piece
        The piece, with n frames.
    response : EdgeResponse
        Response of its motion.
    factor : array of shape (n,)
        Measured shift at the frames per acceleration response times N, 1/kg.
    starts : array of shape (n, S)
        Orthonormal columns of the start.

    """

    piece: Piece
    response: EdgeResponse
    factor: Array
    starts: Array

    @cached_property
    def edges(self) -> Rows:
        """Which edge of the path each frame is, (n,)."""
        return self.piece.at // self.piece.per_frame


class StackedForceMap:
    """The maps of several pieces, applied to rows (..., B n) along their joined path."""

    def __init__(self, maps: Sequence[ForceMap], n: int) -> None:
        self._shape = len(maps), n
        self._response = StackedEdgeResponse([m.response for m in maps], n)
        self._edges = np.concatenate([m.edges + n * i for i, m in enumerate(maps)])
        self._factor = np.concatenate([m.factor for m in maps])
        self._whitened = joined_whitening([m.piece for m in maps])
        ends = np.cumsum([0, *[len(m.edges) for m in maps]])
        self._starts = [(slice(int(a), int(b)), m.starts) for a, b, m in zip(ends, ends[1:], maps, strict=False)]

    def forward(self, rows: Array) -> Array:
        """Compute the data (..., m) that forces (..., B n), N, make."""
        moved = self._response(rows.reshape(*rows.shape[:-1], *self._shape)).reshape(rows.shape)
        return self._white(moved[..., self._edges] * self._factor)

    def picture(self, rows: Array) -> Array:
        """Compute the data (..., m) that measurement shifts (..., B n), m, make."""
        return self._white(rows[..., self._edges])

    def _white(self, shifts: Array) -> Array:
        """Whiten shifts (..., m) and project the starts out, in place."""
        flat = self._whitened(shifts.reshape(-1, shifts.shape[-1]).T).T
        for cut, q in self._starts:
            flat[:, cut] -= (flat[:, cut] @ q) @ q.T
        return np.asarray(flat.reshape(*shifts.shape[:-1], -1))


def stack_blocks(blocks: Sequence[DataBlock], maps: Sequence[ForceMap | None]) -> list[BlockStack]:
    """Join consecutive blocks that can be evaluated together.

    Parameters
    ----------
    blocks : sequence of DataBlock
        The data of the pieces.
    maps : sequence of ForceMap or None
        Their maps; None where a piece cannot be joined.

    Returns
    -------
    list of BlockStack
        All blocks in order, joined or alone.

    """
    groups: list[list[int]] = []
    for i in range(len(blocks)):
        if groups and _can_join(blocks, maps, [*groups[-1], i]):
            groups[-1].append(i)
        else:
            groups.append([i])
    return [_stack(blocks, maps, members) for members in groups]


def _can_join(blocks: Sequence[DataBlock], maps: Sequence[ForceMap | None], members: list[int]) -> bool:
    """Whether blocks can be one stack: equal constants, equal kind of noise, similar lengths."""
    first, last = maps[members[0]], maps[members[-1]]
    if first is None or last is None or bool(first.piece.correlated) != bool(last.piece.correlated):
        return False
    samples = [len(blocks[i].path.t) for i in members]
    filled = sum(samples) >= MIN_FILLED_SHARE * len(samples) * max(samples)
    return filled and are_stackable(blocks[members[0]].path, blocks[members[-1]].path)


def _stack(blocks: Sequence[DataBlock], maps: Sequence[ForceMap | None], members: list[int]) -> BlockStack:
    own = [m for i in members if (m := maps[i]) is not None]
    if len(members) == 1:
        return BlockStack.of_block(members[0], blocks[members[0]])
    paths = [blocks[i].path for i in members]
    n = max(len(p.t) for p in paths)
    joined = StackedForceMap(own, n)
    return BlockStack(
        members=tuple(members),
        runs=tuple(blocks[i].run for i in members),
        path=joined_path(paths, n),
        forward=joined.forward,
        picture=joined.picture,
        lengths=tuple(len(blocks[i].data) for i in members),
        loads=tuple(float(p.load) for p in paths),
    )
