"""The least-squares problem: simulate the motion of every piece, compare it with the measurement, and linearise it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictrack.effects import Path
from frictrack.errors import FrictrackError
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.segments import Piece
from frictrack.models import Model, Values
from frictrack.records import Array
from frictrack.simulate.dynamics import CollocationSolution, MotionResponse, solve_motion

SERIES = ("t", "x", "v", "s", "drive", "lift", "angle")  # arrays of a path with one value per node


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


@dataclass(frozen=True)
class _PreviousMotion:
    """The previous motion of a piece, used as a starting point: unknowns p, start, and accelerations a (3 p,).

    `acceleration_change` (3 p, A + 2) is the derivative of the accelerations by the active unknowns and the start.
    """

    p: Array | None
    start: Array
    a: Array
    acceleration_change: Array
    active: list[int]

    def extrapolated(self, p: Array, start: Array) -> Array | None:
        """Accelerations (3 p,) at other unknowns to first order; None if they change by more than their size."""
        if self.p is None or len(p) != len(self.p):
            return None
        change = self.acceleration_change @ np.concatenate([(p - self.p)[self.active], start - self.start])
        return self.a + change if np.max(np.abs(change)) < np.max(np.abs(self.a)) else None


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

    Raises
    ------
    FrictrackError
        If the runs lack what an effect needs.

    """

    simulates = True

    def __init__(self, model: Model, layout: ParameterLayout, pieces: Sequence[Piece]) -> None:
        self.model, self.layout, self.pieces = model, layout, list(pieces)
        paths = [piece.path for piece in self.pieces]
        if missing := [message for effect in model.effects if (message := effect.lacks(paths))]:
            raise FrictrackError("; ".join(missing))
        self._previous = [
            _PreviousMotion(None, np.zeros(2), piece.a_hat, np.empty((0, 0)), []) for piece in self.pieces
        ]

    def rebuild(self, layout: ParameterLayout, pieces: Sequence[Piece]) -> LeastSquaresProblem:
        """Create the same kind of problem for another layout or other pieces."""
        return LeastSquaresProblem(layout.model, layout, pieces)

    @property
    def n_frames(self) -> int:
        """Frames of all pieces."""
        return sum(len(p.t) for p in self.pieces)

    def first_starts(self) -> list[Array]:
        """Return start position (m) and speed (m/s) of every piece, from the smoothed motion."""
        return [np.array([np.interp(p.t[0], p.panels.t, p.x_hat), p.v_hat[0]]) for p in self.pieces]

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
        return [self._respond(i, p, starts[i]) for i in range(len(self.pieces))]

    def _respond(self, i: int, p: Array, start: Array) -> PieceResponse:
        """Simulate and linearise piece i."""
        piece = self._with_clock(self.pieces[i], p)
        motion, linear = self._simulate(i, piece, p, start)
        acceleration_change, motion_sensitivities = self.sensitivities(piece, p, motion, linear)
        self._previous[i] = _PreviousMotion(
            p, np.array(start), motion.a, acceleration_change, self.layout.active(piece.run)
        )
        return self._linearised_response(piece, p, (motion, linear), (motion.x_edge[piece.at], motion_sensitivities))

    def _with_clock(self, piece: Piece, p: Array) -> Piece:
        """A piece with the clock rate that the model gives to its run."""
        if all(e.clock is None for e in self.model.effects):
            return piece
        return piece.with_clock(self.model.clock(self.layout.values(p, piece.run)[0]))

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
        return self._linearised_response(piece, p, about, (x, self.sensitivities(piece, p, *about)[1]))

    def _linearised_response(
        self,
        piece: Piece,
        p: Array,
        about: tuple[CollocationSolution, MotionResponse],
        seen_motion: tuple[Array, Array],
    ) -> PieceResponse:
        """The same from the sensitivities (n, 2, A + 2) of the motion to the active unknowns and the start."""
        (motion, linear), (x, motion_sensitivities) = about, seen_motion
        active = self.layout.active(piece.run)
        x_sens = motion_sensitivities[:, 0, :]
        shift, slope, direct = self._measurement_shift(piece, p, motion, active)
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
        memory, (values, level) = self.model.memory, self.layout.values(p, piece.run)
        states = self._initial_states(piece, values)

        def acceleration(x: Array, v: Array, t: Array) -> Array:
            if not memory:
                return piece.known - self.model.force(piece.path_at_nodes(x, v, level), values) / piece.mass
            force = self.model.force(replace(piece.path_since_start(x, v, t, level), states=states), values)
            return np.append(0.0, piece.known[: len(t) - 1]) - force / piece.mass

        return acceleration

    def sensitivities(
        self, piece: Piece, p: Array, motion: CollocationSolution, linear: MotionResponse
    ) -> tuple[Array, Array]:
        """Compute the sensitivities of one piece to every active unknown and to the start.

        Returns
        -------
        accelerations : array of shape (3 p, A + 2)
            Change of the acceleration at the nodes.
        motion : array of shape (n, 2, A + 2)
            Change of position and speed at the frames.

        """
        active = self.layout.active(piece.run)
        g = self._acceleration_sensitivities(piece, p, motion, active)
        acceleration_change, edges = linear.respond(
            np.column_stack([g, np.zeros((len(g), 2))]), _unit_starts(len(active))
        )
        return acceleration_change, edges[piece.at]

    def motion_sensitivities(
        self, piece: Piece, p: Array, motion: CollocationSolution, linear: MotionResponse
    ) -> Array:
        """Compute the sensitivities (n, 2, A + 2) of position and speed to the active unknowns and to the start."""
        return self.sensitivities(piece, p, motion, linear)[1]

    def _simulate(self, i: int, piece: Piece, p: Array, start: Array) -> tuple[CollocationSolution, MotionResponse]:
        """Solve the motion of a piece, from the extrapolated previous one where that is close enough."""
        initial = float(start[0]), float(start[1])
        acceleration, memory, previous = self.acceleration(piece, p), self.model.memory, self._previous[i]
        extrapolated = previous.extrapolated(p, start)
        if extrapolated is not None:
            try:
                return solve_motion(acceleration, piece.panels, initial, extrapolated, memory=memory)
            except FrictrackError:  # the extrapolation failed: start from the previous motion
                pass
        return solve_motion(acceleration, piece.panels, initial, previous.a, memory=memory)

    def _initial_states(self, piece: Piece, values: Values) -> dict[str, Array]:
        """States of effects with memory after the motion before a piece; computed once for all motions through it."""
        path = piece.path
        if (
            not (self.simulates and self.model.memory)
            or path.before is None
            or path.before.shape[1] < 2
            or path.s[0] == 0
        ):
            return {}
        two = {name: getattr(path, name)[[0, 0]] for name in SERIES if getattr(path, name) is not None}
        states = self.model.states(replace(path, **two), values)
        return {e.name: states[e.name] for e in self.model.effects if e.turns}

    def _solved_path(self, piece: Piece, motion: CollocationSolution, level: float) -> Path:
        """The path of a solved motion at its nodes; with memory it begins at the start."""
        if not self.model.memory:
            return piece.path_at_nodes(motion.x, motion.v, level)
        x, v = np.append(motion.x_edge[0], motion.x), np.append(motion.v_edge[0], motion.v)
        return piece.path_since_start(x, v, np.append(piece.panels.edges[0], piece.panels.t), level)

    def _acceleration_sensitivities(
        self, piece: Piece, p: Array, motion: CollocationSolution, active: list[int]
    ) -> Array:
        """Acceleration at the nodes per unit of every active unknown, (3 p, A)."""
        values, level = self.layout.values(p, piece.run)
        path = replace(self._solved_path(piece, motion, level), states=self._initial_states(piece, values))
        columns = self.model.force_columns(path, values)
        base = self.model.force(path, values)
        g = np.zeros((len(path.t), len(active)))
        for j, i in enumerate(active):
            slot = self.layout.slots[i]
            leads = i in self.layout.leaders
            if slot.linear and slot.effect in columns and not leads:
                g[:, j] = columns[slot.effect][:, self.column(slot.effect, slot.parameter)]
            elif leads or not slot.linear:
                step = _step(p[i], slot.bounds)
                values_i, level_i = self.layout.values(_shifted(p, i, step), piece.run)
                path_i = replace(
                    self._solved_path(piece, motion, level_i), states=self._initial_states(piece, values_i)
                )
                shifted_force = self.model.force(path_i, values_i)
                g[:, j] = (shifted_force - base) / step
        return -g[-len(motion.x) :] / piece.mass

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
        shift, slope, direct = np.zeros_like(x), np.zeros_like(x), np.zeros((len(x), len(active)))
        if all(e.acts_on == "force" for e in self.model.effects):
            return shift, slope, direct

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
                step = 1.0 if slot.linear and not leads else _step(p[i], slot.bounds)
                direct[:, j] = (total(_shifted(p, i, step), x) - shift) / step
        return shift, slope, direct


def _unit_starts(n: int) -> Array:
    start = np.zeros((2, n + 2))
    start[0, n] = start[1, n + 1] = 1.0
    return start


def _step(value: float, bounds: tuple[float, float]) -> float:
    width = bounds[1] - bounds[0]
    return 1e-6 * max(abs(value), 1e-3 * width if np.isfinite(width) else 1.0)


def _shifted(p: Array, i: int, step: float) -> Array:
    out = p.copy()
    out[i] += step
    return out
