"""The least-squares problem of a friction force that a load cell or a tribometer measured.

The model is compared with it along the measured motion: nothing is differentiated and no mass is needed. A run is one
piece from its first frame to its last, because effects with memory (presliding, lag) need the history; only the moving
frames are compared. Friction takes the place of the displacement, with unit mass and without a start. So everything
that uses a `LeastSquaresProblem` works.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from frictrack.effects import Path, Span
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import LeastSquaresProblem, PieceResponse, Solution, fit_with_scatter, hold
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.pieces import Piece, Reference, Rows, RunContext, path_of_rows, run_context
from frictrack.fit.separable import (
    DataBlock,
    ProjectedProblem,
    SeparableModel,
    SeparableSolution,
    path_at_compared,
    rows_at_compared,
    variable_projection,
)
from frictrack.fit.smooth_functions import correlated_frames
from frictrack.friction import free_section, is_moving, white_noise
from frictrack.models import Model
from frictrack.records import Array, Mask, Run, stretches
from frictrack.simulate.dynamics import CollocationSolution, LinearResponse, Panels

MIN_NOISE_SHARE = 1e-9  # smallest noise over the largest friction
PATH_ARRAYS = ("t", "s", "drive", "lift", "angle", "travelled", "begins")  # arrays of a path besides x and v
MIN_HELD_SHARE = 0.5  # least held friction at rest over the median friction
MIN_CREEP_STD = 3.0  # standard deviations of a significant creep
MAX_GRID_STARTS = 3  # points of a grid that are refined
MAX_GRID_POINTS = 200  # grid points over the parameters of modifiers
BLOCK_CORRELATION_TIMES = 2.0  # block length over the correlation of the residual
MIN_BLOCKS = 8  # least number of blocks per run
MIN_BLOCKS_PER_UNKNOWN = 2  # least number of blocks per unknown


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

    `whole` is the piece of all frames where only one in `every` frames is compared.
    """

    whole: MeasuredFrictionPiece | None = None
    every: int = 1

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
        return replace(self.path, x=x, v=v, load=self.path.load * level, **compared)

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

    def rebuild(self, layout: ParameterLayout, pieces: Sequence[Piece]) -> LeastSquaresProblem:
        """Create the same kind of problem for another layout or other pieces."""
        return MeasuredFrictionProblem(layout.model, layout, pieces, self.budget)

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
        layout = self.layout
        path = piece.path
        motion = CollocationSolution(piece.panels, path.x, path.v, piece.a_hat, path.x, path.v)
        active = layout.active(piece.run)
        values, level = layout.values(p, piece.run)
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
    if domain == "displacement" or len(without_friction) == len(runs):
        return False
    if without_friction:
        raise FrictrackError(
            f"expected friction_N of all runs or of none but {', '.join(without_friction)} of {len(runs)} runs "
            f"{'has' if len(without_friction) == 1 else 'have'} none; give these a study of their own"
        )
    return True


def check_effects(model: Model) -> None:
    """Check that no effect acts on a camera measurement, which a measured friction does not have."""
    if of_camera := [e.name for e in model.effects if e.acts_on == "measurement"]:
        raise FrictrackError(
            "expected effects on the force, because friction itself was measured, but got "
            f"{', '.join(of_camera)}, which acts on the camera measurement; remove it",
            usage=True,
        )


def reference_load(runs: Sequence[Run]) -> float:
    """Return the normal load of the first run, N, at which newtons are reported; NaN if a load is not known."""
    known = [np.nan if run.load is None else run.load for run in runs]
    return float(known[0]) if np.all(np.isfinite(known)) else float("nan")


def friction_pieces(runs: Sequence[Run], reference: float) -> list[Piece]:
    """Create one piece per run, all with the same noise, so that residuals in N have equal weights.

    Newtons are reported at the normal load `reference`, N; NaN if a load is not known.
    """
    noise = float(np.sqrt(np.mean([_white_noise(run) ** 2 for run in runs])))
    loads = [(run.load or reference) / reference if np.isfinite(reference) else 1.0 for run in runs]
    return [_make_piece(run, i, noise, load) for i, (run, load) in enumerate(zip(runs, loads, strict=True))]


def _span(piece: Piece, fps: float) -> Span:
    """Duration, places and speeds of a run."""
    x, speed = piece.path.x[piece.at], np.abs(piece.path.v[piece.at])
    return Span(float(piece.t[-1]), float(x.min()), float(x.max()), float(speed.min()), float(speed.max()), fps)


def _white_noise(run: Run) -> float:
    """White noise of the load cell, N: as stated, or estimated from the series."""
    if run.noise is not None:
        return run.noise
    series = np.asarray(run.friction_N, dtype=float)
    largest = float(np.nanmax(np.abs(series), initial=0.0))
    return max(white_noise(series), MIN_NOISE_SHARE * largest, 1e-12)


def _make_piece(run: Run, index: int, noise: float, load: float) -> Piece:
    """The piece of one run."""
    free, _ = free_section(run)
    series = np.asarray(run.friction_N, dtype=float)
    rows = np.flatnonzero(free & np.isfinite(series))
    rows = rows[rows > 0]  # the first frame only gives the sign of the held friction
    known = np.flatnonzero(np.isfinite(series))
    full_series = np.interp(np.arange(len(series)), known, series[known])
    context = run_context(run, Reference(run.mass or 1.0, 1.0))
    path = _measured_path(run, context, full_series, load)
    return MeasuredFrictionPiece(
        run=index,
        frames=rows,
        t=path.t[rows],
        y=series[rows],
        sigma=np.full(len(rows), noise),
        panels=FrameNodes(path.t),
        at=rows,
        per_frame=1,
        x_hat=path.x,
        v_hat=path.v,
        a_hat=-full_series,
        known=np.zeros_like(path.t),
        path=path,
        mass=1.0,
        way=context.way,
        systematic=run.drift or 0.0,
    )


def _measured_path(run: Run, context: RunContext, force: Array, load: float) -> Path:
    """The measured motion from the first frame to the last: friction may depend on all of the distance before."""
    t, x, v = run.motion.t - context.release, np.asarray(run.motion.x), _steady_velocity(run)
    slid = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(x)) * (v[1:] != 0))])
    held = float(np.sign(force[0])) if abs(force[0]) > MIN_HELD_SHARE * np.median(np.abs(force)) else 0.0
    known = path_of_rows(run, np.arange(len(t)), t, context)
    travelled = slid - slid[int(np.searchsorted(t, 0.0))]
    return replace(known, x=x, v=v, s=_direction(v, held), load=load, travelled=travelled, begins=x)


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
    problem = friction_problem(model, pieces, names, fps)
    separable = SeparableModel(problem.layout, [friction_block(p) for p in pieces])
    state = _refine_modifiers(ProjectedProblem(separable, separable.data), variable_projection(separable)())
    return fit_with_scatter(problem, separable.law(state.nonlinear_values, state.coefficients), problem.first_starts())


def friction_problem(
    model: Model, pieces: Sequence[Piece], names: tuple[str, ...], fps: float
) -> MeasuredFrictionProblem:
    """Create the problem of a model that has no start values yet; FrictrackError if the runs lack what it needs."""
    spans = tuple(_span(piece, fps) for piece in pieces)
    return MeasuredFrictionProblem(model, ParameterLayout(model, names, spans), pieces)


def friction_block(piece: Piece) -> DataBlock:
    """Create the compared frames of a run as data of the separable model."""
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
        parameter = next(e for e in layout.model.effects if e.name == slot.effect).parameter(slot.parameter)
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
