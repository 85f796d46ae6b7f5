"""Data along the measured motion, and the linear map from a force to the change that it makes in them.

A block is one stretch of one run. Its data (m,) are what the forces (and measurement shifts) of a model must explain
after `forward`, in units of the noise. Forces are rows (..., n), so that a population is mapped at once.

The columns of most effects depend on the moment alone. One call on the paths of several blocks, extended to a common
length at their last state and laid end to end (`BlockStack`), then replaces one call per block. The map to the data
leaves the extension out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct
from scipy.interpolate import CubicSpline

from frictrack.effects import Path, joined_earlier
from frictrack.fit.pieces import AccelerationChain, Piece
from frictrack.records import Array

PASSBAND_FACTOR = 3.2  # times the cut-off; beyond, the chain passes less than a thousandth
SCAN_BAND_FACTOR = 2.0  # times the cut-off; beyond, the chain passes less than a sixtieth
MIN_SAMPLES_PER_COMPARED = 2  # samples per compared frame from which a separate path is worth its cost
PATH_SERIES = ("t", "x", "v", "s", "drive", "lift", "angle")
PATH_CONSTANTS = ("pixel_pitch", "gravity", "clamp_x", "beam_length")
Forward = Callable[[Array], Array]  # rows (..., n) to rows (..., m)


@dataclass(frozen=True, eq=False)
class DataBlock:
    """One stretch of one run: data (m,) ~ forward(force) + picture(shift), white noise of standard deviation one.

    Attributes
    ----------
    run : int
        Index of the run.
    path : Path
        Motion at the n samples.
    data : array of shape (m,)
        Whitened data.
    forward : callable
        Maps forces (..., n), N, to data (..., m).
    picture : callable
        Maps measurement shifts (..., n), m, to data (..., m).
    friction : array of shape (n,)
        Measured force at the reference load, N.
    rest : float
        Part of the squared data that no force along the path can change.
    highest : float
        Highest frequency at which periodic effects are searched, Hz.
    compared_path : Path, optional
        The path at the compared samples only, where these are few. It suffices for effects without memory.

    """

    run: int
    path: Path
    data: Array
    forward: Forward
    picture: Forward
    friction: Array
    rest: float = 0.0
    highest: float = np.inf
    compared_path: Path | None = None


def force_block(run: int, path: Path, friction: Array, sigma: Array | float) -> DataBlock:
    """Create a block from a measured friction series.

    Parameters
    ----------
    run : int
        Index of the run.
    path : Path
        Motion at the n samples.
    friction : array of shape (n,)
        Measured friction, N.
    sigma : array of shape (n,) or float
        Its standard deviation, N.

    Returns
    -------
    DataBlock
        The series as data; forces map to it directly.

    """
    weight = np.broadcast_to(1.0 / np.asarray(sigma, dtype=float), friction.shape)
    return DataBlock(
        run=run,
        path=path,
        data=friction * weight,
        forward=(lambda rows: rows) if np.all(weight == 1.0) else (lambda rows: rows * weight),
        picture=np.zeros_like,
        friction=friction / path.load,
    )


def displacement_block(piece: Piece) -> DataBlock:
    """Create a block from the displacement of a piece.

    Parameters
    ----------
    piece : Piece
        The piece.

    Returns
    -------
    DataBlock
        Whitened displacement minus that of the known acceleration, start position and speed projected out.

    """
    q, _ = np.linalg.qr(piece.whitened(np.column_stack([np.ones_like(piece.t), piece.t])))
    twice = double_integral(piece.t)

    def picture(rows: Array) -> Array:
        white = np.moveaxis(piece.whitened(np.moveaxis(rows, -1, 0)), 0, -1)
        clean: Array = white - (white @ q) @ q.T
        return clean

    known = np.interp(piece.t, piece.panels.t, piece.known)
    return DataBlock(
        run=piece.run,
        path=path_of(piece),
        data=picture(piece.y - twice(known)),
        forward=lambda rows: picture(twice(rows) * (-1.0 / piece.mass)),
        picture=picture,
        friction=_friction(piece),
    )


def chain_block(piece: Piece, chain: AccelerationChain, noise: float) -> DataBlock:
    """Create a block from the accelerations of a piece through the papers' chain.

    The force enters by its cosine components within the passband of the chain, so that the map is one small matrix.

    Parameters
    ----------
    piece : Piece
        The piece.
    chain : AccelerationChain
        Its low-pass and double difference.
    noise : float
        Noise of the accelerations, m/s^2; the unit of the data.

    Returns
    -------
    DataBlock
        Accelerations in the coordinates that a force along the path can change.

    """
    t = piece.t
    k = min(len(t), int(2 * (t[-1] - t[0]) * PASSBAND_FACTOR * chain.cutoff) + 8)
    cosines = dct(np.eye(len(t)), norm="ortho", axis=0)[:k].T
    known = np.interp(t, piece.panels.t, piece.known)
    twice = CubicSpline(t, np.column_stack([cosines, known])).antiderivative(2)(t)
    basis, response = np.linalg.qr(chain.apply(twice[:, :k] / piece.mass) / noise)
    measured = chain.apply((piece.y - twice[:, k])[:, None])[:, 0] / noise
    data = basis.T @ measured
    through = -cosines @ response.T
    return DataBlock(
        run=piece.run,
        path=path_of(piece),
        data=data,
        forward=lambda rows: rows @ through,
        picture=lambda rows: _map_rows(rows, lambda x: chain.apply(x) / noise) @ basis,
        friction=_friction(piece),
        rest=max(float(measured @ measured - data @ data), 0.0),
        highest=SCAN_BAND_FACTOR * chain.cutoff,
    )


def rows_at_compared(rows: Array, at: NDArray[np.int_]) -> Array:
    """Select the compared samples `at` (m,) of rows (..., n). Rows (..., m) are returned unchanged.

    Examples
    --------
    >>> rows_at_compared(np.arange(4.0), np.array([1, 3]))
    array([1., 3.])
    >>> rows_at_compared(np.array([5.0, 7.0]), np.array([1, 3]))
    array([5., 7.])

    """
    return rows if rows.shape[-1] == len(at) else rows[..., at]


def path_at_compared(piece: Piece, x: Array, v: Array, level: float) -> Path | None:
    """Return the path of a motion x, v (n,) at the compared frames only; None where these are most of its samples."""
    if MIN_SAMPLES_PER_COMPARED * len(piece.at) > len(piece.path.t):
        return None
    return piece.at_frames(x[piece.at], v[piece.at], level)


def path_of(piece: Piece) -> Path:
    """Return the measured motion of a piece at its frames."""
    nodes, t = piece.panels.t, piece.t
    path = piece.at_frames(CubicSpline(nodes, piece.x_hat)(t), CubicSpline(nodes, piece.v_hat)(t), 1.0)
    return replace(path, drive=None if piece.path.drive is None else np.interp(t, nodes, piece.path.drive))


def double_integral(t: Array) -> Forward:
    """Create the operator that integrates rows (..., n) over t (n,) twice, with start position and speed zero.

    The second difference x[i+1] - 2 x[i] + x[i-1] is the mean of the force under a hat function, with the force a
    parabola in between. For evenly spaced frames these are Numerov's weights h^2 (1, 10, 1)/12.

    References
    ----------
    Hairer, E., Norsett, S. P. & Wanner, G. (1993). Solving Ordinary Differential Equations I, sec. III.10. Springer.

    """
    before, after = np.diff(t)[:-1], np.diff(t)[1:]
    tilt, bend = (after**2 - before**2) / 6, (before**3 + after**3) / 12
    left = (bend - after * tilt) / (before * (before + after))
    right = (bend + before * tilt) / (after * (before + after))
    middle = (before + after) / 2 - left - right

    def twice(rows: Array) -> Array:
        kinks = left * rows[..., :-2] + middle * rows[..., 1:-1] + right * rows[..., 2:]
        out = np.zeros_like(rows)
        np.cumsum(after * np.cumsum(kinks, axis=-1), axis=-1, out=out[..., 2:])
        return out

    return twice


def _friction(piece: Piece) -> Array:
    force = piece.mass * (piece.known - piece.a_hat) / piece.path.load
    return np.interp(piece.t, piece.panels.t, force)


def _map_rows(rows: Array, chain: Callable[[Array], Array]) -> Array:
    flat = chain(rows.reshape(-1, rows.shape[-1]).T).T
    return flat.reshape(*rows.shape[:-1], -1)


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
