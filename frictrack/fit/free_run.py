"""Free runs: the model over a whole record from its first state, with the measured drive.

A piece forgets what the model missed before it; a free run does not. Benchmarks of system identification score it as
the root mean square of measured minus simulated output. The first state (position, velocity, states of memory) is
fitted to the first frames of the record. Without a measured drive, a free run is the simulation from the release, from
the state that was fitted there.

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

from frictrack.base.errors import FrictrackError
from frictrack.effects.models import Model, Values
from frictrack.fit.cutting import Reference, whole_piece
from frictrack.fit.least_squares import Solution
from frictrack.fit.parameters import without_mass
from frictrack.fit.pieces import Piece
from frictrack.fit.smooth_functions import rms
from frictrack.measure.friction import count_flights
from frictrack.records import GRAVITY, Array, Run
from frictrack.simulate import Conditions, Start, simulate_displacement

FIRST_FRAMES = (20, 200)  # frames of a driven record to which its first state is fitted: least, most
FIRST_SHARE = 0.025  # share of the record, between these limits
MAX_STEPS = 4  # Gauss-Newton steps; the motion depends smoothly on the first state
DIFFERENCE_STEP = 1e-4  # of a first state, share of the travel and speed in the first frames
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
        return rms(self.y - self.x)


def free_run(solution: Solution, run: Run, reference: Reference, index: int = 0) -> FreeRun | None:
    """Simulate one free run of a fit, or of a prediction, over a whole record; None if it cannot be followed.

    `index` is the number of the run in the solution, for per-run parameters. The drive is interpolated.
    """
    mine = [r for r in solution.responses if r.piece.run == index]
    if run.drive is None and len(mine) == 1:  # the fit is already a simulation from the release
        return FreeRun(mine[0].piece.t, mine[0].piece.y, mine[0].model_y)
    if count_flights(run) > 1:  # no model has the blows between them
        return None
    piece, model = whole_piece(run, index, reference), without_mass(solution.problem.model)
    values, level = solution.problem.layout.values(solution.p, index)
    conditions, tolerance = _conditions(piece, run, level), RELATIVE_TOLERANCE * float(np.std(piece.y))

    def simulate(start: Start, frames: int) -> Array:
        return simulate_displacement(model, values, conditions, piece.t[:frames], start, tolerance)

    try:
        states = _initial_states(model, values, piece, level)
        if run.drive is None:
            pairs = zip(solution.problem.pieces, solution.starts, strict=True)
            x, v = next(start for own, start in pairs if own.run == index)
            start = Start(float(x), float(v), states)
        else:
            start = _first_state(piece, states, simulate)
        return FreeRun(piece.t, piece.y, simulate(start, len(piece.t)))
    except FrictrackError:
        return None


def free_errors(found: Sequence[FreeRun | None], role: str | None = None) -> dict[str, Any]:
    """Compute the errors of free runs, as JSON: rms in um, and relative to the displacement; None if one is missing.

    The `role` of the runs, "fit" or "validation", is included where it is given.

    Examples
    --------
    >>> free_errors([FreeRun(np.arange(2.0), np.array([0.0, 2.0]), np.array([0.0, 2.0]))])
    {'free_run_rms_um': 0.0, 'free_run_relative': 0.0}

    """
    known = [f for f in found if f is not None]
    out: dict[str, Any] = {"free_run_rms_um": None, "free_run_relative": None}
    if found and len(known) == len(found):
        residual = np.concatenate([f.y - f.x for f in known])
        moved = np.concatenate([f.y - np.mean(f.y) for f in known])
        out["free_run_rms_um"] = 1e6 * rms(residual)
        out["free_run_relative"] = float(np.linalg.norm(residual) / max(float(np.linalg.norm(moved)), 1e-30))
    return out if role is None else out | {"free_run": role if found else None}


def _initial_states(model: Model, values: Values, piece: Piece, level: float) -> dict[str, Array]:
    """States of memory at the first frame of a record, as far as the motion before determines them; none at rest."""
    if not model.memory or piece.path.s[0] == 0:
        return {}
    first = piece.part(0, 2)
    path = first.at_frames(first.y[:1], first.v_hat[:1], level)
    one = {name: q[:1] for name in PATH_ARRAYS if (q := getattr(path, name)) is not None}
    return model.states(replace(path, **one), values)


def _first_state(piece: Piece, states: dict[str, Array], simulate: Callable[[Start, int], Array]) -> Start:
    """The first state, fitted to the first frames by Gauss-Newton; from rest only the position is fitted."""
    frames = min(int(np.clip(FIRST_SHARE * len(piece.t), *FIRST_FRAMES)), len(piece.t))
    first, rests = piece.part(0, frames), piece.path.s[0] == 0
    names = [(name, k) for name, state in states.items() for k in range(state.shape[1])]
    memory = np.array([states[name][0, k] for name, k in names])
    travel, speed = float(np.ptp(first.x_hat)), float(np.ptp(first.v_hat))
    scales = np.array([travel, max(speed, abs(float(piece.v_hat[0]))), *np.maximum(np.abs(memory), 1e-3 * travel)])
    directions = np.diag(scales + 1e-12)[[0, *range(2, len(scales))] if rests else slice(None)]

    def start(theta: Array) -> Start:
        own = {name: state.copy() for name, state in states.items()}
        for (name, k), value in zip(names, theta[2:], strict=True):
            own[name][0, k] = value
        return Start(float(theta[0]), float(theta[1]), own)

    def residual(theta: Array) -> Array:
        return first.whitened(first.y - simulate(start(theta), frames))

    theta = np.array([piece.y[0], 0.0 if rests else piece.v_hat[0], *memory])
    r = residual(theta)
    for _ in range(MAX_STEPS):
        changes = [(residual(theta + DIFFERENCE_STEP * d) - r) / DIFFERENCE_STEP for d in directions]
        step = -np.linalg.lstsq(np.stack(changes, axis=1), r, rcond=MIN_SINGULAR_VALUE)[0] @ directions
        for _ in range(MAX_STEPS):  # a step that does not help is halved
            trial = residual(theta + step)
            if trial @ trial <= r @ r:
                break
            step /= 2
        gain, before = float(r @ r - trial @ trial), float(r @ r)
        if gain > 0:
            theta, r = theta + step, trial
        if gain <= 1e-3 * before:
            break
    return start(theta)


def _conditions(piece: Piece, run: Run, level: float) -> Conditions:
    """The conditions of the record, as functions of the time since release."""
    path = piece.path

    def read(series: Array | None) -> Callable[[Array], Array] | None:
        return None if series is None else make_interp_spline(piece.panels.t, series, k=1)

    return Conditions(
        mass=piece.mass,
        load=float(path.load) * level,
        mass_ratio=float(path.mass_ratio),
        pixel_pitch=path.pixel_pitch,
        incline=float(np.arcsin(-run.pull / GRAVITY)),
        drive=path.drive_at,
        lift=read(path.lift),
        angle=read(path.angle),
        clamp_x=path.clamp_x,
        beam_length=path.beam_length,
        earlier=None if path.earlier is None else path.earlier[0],
    )
