"""Data along the measured motion, and the linear map from a force to the change that it makes in them.

A block is one stretch of one run. Its data (m,) are what the forces (and measurement shifts) of a model must explain
after `forward`, in units of the noise. Forces are rows (..., n), so that a population is mapped at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct
from scipy.interpolate import CubicSpline

from frictrack.effects import Path
from frictrack.fit.pieces import AccelerationChain, Piece
from frictrack.records import Array

PASSBAND_FACTOR = 3.2  # times the cut-off; beyond, the chain passes less than a thousandth
SCAN_BAND_FACTOR = 2.0  # times the cut-off; beyond, the chain passes less than a sixtieth
MAX_SAMPLES_KEPT = 20_000  # of a tiled path: to evaluate an effect along a longer one takes far longer than to tile it
MIN_SAMPLES_PER_COMPARED = 2  # samples per compared frame from which a separate path is worth its cost
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

    def evaluation_path(self, has_memory: bool) -> Path:
        """Return the path on which effects are evaluated: those without memory at the compared samples only."""
        return self.path if self.compared_path is None or has_memory else self.compared_path


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


def tiled_path(path: Path, count: int) -> Path:
    """Return a path `count` times end to end, for a population; the last short one is kept with the path."""
    if count == 1:
        return path
    kept: tuple[int, Path] | None = vars(path).get("_tiled")
    if kept is not None and kept[0] == count:
        return kept[1]
    n = len(path.t)
    repeated: dict[str, Any] = {
        one.name: np.tile(value, count)
        for one in fields(path)
        if isinstance(value := getattr(path, one.name), np.ndarray) and value.shape == (n,)
    }
    tiled = replace(path, starts=tuple(n * i for i in range(count)), **repeated)
    if n * count <= MAX_SAMPLES_KEPT:
        vars(path)["_tiled"] = count, tiled
    return tiled


def repeat_values(values: Any, n: int, is_depth: bool) -> Any:
    """Repeat the values (Q,) of a population, n samples each; a common value stays a number.

    A depth multiplies whole columns (n, k), so it has shape (Q n, 1).
    """
    values = np.ravel(values)
    if values.size == 1 or (values == values[0]).all():
        return float(values[0])
    repeated = np.repeat(values, n)
    return repeated[:, None] if is_depth else repeated
