"""The least-squares problem: simulate the motion of every piece, compare it with the measurement, and linearise it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.evaluation_budget import EvaluationBudget
from frictrack.fit.least_squares.joined_law import JoinedLaw, LawStructure, difference_step
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.segments import JoinedPieces, Piece, group_by_size, split_motions
from frictrack.models import Model
from frictrack.records import Array, Mask
from frictrack.simulate.dynamics import CollocationSolution, MotionResponse, Start, solve_motion

MAX_JOINED_NODES = 30_000  # nodes that are simulated together, so that their arrays stay in the cache
SHARPENING = 1.5  # by which the speed of a reversal falls from step to step, where a swing cannot be solved at once


@dataclass(frozen=True)
class PieceResponse:
    """One piece under a model: motion, whitened residual and sensitivities, start position and speed projected out.

    Attributes
    ----------
    piece : Piece
        The piece of a run.
    motion : Motion6
        The simulated motion.
    linear : Response
        Linear response of the motion to a change of acceleration or start.
    active : list of int
        Positions of the A unknowns that affect the piece.
    model_y : array of shape (n,)
        Modelled measurement, m.
    shift_slope : array of shape (n,)
        Derivative of the measurement shift with respect to x.
    r : array of shape (n,)
        Whitened residual without the part that another start explains.
    jac : array of shape (n, A)
        Whitened sensitivities, start projected out.
    q, upper : array of shape (n, 2) and (2, 2)
        QR factors of the whitened sensitivities to the start.
    on_start : array of shape (2, A)
        Part of the sensitivities that a change of start explains, in coordinates of `q`.
    r_full : array of shape (n,)
        Whitened residual.

    """

    piece: Piece
    motion: CollocationSolution
    linear: MotionResponse
    active: list[int]
    model_y: Array
    shift_slope: Array  # d(o)/dx at the frames
    r: Array
    jac: Array
    q: Array
    upper: Array
    on_start: Array  # the part of the sensitivities that a change of start explains, (2, A)
    r_full: Array

    def start_step(self, step: Array) -> Array:
        """Compute the change of (x0, v0) that goes with a step (A,) of the active unknowns."""
        left = self.q.T @ self.r_full - self.on_start @ step
        return np.asarray(np.linalg.solve(self.upper, left), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _PreviousMotion:
    """The previous motion of some pieces: unknowns p, starts (R, 2), and motion with its response and sensitivities."""

    p: Array
    starts: Array
    motion: CollocationSolution
    linear: MotionResponse
    sensitivities: Array  # of the acceleration at the nodes to the unknowns, (K, 3 p)

    def extrapolated(self, joined: JoinedPieces, changes: Array, starts: Array) -> Array | None:
        """Accelerations (3 p,) after changes (R, K) of the unknowns to first order; None if there is no change.

        Pieces whose acceleration would change by more than its size keep their own.
        """
        if not (np.any(changes) or np.any(starts != self.starts)):
            return None
        each = zip(joined.nodes, changes, strict=True)
        g = np.concatenate([change @ self.sensitivities[:, rows] for rows, change in each])
        change = self.linear.respond_to_one(g, (starts - self.starts).T)[0]
        panels, a = self.motion.panels, self.motion.a
        small = np.where(panels.largest(np.abs(change)) < panels.largest(np.abs(a)), 1.0, 0.0)
        return a + panels.per_node(small) * np.nan_to_num(change)


@dataclass(eq=False)
class _Simulation:
    """Pieces of a problem that are simulated together, and their previous motion.

    Attributes
    ----------
    joined : JoinedPieces
        The pieces.
    columns : list of list of int
        Groups of unknowns that affect each piece.
    near : list of PieceResponse
        Known motions near which the first one is, perhaps on other panels; none by default.

    """

    joined: JoinedPieces
    columns: list[list[int]]
    near: list[PieceResponse]
    previous: _PreviousMotion | None = None

    @property
    def response(self) -> MotionResponse | None:
        """Response of a near motion on the same panels; None if none is known."""
        if self.previous is not None:
            return self.previous.linear
        alone = self.near[0] if len(self.near) == 1 else None
        return alone.linear if alone and len(alone.motion.a) == len(self.joined.panels.t) else None

    @cached_property
    def first(self) -> Array:
        """First guess of the accelerations (3 p,): those of near motions, else those of the measured ones."""
        if not self.near:
            return np.concatenate([piece.a_hat for piece in self.joined.pieces])
        pairs = zip(self.joined.pieces, (one.motion for one in self.near), strict=True)
        return np.concatenate([np.interp(piece.panels.t, motion.panels.t, motion.a) for piece, motion in pairs])

    def guess(self, law: JoinedLaw, starts: Array) -> tuple[Array, Array | None]:
        """First guess of the accelerations (3 p,): the previous ones, and if there are any, the extrapolated ones."""
        if self.previous is None:
            return self.first, None
        changes = np.zeros((len(self.columns), len(law.structure.groups)))
        for row, columns, piece in zip(changes, self.columns, self.joined.pieces, strict=True):
            active = law.layout.active(piece.run)
            row[columns] = (law.p - self.previous.p)[active]
        return self.previous.motion.a, self.previous.extrapolated(self.joined, changes, starts)


class LeastSquaresProblem:
    """A model over pieces of runs: evaluates residuals and sensitivities for given unknowns and starts.

    Parameters
    ----------
    model : Model
        The model, its unknowns as in the layout.
    layout : ParameterLayout
        Map of the parameter vector.
    pieces : sequence of Piece
        The pieces of all runs.
    budget : EvaluationBudget, optional
        Budget of the fits of this problem and of those built from it; default unlimited.

    Raises
    ------
    FrictrackError
        If the runs lack what an effect needs.

    """

    observed = "displacement"  # what is compared
    simulates = True  # whether the model makes a motion

    def __init__(
        self, model: Model, layout: ParameterLayout, pieces: Sequence[Piece], budget: EvaluationBudget | None = None
    ) -> None:
        self.model, self.layout, self.pieces = model, layout, list(pieces)
        self.budget = budget or EvaluationBudget()
        paths = [piece.path for piece in self.pieces]
        if missing := [message for effect in model.effects if (message := effect.lacks(paths))]:
            raise FrictrackError("; ".join(missing))
        together = model.memory or any(piece.turns for piece in self.pieces)
        self._structure = LawStructure.of(layout, together=together)
        self._simulations: dict[tuple[int, ...], _Simulation] = {}
        self._near: list[PieceResponse] = []

    def beginning_at(self, responses: Sequence[PieceResponse]) -> LeastSquaresProblem:
        """Return the same problem, whose first simulation begins at known motions of the pieces."""
        near = copy(self)
        near._simulations, near._near = {}, list(responses)
        return near

    def rebuild(self, layout: ParameterLayout, pieces: Sequence[Piece]) -> LeastSquaresProblem:
        """Create the same kind of problem for another layout or other pieces."""
        return LeastSquaresProblem(layout.model, layout, pieces, self.budget)

    def with_budget(self, budget: EvaluationBudget) -> LeastSquaresProblem:
        """Return the same problem with another budget of evaluations."""
        limited = copy(self)
        limited.budget = budget
        return limited

    @property
    def n_frames(self) -> int:
        """Frames of all pieces."""
        return sum(len(p.t) for p in self.pieces)

    def first_starts(self) -> list[Array]:
        """Return start position (m) and speed (m/s) of every piece, from the smoothed motion."""
        return [np.array([np.interp(p.t[0], p.panels.t, p.x_hat), p.v_hat[0]]) for p in self.pieces]

    def hidden_frames(self, responses: Sequence[PieceResponse]) -> list[Mask]:
        """Return which frames of every piece a held-out error leaves out: the odd ones."""
        return [np.arange(len(r.r)) % 2 == 1 for r in responses]

    def kept_rows(self, responses: Sequence[PieceResponse], hidden: Sequence[Mask]) -> list[Array]:
        """Return sensitivities and residual (m, A + 1) of every piece at its other frames, start projected out."""
        out = []
        for r, rows in zip(responses, hidden, strict=True):
            (q, _), kept = np.linalg.qr(r.q[~rows]), np.column_stack([r.jac, r.r])[~rows]
            out.append(kept - q @ (q.T @ kept))
        return out

    def evaluate(self, p: Array, starts: Sequence[Array]) -> list[PieceResponse]:
        """Simulate every piece and linearise it.

        Parameters
        ----------
        p : array of shape (P,)
            The unknowns.
        starts : sequence of array of shape (2,)
            Start position (m) and speed (m/s) of every piece.

        Returns
        -------
        list of PieceResponse
            One per piece.

        Raises
        ------
        FrictrackError
            If a motion cannot be integrated.

        """
        return [r for rows in self._simulated_together for r in self._respond_together(rows, p, starts)]

    @cached_property
    def _simulated_together(self) -> list[tuple[int, ...]]:
        """Positions of the pieces that are simulated together; each alone under a model with memory."""
        counts = [0 if self.model.memory else len(piece.panels.t) for piece in self.pieces]
        return group_by_size(counts, MAX_JOINED_NODES, alone=self.model.memory)

    def _respond(self, i: int, p: Array, start: Array) -> PieceResponse:
        """Simulate and linearise piece i alone."""
        return self._respond_together((i,), p, {i: start})[0]

    def _respond_together(
        self, rows: tuple[int, ...], p: Array, starts: Sequence[Array] | Mapping[int, Array]
    ) -> list[PieceResponse]:
        """Simulate and linearise some pieces together."""
        simulation = self._simulation(rows)
        joined = self._with_clock(simulation.joined, p)
        law = self._law(joined, p)
        begin = np.array([starts[i] for i in rows], dtype=float)
        motion, linear = self._simulate(simulation, law, begin)
        g = law.sensitivities(motion)
        edges = linear.edge_states(*_with_starts(g))
        simulation.previous = _PreviousMotion(p, begin, motion, linear, g)
        return [
            self._linearised_response(
                piece,
                law,
                (own, own_linear),
                (own.x_edge[piece.at], edges[edge_rows, 0][piece.at][:, [*columns, -2, -1]]),
            )
            for piece, columns, edge_rows, (own, own_linear) in zip(
                joined.pieces, simulation.columns, joined.edges, split_motions(joined, motion, linear), strict=True
            )
        ]

    def _simulation(self, rows: tuple[int, ...]) -> _Simulation:
        """The simulation of some pieces together, with their previous motion."""
        if rows not in self._simulations:
            pieces = tuple(self.pieces[i] for i in rows)
            columns = [self._columns_of(q.run) for q in pieces]
            near = [self._near[i] for i in rows] if self._near else []
            self._simulations[rows] = _Simulation(JoinedPieces(pieces), columns, near)
        return self._simulations[rows]

    def _columns_of(self, run: int) -> list[int]:
        """Groups of unknowns that affect one run."""
        return [j for j, group in enumerate(self._structure.groups) if group.slot_in(run) is not None]

    def _law(self, joined: JoinedPieces, p: Array) -> JoinedLaw:
        """The model along some pieces."""
        return JoinedLaw(self.layout, self._structure, joined, p, self.model.memory and self.simulates)

    def _with_clock(self, joined: JoinedPieces, p: Array) -> JoinedPieces:
        """Pieces with the clock rate that the model gives to their runs."""
        if all(e.clock is None for e in self.model.effects):
            return joined
        clocks = [self.model.clock(self.layout.values(p, piece.run)[0]) for piece in joined.pieces]
        return JoinedPieces(tuple(q.with_clock(clock) for q, clock in zip(joined.pieces, clocks, strict=True)))

    def linearised_response(
        self, piece: Piece, p: Array, about: tuple[CollocationSolution, MotionResponse], x: Array
    ) -> PieceResponse:
        """Compute residual and sensitivities of one piece, linearised about a given motion.

        Parameters
        ----------
        piece : Piece
            The piece.
        p : array of shape (P,)
            The unknowns.
        about : tuple of (Motion6, Response)
            The motion at which the model is linearised, and its linear response.
        x : array of shape (n,)
            Modelled position at the frames, m.

        Returns
        -------
        PieceResponse
            The response with `x` as its motion at the frames.

        """
        sensitivities = self.motion_sensitivities(piece, p, *about)[:, 0]
        return self._linearised_response(piece, self._law(JoinedPieces((piece,)), p), about, (x, sensitivities))

    def _linearised_response(
        self,
        piece: Piece,
        law: JoinedLaw,
        about: tuple[CollocationSolution, MotionResponse],
        seen_motion: tuple[Array, Array],
    ) -> PieceResponse:
        """The same from the sensitivities (n, A + 2) of the position to the active unknowns and the start."""
        (motion, linear), (x, x_sens) = about, seen_motion
        active = self.layout.active(piece.run)
        shift, slope, direct = self._measurement_shift(piece, law.p, motion, active)
        x_sens = (1 + slope)[:, None] * x_sens
        x_sens[:, :-2] += direct
        model_y = x + shift + slope * (x - motion.x_edge[piece.at])
        weighted = piece.whitened(x_sens)
        residual = piece.whitened(piece.y - model_y)
        q, upper = np.linalg.qr(weighted[:, -2:])
        on_start = q.T @ weighted[:, :-2]
        return PieceResponse(
            piece=piece,
            motion=motion,
            linear=linear,
            active=active,
            model_y=model_y,
            shift_slope=slope,
            r=residual - q @ (q.T @ residual),
            jac=weighted[:, :-2] - q @ on_start,
            q=q,
            upper=upper,
            on_start=on_start,
            r_full=residual,
        )

    def acceleration(self, piece: Piece, p: Array) -> Callable[[Array, Array, Array], Array]:
        """Return the model's acceleration along one piece as a function of x, v and t."""
        return self._law(JoinedPieces((piece,)), p).acceleration

    def motion_sensitivities(
        self, piece: Piece, p: Array, motion: CollocationSolution, linear: MotionResponse
    ) -> Array:
        """Compute the sensitivities (n, 2, A + 2) of position and speed to the active unknowns and to the start."""
        edges = linear.edge_states(*_with_starts(self.acceleration_sensitivities(piece, p, motion).T))
        return edges[piece.at]

    def acceleration_sensitivities(self, piece: Piece, p: Array, motion: CollocationSolution) -> Array:
        """Acceleration at the nodes of one piece per unit of every active unknown, (3 p, A)."""
        g = self._law(JoinedPieces((piece,)), p).sensitivities(motion)
        return g[self._columns_of(piece.run)].T

    def _simulate(
        self, simulation: _Simulation, law: JoinedLaw, starts: Array
    ) -> tuple[CollocationSolution, MotionResponse]:
        """Solve the motion of pieces, from the extrapolated previous one where that is close enough."""
        guess, extrapolated = simulation.guess(law, starts)
        near = simulation.response if law.remembers else None
        if simulation.previous is None and near is not None:
            with suppress(FrictrackError):  # the law may have changed too much
                return self._solve(law, starts, guess, near)
            near = None
        if extrapolated is not None:
            with suppress(FrictrackError):  # if the extrapolation fails, start from the previous motion
                return self._solve(law, starts, extrapolated, near)
        try:
            return self._solve(law, starts, guess, near)
        except FrictrackError:  # after a previous motion the caller rather takes a shorter step
            if simulation.previous is not None or not any(piece.slack for piece in law.joined.pieces):
                raise
        return self._solve_sharpening(law, starts, guess)

    def _solve_sharpening(
        self, law: JoinedLaw, starts: Array, guess: Array
    ) -> tuple[CollocationSolution, MotionResponse]:
        """Solve swinging masses whose dry friction turns slowly at a reversal first, then as sharply as it does.

        A mass that swings in the record and comes to rest under the law has no other near motion to begin with
        (continuation: Allgower & Georg 1990, Numerical Continuation Methods).
        """
        pieces = law.joined.pieces
        widest = max(float(np.max(np.abs(q.v_hat))) / q.slack for q in pieces if q.slack)
        for k in range(max(int(np.ceil(np.log(widest) / np.log(SHARPENING))), 1), -1, -1):
            wider = JoinedPieces(tuple(replace(q, slack=q.slack * SHARPENING**k) for q in pieces))
            motion, linear = self._solve(self._law(wider, law.p), starts, guess, None)
            guess = motion.a
        return motion, linear

    def _solve(
        self, law: JoinedLaw, starts: Array, guess: Array, near: MotionResponse | None
    ) -> tuple[CollocationSolution, MotionResponse]:
        """Solve the motion of pieces from a first guess of the accelerations (3 p,) and the response of a near one."""
        memory = law.remembers
        slopes, continued = (None, law) if memory else (law.slopes, None)
        return solve_motion(
            law.acceleration,
            law.joined.panels,
            _by_motion(starts),
            guess,
            slopes=slopes,
            memory=memory,
            near=near,
            continued=continued,
        )

    def column(self, effect: str, parameter: str) -> int:
        """Return which column of an effect a linear parameter multiplies."""
        of = next(e for e in self.model.effects if e.name == effect)
        return [q.name for q in of.linear].index(parameter)

    def _measurement_shift(
        self, piece: Piece, p: Array, motion: CollocationSolution, active: list[int]
    ) -> tuple[Array, Array, Array]:
        """Measurement shift at the frames, its derivative in x, and its change per unit of every active unknown.

        A clock error is already in the times of the piece. Only its change shifts the measurement.
        """
        x = motion.x_edge[piece.at]
        v = motion.v_edge[piece.at]
        direct = np.zeros((len(x), len(active)))
        if all(e.acts_on == "force" for e in self.model.effects):
            return np.zeros_like(x), np.zeros_like(x), direct
        timed = self.layout.values(p, piece.run)[0]
        held = {e.name: self.model.coefficients(e.name, timed) for e in self.model.effects if e.clock is not None}

        def total(p_: Array, x_: Array) -> Array:
            values, level = self.layout.values(p_, piece.run)
            blocks = self.model.measurement_columns(piece.at_frames(x_, v, level), values)
            sizes = {n: self.model.coefficients(n, values) - held.get(n, 0.0) for n in blocks}
            return np.sum([b @ sizes[n] for n, b in blocks.items()], axis=0)

        shift = total(p, x)
        h = 1e-7 * max(float(np.ptp(x)), 1e-3)
        slope = (total(p, x + h) - total(p, x - h)) / (2 * h)
        measurement_effects = {e.name for e in self.model.effects if e.acts_on == "measurement"}
        for j, i in enumerate(active):
            slot = self.layout.slots[i]
            leads = i in self.layout.leaders
            if slot.effect in measurement_effects or leads:
                step = 1.0 if slot.linear and not leads else difference_step(p[i], slot.bounds)
                direct[:, j] = (total(_shifted(p, i, step), x) - shift) / step
        return shift, slope, direct


def _by_motion(starts: Array) -> tuple[Start, Start]:
    """Positions and velocities of starts (R, 2); numbers if there is only one."""
    if len(starts) == 1:
        return float(starts[0, 0]), float(starts[0, 1])
    return starts[:, 0], starts[:, 1]


def _with_starts(g: Array) -> tuple[Array, Array]:
    """Inputs g (K, 3 p) and two empty ones, (3 p, K + 2), and the starts (2, K + 2) that belong to the latter."""
    inputs, start = np.zeros((len(g) + 2, g.shape[1])), np.zeros((2, len(g) + 2))
    inputs[:-2] = g
    start[0, -2] = start[1, -1] = 1.0
    return inputs.T, start


def _shifted(p: Array, i: int, step: float) -> Array:
    out = p.copy()
    out[i] += step
    return out
