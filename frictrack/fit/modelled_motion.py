"""Compute the modelled motion x, v, a and F of every run, with uncertainty bands from the fit.

An adequate model has only a few uncertain parameters, so its acceleration is known several times better than that of
any smoother. All unknowns, with the starts, are varied along independent directions by one standard deviation. The
change in x, v, a and F is the band. It is exact to first order: x and v by the linear response of the motion, F and a
by differences along it.

What the model misses is in its residual: to first order, modelled minus true displacement is the residual without its
noise. Its significant part is added to the bands, with its first two derivatives.

A piece forgets what the model missed before it; a free run, over a whole record from its first state, does not.
Benchmarks of system identification score it as the root mean square of measured minus simulated output. The first state
(position, velocity, states of memory) is fitted to the first frames of the record. Without a measured drive, a free run
is the simulation from the release, from the state that was fitted there.

Summarise collisions: a film determines the impulse, but mostly not the duration and so not the peak force.

The displacement responds to a pulse J g((t - time)/width) through its moments: J, J time and J width^2/2. So the
square of the width is nearly linear in the data, with the standard deviation 2 width std(width).

Evaluate the fitted law over the velocity: F(v) at the reference load, with its standard deviation.

The law is the sum of the force effects that depend on the velocity alone. Effects of place, time or memory, and those
that modify others, are left out of it: what is left is the friction of a steady slide.

References
----------
Schoukens, M. & Noel, J. P. (2017). Three benchmarks addressing open challenges in nonlinear system identification.
IFAC-PapersOnLine 50, 446-451.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.fft import dct
from scipy.interpolate import make_interp_spline
from scipy.optimize import least_squares
from scipy.special import ndtri

from frictrack.base.errors import FrictrackError
from frictrack.effects import Effect, Path
from frictrack.effects.models import Model, Values
from frictrack.fit.cutting import Reference, whole_piece
from frictrack.fit.least_squares import PieceResponse, Solution, inverse_normal_matrix
from frictrack.fit.parameters import mass_ratio, without_mass
from frictrack.fit.pieces import Piece
from frictrack.fit.smooth_functions import rms
from frictrack.fit.uncertainty.estimates import Estimates
from frictrack.measure.friction import count_flights
from frictrack.records import GRAVITY, Array, Curve, Mask, ModelledMotion, Run
from frictrack.sampling import noise_level
from frictrack.simulate import Conditions, Start, simulate_displacement

MAX_RELATIVE_STD = 0.3  # relative standard deviation of a resolved width
MIN_IMPULSE_STD = 3.0  # standard deviations; a smaller impulse is not significant
PULSE_HALF_WIDTHS = 3.0  # half length of a pulse in widths
DIFFERENCE_STEP = 1e-6  # finite-difference step, standard deviations
ALPHA_UNMODELLED = 1e-3  # false-alarm probability of unmodelled motion per run
EXCESS_STD = 4.0  # standard deviations of chi-squared per frame: significantly above one
POINTS = 40  # of a curve
STEP_STD = 1e-4  # of the finite differences, standard deviations
MIN_SPEED_SHARE = 1e-3  # slowest speed of a curve over the fastest one
FIRST_FRAMES = (20, 200)  # frames of a driven record to which its first state is fitted: least, most
FIRST_SHARE = 0.025  # share of the record, between these limits
FIRST_STATE_STEP = 1e-4  # of a first state, share of the travel and speed in the first frames
RELATIVE_TOLERANCE = 5e-4  # accuracy of a free run, share of the rms displacement
PATH_ARRAYS = ("t", "x", "v", "s", "drive", "lift", "angle")  # series of a path


def collisions(solution: Solution, estimates: Estimates) -> list[dict[str, Any]]:
    """Summarise every collision of the fitted runs as JSON: impulse, time since release, what is known of the width."""
    layout = solution.problem.layout
    return [
        _collision(solution, estimates, effect, i)
        for effect in _collision_effects(solution)
        for i in range(len(layout.run_names))
        if (effect.name, i) not in layout.absent
    ]


def frames_of_impact(solution: Solution, covariance: Array, piece: Piece) -> Mask:
    """Return the frames (n,) of collisions whose width is not resolved."""
    layout = solution.problem.layout
    values, _ = layout.values(solution.p, piece.run)
    out = np.zeros(len(piece.t), dtype=bool)
    for effect in _collision_effects(solution):
        width, std = _width(solution, covariance, effect, piece.run)
        if (effect.name, piece.run) not in layout.absent and std > MAX_RELATIVE_STD * width:
            out |= np.abs(piece.t - values[effect.name]["time"]) <= PULSE_HALF_WIDTHS * max_width(width, std)
    return out


def max_width(width: float, std: float) -> float:
    """Compute the largest plausible width (s) of a pulse: two standard deviations of its square above the fitted one.

    Examples
    --------
    >>> max_width(3.0, 0.0)
    3.0

    """
    return float(np.sqrt(width**2 + 4 * width * std))


def _collision_effects(solution: Solution) -> list[Effect]:
    return [e for e in solution.problem.model.effects if e.kind == "collision"]


def _width(solution: Solution, covariance: Array, effect: Effect, run: int) -> tuple[float, float]:
    """Width of a collision and its standard deviation, s; 0 where it is fixed."""
    layout = solution.problem.layout
    values, _ = layout.values(solution.p, run)
    at = [i for i in layout.active(run) if (s := layout.slots[i]).effect == effect.name and s.parameter == "width"]
    return values[effect.name]["width"], float(np.sqrt(covariance[at[0], at[0]])) if at else 0.0


def _collision(solution: Solution, estimates: Estimates, effect: Effect, index: int) -> dict[str, Any]:
    run, parameters = solution.problem.layout.run_names[index], estimates.parameters
    impulse, time = parameters[f"{effect.name}.J[{run}]"], parameters[f"{effect.name}.time[{run}]"]
    width, std = _width(solution, estimates.covariance, effect, index)
    at_most, resolved = max_width(width, std), std <= MAX_RELATIVE_STD * width
    if not impulse.value or abs(impulse.value) < MIN_IMPULSE_STD * (impulse.std or np.inf):
        remark = "no significant collision in this run"
    elif resolved:
        remark = "its width is resolved"
    else:
        remark = (
            f"its width is known to {100 * std / width:.0f} % only (at most {1e3 * at_most:.2g} ms): "
            "these frames determine the impulse, but not the peak force"
        )
    return {
        "effect": effect.name,
        "run": run,
        "impulse_N_s": impulse.value,
        "std": impulse.std,
        "relative_std": impulse.std / abs(impulse.value) if impulse.value and impulse.std is not None else None,
        "time_s": time.value,
        "width_s": width,
        "width_std": std,
        "width_at_most_s": at_most,
        "resolved": resolved,
        "words": remark,
    }


class UnmodelledMotion(NamedTuple):
    """The significant part of a residual beyond white noise."""

    rms: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of x (m), v (m/s) and a (m/s^2)
    factor: float = 1.0  # on the model's own band, for coloured noise
    hertz: float | None = None  # where it is strongest; None if nothing is missed


def modelled_motion(
    solution: Solution, covariance: Array, runs: Sequence[Run], validation: Sequence[tuple[Solution, Run]] = ()
) -> tuple[ModelledMotion, ...]:
    """Compute the modelled motion of every run with its bands, validation runs, each with its prediction, last.

    `covariance` (P, P) is that of the unknowns. A band includes parameters, starts and camera noise. Mass and scale are
    common to all runs and are stated separately.
    """
    fitted = [_run_motion(solution, covariance, i, run) for i, run in enumerate(runs)]
    predicted = [_run_motion(own, _predicted_covariance(solution, covariance, own), 0, run) for own, run in validation]
    return (*fitted, *(replace(motion, role="validation") for motion in predicted))


def _predicted_covariance(fitted: Solution, covariance: Array, solution: Solution) -> Array:
    """Covariance of the unknowns of a validation run: shared ones from the fit, its own free."""
    theirs, mine = fitted.problem.layout.slots, solution.problem.layout.slots
    shared = {(s.effect, s.parameter): i for i, s in enumerate(theirs) if s.run is None}
    common = [i for i, s in enumerate(mine) if s.run is None]
    own = [i for i, s in enumerate(mine) if s.run is not None]
    at = [shared[mine[i].effect, mine[i].parameter] for i in common]
    follow = np.zeros((len(mine), len(common)))  # change of all unknowns with the shared ones
    follow[common] = np.eye(len(common))
    own_covariance = np.zeros((len(mine), len(mine)))
    if own:
        jac = solution.few_rows
        own_covariance[np.ix_(own, own)] = inverse = inverse_normal_matrix(jac[:, own])[0]
        follow[own] = -inverse @ jac[:, own].T @ jac[:, common]
    return np.asarray(follow @ covariance[np.ix_(at, at)] @ follow.T + own_covariance)


def _run_motion(solution: Solution, covariance: Array, index: int, run: Run) -> ModelledMotion:
    """The modelled motion of one run, its pieces joined."""
    mine = [r for r in solution.responses if r.piece.run == index]
    unmodelled = [unmodelled_motion(r, run, ALPHA_UNMODELLED / len(mine)) for r in mine]
    parts = [_piece_motion(solution, covariance, r, left) for r, left in zip(mine, unmodelled, strict=True)]
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    frames = np.concatenate([r.piece.frames for r in mine])
    whole |= {
        "t": run.displacement.t[frames],
        "segment": np.repeat(np.arange(len(mine)), [len(r.piece.t) for r in mine]),
    }
    unique = np.unique(frames, return_index=True)[1]  # neighbouring pieces share a frame
    columns: dict[str, Any] = {name: column[unique] for name, column in whole.items()}
    return ModelledMotion(**columns, run=run.name, notes=_unmodelled_notes(unmodelled))


def _piece_motion(
    solution: Solution, covariance: Array, response: PieceResponse, unmodelled: UnmodelledMotion
) -> dict[str, Array]:
    """The modelled motion of one piece at its frames, with its bands."""
    piece = response.piece
    x, v = response.motion.x_edge[piece.at], response.motion.v_edge[piece.at]
    force, a = _force_and_acceleration(solution, piece, solution.p, x, v)
    changes = _independent_changes(solution, covariance, response, x, v)
    sigma = np.array([np.sqrt(np.sum(change**2, axis=1)) for change in changes])
    beyond = np.array([*unmodelled.rms, unmodelled.rms[2] * piece.mass])
    bands = zip(
        ("sigma_x", "sigma_v", "sigma_a", "sigma_F"), np.hypot(unmodelled.factor * sigma, beyond[:, None]), strict=True
    )
    return {"x": x, "v": v, "a": a, "F": force, **dict(bands), "blow": frames_of_impact(solution, covariance, piece)}


def _force_and_acceleration(solution: Solution, piece: Piece, p: Array, x: Array, v: Array) -> tuple[Array, Array]:
    """Friction force (N) and acceleration at the frames for unknowns p (P,) and a path x, v (n,)."""
    # a fitted mass acts as one more force, and every coefficient stands for `mass_ratio` times itself
    problem = solution.problem
    values, level = problem.layout.values(p, piece.run)
    path = piece.at_frames(x, v, level)
    force = without_mass(problem.model).force(path, values) / mass_ratio(problem.layout, p)
    return force, piece.known_at_frames - problem.model.force(path, values) / piece.mass


def _independent_changes(
    solution: Solution, covariance: Array, response: PieceResponse, x: Array, v: Array
) -> list[Array]:
    """Changes of x, v, a and F at the frames, (n, k) each, along k independent directions of one standard deviation."""
    # the start is least squares for any unknowns, so it follows them; it has an error of its own as well
    piece, active, p = response.piece, response.active, solution.p
    n = len(active)
    inverse_upper = np.linalg.inv(response.upper)
    root = _square_root(covariance[np.ix_(active, active)])
    parameter_moves = np.block([[root, np.zeros((n, 2))], [-inverse_upper @ response.on_start @ root, inverse_upper]])
    moved = solution.problem.motion_sensitivities(piece, p, response.motion, response.linear)
    dx, dv = (moved @ parameter_moves).transpose(1, 0, 2)
    unknown = np.zeros((len(p), n + 2))
    unknown[active] = parameter_moves[:n]
    changes = []
    for u, ex, ev in zip(unknown.T, dx.T, dv.T, strict=True):
        after, before = (
            np.array(_force_and_acceleration(solution, piece, p + h * u, x + h * ex, v + h * ev))
            for h in (DIFFERENCE_STEP, -DIFFERENCE_STEP)
        )
        changes.append((after - before) / (2 * DIFFERENCE_STEP))
    force, a = np.array(changes).transpose(1, 2, 0)
    return [dx, dv, a, force]


def _square_root(covariance: Array) -> Array:
    """A square root (n, n) of a covariance whose variances may differ by many powers of ten."""
    std = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    value, vector = np.linalg.eigh(covariance / std[:, None] / std)
    return np.asarray(std[:, None] * vector * np.sqrt(np.maximum(value, 0.0)))


def unmodelled_motion(response: PieceResponse, run: Run, alarms: float) -> UnmodelledMotion:
    """Find the significant part of one piece's residual; white noise shows one with probability `alarms`.

    The cosine transform of the residual is white if only noise is left. Significant coefficients belong to motion
    that the model misses. Excess power without significant coefficients counts as coloured noise and widens the band.
    """
    piece = response.piece
    n = len(piece.t)
    z = dct(piece.whitened(piece.y - response.model_y), norm="ortho")
    significant = np.abs(z) > ndtri(1 - alarms / (2 * n))
    power = float(np.mean(z**2))
    level = noise_level(run.displacement.x, run.displacement.valid, t=run.displacement.t)[1]
    excessive = power > 1 + EXCESS_STD * float(np.sqrt(2 / n + (2 * level) ** 2))
    if not (excessive or np.any(significant)):
        return UnmodelledMotion()
    omega = np.pi * np.arange(n) / (piece.t[-1] - piece.t[0]) * (n - 1) / n
    power_beyond_noise = np.where(significant, z**2 - 1, 0.0) / n * np.mean(piece.noise**2)
    x, v, a = (float(np.sqrt(power_beyond_noise @ omega**k)) for k in (0, 2, 4))
    peak_frequency = omega[int(np.argmax(np.abs(z)))] / (2 * np.pi)
    remaining = float(np.mean(z[~significant] ** 2)) if excessive and not np.all(significant) else 1.0
    return UnmodelledMotion((x, v, a), max(1.0, float(np.sqrt(remaining))), peak_frequency)


def _unmodelled_notes(unmodelled: Sequence[UnmodelledMotion]) -> tuple[str, ...]:
    """A note on what the pieces of a run miss: that of the worst one."""
    found = [one for one in unmodelled if one.hertz is not None]
    if not found:
        return ()
    (x, _, a), _, hertz = max(found, key=lambda one: one.rms[2])
    where = f" in {len(found)} of {len(unmodelled)} segments" if len(unmodelled) > 1 else ""
    return (
        f"the model misses something{where}: its residual shows {1e6 * x:.2g} µm beyond the noise, most near "
        f"{hertz:.0f} Hz, which is {a:.2g} m/s² rms; the bands hold only if nothing faster is missing, and at single "
        "places the error may be larger; `frictrack diagnose` names what is missing",
    )


def band_summary(motion: ModelledMotion, run: Run) -> dict[str, Any]:
    """Compute rms bands of the modelled motion, and of the smoothed acceleration at the same frames, as JSON.

    Frames of unresolved collisions are left out of both.
    """
    kept = ~motion.blow
    smoothed = run.motion.sigma_a[np.searchsorted(run.motion.t, motion.t - 1e-9)]
    bands = {
        "sigma_x_um": 1e6 * motion.sigma_x,
        "sigma_v": motion.sigma_v,
        "sigma_a": motion.sigma_a,
        "sigma_F_N": motion.sigma_F,
        "sigma_a_smoothed": smoothed,
    }
    return {name: rms(band[kept]) for name, band in bands.items()} | {"notes": list(motion.notes)}


def law_branches(
    solution: Solution, curves: Sequence[Curve], covariance: Array, load: float | None
) -> list[dict[str, Any]]:
    """Compute the law for each direction in which the fitted runs moved.

    Parameters
    ----------
    solution
        The fit.
    curves
        Its curves.
    covariance
        Covariance of the unknowns, (P, P).
    load
        Reference load, N; None if it is not known.

    Returns
    -------
    list of dict
        `direction` (+1 or -1), speeds `v` (m/s, above 0) from the slowest to the fastest that was seen, friction force
        against the motion `F` and its standard deviation `sigma_F` (N) at the reference load, `load_N` (that load; None
        if it is not known) and `effects`, the names of those that it contains. Empty without such effects.

    """
    speeds = np.concatenate([curve.v_model for curve in curves if curve.role == "fit"])
    effects = tuple(e for e in without_mass(solution.problem.model).effects if _is_of_velocity(e))
    if not effects:
        return []
    out = []
    for direction in (1, -1):
        seen = np.abs(speeds[direction * speeds > 0])
        if not len(seen) or float(np.max(seen)) < MIN_SPEED_SHARE * float(np.max(np.abs(speeds))):
            continue
        low, high = max(float(np.min(seen)), MIN_SPEED_SHARE * float(np.max(seen))), float(np.max(seen))
        v = low + (high - low) * np.linspace(0.0, 1.0, POINTS) ** 2  # closer where the law is steep
        force, sigma = _force_and_deviation(
            solution, covariance, Model(effects), Path(0 * v, 0 * v, direction * v, np.full_like(v, direction))
        )
        branch = {"direction": direction, "v": v, "F": direction * force, "sigma_F": sigma}
        out.append(branch | {"load_N": load, "effects": [e.name for e in effects]})
    return [{k: q.tolist() if isinstance(q, np.ndarray) else q for k, q in branch.items()} for branch in out]


def _is_of_velocity(effect: Effect) -> bool:
    """Whether an effect adds a force of friction, not of gravity or the drive, that depends on the velocity alone."""
    of_runs = any(p.per_run for p in effect.parameters)
    return effect.scales_with in ("load", "nothing") and not (effect.modifies or of_runs) and effect.is_of_velocity


def _force_and_deviation(solution: Solution, covariance: Array, law: Model, path: Path) -> tuple[Array, Array]:
    """Force of the law along a path, N, and its standard deviation to first order."""
    layout, p = solution.problem.layout, solution.p

    def force(unknowns: Array) -> Array:
        return law.force(path, layout.values(unknowns, 0)[0]) / mass_ratio(layout, unknowns)

    steps = STEP_STD * _square_root(covariance).T  # along independent directions
    changes = [(force(p + step) - force(p - step)) / (2 * STEP_STD) for step in steps]
    return force(p), np.linalg.norm(changes, axis=0)


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
    """The first state, fitted to the first frames; from rest only the position is fitted."""
    frames = min(int(np.clip(FIRST_SHARE * len(piece.t), *FIRST_FRAMES)), len(piece.t))
    first, rests = piece.part(0, frames), piece.path.s[0] == 0
    names = [(name, k) for name, state in states.items() for k in range(state.shape[1])]
    memory = np.array([states[name][0, k] for name, k in names])
    travel, speed = float(np.ptp(first.x_hat)), float(np.ptp(first.v_hat))
    scales = np.array([travel, max(speed, abs(float(piece.v_hat[0]))), *np.maximum(np.abs(memory), 1e-3 * travel)])
    directions = np.diag(scales + 1e-12)[[0, *range(2, len(scales))] if rests else slice(None)]
    smoothed = np.array([piece.y[0], 0.0 if rests else piece.v_hat[0], *memory])

    def start(q: Array) -> Start:  # one at the smoothed motion, so that relative steps are shares of the scales
        theta = smoothed + (q - 1.0) @ directions
        own = {name: state.copy() for name, state in states.items()}
        for (name, k), value in zip(names, theta[2:], strict=True):
            own[name][0, k] = value
        return Start(float(theta[0]), float(theta[1]), own)

    def residual(q: Array) -> Array:
        return first.whitened(first.y - simulate(start(q), frames))

    ones = np.ones(len(directions))
    return start(least_squares(residual, ones, diff_step=FIRST_STATE_STEP * ones, ftol=1e-3).x)


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
        curvature=float(path.curvature),
        lowest=float(path.lowest),
        drive=path.drive_at,
        lift=read(path.lift),
        angle=read(path.angle),
        clamp_x=path.clamp_x,
        beam_length=path.beam_length,
        earlier=None if path.earlier is None else path.earlier[0],
    )
