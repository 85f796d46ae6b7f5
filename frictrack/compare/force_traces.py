"""Compute the traces of many forces in the displacement of one piece, from forces at the edges of its panels.

Scans need thousands of traces. Forces at the edges are a third of those at the nodes, and running sums replace the
step from panel to panel (see `EdgeResponse`). What a scan finds is computed again from the nodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from frictrack.compare.bumps import motion_at_nodes
from frictrack.effects import frequencies, spatial_periods
from frictrack.fit.least_squares import PieceResponse, Solution
from frictrack.fit.linearised import Float32Array
from frictrack.fit.observations import MeasuredFrictionPiece
from frictrack.records import Array
from frictrack.simulate.dynamics import EdgeResponse, KrylovResponse, LinearResponse

WAVES_PER_BLOCK = 32  # computed together, so that their arrays stay in the cache
MIN_PERIODS = 3.0  # in the longest run
FREQUENCY_STRIDE = 2  # of the library's scan, which has steps of a quarter Rayleigh cell
MIN_VISIBLE_SHARE = 1e-4  # of a trace's square that must remain beside the model


@dataclass(frozen=True)
class ForceTraces:
    """Map forces at the edges of one piece to whitened traces at its frames, start projected out.

    Parameters
    ----------
    response
        The piece under the model.
    t, x, v
        Time since release s, position m and velocity m/s at the edges, (p + 1,).
    dry_factor
        Force there of a dry friction of 1 N at the reference load, (p + 1,).

    """

    response: PieceResponse
    t: Array
    x: Array
    v: Array
    dry_factor: Array

    @classmethod
    def of(cls, solution: Solution, response: PieceResponse) -> ForceTraces:
        """Make the map of one piece of a fit."""
        at_nodes, panels, motion = motion_at_nodes(solution, response), response.piece.panels, response.motion
        dry_factor = np.interp(panels.edges, at_nodes.t, at_nodes.dry_factor)
        return cls(response, panels.edges, motion.x_edge, motion.v_edge, dry_factor)

    @cached_property
    def _edge_response(self) -> EdgeResponse | None:
        """Response of the motion; None where a force is measured directly."""
        linear, piece = self.response.linear, self.response.piece
        if isinstance(piece, MeasuredFrictionPiece):
            return None
        if isinstance(linear, KrylovResponse):  # as in `displacement_response`
            still = np.zeros(len(piece.panels.t))
            return EdgeResponse(LinearResponse(piece.panels, still, still))
        return EdgeResponse(linear)

    @cached_property
    def _scale(self) -> Array:
        """Displacement shown per displacement, over the mass and with the sign of a resisting force, (n,)."""
        sign = 1.0 if self._edge_response is None else -1.0
        return sign * (1 + self.response.shift_slope) / self.response.piece.mass

    def __call__(self, forces: Array) -> Array:
        """Traces (k, n), in standard deviations, of forces (k, p + 1), N."""
        piece, q = self.response.piece, self.response.q
        moved = forces if self._edge_response is None else self._edge_response(forces)
        rows = moved if len(piece.at) == moved.shape[1] else moved[:, piece.at]
        rows = self._whitened(rows)
        rows -= (rows @ q) @ q.T
        return rows

    def _whitened(self, moved: Array) -> Array:
        """Displacements (k, n) per unit mass as traces in standard deviations."""
        piece = self.response.piece
        if piece.correlated:
            return np.array(piece.whitened((moved * self._scale).T).T)
        return np.asarray(moved * (self._scale / piece.sigma))

    def of_waves(self, position: Array, f: Array, factor: Array | float = 1.0) -> Float32Array:
        """Traces of sines and cosines along a variable.

        Parameters
        ----------
        position
            The variable at the edges, (p + 1,).
        f
            Equally spaced frequencies (G,), in cycles per unit of `position`.
        factor
            Factor on the force at the edges, (p + 1,).

        Returns
        -------
        ndarray, shape (2, G, n)
            Traces of sines and of cosines.

        """
        out = np.empty((2, len(f), len(self.response.r)), dtype=np.float32)
        step = 2j * np.pi * (f[1] - f[0]) * position if len(f) > 1 else 0j * position
        powers = factor * np.exp(np.arange(min(WAVES_PER_BLOCK, len(f)))[:, None] * step)
        for first in range(0, len(f), WAVES_PER_BLOCK):
            part = slice(first, min(first + WAVES_PER_BLOCK, len(f)))
            waves = powers[: part.stop - first] * np.exp(2j * np.pi * f[first] * position)
            out[:, part] = self(np.concatenate([waves.imag, waves.real])).reshape(2, part.stop - first, -1)
        return out


@dataclass(frozen=True)
class WaveTraces:
    """Traces of sines and cosines of many frequencies.

    Parameters
    ----------
    f
        Equally spaced frequencies, (G,): Hz, or cycles per m.
    of_pieces
        Traces (2, G, n) in every piece.

    """

    f: Array
    of_pieces: list[Float32Array]


@dataclass(frozen=True)
class WaveScan:
    """Traces of all waves that are scanned for in the residual of a fit, each computed once.

    Parameters
    ----------
    solution
        The fit.

    """

    solution: Solution

    @cached_property
    def traces(self) -> list[ForceTraces]:
        """The maps of all pieces from forces to traces."""
        return [ForceTraces.of(self.solution, r) for r in self.solution.responses]

    @cached_property
    def in_time(self) -> WaveTraces:
        """Forces that are sinusoidal in time; at least `MIN_PERIODS` periods in the longest run."""
        span = self.solution.problem.layout.span
        f = frequencies(span)[::FREQUENCY_STRIDE]
        f = f[f >= MIN_PERIODS / span.duration]
        return WaveTraces(f, [q.of_waves(q.t, f) for q in self.traces] if len(f) else [])

    @cached_property
    def in_place(self) -> WaveTraces:
        """Dry friction forces that are sinusoidal over the place."""
        f = np.sort(1 / spatial_periods(self.solution.problem.layout.span))
        return WaveTraces(f, [q.of_waves(q.x, f, q.dry_factor) for q in self.traces])


def pair_products(traces: Array | Float32Array) -> Array:
    """Inner products (G, 2, 2) of the sine and cosine of every frequency, from traces (2, G, n)."""
    sine, cosine = traces
    products = [np.einsum("gn,gn->g", a, b) for a, b in ((sine, sine), (sine, cosine), (cosine, cosine))]
    return np.asarray(np.stack([products[0], products[1], products[1], products[2]], axis=1).reshape(-1, 2, 2), float)


def visible_part(whole: Array, absorbed: Array) -> Array:
    """Gram matrices (G, 2, 2) of waves without what the model absorbs; 0 where that is nearly all."""
    left = whole - absorbed
    share = np.einsum("gaa->g", left) / np.maximum(np.einsum("gaa->g", whole), 1e-300)
    return np.where((share > MIN_VISIBLE_SHARE)[:, None, None], left, 0.0)
