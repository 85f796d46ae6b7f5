"""The least-squares problem: simulate the motion of every piece, compare it with the measurement, and linearise it."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from frictrack.base.errors import FrictrackError, result_or_none
from frictrack.effects.models import Model
from frictrack.fit.least_squares.joined_law import JoinedLaw, difference_step, group_unknowns
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.pieces import JoinedPieces, Piece, spans_of
from frictrack.fit.separable.model import DataBlock, displacement_block
from frictrack.records import Array, Mask
from frictrack.search import EvaluationBudget
from frictrack.simulate.dynamics import (
    CollocationSolution,
    LinearResponse,
    Start,
    solve_motion,
)

MAX_JOINED_NODES = 30_000  # nodes that are simulated together, so that their arrays stay in the cache
TURNING_SHARE = 0.5  # of the speed gained in a frame, within which it turns
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
    linear: LinearResponse
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


@dataclass(eq=False)
class _Simulation:
    """Pieces of a problem that are simulated together, and a motion near theirs."""

    joined: JoinedPieces
    columns: list[list[int]]
    guess: Array
    is_first: bool = True


class LeastSquaresProblem:
    """A model over pieces of runs: evaluates residuals and sensitivities for given unknowns and starts.

    Parameters
    ----------
    model : Model
        The model, its unknowns as in the layout.
    layout : ParameterLayout
        Map of the parameter vector.
    pieces : sequence of Piece
        The pieces of all runs; they get the panels per frame that the effects need.
    budget : EvaluationBudget, optional
        Budget of the fits of this problem and of those built from it; default unlimited.

    Raises
    ------
    FrictrackError
        If the runs lack what an effect needs.

    """

    observed = "displacement"  # what is compared
    simulates = True  # whether the model makes a motion
    noise = 1.0  # what one whitened number stands for where all have the same noise, m/s^2 or N

    @property
    def is_of_points(self) -> bool:
        """Whether the runs are tables of speeds and forces, whose rows have no place and no order in time."""
        return self.pieces[0].path.steady

    def __init__(
        self, model: Model, layout: ParameterLayout, pieces: Sequence[Piece], budget: EvaluationBudget | None = None
    ) -> None:
        fine = max((effect.fine for effect in model.effects), default=1)
        self.model, self.layout = model, layout
        self.pieces = [piece if piece.per_frame >= fine else piece.refined(fine) for piece in pieces]
        self.budget = budget or EvaluationBudget()
        paths = [piece.path for piece in self.pieces]
        if missing := [message for effect in model.effects if (message := effect.lacks(paths))]:
            raise FrictrackError("; ".join(missing))
        self._groups = group_unknowns(layout)
        self._simulations: dict[tuple[int, ...], _Simulation] = {}
        self._near: list[PieceResponse] = []

    def beginning_at(self, responses: Sequence[PieceResponse]) -> LeastSquaresProblem:
        """Return the same problem, whose first simulation begins at known motions of the pieces."""
        near = copy(self)
        near._simulations, near._near = {}, list(responses)
        return near

    def rebuild(self, layout: ParameterLayout, pieces: Sequence[Piece] | None = None) -> LeastSquaresProblem:
        """Create the same kind of problem for another layout or other pieces than its own."""
        return type(self)(layout.model, layout, pieces or self.pieces, self.budget)

    def with_budget(self, budget: EvaluationBudget) -> LeastSquaresProblem:
        """Return the same problem with another budget of evaluations."""
        limited = copy(self)
        limited.budget = budget
        return limited

    @property
    def n_frames(self) -> int:
        """Frames of all pieces."""
        return sum(len(p.t) for p in self.pieces)

    @classmethod
    def of(cls, model: Model, pieces: Sequence[Piece], names: tuple[str, ...], fps: float) -> LeastSquaresProblem:
        """Create the problem of a model that has no start values yet, over the pieces of runs with these names."""
        return cls(model, ParameterLayout(model, names, spans_of(pieces, len(names), fps)), pieces)

    @property
    def blocks(self) -> list[DataBlock]:
        """The pieces as data that forces along their measured motion explain."""
        return [displacement_block(piece) for piece in self.pieces]

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
        """Positions of the pieces that are simulated together."""
        return group_by_size([len(piece.panels.t) for piece in self.pieces], MAX_JOINED_NODES)

    def _respond_together(self, rows: tuple[int, ...], p: Array, starts: Sequence[Array]) -> list[PieceResponse]:
        """Simulate and linearise some pieces together."""
        simulation = self._simulation(rows)
        joined = self._with_clock(simulation.joined, p)
        law = self._law(joined, p)
        begin = np.array([starts[i] for i in rows], dtype=float)
        motion, linear = self._simulate(simulation, law, begin)
        edges = linear.edge_states(*_with_starts(law.sensitivities(motion)))
        simulation.guess, simulation.is_first = motion.a, False
        responses, split = [], split_motions(joined, motion, linear)
        for piece, columns, rows_of_edges, own in zip(
            joined.pieces, simulation.columns, joined.edges, split, strict=True
        ):
            sensitivities = edges[rows_of_edges, 0][piece.at][:, [*columns, -2, -1]]
            responses.append(self._linearised_response(piece, law, own, (own[0].x_edge[piece.at], sensitivities)))
        return responses

    def _simulation(self, rows: tuple[int, ...]) -> _Simulation:
        """The simulation of some pieces together, with their previous motion."""
        if rows not in self._simulations:
            pieces, near = tuple(self.pieces[i] for i in rows), [self._near[i] for i in rows] if self._near else []
            guesses = [np.interp(q.panels.t, r.motion.panels.t, r.motion.a) for q, r in zip(pieces, near, strict=False)]
            self._simulations[rows] = _Simulation(
                JoinedPieces(pieces),
                [self._columns_of(q.run) for q in pieces],
                np.concatenate(guesses or [q.a_hat for q in pieces]),
            )
        return self._simulations[rows]

    def _columns_of(self, run: int) -> list[int]:
        """Groups of unknowns that affect one run."""
        return [j for j, group in enumerate(self._groups) if group.slot_in(run) is not None]

    def _law(self, joined: JoinedPieces, p: Array) -> JoinedLaw:
        """The model along some pieces."""
        return JoinedLaw(self.layout, self._groups, joined, p, self.model.memory and self.simulates)

    def _with_clock(self, joined: JoinedPieces, p: Array) -> JoinedPieces:
        """Pieces with the clock rate that the model gives to their runs."""
        if all(e.clock is None for e in self.model.effects):
            return joined
        clocks = [self.model.clock(self.layout.values(p, piece.run)[0]) for piece in joined.pieces]
        ways: dict[tuple[int, float], Array] = {}
        return JoinedPieces(tuple(q.with_clock(clock, ways) for q, clock in zip(joined.pieces, clocks, strict=True)))

    def linearised_response(
        self, piece: Piece, p: Array, about: tuple[CollocationSolution, LinearResponse], x: Array
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
        return self._linearised_response(piece, self.law_of(piece, p), about, (x, sensitivities))

    def _linearised_response(
        self,
        piece: Piece,
        law: JoinedLaw,
        about: tuple[CollocationSolution, LinearResponse],
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

    def law_of(self, piece: Piece, p: Array) -> JoinedLaw:
        """Return the model with unknowns p (P,) along one piece."""
        return self._law(JoinedPieces((piece,)), p)

    def motion_sensitivities(
        self, piece: Piece, p: Array, motion: CollocationSolution, linear: LinearResponse
    ) -> Array:
        """Compute the sensitivities (n, 2, A + 2) of position and speed to the active unknowns and to the start."""
        edges = linear.edge_states(*_with_starts(self.acceleration_sensitivities(piece, p, motion).T))
        return edges[piece.at]

    def acceleration_sensitivities(self, piece: Piece, p: Array, motion: CollocationSolution) -> Array:
        """Acceleration at the nodes of one piece per unit of every active unknown, (3 p, A)."""
        g = self.law_of(piece, p).sensitivities(motion)
        return g[self._columns_of(piece.run)].T

    def _simulate(
        self, simulation: _Simulation, law: JoinedLaw, starts: Array
    ) -> tuple[CollocationSolution, LinearResponse]:
        """Solve the motion of pieces, beginning at a near one."""
        pieces, panels, start = law.joined.pieces, law.joined.panels, _by_motion(starts)
        try:
            return solve_motion(law, panels, start, simulation.guess)
        except FrictrackError:
            if self.model.turns or not any(piece.gain for piece in pieces):
                raise
        # under the law the mass comes to rest: no motion turns there, but one whose dry friction turns slowly creeps
        # (where no motion is near, continuation: Allgower & Georg 1990, Numerical Continuation Methods)
        speeds = [float(np.max(np.abs(piece.v_hat))) / piece.gain if piece.gain else 0.0 for piece in pieces]
        steps = int(np.ceil(np.log(max(speeds)) / np.log(SHARPENING))) if simulation.is_first else 0
        guess = simulation.guess
        for k in range(max(steps, 0), -1, -1):
            each = [replace(piece, slack=TURNING_SHARE * piece.gain * SHARPENING**k) for piece in pieces]
            slow = JoinedPieces(tuple(each))
            solved = solve_motion(self._law(slow, law.p), panels, start, guess)
            guess = solved[0].a
        return result_or_none(solve_motion, law, panels, start, guess) or solved

    def _measurement_shift(
        self, piece: Piece, p: Array, motion: CollocationSolution, active: list[int]
    ) -> tuple[Array, Array, Array]:
        """Measurement shift at the frames, its derivative in x, and its change per unit of every active unknown."""
        # A clock error is already in the times of the piece. Only its change shifts the measurement.
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


def split_motions(
    joined: JoinedPieces, motion: CollocationSolution, response: LinearResponse
) -> list[tuple[CollocationSolution, LinearResponse]]:
    """Split motions that were solved together: motion and response of every piece."""
    if len(joined.pieces) == 1:
        return [(motion, response)]
    return [
        (motion.part(piece.panels, nodes, edges), response.part(piece.panels, nodes))
        for piece, nodes, edges in zip(joined.pieces, joined.nodes, joined.edges, strict=True)
    ]


def group_by_size(sizes: Sequence[int], limit: int) -> list[tuple[int, ...]]:
    """Group neighbours whose sizes add up to at most `limit`.

    Examples
    --------
    >>> group_by_size([2, 2, 3, 9, 1], 5)
    [(0, 1), (2,), (3,), (4,)]

    """
    out: list[tuple[int, ...]] = []
    total = 0
    for i, size in enumerate(sizes):
        if not out or total + size > limit:
            out.append(())
            total = 0
        out[-1] += (i,)
        total += size
    return out
