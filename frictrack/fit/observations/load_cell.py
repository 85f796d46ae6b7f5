"""The least-squares problem of a friction force that a load cell or a tribometer measured.

The model is compared with it along the measured motion: nothing is differentiated and no mass is needed. A run is one
piece from its first frame to its last, because effects with memory (presliding, lag) need the history; only the moving
frames are compared. Friction takes the place of the displacement, with unit mass and without a start. So everything
that uses a `LeastSquaresProblem` works.

The noise of friction at constant speeds: points (v, F) without order in time.

Repeated speeds show it (pure error, Draper & Smith 1998, section 2.1). Without them it is what the force scatters about
a smooth course over the logarithm of the speed: the residual variance of the most likely Gaussian process (Matern 5/2),
one for each load, and one for each direction where these differ, about straight lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError, UsageError
from frictrack.effects import Path, Span
from frictrack.effects.models import Model
from frictrack.fit.cutting import Reference, RunContext, path_of_rows, run_context
from frictrack.fit.least_squares import LeastSquaresProblem, PieceResponse, Solution, fit_with_scatter, hold
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.pieces import Piece, Rows, cycle_of
from frictrack.fit.separable.common_amplitudes import variable_projection
from frictrack.fit.separable.model import DataBlock, SeparableModel, path_at_compared, rows_at_compared
from frictrack.fit.separable.projected import ProjectedProblem, SeparableSolution
from frictrack.fit.smooth_functions import correlated_frames, matern_covariance
from frictrack.measure.friction import MIN_NOISE_SHARE, cell_noise, correlated_cell_noise, free_section, is_moving
from frictrack.records import Array, Mask, Run, stretches
from frictrack.simulate.dynamics import CollocationSolution, LinearResponse, Panels

MAX_SAME_SPEED, MAX_SAME_LOAD = 1e-3, 0.05  # relative difference of speeds that are repeats, and of loads that are one
MIN_REPEATS = 4  # points beyond the first of their speed that show the noise
LENGTHS = np.geomspace(0.7, 8.0, 12)  # correlation lengths in ln v: no law of friction changes faster than twofold in v
RATIOS = np.geomspace(1e-2, 1e7, 46)  # variance of the course over that of the noise
# arrays of a path besides x and v
PATH_ARRAYS = ("t", "s", "load", "drive", "friction", "lift", "angle", "travelled", "begins")
MIN_HELD_SHARE = 0.5  # least held friction at rest over the median friction
MIN_CREEP_STD = 3.0  # standard deviations of a significant creep
MAX_GRID_STARTS = 3  # points of a grid that are refined
MAX_GRID_POINTS = 200  # grid points over the parameters of modifiers
BLOCK_CORRELATION_TIMES = 2.0  # block length over the correlation of the residual
MIN_BLOCKS = 8  # least number of blocks per run
MIN_BLOCKS_PER_UNKNOWN = 2  # least number of blocks per unknown


@dataclass(frozen=True, eq=False)
class SpeedPoints:
    """Where the points of a table were measured, and how their noise is known.

    `v` (n,): speeds, m/s; `load` (n,): loads over their mean; `relative` (n,): deviations over their mean; `stated`:
    whether the deviations were given.
    """

    v: Array
    load: Array
    relative: Array
    stated: bool = False

    @property
    def repeats(self) -> int:
        """Number of points beyond the first at their speed and load, which show the noise; 0 of too few."""
        count = len(self.v) - len(np.unique(self._places()))
        return count if count >= MIN_REPEATS else 0

    @property
    def source(self) -> str:
        """From what the noise is known."""
        if self.stated:
            return "as stated"
        if self.repeats:
            return f"the scatter of repeated speeds, {self.repeats} degrees of freedom"
        return "what the force scatters about a smooth course over the speed"

    def noise(self, force: Array) -> Array:
        """Mean standard deviation (D,) of the noise of forces (n, D)."""
        weight = 1.0 / self.relative
        if not self.repeats:
            return self._scatter_about_course(force, weight)
        members = self._places() == np.unique(self._places())[:, None]
        share = members * weight**2
        share = share / share.sum(axis=1)[:, None]  # (groups, n)
        left = (force - members.T @ (share @ force)) * weight[:, None]
        return np.asarray(np.sqrt(np.sum(left**2, axis=0) / self.repeats))

    def _kinds(self) -> NDArray[np.int64]:
        """Number (n,) of the direction and load of every point."""
        return 2 * _numbered(self.load, MAX_SAME_LOAD) + (self.v > 0)

    def _places(self) -> NDArray[np.int64]:
        """Number (n,) of the speed, direction and load of every point."""
        return len(self.v) * self._kinds() + _numbered(self.v, MAX_SAME_SPEED)

    def _scatter_about_course(self, force: Array, weight: Array) -> Array:
        """Noise (D,) of forces (n, D): its restricted likelihood averaged over all courses."""
        kinds, direction = self._kinds(), np.sign(self.v)
        both = [np.abs(self.v)] if np.ptp(direction) else []
        lines = np.column_stack([kinds[:, None] == np.unique(kinds), self.v, *both]) * weight[:, None]
        free = np.linalg.svd(lines)[0][:, np.linalg.matrix_rank(lines) :]  # what no straight lines explain
        y = free.T @ (force * weight[:, None])
        own = (kinds[:, None] == kinds) * 1.0
        odd = (kinds[:, None] // 2 == kinds // 2) * direction[:, None] * direction  # one course for both directions
        variances, costs = [], []
        for length, together in product(LENGTHS, [own, odd] if both else [own]):
            course = matern_covariance(np.log(np.abs(self.v)), length) * together * weight[:, None] * weight
            values, vectors = np.linalg.eigh(free.T @ course @ free)
            squares = (vectors.T @ y) ** 2
            for ratio in RATIOS:
                spread = 1.0 + ratio * np.maximum(values, 0.0)
                variances.append(np.mean(squares / spread[:, None], axis=0))
                costs.append(len(y) * np.log(np.maximum(variances[-1], 1e-300)) + np.sum(np.log(spread)))
        share = np.exp(-0.5 * (np.array(costs) - np.min(costs, axis=0)))
        return np.asarray(np.sqrt(np.sum(share * variances, axis=0) / np.sum(share, axis=0)))


def _numbered(values: Array, tolerance: float) -> NDArray[np.int64]:
    """Number (n,) of the group of every value; neighbours within a relative tolerance are one group."""
    order = np.argsort(values)
    steps = np.diff(values[order]) > tolerance * np.abs(values[order][1:])
    out = np.empty(len(values), dtype=np.int64)
    out[order] = np.concatenate([[0], np.cumsum(steps)])
    return out


def points_of(run: Run) -> tuple[SpeedPoints, Array]:
    """The points of a table of speeds and forces, and their standard deviations (n,), N."""
    force = np.asarray(run.friction_N, dtype=float)
    load = np.ones(len(force)) if run.loads is None else run.loads / np.mean(run.loads)
    stated = run.sigma_friction if run.sigma_friction is not None else run.noise
    if stated is not None:
        sigma = np.broadcast_to(np.asarray(stated, dtype=float), force.shape)
        return SpeedPoints(run.motion.v, load, sigma / np.mean(sigma), stated=True), sigma
    points = SpeedPoints(run.motion.v, load, np.ones(len(force)))
    return points, np.full(len(force), points.noise(force[:, None])[0])


class FrameNodes(Panels):
    """Nodes at the frames of a run: nothing is integrated between them."""

    @property
    def t(self) -> Array:
        """Times of the frames, s, shape (n,)."""
        return self.edges


class DirectForce(LinearResponse):
    """The linear response of a directly measured force: minus the acceleration that it makes at unit mass."""

    def __init__(self) -> None:  # nothing is integrated
        pass

    def respond(self, g: Array, start: Array) -> tuple[Array, Array]:
        """Return the accelerations g (n, k), and the forces behind them as states (n, 2, k)."""
        return g, self.edge_states(g)

    def edge_states(self, g: Array, start: Array | None = None) -> Array:
        """Return the forces as states (n, 2, k)."""
        return np.stack([-g, np.zeros_like(g)], axis=1)


@dataclass(frozen=True)
class MeasuredFrictionPiece(Piece):
    """One run whose friction was measured: y is the friction, N, at the compared frames, rows `at` of the path.

    `whole` is the piece of all frames where only one in `every` frames is compared; of `points` (v, F), every row is.
    `correlation` is the integrated correlation time of the noise of the cell, in frames.
    """

    whole: MeasuredFrictionPiece | None = None
    every: int = 1
    points: SpeedPoints | None = None  # of a table of speeds and forces
    correlation: float = 1.0

    def noise_levels(self, model: Array, residual: Array, unknowns: int, errors: Array) -> Array:
        """Noise (D,) that is estimated of points with errors (n, D) of deviation one.

        If the model (n,), N, is true, its residual (n,), in deviations, shows how large errors are.
        """
        assert self.points is not None
        if self.points.stated:
            return np.ones(errors.shape[1])
        degrees = max(len(residual) - unknowns, 1)
        sigma = self.sigma * max(float(np.sqrt(residual @ residual / degrees)), MIN_NOISE_SHARE)
        return self.points.noise(model[:, None] + errors * sigma[:, None]) / float(np.mean(sigma))

    def at_frames_kept(self, rows: Rows, every: int) -> MeasuredFrictionPiece:
        """Return the piece that compares only some of these frames, one in `every`."""
        kept: dict[str, Any] = {name: getattr(self, name)[rows] for name in ("frames", "t", "y", "sigma", "at")}
        return replace(self, whole=self, every=every, **kept)

    def refined(self, per_frame: int) -> Piece:
        """Return the same piece, because nothing lies between its frames."""
        return self

    def at_frames(self, x: Array, v: Array, level: float) -> Path:
        """Return the path at the compared frames, for effects without memory."""
        known = {name: getattr(self.path, name) for name in PATH_ARRAYS}
        compared: dict[str, Any] = {k: value[self.at] for k, value in known.items() if isinstance(value, np.ndarray)}
        path = replace(self.path, x=x, v=v, **compared)
        return replace(path, load=path.load * level)

    def compared_frames(self) -> MeasuredFrictionPiece:
        """Return the piece whose path holds its compared frames alone, where they are few."""
        path = path_at_compared(self, self.path.x, self.path.v, 1.0)
        if path is None:
            return self
        return replace(
            self,
            panels=FrameNodes(path.t),
            at=np.arange(len(path.t)),
            x_hat=path.x,
            v_hat=path.v,
            a_hat=self.a_hat[self.at],
            known=self.known[self.at],
            path=path,
        )


class MeasuredFrictionProblem(LeastSquaresProblem):
    """A model over runs whose friction was measured; the pieces are `MeasuredFrictionPiece`, one per run."""

    observed, simulates = "friction", False

    @classmethod
    def of(cls, model: Model, pieces: Sequence[Piece], names: tuple[str, ...], fps: float) -> MeasuredFrictionProblem:
        """Create the problem of a model that has no start values yet; FrictrackError if the runs lack what it needs."""
        return cls(model, ParameterLayout(model, names, tuple(_span(piece, fps) for piece in pieces)), pieces)

    @property
    def noise(self) -> float:  # type: ignore[override]
        """Noise of the load cell, N."""
        return float(self.pieces[0].sigma[0])

    @property
    def blocks(self) -> list[DataBlock]:
        """The compared frames of every run."""
        return [_block(piece) for piece in self.pieces]

    def first_starts(self) -> list[Array]:
        """Return empty starts: no piece has an unknown start."""
        return [np.zeros(0) for _ in self.pieces]

    def hidden_frames(self, responses: Sequence[PieceResponse]) -> list[Mask]:
        """Return every other block of frames of every run, longer than the correlation of the residual."""
        starts = block_starts(responses, len(self.layout.slots))
        return [
            np.searchsorted(at, np.arange(len(r.r)), side="right") % 2 == 0
            for r, at in zip(responses, starts, strict=True)
        ]

    def evaluate(self, p: Array, starts: Sequence[Array]) -> list[PieceResponse]:
        """Compute residual and sensitivities of every run."""
        return [self._response(piece, p) for piece in self.pieces]

    def _response(self, piece: Piece, p: Array) -> PieceResponse:
        path = piece.path
        motion = CollocationSolution(piece.panels, path.x, path.v, piece.a_hat, path.x, path.v)
        active = self.layout.active(piece.run)
        values, level = self.layout.values(p, piece.run)
        force = self.model.force(piece.path_at_nodes(path.x, path.v, level), values)[piece.at]
        residual = (piece.y - force) / piece.sigma
        return PieceResponse(
            piece=piece,
            motion=motion,
            linear=DirectForce(),
            active=active,
            model_y=force,
            shift_slope=np.zeros_like(force),
            r=residual,
            jac=-self.acceleration_sensitivities(piece, p, motion)[piece.at] / piece.sigma[:, None],
            q=np.zeros((len(force), 0)),
            upper=np.zeros((0, 0)),
            on_start=np.zeros((0, len(active))),
            r_full=residual,
        )


def _span(piece: Piece, fps: float) -> Span:
    """Duration, places and speeds of a run."""
    x, speed = piece.path.x[piece.at], np.abs(piece.path.v[piece.at])
    reach = float(x.min()), float(x.max()), float(speed.min()), float(speed.max())
    return Span(float(piece.t[-1]), *reach, fps, cycle=cycle_of(piece.t, x))


def _block(piece: Piece) -> DataBlock:
    """The compared frames of a run as data of the separable model."""
    weight = 1.0 / piece.sigma
    return DataBlock(
        run=piece.run,
        path=piece.path,
        data=piece.y * weight,
        forward=lambda rows: rows_at_compared(rows, piece.at) * weight,
        picture=lambda rows: np.zeros_like(rows_at_compared(rows, piece.at)),
        friction=-piece.a_hat / piece.path.load,
        compared_path=path_at_compared(piece, piece.path.x, piece.path.v, 1.0),
    )


def keep_compared_frames(solution: Solution) -> Solution:
    """Restrict a solution to its compared frames, where friction was measured and no effect has memory.

    Frames that are not compared carry no information then, but take time.
    """
    problem = solution.problem
    if problem.simulates or problem.model.memory:
        return solution
    pieces = [p.compared_frames() if isinstance(p, MeasuredFrictionPiece) else p for p in problem.pieces]
    if all(new is old for new, old in zip(pieces, problem.pieces, strict=True)):
        return solution
    return hold(problem.rebuild(problem.layout, pieces), solution.p, solution.starts, solution.tau)


def uses_measured_friction(runs: Sequence[Run], domain: str | None) -> bool:
    """Return whether these runs are fitted to their measured friction: by default, if all of them have it."""
    without_friction = [run.name for run in runs if run.friction_N is None]
    if (steady := sum(run.steady for run in runs)) and (domain == "displacement" or steady < len(runs)):
        came = "the domain of displacements" if steady == len(runs) else f"{len(runs) - steady} records over time"
        raise FrictrackError(f"expected only points (v, F) and the domain of forces but got {came}; fit these apart")
    if domain == "displacement" or len(without_friction) == len(runs):
        return False
    if without_friction:
        raise FrictrackError(
            f"expected friction_N of all runs or of none but {', '.join(without_friction)} of {len(runs)} runs "
            f"{'has' if len(without_friction) == 1 else 'have'} none; give these a study of their own"
        )
    return True


def check_effects(model: Model, runs: Sequence[Run]) -> None:
    """Check that no effect acts on a camera measurement, and on what the runs do not tell."""
    of_record = [e.name for e in model.effects if not e.is_of_velocity]
    if of_record and any(run.steady for run in runs):
        raise UsageError(
            f"expected effects of the speed alone, because points (v, F) tell neither time nor place, but got "
            f"{', '.join(of_record)}; remove {'it' if len(of_record) == 1 else 'them'}, or give records over time"
        )
    if of_camera := [e.name for e in model.effects if e.acts_on == "measurement"]:
        raise UsageError(
            "expected effects on the force, because friction itself was measured, but got "
            f"{', '.join(of_camera)}, which acts on the camera measurement; remove it"
        )


def reference_load(runs: Sequence[Run]) -> float:
    """Return the normal load of the first run, N, at which newtons are reported; NaN if a load is not known."""
    known = [np.nan if run.load is None else run.load for run in runs]
    return float(known[0]) if np.all(np.isfinite(known)) else float("nan")


def friction_pieces(runs: Sequence[Run], reference: float) -> list[MeasuredFrictionPiece]:
    """Create one piece per run, all with the same noise, so that residuals in N have equal weights.

    Newtons are reported at the normal load `reference`, N; NaN if a load is not known.
    """
    noise = float(np.sqrt(np.mean([0.0 if run.steady else cell_noise(run) ** 2 for run in runs])))
    loads = [(run.load or reference) / reference if np.isfinite(reference) else 1.0 for run in runs]
    pieces = [
        _piece_of_points(run, i, load) if run.steady else _make_piece(run, i, noise, load)
        for i, (run, load) in enumerate(zip(runs, loads, strict=True))
    ]
    if any(run.steady or run.noise is not None for run in runs):
        return pieces
    if (found := correlated_cell_noise([p.y for p in pieces], [p.frames for p in pieces])) is None:
        return pieces
    level = float(np.sqrt(np.mean(found.rms**2)))
    frames = 1.0 + 2.0 * found.share * found.correlation / (1.0 - found.correlation)
    return [replace(p, sigma=np.full(len(p.t), level), correlation=frames) for p in pieces]


def _make_piece(run: Run, index: int, noise: float, load: float) -> MeasuredFrictionPiece:
    """The piece of one run."""
    free, _ = free_section(run)
    series = np.asarray(run.friction_N, dtype=float)
    rows = np.flatnonzero(free & np.isfinite(series))
    rows = rows[rows > 0]  # the first frame only gives the sign of the held friction
    known = np.flatnonzero(np.isfinite(series))
    full_series = np.interp(np.arange(len(series)), known, series[known])
    context = run_context(run, Reference(run.mass or 1.0, 1.0))
    path, sigma = _measured_path(run, context, full_series, load), np.full(len(rows), noise)
    piece = _friction_piece(index, path, full_series, rows, sigma)
    return replace(piece, way=context.way, systematic=run.drift or 0.0)


def _piece_of_points(run: Run, index: int, load: float | Array) -> MeasuredFrictionPiece:
    """The piece of a table of speeds and forces: every row is compared, with its own deviation."""
    points, sigma = points_of(run)
    force, v = np.asarray(run.friction_N, dtype=float), run.motion.v
    least = max(MIN_NOISE_SHARE * float(np.max(np.abs(force))), 1e-12)
    t, still = run.motion.t - run.motion.t[0], np.zeros(len(v))
    load = load * (points.load if run.loads is not None else 1.0)
    path = Path(t, still, v, np.sign(v), load=load, mass=run.mass, steady=True)
    piece = _friction_piece(index, path, force, np.arange(len(v)), np.maximum(sigma, least))
    return replace(piece, way=np.stack([t, still, v]), points=points)


def _friction_piece(index: int, path: Path, force: Array, rows: Rows, sigma: Array) -> MeasuredFrictionPiece:
    """The piece of a force (n,) along a path, compared at some rows, there with the deviations sigma."""
    return MeasuredFrictionPiece(
        run=index,
        frames=rows,
        t=path.t[rows],
        y=force[rows],
        sigma=sigma,
        panels=FrameNodes(path.t),
        at=rows,
        per_frame=1,
        x_hat=path.x,
        v_hat=path.v,
        a_hat=-force,
        known=np.zeros_like(path.t),
        path=path,
        mass=1.0,
    )


def _measured_path(run: Run, context: RunContext, force: Array, load: float) -> Path:
    """The measured motion from the first frame to the last: friction may depend on all of the distance before."""
    t, x, v = run.motion.t - context.release, np.asarray(run.motion.x), _steady_velocity(run)
    slid = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(x)) * (v[1:] != 0))])
    held = float(np.sign(force[0])) if abs(force[0]) > MIN_HELD_SHARE * np.median(np.abs(force)) else 0.0
    known = path_of_rows(run, np.arange(len(t)), t, context)
    travelled = slid - slid[int(np.searchsorted(t, 0.0))]
    return replace(known, x=x, v=v, s=_direction(v, held), load=load, friction=force, travelled=travelled, begins=x)


def _steady_velocity(run: Run) -> Array:
    """Velocity (n,); a stuck mass has its mean creep velocity, so that noise does not add up to a distance."""
    motion = run.motion
    v = np.array(motion.v)
    for s in stretches(~is_moving(run)):
        first, last = s.start, s.stop - 1
        crept = motion.x[last] - motion.x[first]
        significant = abs(crept) > MIN_CREEP_STD * float(np.hypot(motion.sigma_x[first], motion.sigma_x[last]))
        v[s] = crept / (motion.t[last] - motion.t[first]) if significant and last > first else 0.0
    return v


def _direction(v: Array, held: float) -> Array:
    """Direction of motion (n,); at rest the previous one, at first the sign of the held friction."""
    s = np.concatenate([[held], np.sign(v[1:])])
    last = np.maximum.accumulate(np.where(s != 0, np.arange(len(s)), 0))
    return np.asarray(s[last])


def fit_measured_friction(model: Model, pieces: Sequence[Piece], names: tuple[str, ...], fps: float) -> Solution:
    """Fit a model from scratch: variable projection along the measured motion, then all unknowns together."""
    problem = MeasuredFrictionProblem.of(model, pieces, names, fps)
    separable = SeparableModel(problem.layout, problem.blocks)
    state = _refine_modifiers(ProjectedProblem(separable, separable.data), variable_projection(separable)())
    return fit_with_scatter(problem, separable.law(state.nonlinear_values, state.coefficients), problem.first_starts())


def _refine_modifiers(problem: ProjectedProblem, state: SeparableSolution) -> SeparableSolution:
    """Search the parameters of modifiers without a coefficient, which no scan covers, over a coarse grid."""
    for g, group in enumerate(problem.separable.groups):
        if not any(e.modifies and not e.linear for e in group.model.effects):
            continue
        found = [problem.at(values, state, {g}) for values in _grid(problem, state.nonlinear_values, g)]
        best = sorted(found, key=lambda s: s.misfit)[:MAX_GRID_STARTS]
        state = min((problem.refine(s) for s in [state, *best]), key=lambda s: s.misfit)
    return state


def _grid(problem: ProjectedProblem, nonlinear_values: Array, g: int) -> list[Array]:
    """Parameter vectors (P,) at the points of a coarse grid over the scanned parameters of a group."""
    layout = problem.layout
    scanned = {}
    for i in problem.separable.groups[g].nonlinear_slots:
        slot = layout.slots[i]
        parameter = layout.effect(slot.effect).parameter(slot.parameter)
        if parameter.scan is not None:
            scanned[i] = parameter.scan(layout.span if slot.run is None else layout.spans[slot.run])
    most = max(int(MAX_GRID_POINTS ** (1 / max(len(scanned), 1))), 2)  # points per axis
    axes = [a[np.linspace(0, len(a) - 1, min(most, len(a))).round().astype(int)] for a in scanned.values()]
    points = np.array(list(product(*axes)))
    out = np.tile(nonlinear_values, (len(points), 1))
    out[:, list(scanned)] = points
    return list(out)


def block_starts(responses: Sequence[PieceResponse], n_unknowns: int) -> list[Rows]:
    """Cut the frames of every run into blocks: longer than the correlation of the residual, enough for the unknowns."""
    min_blocks = max(MIN_BLOCKS, -(-MIN_BLOCKS_PER_UNKNOWN * n_unknowns // len(responses)))
    out = []
    for r in responses:
        n, length = len(r.r), max(int(np.ceil(BLOCK_CORRELATION_TIMES * correlated_frames(r.r))), 1)
        count = max(n // min(length, max(n // min_blocks, 1)), 1)
        out.append(np.linspace(0, n, count + 1).round().astype(int)[:-1])
    return out
