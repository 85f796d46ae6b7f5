"""Cut runs into pieces of one direction: the measurement there, and what a model needs to know of the run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, make_interp_spline

from frictrack.effects import Path, Span, direction_of_motion
from frictrack.errors import FrictrackError
from frictrack.fit.segments.release import Reference, RunContext, run_context
from frictrack.fit.segments.swings import join_swings
from frictrack.fit.segments.whitening import Whitening
from frictrack.friction import free_section, is_moving, moving_sections
from frictrack.motion import noise_level
from frictrack.records import GRAVITY, Array, Mask, Run
from frictrack.simulate.dynamics import Panels

Rows = NDArray[np.int_]

MIN_NOISE_OF_TRAVEL = 1e-9  # motions are solved to 1e-13 m, and singular values of 1e-8 are the last that count
MIN_FRAMES = 8  # fewer leave no information beyond start position and speed


@dataclass(frozen=True)
class Piece:
    """One stretch of a run: measured displacement and what drives it.

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
    cut: bool = False  # a segment of a longer stretch
    turns: bool = False  # followed through stops and reversals; the direction is that of the simulated motion
    slack: float = 0.0  # m/s: speed within which the direction of a swinging mass changes at a reversal
    systematic: float = 0.0  # m rms of slow systematic errors
    correlated: tuple[float, ...] = ()  # correlated noise: rms in m, correlation time in s
    step: float = 0.0  # resolution of the positions, m
    shake: tuple[float, ...] = ()  # remaining camera shake: frequency in Hz, rms in m
    locked: float = 0.0  # share of the noise variance that the tracker does not state; it may be peak locking
    clock: float = 1.0  # factor on the recorded times

    @cached_property
    def whitening(self) -> Whitening | None:
        """The map of correlated noise to white noise; None where the noise is white."""
        return Whitening.of(self.t, self.sigma, (self.correlated[0], self.correlated[1])) if self.correlated else None

    def whitened(self, errors: Array) -> Array:
        """Convert errors (n, ...) at the frames, m, to independent numbers of standard deviation one."""
        way = self.whitening
        return np.asarray((errors.T / self.sigma).T) if way is None else way.whitened(errors)

    def coloured(self, white: Array) -> Array:
        """Convert independent numbers (n, ...) of standard deviation one to errors, m: the inverse of `whitened`."""
        way = self.whitening
        return np.asarray((white.T * self.sigma).T) if way is None else way.coloured(white)

    def whitened_transposed(self, white: Array) -> Array:
        """Apply the transpose of `whitened`."""
        way = self.whitening
        return np.asarray((white.T / self.sigma).T) if way is None else way.transposed(white)

    def coloured_transposed(self, rows: Array) -> Array:
        """Apply the transpose of `coloured`."""
        way = self.whitening
        return np.asarray((rows.T * self.sigma).T) if way is None else way.coloured_transposed(rows)

    @property
    def noise(self) -> Array:
        """Standard deviation of all noise at the frames (n,), m."""
        return np.hypot(self.sigma, self.correlated[0]) if self.correlated else self.sigma

    def path_at_nodes(self, x: Array, v: Array, level: float) -> Path:
        """Return the path at the nodes for a motion.

        Parameters
        ----------
        x, v : array of shape (3 p,)
            Position, m, and velocity, m/s, at the nodes.
        level : float
            Friction level of the run.

        Returns
        -------
        Path
            The path with this motion, its load times `level`.

        """
        return replace(self.path, x=x, v=v, s=self.direction(v), load=self.path.load * level)

    def direction(self, v: Array) -> Array:
        """Return the direction of motion (3 p,) at the nodes for velocities there."""
        return self._direction(v) if self.turns else self.path.s

    def path_since_start(self, x: Array, v: Array, t: Array, level: float, first: int = 0) -> Path:
        """Return the path from the start of the piece through its first k nodes, (1 + k,), for a model with memory.

        With `first`, it begins at the last of so many nodes instead of the start.
        """
        rows = self.rows_after(first, len(t))
        s = self._direction(v, begins=not first) if self.turns else self.path.s[rows]
        series = self._series(lambda q: q[rows])
        return replace(self.path, t=t, x=x, v=v, s=s, load=self.path.load * level, **series)

    @staticmethod
    def rows_after(first: int, n: int) -> Rows:
        """Rows of n nodes from the last of the `first` ones on; the start takes the values of the first node."""
        return np.maximum(np.arange(first - 1, first - 1 + n), 0)

    def _direction(self, v: Array, *, begins: bool = True) -> Array:
        """Sign of the velocity (n,), at rest the last one; 0 at first where the piece begins, and at rest."""
        if self.slack:
            return np.clip(v / self.slack, -1.0, 1.0)
        s = direction_of_motion(v)
        if begins and self.path.s[0] == 0:
            s[0] = 0.0
        return s

    def refined(self, per_frame: int) -> Piece:
        """Return the same piece with `per_frame` panels per frame interval."""
        edges, at = _panel_edges(self.t, per_frame)
        panels = Panels(edges)
        old, new = self.panels.t, panels.t
        moved = {name: np.interp(new, old, getattr(self, name)) for name in ("x_hat", "v_hat", "a_hat", "known")}
        still = np.zeros_like(new)
        series = self._series(lambda q: np.interp(new, old, q))
        path = replace(self.path, t=new, x=still, v=still, s=still + self.path.s[0], **series)
        return replace(self, panels=panels, at=at, per_frame=per_frame, path=path, **moved)

    def with_clock(self, clock: float) -> Piece:
        """Return the same piece with all times since release multiplied by `clock` relative to the recorded ones."""
        by = clock / self.clock
        if by == 1.0:
            return self
        path = replace(
            self.path,
            t=by * self.path.t,
            v=self.path.v / by,
            drive_at=_series_with_time_scaled(self.path.drive_at, by),
            lift=None if self.path.lift is None else self.path.lift / by**2,
            before=None if self.path.before is None else _with_time_scaled(self.path.before, by),
        )
        return replace(
            self,
            t=by * self.t,
            panels=Panels(by * self.panels.edges),
            v_hat=self.v_hat / by,
            a_hat=self.a_hat / by**2,
            path=path,
            way=_with_time_scaled(self.way, by),
            slack=self.slack / by,
            clock=clock,
        )

    def first(self, n: int) -> Piece:
        """Return the first n frames of the piece."""
        return self.part(0, n)

    def part(self, start: int, stop: int) -> Piece:
        """Return the frames from `start` up to `stop` as a piece."""
        low, high = int(self.at[start]), int(self.at[stop - 1])
        nodes = slice(3 * low, 3 * high)
        at_nodes = {name: getattr(self, name)[nodes] for name in ("x_hat", "v_hat", "a_hat", "known")}
        at_frames = {name: getattr(self, name)[start:stop] for name in ("frames", "t", "y", "sigma")}
        path = replace(
            self.path,
            before=_motion_before(self.way, self.t[start]),
            **{name: getattr(self.path, name)[nodes] for name in ("t", "x", "v")},
            s=self._direction_at_nodes(low, high),
            **self._series(lambda q: q[nodes]),
        )
        angle = None if self.angle is None else self.angle[start:stop]
        panels, at = Panels(self.panels.edges[low : high + 1]), self.at[start:stop] - low
        return replace(self, panels=panels, path=path, at=at, angle=angle, **at_nodes, **at_frames)

    def _direction_at_nodes(self, low: int, high: int) -> Array:
        """Direction of motion at the nodes of some panels; of a piece with reversals, the one at the first of them."""
        s = self.path.s[3 * low : 3 * high]
        return np.full_like(s, direction_of_motion(self.v_hat[: 3 * low + 1])[-1]) if self.turns and low else s

    def _series(self, of: Callable[[Array], Array]) -> dict[str, Any]:
        """Series measured beside the motion, mapped by `of` from the nodes to other points."""
        known = {name: getattr(self.path, name) for name in ("drive", "lift", "angle")}
        return {name: of(q) for name, q in known.items() if q is not None}

    @property
    def known_at_frames(self) -> Array:
        """Acceleration by drive and incline at the frames, m/s^2. The first frame lies before the first node."""
        out: Array = make_interp_spline(self.panels.t, self.known, k=1)(self.t)
        return out

    def at_frames(self, x: Array, v: Array, level: float) -> Path:
        """Return the path at the frames.

        Parameters
        ----------
        x, v : array of shape (n,)
            Position, m, and velocity, m/s, at the frames.
        level : float
            Friction level of the run.

        Returns
        -------
        Path
            The path with this motion, its load times `level`.

        """
        s = self._direction(v) if self.turns else np.full_like(x, self.path.s[0])
        series = self._series(lambda q: make_interp_spline(self.panels.t, q, k=1)(self.t)) | {"angle": self.angle}
        return replace(self.path, t=self.t, x=x, v=v, s=s, load=self.path.load * level, **series)


def joined_whitening(pieces: Sequence[Piece]) -> Callable[[Array], Array]:
    """Return the map that whitens errors (m, ...) at the frames of several pieces end to end.

    The pieces all have correlated noise, or none has.
    """
    parts = [w for p in pieces if (w := p.whitening) is not None]
    if parts:
        return Whitening.joined(parts).whitened
    sigma = np.concatenate([p.sigma for p in pieces])
    return lambda errors: np.asarray((errors.T / sigma).T)


def pieces_of(
    run: Run, index: int, free: Mask, reference: Reference, *, through_reversals: bool = False
) -> list[Piece]:
    """Cut one run into pieces of one direction, of at least `MIN_FRAMES` frames.

    Parameters
    ----------
    run : Run
        The run.
    index : int
        Its index among the runs.
    free : array of bool
        Frames of the free section.
    reference : Reference
        Mass and load at which newtons are reported. An unknown mass is counted in units of the reference mass.
    through_reversals : bool
        Whether the model can pass stops and reversals. A run with a measured drive is then one piece.

    Returns
    -------
    list of Piece
        The pieces in order of time.

    Raises
    ------
    FrictrackError
        If the run has neither mass nor drive, or no usable stretch.

    """
    if run.mass is None and run.drive is None:
        raise FrictrackError(f'run "{run.name}": expected a mass for a fit of the displacement but got none')
    disp = run.displacement
    use = free & disp.valid
    noise = relative_noise(disp.sigma_x, use)
    white = float(noise_level(disp.x, use, noise)[0])
    noise = noise * (run.noise or max(white, least_noise(run), disp.resolution / float(np.sqrt(12.0))))
    context = run_context(run, reference)
    sections = moving_sections(run)
    if through_reversals and run.drive is not None and _stops_or_reverses(sections):
        return [_through_reversals(run, index, noise, context)]
    made = []
    for section, slack in join_swings(run, sections):
        rows = np.arange(len(disp))[section]
        rows = rows[disp.valid[rows] & np.isfinite(disp.x[rows])]
        if len(rows) >= MIN_FRAMES:
            piece = _piece(run, index, rows, noise, context)
            made.append(replace(piece, turns=True, slack=slack) if slack else piece)
    if not made:
        raise FrictrackError(
            f'run "{run.name}": expected at least {MIN_FRAMES} free frames in one direction but found none; '
            "look at its velocity, or give free = [t0, t1]"
        )
    return made


def least_noise(run: Run) -> float:
    """Return the least noise of the positions of a run that a fit can use, m: fitted motions are not more accurate."""
    x = run.displacement.x[run.displacement.valid]
    return MIN_NOISE_OF_TRAVEL * float(np.nanmax(x) - np.nanmin(x))


def noise_free_remark(runs: Sequence[Run]) -> Iterator[str]:
    """Yield a sentence about runs whose positions have no noise, as computed ones."""
    free = [
        run.name
        for run in runs
        if run.noise is None and noise_level(run.displacement.x, run.displacement.valid)[0] < least_noise(run)
    ]
    if free:
        yield (
            f"the positions of {', '.join(free)} have no noise, as if they were computed; a noise of "
            f"{MIN_NOISE_OF_TRAVEL:g} of the travel is assumed, and the standard deviations do not tell how well a "
            "measurement determines the parameters"
        )


def _stops_or_reverses(sections: Sequence[slice]) -> bool:
    """Whether a run stops or reverses and then moves for at least `MIN_FRAMES` frames."""
    return sum(s.stop - s.start >= MIN_FRAMES for s in sections) > 1


def _through_reversals(run: Run, index: int, noise: Array, context: RunContext) -> Piece:
    """The whole record, or its given free section, in one piece; it begins at rest where its first frame does."""
    disp = run.displacement
    use = disp.valid & np.isfinite(disp.x)
    if run.free is not None:
        use &= (disp.t >= run.free[0]) & (disp.t <= run.free[1])
    rows = np.flatnonzero(use)
    piece = _piece(run, index, rows, noise, context)
    first = np.sign(run.motion.v[rows[0]]) if is_moving(run)[rows[0]] else 0.0
    return replace(piece, turns=True, path=replace(piece.path, s=np.full_like(piece.path.t, first)))


def whole_piece(run: Run, index: int, reference: Reference) -> Piece:
    """Return one piece over the whole record of a driven run, or over the free section of a pushed run.

    Its direction is 0 where the record begins at rest.
    """
    if run.drive is not None:
        noise = relative_noise(run.displacement.sigma_x, run.displacement.valid)
        return _through_reversals(run, index, noise, run_context(run, reference))
    free, _ = free_section(run)
    rows = np.flatnonzero(free & np.isfinite(run.displacement.x))
    noise = relative_noise(run.displacement.sigma_x, free)
    return _piece(run, index, rows, noise, run_context(run, reference))


def _panel_edges(t: Array, per_frame: int) -> tuple[Array, Rows]:
    """Panel edges through the frame times t (n,), no panel longer than a frame, and the edge index of each frame."""
    interval = np.diff(t)
    count = per_frame * np.maximum(1, np.rint(interval / np.median(interval)).astype(int))
    at = np.concatenate([[0], np.cumsum(count)])
    return np.interp(np.arange(at[-1] + 1), at, t), at


def relative_noise(sigma: Array, use: Mask) -> Array:
    """Convert the tracker's standard deviations to relative weights: 1 in the median frame, 1 where not stated."""
    known = np.isfinite(sigma) & (sigma > 0) & use
    if not known.any():
        return np.ones(len(sigma))
    relative = np.ones(len(sigma))
    relative[known] = sigma[known] / np.median(sigma[known])
    return relative


def _with_time_scaled(way: Array, by: float) -> Array:
    """A motion t, x, v (3, k) with its times multiplied by `by`."""
    return way * np.array([[by], [1.0], [1.0 / by]])


def _series_with_time_scaled(series: Callable[[Array], Array] | None, by: float) -> Callable[[Array], Array] | None:
    """A function of time with its times multiplied by `by`."""
    return None if series is None else partial(_at_scaled_time, series, by)


def _at_scaled_time(series: Callable[[Array], Array], by: float, t: Array) -> Array:
    return series(t / by)


def _motion_before(way: Array, t: float) -> Array:
    """The part of a motion (3, k) up to time t."""
    return way[:, : int(np.searchsorted(way[0], t, side="right"))]


def _piece(run: Run, index: int, rows: Rows, noise: Array, context: RunContext) -> Piece:
    mass = float(run.mass or context.reference.mass)
    t = run.displacement.t[rows] - context.release
    edges, at = _panel_edges(t, context.per_frame)
    panels = Panels(edges)
    nodes = panels.t
    motion = run.motion
    times = motion.t - context.release
    path = path_of_rows(run, rows, nodes, context)
    known = np.full(len(nodes), -GRAVITY * np.sin(run.incline))
    if path.drive is not None:
        known = known + path.drive / mass
    return Piece(
        run=index,
        frames=rows,
        t=t,
        y=run.displacement.x[rows],
        sigma=noise[rows],
        panels=panels,
        at=at,
        per_frame=context.per_frame,
        x_hat=CubicSpline(times, motion.x)(nodes),
        v_hat=CubicSpline(times, motion.v)(nodes),
        a_hat=np.interp(nodes, times, motion.a),
        known=known,
        path=path,
        mass=mass,
        way=context.way,
        angle=_interpolated(times, context.angle, t),
        systematic=float(np.hypot(run.displacement.systematic, run.drift or 0.0)),
        step=run.displacement.resolution,
        shake=run.displacement.shake,
        locked=_pixel_locked_share(run, rows, noise),
    )


def _pixel_locked_share(run: Run, rows: Rows, noise: Array) -> float:
    """Share of the measured variance of a film beyond what its tracker states; 0 for a table."""
    if not run.displacement.systematic or not run.pixel_pitch:
        return 0.0
    return max(0.0, 1 - float(np.mean(run.displacement.sigma_x[rows] ** 2) / np.mean(noise[rows] ** 2)))


def path_of_rows(run: Run, rows: Rows, nodes: Array, context: RunContext) -> Path:
    """Create the path of one piece at its nodes, without motion.

    Parameters
    ----------
    run : Run
        The run.
    rows : array of int
        Frames of the piece.
    nodes : array of shape (m,)
        Times of the nodes since release, s.
    context : RunContext
        Release and smoothed motion of the run.

    Returns
    -------
    Path
        Load, drive and further series of the run; x and v are zero.

    """
    motion = run.motion
    times = motion.t - context.release
    drive_at = None if run.drive is None else partial(_clamped, CubicSpline(times, run.drive))
    still = np.zeros_like(nodes)
    before = _motion_before(context.way, run.displacement.t[rows[0]] - context.release)
    row = max(before.shape[1] - 1, 0)
    return Path(
        t=nodes,
        x=still,
        v=still,
        s=still + np.sign(np.median(motion.v[rows])),
        load=1.0 if run.mass is None else (run.load or 1.0) / context.reference.load,
        mass_ratio=float(run.mass or context.reference.mass) / context.reference.mass,
        mass=run.mass,
        pixel_pitch=run.pixel_pitch,
        drive=None if drive_at is None else drive_at(nodes),
        drive_at=drive_at,
        lift=CubicSpline(times, motion.a_y)(nodes) if np.all(np.isfinite(motion.a_y)) else None,
        gravity=GRAVITY * float(np.cos(run.incline)) if run.mass is None else (run.load or 1.0) / run.mass,
        angle=_interpolated(times, context.angle, nodes),
        clamp_x=run.clamp_x,
        beam_length=run.beam_length,
        earlier=None if run.earlier is None else (run.earlier,),
        travelled=float(context.slid[row]),
        begins=float(context.way[1, row]),
        before=before,
    )


def _clamped(series: CubicSpline, t: Array) -> Array:
    """Values of an interpolant that keeps its first and last value outside the known times."""
    return np.asarray(series(np.clip(t, series.x[0], series.x[-1])))


def _interpolated(times: Array, series: Array | None, t: Array) -> Array | None:
    return None if series is None else np.interp(t, times, series)


def spans_of(pieces: Sequence[Piece], n_runs: int, fps: float) -> tuple[Span, ...]:
    """Compute the span of every run: duration, places and speeds."""
    return tuple(_span([p for p in pieces if p.run == r], fps) for r in range(n_runs))


def _span(pieces: Sequence[Piece], fps: float) -> Span:
    speeds = np.concatenate([np.abs(p.v_hat) for p in pieces])
    return Span(
        duration=max(float(p.t[-1]) for p in pieces),
        x_min=min(float(p.y.min()) for p in pieces),
        x_max=max(float(p.y.max()) for p in pieces),
        v_min=float(speeds.min()),
        v_max=float(speeds.max()),
        fps=fps,
        clamp_x=pieces[0].path.clamp_x,
        beam_length=pieces[0].path.beam_length,
        earlier=(pieces[0].path.earlier or ((),))[0],
    )
