"""Simulate the free run: the fitted model over a whole record from its first state, with the measured drive.

A segment forgets what the model missed before it; a free run does not. Benchmarks of system identification score it
as the root mean square of measured minus simulated output.

The first state (position, velocity, states of memory) is fitted to the first frames of the record. Without a measured
drive, a free run is the simulation from the release, from the state that was fitted there.

References
----------
Schoukens, M. & Noel, J. P. (2017). Three benchmarks addressing open challenges in nonlinear system identification.
IFAC-PapersOnLine 50, 446-451.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import make_interp_spline

from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution
from frictrack.fit.parameters import without_mass
from frictrack.fit.segments import Piece, Reference, whole_piece
from frictrack.models import Model, Values
from frictrack.records import Array, Run
from frictrack.simulate import Conditions, Start, simulate_displacement

FIRST_FRAMES = (20, 200)  # frames of a driven record to which its first state is fitted: least, most
FIRST_SHARE = 0.025  # share of the record, between these limits
MAX_STEPS = 4  # Gauss-Newton steps; the motion depends smoothly on the first state
RELATIVE_TOLERANCE = 5e-4  # accuracy of a free run, share of the rms displacement
PATH_ARRAYS = ("t", "x", "v", "s", "drive", "lift", "angle")  # series of a path
MIN_SINGULAR_VALUE = 1e-6  # relative; smaller ones are not determined


@dataclass(frozen=True)
class FreeRun:
    """A model simulated over one record: t since release (s), measured y and modelled x (m), (n,) each."""

    t: Array
    y: Array
    x: Array

    @property
    def rms(self) -> float:
        """Root mean square of measured minus simulated displacement, m."""
        return float(np.sqrt(np.mean((self.y - self.x) ** 2)))


def free_run(solution: Solution, run: Run, reference: Reference, index: int = 0) -> FreeRun | None:
    """Simulate one free run of a fitted model over a whole record of displacement.

    Parameters
    ----------
    solution : Solution
        The fit, or the prediction of a validation run.
    run : Run
        The record; its drive is interpolated between samples.
    reference : Reference
        Mass and load at which newtons are reported.
    index : int
        Index of the run in the solution, for per-run parameters.

    Returns
    -------
    FreeRun or None
        None if the motion cannot be simulated to the end of the record.

    """
    mine = [r for r in solution.responses if r.piece.run == index]
    if run.drive is None and len(mine) == 1:  # the fit is already a simulation from the release
        return FreeRun(mine[0].piece.t, mine[0].piece.y, mine[0].model_y)
    piece = whole_piece(run, index, reference)
    values, level = solution.problem.layout.values(solution.p, index)
    law = _BoundModel(without_mass(solution.problem.model), values, piece, _conditions(piece, run, level))
    try:
        start = law.first_state(level) if run.drive is not None else _fitted_start(solution, index, law, level)
        return FreeRun(piece.t, piece.y, law.simulate(start, len(piece.t)))
    except FrictrackError:
        return None


def free_errors(found: Sequence[FreeRun | None], role: str | None = None) -> dict[str, Any]:
    """Compute the errors of free runs.

    Parameters
    ----------
    found : sequence of FreeRun or None
        Free runs; None for one that could not be simulated.
    role : str, optional
        Role of the runs, "fit" or "validation", to be included.

    Returns
    -------
    dict
        JSON: rms in um, and relative to the displacement; None if a run could not be simulated.

    Examples
    --------
    >>> free_errors([FreeRun(np.arange(2.0), np.array([0.0, 2.0]), np.array([0.0, 2.0]))])
    {'free_run_rms_um': 0.0, 'free_run_relative': 0.0}

    """
    known = [f for f in found if f is not None]
    if not found or len(known) < len(found):
        rms = relative = None
    else:
        residual = np.concatenate([f.y - f.x for f in known])
        moved = np.concatenate([f.y - np.mean(f.y) for f in known])
        rms = 1e6 * float(np.sqrt(np.mean(residual**2)))
        relative = float(np.linalg.norm(residual) / max(float(np.linalg.norm(moved)), 1e-30))
    out: dict[str, Any] = {"free_run_rms_um": rms, "free_run_relative": relative}
    return out if role is None else out | {"free_run": role if found else None}


@dataclass(frozen=True)
class _BoundModel:
    """A model with its parameter values, over one record."""

    model: Model
    values: Values
    piece: Piece
    conditions: Conditions

    def simulate(self, start: Start, frames: int) -> Array:
        """Displacement (n,) at the first frames, m."""
        within = RELATIVE_TOLERANCE * float(np.std(self.piece.y))
        t = self.piece.t[:frames]
        return simulate_displacement(self.model, self.values, self.conditions, t, start, within)

    def initial_states(self, level: float) -> dict[str, Array]:
        """States of memory at the first frame, as far as the motion before determines them."""
        if not self.model.memory:
            return {}
        first = self.piece.part(0, 2)
        path = first.at_frames(first.y[:1], first.v_hat[:1], level)
        one = {name: q[:1] for name in PATH_ARRAYS if (q := getattr(path, name)) is not None}
        return self.model.states(replace(path, **one), self.values)

    def first_state(self, level: float) -> Start:
        """The first state, fitted to the first frames; from rest only the position is fitted."""
        piece = self.piece
        frames = int(np.clip(FIRST_SHARE * len(piece.t), *FIRST_FRAMES))
        frames = min(frames, len(piece.t))
        first_frames = piece.first(frames)
        starts_at_rest = piece.path.s[0] == 0
        states = {} if starts_at_rest else self.initial_states(level)
        names = [(name, k) for name, state in states.items() for k in range(state.shape[1])]
        first = np.array([piece.y[0], 0.0 if starts_at_rest else piece.v_hat[0], *(states[n][0, k] for n, k in names)])
        free = np.arange(len(first)) != 1 if starts_at_rest else np.ones(len(first), dtype=bool)

        def start(theta: Array) -> Start:
            own = {name: state.copy() for name, state in states.items()}
            for (name, k), value in zip(names, theta[2:], strict=True):
                own[name][0, k] = value
            return Start(float(theta[0]), float(theta[1]), own)

        def residual(theta: Array) -> Array:
            return first_frames.whitened(first_frames.y - self.simulate(start(theta), frames))

        return start(_gauss_newton(residual, first, free, _scales(piece, states, frames)))


def _scales(piece: Piece, states: dict[str, Array], frames: int) -> Array:
    """Step sizes of the numbers of a first state, for differences."""
    travel, speed = (float(np.ptp(q[: 3 * frames * piece.per_frame])) for q in (piece.x_hat, piece.v_hat))
    state_scales = [max(abs(float(q)), 1e-3 * travel) for state in states.values() for q in state[0]]
    return np.array([travel, max(speed, abs(float(piece.v_hat[0]))), *state_scales]) + 1e-12


def _gauss_newton(residual: Callable[[Array], Array], first: Array, free: Array, scales: Array) -> Array:
    """Gauss-Newton from a first guess (k,) for the free numbers; a step that does not help is halved."""
    theta, r = first, residual(first)
    free_indices = np.flatnonzero(free).tolist()
    for _ in range(MAX_STEPS):
        jac = np.stack([(residual(_shifted(theta, i, 1e-4 * scales[i])) - r) / 1e-4 for i in free_indices], axis=1)
        step = np.zeros(len(theta))
        step[free_indices] = -np.linalg.lstsq(jac, r, rcond=MIN_SINGULAR_VALUE)[0] * scales[free_indices]
        for _ in range(MAX_STEPS):
            trial = residual(theta + step)
            if trial @ trial <= r @ r:
                break
            step /= 2
        gain = float(r @ r - trial @ trial)
        if gain > 0:
            theta, r = theta + step, trial
        if gain <= 1e-3 * float(r @ r):
            break
    return theta


def _shifted(theta: Array, i: int, step: float) -> Array:
    out = theta.copy()
    out[i] += step
    return out


def _fitted_start(solution: Solution, index: int, law: _BoundModel, level: float) -> Start:
    """The state that was fitted at the first frame of a run without a drive."""
    pairs = zip(solution.problem.pieces, solution.starts, strict=True)
    x, v = next(start for piece, start in pairs if piece.run == index)
    return Start(float(x), float(v), law.initial_states(level))


def _conditions(piece: Piece, run: Run, level: float) -> Conditions:
    """The conditions of the record, as functions of the time since release."""
    path, nodes = piece.path, piece.panels.t

    def read(series: Array | None) -> Callable[[Array], Array] | None:
        return None if series is None else make_interp_spline(nodes, series, k=1)

    return Conditions(
        mass=piece.mass,
        load=float(path.load) * level,
        mass_ratio=float(path.mass_ratio),
        pixel_pitch=path.pixel_pitch,
        incline=run.incline,
        drive=path.drive_at,
        lift=read(path.lift),
        angle=read(path.angle),
        clamp_x=path.clamp_x,
        beam_length=path.beam_length,
        earlier=None if path.earlier is None else path.earlier[0],
    )
