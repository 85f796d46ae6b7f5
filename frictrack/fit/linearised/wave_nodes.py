"""Interpolate the columns of a wave between few frequencies, by the sampling theorem.

Along a run that spans a length U of its coordinate, exp(2 pi i q u) is determined by its values at frequencies q that
are 1/U apart. With nodes `OVERSAMPLING` times closer, a sum over `N_TAPS` nodes on either side, weighted by a
Kaiser-windowed sinc, gives any frequency between them to 1.3e-4 of the amplitude. The map from columns to data is
linear, so products of the columns are interpolated like the columns.

References
----------
Kaiser, J. F. & Schafer, R. W. (1980). On the use of the I0-sinh window for spectrum analysis. IEEE Trans. ASSP 28.
Jackson, J. I. et al. (1991). Selection of a convolution function for Fourier inversion using gridding. IEEE TMI 10.

"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import i0

from frictrack.fit.linearised.grid import CandidateGrid
from frictrack.fit.linearised.model import LinearisedPiece
from frictrack.records import Array

OVERSAMPLING = 1.5  # nodes per cell 1/U
N_TAPS = 8  # nodes on either side
MAX_NODE_SHARE = 0.8  # of the grid points; with more nodes every grid point is computed itself
MIN_NODES_PER_GRID = 40  # fewer points are not worth an interpolation
MAX_NODE_SAMPLES = 3_000_000  # of columns at the nodes, held at once
TARGETS_AT_ONCE = 48


@dataclass(frozen=True, eq=False)
class WaveNodes:
    """Nodes along the wave axis of a grid for one piece, at one setting of the other parameters.

    Attributes
    ----------
    targets : slice
        Grid points.
    points : array of shape (M, d)
        The nodes, as points of the grid.
    spacing, middle : float
        Spacing of the nodes, and middle of the coordinate along the piece.
    node_q, target_q : array of shape (M,), (G',)
        Frequencies of the nodes and of the grid points.

    """

    targets: slice
    points: Array
    spacing: float
    middle: float
    node_q: Array
    target_q: Array

    def chunks(self) -> Iterator[tuple[slice, slice, Array]]:
        """Yield grid points, the nodes that they need, and weights (2 G'', 2 M'') of both quadratures."""
        for first in range(0, len(self.target_q), TARGETS_AT_ONCE):
            q = self.target_q[first : first + TARGETS_AT_ONCE]
            low = np.searchsorted(self.node_q, q.min() - N_TAPS * self.spacing)
            high = np.searchsorted(self.node_q, q.max() + N_TAPS * self.spacing, side="right")
            weights = _weights(q, self.node_q[low:high], self.spacing, self.middle)
            start = self.targets.start + first
            yield slice(start, start + len(q)), slice(int(low), int(high)), weights


def wave_nodes(grid: CandidateGrid, piece: LinearisedPiece) -> list[WaveNodes]:
    """Choose the nodes for one piece; empty if every grid point is to be computed itself."""
    wave = grid.effect.scan_wave
    if wave is None or grid.k != len(grid.phases) != 1 or grid.names[-1:] != (wave.parameter,):
        return []
    q = wave.frequency(grid.values[: grid.shape[-1], -1])
    step = np.diff(q)
    if len(q) < MIN_NODES_PER_GRID or not np.allclose(step, step[0], rtol=1e-6):
        return []
    out: list[WaveNodes] = []
    for first in range(0, len(grid.values), len(q)):
        u = wave.coordinate(piece.path_for(grid.effect), grid.point(first))
        length, middle = float(np.ptp(u)), float(u.min() + u.max()) / 2
        spacing = 1 / (OVERSAMPLING * length) if length else np.inf
        if (abs(q[-1] - q[0]) / spacing + 2 * N_TAPS + 1) > MAX_NODE_SHARE * len(q):
            return []
        out.extend(_spans(grid, first, (spacing, middle), q, len(u)))
    return out


def _spans(
    grid: CandidateGrid, first: int, spacing_and_middle: tuple[float, float], q: Array, samples: int
) -> Iterator[WaveNodes]:
    """Yield nodes for stretches of the axis of which all columns can be held at once."""
    spacing, middle = spacing_and_middle
    room = max(MAX_NODE_SAMPLES // (2 * samples) - 2 * N_TAPS, N_TAPS)  # nodes within the stretch
    count = max(1, int(room * spacing / abs(q[1] - q[0])))
    wave = grid.effect.scan_wave
    assert wave is not None
    for at in range(0, len(q), count):
        target_q = q[at : at + count]
        low = target_q.min() - N_TAPS * spacing
        nodes = low + spacing * np.arange(np.ceil((target_q.max() - low) / spacing) + N_TAPS + 1)
        nodes[nodes == 0] = spacing * np.finfo(float).eps  # a wave without end has no period
        points = np.repeat(grid.values[first : first + 1], len(nodes), axis=0)
        points[:, -1] = wave.frequency(nodes)
        yield WaveNodes(slice(first + at, first + at + len(target_q)), points, spacing, middle, nodes, target_q)


def _weights(q: Array, nodes: Array, spacing: float, middle: float) -> Array:
    """Weights (2 G, 2 M) of sine and cosine at nodes (M,) for those at q (G,)."""
    away = (q[:, None] - nodes) / spacing
    near = np.abs(away) < N_TAPS
    w = np.zeros(away.shape)
    shape = np.pi * N_TAPS * (1 - 1 / OVERSAMPLING)
    w[near] = np.sinc(away[near]) * i0(shape * np.sqrt(1 - (away[near] / N_TAPS) ** 2)) / i0(shape)
    turn = 2 * np.pi * (q - nodes[0]) * middle, 2 * np.pi * (nodes - nodes[0]) * middle
    (cosine, sine), (node_cosine, node_sine) = ((np.cos(a), np.sin(a)) for a in turn)
    out = np.empty((len(q), 2, len(nodes), 2))
    out[:, 0, :, 0] = out[:, 1, :, 1] = w * (cosine[:, None] * node_cosine + sine[:, None] * node_sine)
    out[:, 0, :, 1] = w * (sine[:, None] * node_cosine - cosine[:, None] * node_sine)
    out[:, 1, :, 0] = -out[:, 0, :, 1]
    return out.reshape(2 * len(q), 2 * len(nodes))
