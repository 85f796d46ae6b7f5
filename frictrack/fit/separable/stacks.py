"""Evaluate several data blocks in one call: their paths, extended to a common length, laid end to end.

The columns of most effects depend on the moment alone. One call on the paths of all runs then replaces one call per
run. A path that is shorter than the longest is extended at its last state; the map to the data leaves that part out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from frictrack.effects import Path, joined_earlier
from frictrack.fit.separable.blocks import DataBlock, Forward
from frictrack.records import Array

PATH_SERIES = ("t", "x", "v", "s", "drive", "lift", "angle")
PATH_CONSTANTS = ("pixel_pitch", "gravity", "clamp_x", "beam_length")


@dataclass(eq=False)
class BlockStack:
    """B consecutive blocks that are evaluated together.

    Attributes
    ----------
    members : tuple of int
        Indices of the blocks.
    runs : tuple of int
        Their runs.
    path : Path
        Their paths of n samples each, laid end to end.
    forward, picture : callable
        Map forces (..., B n), N, and measurement shifts, m, to the data of all members (..., m).
    lengths : tuple of int
        Numbers of data of the members.
    compared_path : Path, optional
        The path at the compared samples only, of a single block; see `DataBlock`.
    loads : tuple of float
        Normal load of every member over its reference, which the joined path leaves out; 1 for a single block, whose
        path has its own.

    """

    members: tuple[int, ...]
    runs: tuple[int, ...]
    path: Path
    forward: Forward
    picture: Forward
    lengths: tuple[int, ...]
    compared_path: Path | None = None
    loads: tuple[float, ...] = (1.0,)
    _tiled: dict[tuple[int, int], Path] = field(default_factory=dict, repr=False)

    @classmethod
    def of_block(cls, index: int, block: DataBlock) -> BlockStack:
        """Return the stack of one block."""
        return cls(
            (index,), (block.run,), block.path, block.forward, block.picture, (len(block.data),), block.compared_path
        )

    @cached_property
    def slices(self) -> list[slice]:
        """The data of every member among those of the stack."""
        return [slice(int(a), int(b)) for a, b in pairwise(np.cumsum([0, *self.lengths]))]

    def evaluation_path(self, has_memory: bool) -> Path:
        """Return the path on which effects are evaluated: those without memory at the compared samples only."""
        return self.path if self.compared_path is None or has_memory else self.compared_path

    def population_path(self, has_memory: bool, count: int) -> Path:
        """Return the path through `count` individuals laid end to end, each along all members."""
        path = self.evaluation_path(has_memory)
        n = len(path.t)
        if count == 1:
            return path
        if (count, n) not in self._tiled:
            self._tiled[count, n] = tiled_path(path, count)
        return self._tiled[count, n]

    def repeat_values(self, values: Array, samples: int, is_depth: bool) -> Any:
        """Repeat values (Q, B) sample by sample, each for n of all `samples`; a common value stays a number.

        A depth multiplies whole columns (n, k), so it has shape (Q B n, 1).
        """
        if values.size == 1 or (values == values[0, 0]).all():
            return float(values[0, 0])
        each = np.diff([*self.path.starts, samples]) if len(self.members) > 1 else samples
        repeated = np.repeat(values, each, axis=1).ravel()
        return repeated[:, None] if is_depth else repeated


def tiled_path(path: Path, count: int) -> Path:
    """Return a path of one or several stretches `count` times end to end."""
    n = len(path.t)
    repeated: dict[str, Any] = {
        one.name: np.tile(value, count)
        for one in fields(path)
        if isinstance(value := getattr(path, one.name), np.ndarray) and value.shape == (n,)
    }
    return replace(path, starts=tuple(n * i + start for i in range(count) for start in path.starts), **repeated)


def joined_path(paths: Sequence[Path], n: int | None = None) -> Path:
    """Lay paths end to end, each extended to n samples at its last state; by default as they are.

    The paths must agree in all that `are_stackable` compares. The load is that of the reference.
    """
    lengths = [n or len(p.t) for p in paths]
    series: dict[str, Any] = {
        name: np.concatenate([_extended(getattr(p, name), m) for p, m in zip(paths, lengths, strict=True)])
        for name in PATH_SERIES
        if getattr(paths[0], name) is not None
    }
    series["t"] = np.concatenate([_extended_times(p.t, m) for p, m in zip(paths, lengths, strict=True)])
    first = np.repeat([float(np.ravel(p.x[:1] if p.begins is None else p.begins)[0]) for p in paths], lengths)
    travelled = np.repeat([float(np.ravel(p.travelled)[0]) for p in paths], lengths)
    mass_ratio = np.repeat([float(np.ravel(p.mass_ratio)[0]) for p in paths], lengths)
    starts = tuple(np.cumsum([0, *lengths[:-1]]).tolist())
    return replace(
        paths[0],
        **series,
        begins=first,
        travelled=travelled,
        starts=starts,
        before=None,
        earlier=joined_earlier(paths),
        load=1.0,
        mass_ratio=mass_ratio,
        mass=None,
    )


def are_stackable(one: Path, other: Path) -> bool:
    """Return whether two paths agree in all that is one number for a whole path, and have no drive as a function."""
    same = all(_are_same(getattr(one, name), getattr(other, name)) for name in PATH_CONSTANTS)
    shown = all((getattr(one, name) is None) == (getattr(other, name) is None) for name in PATH_SERIES)
    plain = not (one.states or other.states or one.drive_at or other.drive_at)
    return same and shown and plain and _are_same(_interval(one), _interval(other))


def _are_same(one: float | None, other: float | None) -> bool:
    """Whether two numbers are the same to rounding; films of one camera have pixel pitches that are."""
    return one == other or (one is not None and other is not None and math.isclose(one, other, rel_tol=1e-9))


def _interval(path: Path) -> float:
    """Median interval of the samples, s."""
    return float(np.median(np.diff(path.t)))


def _extended(series: Array, n: int) -> Array:
    """A series with its last value repeated up to n samples."""
    return np.concatenate([series, np.repeat(series[-1:], n - len(series))])


def _extended_times(t: Array, n: int) -> Array:
    """Times continued with the median interval up to n samples."""
    return np.concatenate([t, t[-1] + float(np.median(np.diff(t))) * np.arange(1, n - len(t) + 1)])
