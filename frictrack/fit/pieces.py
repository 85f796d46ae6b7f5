"""Pieces: the parts of runs that are fitted as one, with their measurement, its noise and what drives them.

The noise is white, with a standard deviation per frame, plus in some sensors a first-order autoregressive part (rms,
correlation time), plus the integral of the errors of measured speeds, a Wiener process, plus the double integral of
those of a measured drive, which move the mass of the model but not the real one (Wahba 1978, J. R. Stat. Soc. B 40).
Differences of neighbouring frames leave nothing of what such parts pass on, so that the covariance of the differences
is banded and its Cholesky factor whitens them (Rue & Held 2005, Gaussian Markov Random Fields). The map is exact across
missing frames and linear, so it also applies to sensitivities.

"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.linalg import cholesky_banded, solve_banded

from frictrack.effects import OF_RUNS, Path, Span, direction_of_motion, joined_paths
from frictrack.records import Array, Mask
from frictrack.simulate.dynamics import CollocationSolution, Panels, directions, mean_directions

Rows = NDArray[np.int_]
MAX_SIGMA = 1e5  # times the usual one; a frame with more noise adds no information
MIN_CYCLES, MAX_CYCLE_ERROR = 2, 0.01  # of strokes that repeat; relative error of the times at which they begin
SERIES = ("drive", "lift", "angle")  # of a path: what a run may know at every node besides its motion


@dataclass(frozen=True, eq=False)
class Whitening:
    """The linear map from errors (n, ...) to independent ones of standard deviation one.

    It is D^-1 (I - P)^-1 (I - C): C and P have k diagonals below the main one. I - C leaves nothing of k states that
    the errors pass on from frame to frame, P what the innovations of standard deviations D add to later rows.

    Attributes
    ----------
    size : array of shape (n,)
        The diagonal of D.
    correlation, persistence : array of shape (k, n), optional
        Row j - 1 holds the entries j to the left of the diagonals of C and P; None where all noise is white.

    """

    size: Array
    correlation: Array | None = None
    persistence: Array | None = None

    @classmethod
    def of(
        cls, t: Array, sigma: Array, correlated: tuple[float, ...] = (), walk: float = 0.0, push: float = 0.0
    ) -> Whitening:
        """For frames at t (n,), s, with white noise sigma (n,), m, and three further parts.

        `correlated` is that of first order: rms, m, and correlation time, s. `walk` and `push` are the spectral
        densities of white errors of the speed, (m/s)^2 s, which the position integrates from its start on, and of the
        acceleration, (m/s^2)^2 s, which it integrates twice.

        Examples
        --------
        >>> w = Whitening.of(np.arange(3.0), np.full(3, 1e-9), (2.0, 1 / np.log(2.0)))
        >>> w.whitened(np.array([2.0, 1.0, 0.5])).round(6)
        array([1., 0., 0.])

        """
        n, integrals = len(t), 2 if push else int(walk > 0)
        k = bool(correlated) + integrals
        if not k:
            return cls(sigma)
        rms, time = correlated or (0.0, 1.0)
        sigma = np.minimum(sigma, MAX_SIGMA * np.median(sigma))
        place = np.arange(n)[:, None] + np.arange(-2 * k, 1)
        since = t[np.maximum(place, 0)] - t[np.maximum(place[:, :1], 0)]  # in the 2 k frames before each
        states = [np.exp(-since / time)] * bool(correlated) + [np.ones_like(since), since][:integrals]
        weight = np.zeros((n, k + 1))
        weight[:, k] = 1.0
        near = np.stack(states, axis=1)[k:, :, k:]
        weight[k:, :k] = -np.linalg.solve(near[:, :, :k], near[:, :, k:])[:, :, 0]
        early, late = (cut(since[:, :, None], since[:, None, :]) for cut in (np.minimum, np.maximum))
        shared = rms**2 * np.exp((early - late) / time) + walk * early + push * early**2 * (3 * late - early) / 6
        shared += np.eye(2 * k + 1) * sigma[np.maximum(place, 0), None] ** 2
        bands = np.zeros((k + 1, n))
        for j in range(k + 1):  # covariances of what is left of neighbouring frames
            part = shared[j:, k:, k - j : 2 * k + 1 - j]
            bands[j, : n - j] = np.einsum("na,nab,nb->n", weight[j:], part, weight[: n - j])
        root = cholesky_banded(bands, lower=True)
        size, kept = root[0], np.zeros((k, n))
        for j in range(k):
            kept[j, j + 1 :] = -root[j + 1, : n - j - 1] / size[: n - j - 1]
        return cls(size, -weight[:, k - 1 :: -1].T, kept)

    def whitened(self, errors: Array) -> Array:
        """Compute the innovations (n, ...) of errors (n, ...), in units of their standard deviation."""
        return _solved(self.persistence, _times(self.correlation, errors)) / _column(self.size, errors)

    def coloured(self, white: Array) -> Array:
        """Compute the errors (n, ...) that have these innovations."""
        return _solved(self.correlation, _times(self.persistence, white * _column(self.size, white)))

    def transposed(self, white: Array) -> Array:
        """Apply the transposed map of `whitened`."""
        return _times(self.correlation, _solved(self.persistence, white / _column(self.size, white), up=True), up=True)

    def coloured_transposed(self, rows: Array) -> Array:
        """Apply the transposed map of `coloured` to rows (n, ...)."""
        return _times(self.persistence, _solved(self.correlation, rows, up=True), up=True) * _column(self.size, rows)


def _times(share: Array | None, series: Array, *, up: bool = False) -> Array:
    """Compute (I - S) times a series (n, ...) with the lower diagonals S, or `up` the transposed matrix."""
    if share is None:
        return series
    out = series.copy()
    for j, own in enumerate(share, 1):
        weight = _column(own[j:], series)
        if up:
            out[:-j] -= weight * series[j:]
        else:
            out[j:] -= weight * series[:-j]
    return out


def _solved(share: Array | None, series: Array, *, up: bool = False) -> Array:
    """Compute (I - S)^-1 times a series (n, ...), or `up` that of the transposed matrix."""
    if share is None:
        return series
    k = len(share)
    banded = np.ones((k + 1, len(series)))
    for j, own in enumerate(share, 1):
        banded[(k - j, slice(j, None)) if up else (j, slice(-j))] = -own[j:]
    flat = series.reshape(len(series), -1)
    solution = solve_banded((0, k) if up else (k, 0), banded, flat, check_finite=False)
    return np.asarray(solution).reshape(series.shape)


def _column(values: Array, like: Array) -> Array:
    """Values (n,) reshaped to multiply an array (n, ...)."""
    return values.reshape(-1, *[1] * (like.ndim - 1))


@dataclass(frozen=True)
class Piece:
    """One part of a run: measured displacement and what drives it.

    It has no stop or reversal, unless it is followed through these (`turns`). Times count from release. Shapes are
    (n,) at the frames and (3 p,) at the nodes of the p `panels`.
    """

    run: int
    frames: Rows  # row of each frame in the run's tables
    t: Array
    y: Array
    sigma: Array
    panels: Panels
    at: Rows  # which edge of the panels each frame is
    per_frame: int  # panels per frame interval
    x_hat: Array  # smoothed motion at the nodes: the first guess
    v_hat: Array
    a_hat: Array
    known: Array  # acceleration by drive and incline at the nodes, m/s^2
    path: Path  # load, drive and further series of the run; its motion is replaced by the simulated one
    mass: float
    way: Array = field(default_factory=lambda: np.empty((3, 0)))  # t, x, v of the run's smoothed motion since release
    angle: Array | None = None  # rad, at the frames
    cut: bool = False  # a part of a longer piece
    turns: bool = False  # followed through stops and reversals; the direction is that of the simulated motion
    gain: float = 0.0  # m/s that a mass gains in a frame where it turns, if it swings back by itself
    slack: float = 0.0  # m/s within which the direction of a swinging mass changes, if it does not turn at once
    systematic: float = 0.0  # m rms of slow systematic errors
    correlated: tuple[float, ...] = ()  # correlated noise: rms in m, correlation time in s
    walk: float = 0.0  # spectral density of the errors of measured speeds, (m/s)^2 s
    push: float = 0.0  # spectral density of the errors of the drive over the mass, (m/s^2)^2 s
    step: float = 0.0  # resolution of the positions, m
    shake: tuple[float, ...] = ()  # remaining camera shake: frequency in Hz, rms in m
    locked: float = 0.0  # share of the noise variance that the tracker does not state; it may be peak locking
    clock: float = 1.0  # factor on the recorded times
    clock_error: float = 0.0  # relative standard deviation of their interval

    @cached_property
    def whitening(self) -> Whitening:
        """The map from errors at the frames, m, to independent numbers of standard deviation one."""
        return Whitening.of(self.t, self.sigma, self.correlated, self.walk, self.push)

    def whitened(self, errors: Array) -> Array:
        """Convert errors (n, ...) at the frames, m, to independent numbers of standard deviation one."""
        return self.whitening.whitened(errors)

    def coloured(self, white: Array) -> Array:
        """Convert independent numbers (n, ...) of standard deviation one to errors, m: the inverse of `whitened`."""
        return self.whitening.coloured(white)

    @property
    def noise(self) -> Array:
        """Standard deviation of all noise at the frames (n,), m."""
        return np.hypot(self.sigma, self.correlated[0]) if self.correlated else self.sigma

    def path_at_nodes(self, x: Array, v: Array, level: float) -> Path:
        """Return the path at the nodes for a motion x, v (3 p,) there, its load times the friction `level`."""
        return replace(self.path, x=x, v=v, s=self.direction(v), load=self.path.load * level).pressed()

    def at_frames(self, x: Array, v: Array, level: float) -> Path:
        """Return the path at the frames for a motion x, v (n,) there, its load times the friction `level`."""
        s = self.mean_direction(v) if self.turns else np.full_like(x, self.path.s[0])
        series = self._series(self._nodes_to_frames) | {"angle": self.angle}
        return replace(self.path, t=self.t, x=x, v=v, s=s, load=self.path.load * level, **series).pressed()

    @property
    def known_at_frames(self) -> Array:
        """Acceleration by drive and incline at the frames, m/s^2."""
        return self._nodes_to_frames(self.known)

    def _nodes_to_frames(self, series: Array) -> Array:
        """A series at the frames; the first frame lies before the first node."""
        return np.asarray(make_interp_spline(self.panels.t, series, k=1)(self.t))

    def _series(self, of: Callable[[Array], Array]) -> dict[str, Any]:
        """Series of the path besides its motion, mapped by `of` from the nodes to other points."""
        return {name: of(q) for name in SERIES if (q := getattr(self.path, name)) is not None}

    def direction(self, v: Array) -> Array:
        """Direction of motion (3 p,) for velocities at the nodes; a swinging mass turns within its panels."""
        if not self.turns:
            return self.path.s
        return directions(self.panels, v) if self.gain and not self.slack else self.direction_at(v)

    def mean_direction(self, v: Array) -> Array:
        """Direction of motion (n,) of a piece that turns, at its frames; of a swing its mean about each frame."""
        return mean_directions(v) if self.gain else self.direction_at(v)

    def direction_at(self, v: Array) -> Array:
        """Direction of motion (n,) of a piece that turns, at any points.

        At rest it is the last one; 0 at first where the piece begins at rest.
        """
        if self.slack:
            near = np.clip(v / self.slack, -1.0, 1.0)
            return near * (2.25 - 1.25 * near**2)  # moves a mass as a sign does, as its first moment is the same
        s = direction_of_motion(v)
        if self.path.s[0] == 0:
            s[0] = 0.0
        return s

    def refined(self, per_frame: int) -> Piece:
        """Return the same piece with `per_frame` panels per frame interval."""
        edges, at = panel_edges(self.t, per_frame)
        panels = Panels(edges)
        old, new = self.panels.t, panels.t
        moved = {name: np.interp(new, old, getattr(self, name)) for name in ("x_hat", "v_hat", "a_hat", "known")}
        still = np.zeros_like(new)
        series = self._series(lambda q: np.interp(new, old, q))
        path = replace(self.path, t=new, x=still, v=still, s=still + self.path.s[0], **series)
        return replace(self, panels=panels, at=at, per_frame=per_frame, path=path, **moved)

    def with_clock(self, clock: float, ways: dict[tuple[int, float], Array] | None = None) -> Piece:
        """Return the same piece with all times since release multiplied by `clock` relative to the recorded ones.

        `ways`: of runs, which their pieces share; filled in.
        """
        by, ways = clock / self.clock, {} if ways is None else ways
        if by == 1.0:
            return self
        path, key = self.path, (id(self.way), by)
        if key not in ways:
            ways[key] = self.way * np.array([[by], [1.0], [1.0 / by]])  # t, x, v
        way = ways[key]
        path = replace(
            path,
            t=by * path.t,
            v=path.v / by,
            drive_at=None if path.drive_at is None else partial(_at_scaled_time, path.drive_at, by),
            lift=None if path.lift is None else path.lift / by**2,
            before=None if path.before is None else way[:, : path.before.shape[1]],  # of the way, as before
        )
        return replace(
            self,
            t=by * self.t,
            panels=Panels(by * self.panels.edges),
            v_hat=self.v_hat / by,
            a_hat=self.a_hat / by**2,
            path=path,
            way=way,
            gain=self.gain / by,
            clock=clock,
        )

    def in_mass_units(self, mass: float) -> Piece:
        """Return the same piece with its equation of motion in units of another mass (kg)."""
        drive = 0.0 if self.path.drive is None else self.path.drive
        push = self.push * (self.mass / mass) ** 2
        return replace(self, mass=mass, push=push, known=self.known - drive / self.mass + drive / mass)

    def of_mass(self, ratio: float, load_ratio: float) -> Piece:
        """Return the same piece of a run whose mass and normal load are so many times the stated ones."""
        path = self.path
        path = replace(
            path,
            load=path.load * load_ratio,
            gravity=path.gravity * load_ratio / ratio,
            mass_ratio=path.mass_ratio * ratio,
            mass=None if path.mass is None else path.mass * ratio,
        )
        return replace(self.in_mass_units(self.mass * ratio), path=path)

    def part(self, start: int, stop: int) -> Piece:
        """Return the frames from `start` up to `stop` as a piece."""
        low, high = int(self.at[start]), int(self.at[stop - 1])
        nodes = slice(3 * low, 3 * high)
        at_nodes = {name: getattr(self, name)[nodes] for name in ("x_hat", "v_hat", "a_hat", "known")}
        at_frames = {name: getattr(self, name)[start:stop] for name in ("frames", "t", "y", "sigma")}
        s = self.path.s[nodes]
        if self.turns and low:  # the direction at its first node
            s = np.full_like(s, direction_of_motion(self.v_hat[: 3 * low + 1])[-1])
        path = replace(
            self.path,
            before=motion_before(self.way, self.t[start]),
            **{name: getattr(self.path, name)[nodes] for name in ("t", "x", "v")},
            s=s,
            **self._series(lambda q: q[nodes]),
        )
        angle = None if self.angle is None else self.angle[start:stop]
        panels, at = Panels(self.panels.edges[low : high + 1]), self.at[start:stop] - low
        return replace(self, panels=panels, path=path, at=at, angle=angle, **at_nodes, **at_frames)


def cut_rows(frames: int, n: int) -> list[Rows]:
    """Cut the rows of some frames into parts of about n; 0 leaves them whole."""
    return np.array_split(np.arange(frames), max(1, round(frames / n)) if n else 1)


def displacement_rows(piece: Piece, forces: Array) -> Array:
    """Compute displacements per unit of forces (3 p, K) at the nodes, then the measured less the known one, (n, K + 1).

    They are whitened: in standard deviations. The start is still in them.
    """
    inputs = np.column_stack([-forces / piece.mass, piece.known])
    x = np.column_stack([piece.panels.integrate(g, 0.0, 0.0)[2][piece.at] for g in inputs.T])
    return piece.whitened(np.column_stack([x[:, :-1], piece.y - x[:, -1]]))


def without_starts(piece: Piece, rows: Array, n: int = 0) -> list[Array]:
    """Cut whitened rows (n, k) into windows of about n frames, and project start position and speed of each out."""
    start, out = piece.whitened(np.column_stack([np.ones_like(piece.t), piece.t - piece.t.mean()])), []
    for cut in cut_rows(len(rows), n):
        q, _ = np.linalg.qr(start[cut])
        out.append(rows[cut] - q @ (q.T @ rows[cut]))
    return out


def panel_edges(t: Array, per_frame: int) -> tuple[Array, Rows]:
    """Panel edges through the frame times t (n,), no panel longer than a frame, and the edge index of each frame."""
    interval = np.diff(t)
    count = per_frame * np.maximum(1, np.rint(interval / np.median(interval)).astype(int))
    at = np.concatenate([[0], np.cumsum(count)])
    return np.interp(np.arange(at[-1] + 1), at, t), at


def motion_before(way: Array, t: float) -> Array:
    """The part of a motion (3, k) up to time t."""
    return way[:, : int(np.searchsorted(way[0], t, side="right"))]


def _at_scaled_time(series: Callable[[Array], Array], by: float, t: Array) -> Array:
    return series(t / by)


def spans_of(pieces: Sequence[Piece], n_runs: int, fps: float) -> tuple[Span, ...]:
    """Compute the span of every run: duration, places and speeds."""
    return tuple(_span([p for p in pieces if p.run == r], fps) for r in range(n_runs))


def _span(pieces: Sequence[Piece], fps: float) -> Span:
    speeds, path = np.abs(np.concatenate([p.v_hat for p in pieces])), pieces[0].path
    return Span(
        duration=max(float(p.t[-1]) for p in pieces),
        x_min=min(float(p.y.min()) for p in pieces),
        x_max=max(float(p.y.max()) for p in pieces),
        v_min=float(speeds.min()),
        v_max=float(speeds.max()),
        fps=fps,
        clamp_x=path.clamp_x,
        beam_length=path.beam_length,
        earlier=(path.earlier or ((),))[0],
        cycle=cycle_of(np.concatenate([p.t for p in pieces]), np.concatenate([p.y for p in pieces])),
    )


def cycle_of(t: Array, x: Array) -> float:
    """Time (s) after which a motion to and fro at times t (n,) repeats itself; 0 where it does not, or not evenly."""
    from_middle = x - (np.max(x) + np.min(x)) / 2.0
    far = np.flatnonzero(np.abs(from_middle) > np.ptp(x) / 4.0)
    begins = t[far[1:][np.diff(np.sign(from_middle[far])) > 0]]
    if len(begins) < MIN_CYCLES + 1:
        return 0.0
    cycle, first = np.polyfit(number := np.arange(len(begins)), begins, 1)
    return float(cycle) if np.max(np.abs(begins - first - cycle * number)) < MAX_CYCLE_ERROR * cycle else 0.0


@dataclass(frozen=True)
class Samples:
    """Where a model is evaluated along joined pieces: n samples, some of the edges and nodes of the panels.

    Attributes
    ----------
    source : array of int, shape (n,)
        Position of every sample among all edges, followed by all nodes.
    nodes : array of int, shape (n,)
        Node at which the series of the run are read.
    t : array of shape (n,)
        Time, s.
    is_node : array of bool, shape (n,)
        Whether it is a node.
    pieces : list of slice
        Samples of every piece.
    starts : tuple of int
        Samples at which the model begins anew, from what it remembers there.
    runs : tuple of Path
        Path of every piece at the samples, without motion; empty if there is only one.

    """

    source: Rows
    nodes: Rows
    t: Array
    is_node: Mask
    pieces: list[slice]
    starts: tuple[int, ...]
    runs: tuple[Path, ...] = ()

    def of(self, motion: CollocationSolution) -> tuple[Array, Array]:
        """Position and velocity of a motion at the samples, (n,) each."""
        x, v = np.concatenate([motion.x_edge, motion.x]), np.concatenate([motion.v_edge, motion.v])
        return x[self.source], v[self.source]


@dataclass(frozen=True, eq=False)
class JoinedPieces:
    """Pieces laid end to end, so that one evaluation of a model serves them all.

    Their nodes follow each other in every array (3 p,), p panels in all.
    """

    pieces: tuple[Piece, ...]

    @cached_property
    def panels(self) -> Panels:
        """The panels of all pieces."""
        return Panels.joined([piece.panels for piece in self.pieces])

    @cached_property
    def known(self) -> Array:
        """Acceleration by drive and incline at the nodes, m/s^2, (3 p,)."""
        return np.concatenate([piece.known for piece in self.pieces])

    @cached_property
    def mass(self) -> float | Array:
        """Mass at the nodes, kg, (3 p,); a number where all pieces have the same."""
        return self.spread([piece.mass for piece in self.pieces])

    @cached_property
    def nodes(self) -> list[slice]:
        """Nodes of every piece."""
        return consecutive_slices([3 * len(piece.panels.h) for piece in self.pieces])

    @cached_property
    def edges(self) -> list[slice]:
        """Edges of every piece."""
        return consecutive_slices([len(piece.panels.edges) for piece in self.pieces])

    def spread(self, values: Sequence[float]) -> float | Array:
        """One value per piece, for each of its nodes (3 p,); a number where all are the same."""
        first = values[0]
        return first if all(v == first for v in values) else self.panels.per_node(np.array(values))

    @cached_property
    def at_nodes(self) -> Samples:
        """The nodes."""
        return self._samples(len(self.panels.edges) + np.arange(len(self.panels.t)), np.arange(len(self.panels.t)))

    @cached_property
    def since_start(self) -> Samples:
        """The nodes, and in front of those of every piece its start: a path for a law with memory."""
        first = 3 * self.panels.first
        source = np.insert(self.at_nodes.source, first, np.array(self.panels.starts))
        return self._samples(source, np.insert(self.at_nodes.nodes, first, first))

    @cached_property
    def with_edges(self) -> Samples:
        """All edges and nodes in order of time."""
        panels, nodes = self.panels, self.at_nodes.nodes.reshape(-1, 3)
        source = np.column_stack([panels.begin, self.at_nodes.source.reshape(-1, 3)]).ravel()
        after = panels.first + panels.counts
        last = np.array([*panels.starts[1:], len(panels.edges)]) - 1
        near = np.insert(nodes[:, [0, 0, 1, 2]].ravel(), 4 * after, nodes[after - 1, 2])
        return self._samples(np.insert(source, 4 * after, last), near)

    @cached_property
    def within_panels(self) -> Samples:
        """Every panel alone: where it begins, its nodes, and where it ends."""
        begin, nodes = self.panels.begin, self.at_nodes.nodes.reshape(-1, 3)
        source = np.column_stack([begin, self.at_nodes.source.reshape(-1, 3), begin + 1])
        return self._samples(source.ravel(), nodes[:, [0, 0, 1, 2, 2]].ravel(), alone=source.shape[1])

    def _samples(self, source: Rows, nodes: Rows, alone: int = 0) -> Samples:
        t = np.concatenate([self.panels.edges, self.panels.t])[source]
        ends = np.searchsorted(nodes, 3 * np.cumsum(self.panels.counts))
        pieces = [slice(int(a), int(b)) for a, b in itertools.pairwise([0, *ends])]
        starts = tuple(range(0, len(t), alone)) if alone else tuple(own.start for own in pieces)
        runs = self._runs_at(t, nodes, pieces, starts)
        return Samples(source, nodes, t, source >= len(self.panels.edges), pieces, starts, runs)

    def path(  # noqa: PLR0913, PLR0917 - all that a law may look at
        self,
        samples: Samples,
        x: Array,
        v: Array,
        levels: Sequence[float],
        states: Mapping[str, Array] | None = None,
        heading: Array | None = None,
        sharp: bool = False,
    ) -> Path:
        """Return the path of a motion x, v (n,) at some samples, its loads times the levels of the pieces.

        `states` is what the effects remember where each individual begins. The direction is that of the velocities
        `heading`, by default v. A law that does not jump at a reversal needs the `sharp` one, that of the moment.
        """
        same, base = samples is self.at_nodes, self._path
        s = base.s if same else base.s[samples.nodes]
        if any(piece.turns for piece in self.pieces):
            s, heading = s.copy(), v if heading is None else heading
            for piece, own in zip(self.pieces, samples.pieces, strict=True):
                if piece.turns:
                    s[own] = piece.direction_at(heading[own])
                if piece.gain and not sharp:
                    at = np.flatnonzero(samples.is_node[own]) + own.start
                    s[at] = piece.direction(heading[at])
        loads = [p.path.load * level for p, level in zip(self.pieces, levels, strict=True)]
        load = loads[0] if len(loads) == 1 else self.spread([float(own) for own in loads])
        if same:
            return replace(base, x=x, v=v, s=s, load=load).pressed()
        known: dict[str, Any] = {
            name: value[samples.nodes]
            for name in (*SERIES, *OF_RUNS)
            if isinstance(value := getattr(base, name), np.ndarray)
        }
        earlier = base.earlier
        if earlier is not None and samples.runs:
            earlier = tuple(own for own, run in zip(earlier, samples.runs, strict=True) for _ in run.starts)
        return replace(
            base,
            **known,
            t=samples.t,
            x=x,
            v=v,
            s=s,
            load=load[samples.nodes] if isinstance(load, np.ndarray) else load,
            starts=samples.starts,
            earlier=earlier,
            states=states or {},
            runs=samples.runs,
        ).pressed()

    def _runs_at(self, t: Array, nodes: Rows, pieces: Sequence[slice], starts: Sequence[int]) -> tuple[Path, ...]:
        """The path of every piece at some samples, without motion; empty if there is only one."""
        out = []
        for piece, own, theirs in zip(self.pieces, pieces, self.nodes, strict=True):
            rows = nodes[own] - theirs.start
            series = {name: q[rows] for name in SERIES if (q := getattr(piece.path, name)) is not None}
            first = tuple(start - own.start for start in starts if own.start <= start < own.stop)
            out.append(replace(piece.path, t=t[own], starts=first, **series))
        return tuple(out) if len(out) > 1 else ()

    @cached_property
    def _path(self) -> Path:
        """The path of all pieces at the nodes, without motion."""
        if len(self.pieces) == 1:
            return self.pieces[0].path
        paths = [piece.path for piece in self.pieces]
        zeros = np.zeros(len(self.panels.t))
        return replace(joined_paths(paths), t=self.panels.t, x=zeros, v=zeros, runs=tuple(paths))


def consecutive_slices(counts: Iterable[int]) -> list[slice]:
    """Return the slices of parts of given sizes that follow one another."""
    return [slice(int(a), int(b)) for a, b in itertools.pairwise(np.cumsum([0, *counts]))]


def column_norms(columns: Array) -> Array:
    """Compute the norms (P,) of columns (N, P); one for a column of zeros, so that columns can be divided by them."""
    norm = np.linalg.norm(columns, axis=0)
    norm[norm == 0] = 1.0
    return np.asarray(norm)
