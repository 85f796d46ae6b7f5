"""Fit a rival explanation to the present runs and to a planned run that another explanation predicts, without noise.

The present runs answer linearly to the forces of the fitted rival: to every coefficient, times the friction level of
the run if it carries the load. In the planned run the rival is linearised along the motion that it would have to
reproduce, by one Newton step from there, so that no motion is integrated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import (
    LeastSquaresProblem,
    PieceResponse,
    Solution,
    predicted_objective,
    refine,
    refine_further,
)
from frictrack.fit.parameters import LEVEL, ParameterLayout
from frictrack.fit.pieces import Piece
from frictrack.records import Array, Mask
from frictrack.simulate.dynamics import CollocationSolution, LinearResponse, linearise_acceleration

THREE_PHASES = 2 * np.pi * np.arange(3) / 3  # rad; they determine a constant, a cosine and a sine
TRIED_PHASES = 2 * np.pi * np.arange(64) / 64  # of the planned run, rad
START_TIMES = np.linspace(0.1, 0.9, 7)  # starting times of a rival's event, as shares of the planned run
N_STARTS_REFINED = 2  # best starting values that are refined
MAX_STEPS_OWN, MAX_STEPS = 2, 12  # Gauss-Newton steps: planned run alone, all runs
MIN_CHI2_FALL = 0.1  # of a step; less does not change which runs separate two explanations


class RivalOfPlannedRun(LeastSquaresProblem):
    """A rival in a planned run, linearised along the motion that the truth predicts.

    That motion is what the camera would measure, so a rival that follows it is linearised where it ends. A model with
    memory has to be simulated.
    """

    def __init__(self, layout: ParameterLayout, piece: Piece, start: Array) -> None:
        super().__init__(layout.model, layout, [piece])
        self.first_start = start
        self._linear: LinearResponse | None = None  # of the first evaluation; near the truth it hardly changes

    def with_layout(self, layout: ParameterLayout) -> RivalOfPlannedRun:
        """The same run with other unknowns."""
        return RivalOfPlannedRun(layout, self.pieces[0], self.first_start)

    def respond(self, p: Array, start: Array) -> PieceResponse:
        """Residual and sensitivities of the run at unknowns p (P,) and a start (2,)."""
        return self.evaluate(p, [start])[0]

    def residual(self, about: PieceResponse, p: Array) -> Array:
        """Whitened residual (n,) at other unknowns of the run, start projected out."""
        if self.model.memory:
            return self.respond(p, self.first_start).r
        motion, piece = about.motion, about.piece
        own = self.acceleration(piece, p)(motion.x, motion.v, piece.panels.t)
        moved = about.linear.respond((own - motion.a)[:, None], np.zeros((2, 1)))[1][piece.at, 0, 0]
        shift = self._measurement_shift(piece, p, motion, [])[0]
        r = piece.whitened(piece.y - motion.x_edge[piece.at] - (1 + about.shift_slope) * moved - shift)
        return np.asarray(r - about.q @ (about.q.T @ r))

    def evaluate(self, p: Array, starts: Sequence[Array]) -> list[PieceResponse]:
        """Residual and sensitivities of the run at unknowns p (P,) and its start."""
        if self.model.memory:
            return super().evaluate(p, starts)
        piece = self._with_rival_clock(self.pieces[0], p)
        begin = self.first_start * np.array([1.0, self.pieces[0].clock / piece.clock])
        edges = piece.panels.integrate(piece.a_hat, *begin)[2:]
        motion = CollocationSolution(piece.panels, piece.x_hat, piece.v_hat, piece.a_hat, *edges)
        acceleration = self.acceleration(piece, p)
        if self._linear is None:
            own, self._linear = linearise_acceleration(acceleration, piece.panels, (motion.x, motion.v))
        else:
            own = acceleration(motion.x, motion.v, piece.panels.t)
        moved = self._linear.respond((own - motion.a)[:, None], (starts[0] - begin)[:, None])[1]
        x = motion.x_edge[piece.at] + moved[piece.at, 0, 0]
        response = self.linearised_response(piece, p, (motion, self._linear), x)
        return [replace(response, r_full=response.r)]  # linear in the start: the best one is known

    def _with_rival_clock(self, piece: Piece, p: Array) -> Piece:
        """The run with the clock rate that the rival gives to it."""
        if all(e.clock is None for e in self.model.effects):
            return piece
        return piece.with_clock(self.model.clock(self.layout.values(p, piece.run)[0]))


@dataclass(frozen=True, eq=False)
class _PresentRun:
    """Response of one present run about the fitted rival.

    The force depends on the products of the friction level and the coefficients that carry the load, so that the run
    answers linearly to these products.

    Attributes
    ----------
    response : PieceResponse
        Response about `p`, with the friction level among its A unknowns if the layout has one.
    p : array of shape (A,)
        Unknowns of the fitted rival.
    phases, loaded, level : array of bool, shape (A,)
        Which unknowns are phases, coefficients that carry the load, and the friction level.

    """

    response: PieceResponse
    p: Array
    phases: Mask
    loaded: Mask
    level: Mask

    def at(self, p: Array) -> PieceResponse:
        """The response at other unknowns p (P,) of the rival."""
        change = self._change(p)
        ratio = 1.0 + float(np.sum(change[self.level] / self.p[self.level]))
        scale, loads = np.where(self.loaded, ratio, 1.0), change * self.loaded
        jac = self.response.jac * scale
        jac[:, self.level] += (self.response.jac @ loads)[:, None] / self.p[self.level]
        residual = self.response.r - self.response.jac @ (change * scale)
        return replace(self.response, jac=jac, r=residual, r_full=residual)

    def _change(self, p: Array) -> Array:
        """Change (A,) of the unknowns; phases change by less than half a turn."""
        change = p[self.response.active] - self.p
        return np.where(self.phases, (change + np.pi) % (2 * np.pi) - np.pi, change)


def _present_run(response: PieceResponse, about: Solution, layout: ParameterLayout) -> _PresentRun:
    """A present run under a layout that may have more runs, values per run, or friction levels that `about` lacks."""
    active, p = _positions(about.problem.layout, layout, response), about.p[response.active]
    known = {(e.name, q.name): q for e in layout.model.effects for q in e.parameters}
    parameters = [known.get((s.effect, s.parameter)) for s in (layout.slots[i] for i in active)]
    loaded = np.array([q is not None and q.loaded for q in parameters], dtype=bool)
    phases = np.array([q is not None and q.role == "phase" for q in parameters], dtype=bool)
    if missing := [i for i in layout.levels if layout.slots[i].run == response.piece.run and i not in active]:
        response, active, p = _with_level(response, p * loaded), [*active, *missing], np.append(p, 1.0)
        loaded, phases = np.append(loaded, False), np.append(phases, False)
    return _PresentRun(replace(response, active=active), p, phases, loaded, np.isin(active, layout.levels))


def _with_level(response: PieceResponse, loads: Array) -> PieceResponse:
    """The response with a friction level, now one, on all coefficients that carry the load; `loads` (A,) are these."""
    jac, on_start = (np.column_stack([m, m @ loads]) for m in (response.jac, response.on_start))
    return replace(response, jac=jac, on_start=on_start)


class RivalOfAllRuns(LeastSquaresProblem):
    """The present runs, which answer linearly to the forces of the fitted rival, and a planned run if there is one."""

    def __init__(
        self,
        present: tuple[Solution, list[PieceResponse]],
        layout: ParameterLayout,
        planned: RivalOfPlannedRun | None = None,
    ) -> None:
        about, responses = present
        own = [] if planned is None else planned.pieces
        super().__init__(layout.model, layout, [*(r.piece for r in responses), *own])
        self._present, self._planned = [_present_run(r, about, layout) for r in responses], planned

    def evaluate(self, p: Array, starts: Sequence[Array]) -> list[PieceResponse]:
        """Residuals and sensitivities of all runs at unknowns p (P,)."""
        present = [run.at(p) for run in self._present]
        return present if self._planned is None else [*present, self._planned.respond(p, starts[-1])]


def _roles(layout: ParameterLayout) -> dict[tuple[str, str], str]:
    """Role of every parameter, by effect and name."""
    return {(e.name, q.name): q.role for e in layout.model.effects for q in e.parameters}


def _positions(old: ParameterLayout, new: ParameterLayout, response: PieceResponse) -> list[int]:
    """Where the unknowns of a response are in a layout that may have more runs, or values per run."""
    by_slot = {(s.effect, s.parameter, s.run): i for i, s in enumerate(new.slots)}
    shared = [(s.effect, s.parameter, s.run) for s in (old.slots[k] for k in response.active)]
    return [by_slot[s] if s in by_slot else by_slot[*s[:2], response.piece.run] for s in shared]


def refine_rival(problem: LeastSquaresProblem, p: Array, starts: Sequence[Array], tau: float) -> Solution:
    """Refine all unknowns of a rival as far as the choice of a run needs."""
    return refine(problem, p, starts, tau=tau, max_steps=MAX_STEPS, min_fall=MIN_CHI2_FALL)


def compress_response(response: PieceResponse) -> PieceResponse:
    """The same linear response in as many rows as it has unknowns (QR)."""
    upper = np.asarray(np.linalg.qr(np.column_stack([response.jac, response.r]), mode="r"))
    none = np.zeros((len(upper), response.q.shape[1]))  # the start is in neither
    return replace(response, jac=upper[:, :-1], r=upper[:, -1], r_full=upper[:, -1], q=none)


def start_rival(planned: RivalOfPlannedRun, p: Array, tau: float) -> tuple[Array, Array]:
    """Best phases and event times of the rival in the planned run, and its initial conditions."""
    start = planned.first_start
    p = _with_best_phases(planned, p)
    moments = _moments(planned)
    if not moments:
        return p, start
    own = np.array([s.run == planned.pieces[0].run for s in planned.layout.slots])
    tried = []
    for trial in (p, *_with_moments(planned.pieces[0], p, moments)):
        with suppress(FrictrackError):  # a start too wild to be integrated
            tried.append(predicted_objective(planned, trial, [start], tau=tau, free=own))
    tried.sort(key=lambda t: t[0])
    found = [
        refine_further(s, tau, free=own, max_steps=MAX_STEPS_OWN, min_fall=MIN_CHI2_FALL)
        for _, s in tried[:N_STARTS_REFINED]
    ]
    best = min(found, key=lambda s: s.objective, default=None)
    return (p, start) if best is None else (best.p, best.starts[0])


def _own_slots(planned: RivalOfPlannedRun) -> list[int]:
    """Positions of the unknowns that belong to the planned run alone, without its friction level."""
    run = planned.pieces[0].run
    return [i for i, s in enumerate(planned.layout.slots) if s.run == run and s.effect != LEVEL]


def _moments(planned: RivalOfPlannedRun) -> list[int]:
    """Positions of the times of events in the planned run."""
    slots, roles = planned.layout.slots, _roles(planned.layout)
    own = [(i, slots[i]) for i in _own_slots(planned)]
    return [i for i, s in own if not s.linear and s.unit == "s" and roles[s.effect, s.parameter] != "phase"]


def _with_moments(piece: Piece, p: Array, moments: Sequence[int]) -> Iterator[Array]:
    """Starting values (P,) with the times of events spread over the planned run."""
    for i in moments:
        for share in START_TIMES:
            yield _with_value(p, i, float(piece.t[0] + share * (piece.t[-1] - piece.t[0])))


def _with_best_phases(planned: RivalOfPlannedRun, p: Array) -> Array:
    """The unknowns with the phase of every oscillation in the planned run that fits it best, one after another.

    The force of an oscillation is a constant plus a cosine and a sine of its phase, so that three phases tell all.
    """
    slots, roles = planned.layout.slots, _roles(planned.layout)
    phases = [i for i in _own_slots(planned) if roles[slots[i].effect, slots[i].parameter] == "phase"]
    if not phases:
        return p
    about = planned.respond(p, planned.first_start)
    for i in phases:
        others = [slots[k].run == about.piece.run and slots[k].effect != slots[i].effect for k in about.active]
        q, _ = np.linalg.qr(about.jac[:, others])
        r = np.stack([planned.residual(about, _with_value(p, i, float(phase))) for phase in THREE_PHASES], axis=1)
        r -= q @ (q.T @ r)
        shares = _harmonics(TRIED_PHASES) @ np.linalg.inv(_harmonics(THREE_PHASES))
        chi2 = np.einsum("ka,ab,kb->k", shares, r.T @ r, shares)
        p = _with_value(p, i, float(TRIED_PHASES[int(np.argmin(chi2))]))
    return p


def _harmonics(phases: Array) -> Array:
    """Constant, cosine and sine of phases (k,), (k, 3)."""
    return np.stack([np.ones_like(phases), np.cos(phases), np.sin(phases)], axis=1)


def _with_value(p: Array, i: int, value: float) -> Array:
    out = p.copy()
    out[i] = value
    return out
