"""Compute the modelled motion x, v, a and F of every run, with uncertainty bands from the fit.

An adequate model has only a few uncertain parameters, so its acceleration is known several times better than that of
any smoother. All unknowns, with the starts, are varied along independent directions by one standard deviation. The
change in x, v, a and F is the band. It is exact to first order: x and v by the linear response of the motion, F and a
by differences along it.

What the model misses is in its residual: to first order, modelled minus true displacement is the residual without its
noise. Its significant part is added to the bands, with its first two derivatives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from scipy.fft import dct
from scipy.interpolate import make_interp_spline
from scipy.special import ndtri

from frictrack.fit.collisions import frames_of_impact
from frictrack.fit.least_squares import PieceResponse, Solution, inverse_normal_matrix
from frictrack.fit.parameters import mass_ratio, penalty_jacobian, without_mass
from frictrack.motion import noise_level
from frictrack.records import Array, ModelledMotion, Run

MotionFunction = Callable[[Array, Array, Array], tuple[Array, Array]]

DIFFERENCE_STEP = 1e-6  # finite-difference step, standard deviations
ALPHA_UNMODELLED = 1e-3  # false-alarm probability of unmodelled motion per run
EXCESS_STD = 4.0  # standard deviations of chi-squared per frame: significantly above one


def modelled_motion(
    solution: Solution, covariance: Array, runs: Sequence[Run], validation: Sequence[tuple[Solution, Run]] = ()
) -> tuple[ModelledMotion, ...]:
    """Compute the modelled motion of every run, with its bands.

    A band includes parameters, starts and camera noise. Mass and scale are common to all runs and are stated
    separately.

    Parameters
    ----------
    solution : Solution
        The fit.
    covariance : array of shape (P, P)
        Covariance of its unknowns.
    runs : sequence of Run
        The fitted runs, in the order of the solution.
    validation : sequence of (Solution, Run)
        Validation runs with their predictions.

    Returns
    -------
    tuple of Modelled
        Motion and bands of every run, validation runs last.

    """
    motions = [_run_motion(solution, covariance, i, run) for i, run in enumerate(runs)]
    for inverse_upper, run in validation:
        motions.append(
            replace(
                _run_motion(inverse_upper, _predicted_covariance(solution, covariance, inverse_upper), 0, run),
                role="validation",
            )
        )
    return tuple(motions)


def covariance_at_fitted_scatter(solution: Solution) -> Array:
    """Compute the covariance (P, P) of the unknowns at the fitted scatter of the friction levels.

    Unlike `covariance_of` it is not widened for a scatter known from few runs. Widening would separate each run's
    level from the coefficient that it multiplies, while their product is as well known as the run is.
    """
    held = penalty_jacobian(solution.problem.layout, solution.tau or 0.03)
    return inverse_normal_matrix(np.vstack([solution.few_rows, held]))[0]


def _predicted_covariance(fitted: Solution, covariance: Array, solution: Solution) -> Array:
    """Covariance of the unknowns of a validation run: shared ones from the fit, its own free."""
    theirs, mine = fitted.problem.layout.slots, solution.problem.layout.slots
    shared = {(s.effect, s.parameter): i for i, s in enumerate(theirs) if s.run is None}
    common = [i for i, s in enumerate(mine) if s.run is None]
    inverse_upper = [i for i, s in enumerate(mine) if s.run is not None]
    at = [shared[mine[i].effect, mine[i].parameter] for i in common]
    known, jac = covariance[np.ix_(at, at)], solution.few_rows
    free = np.zeros((len(mine), len(mine)))
    free[np.ix_(common, common)] = known
    if inverse_upper:
        own_covariance, _ = inverse_normal_matrix(jac[:, inverse_upper])
        follow = -own_covariance @ jac[:, inverse_upper].T @ jac[:, common]
        free[np.ix_(inverse_upper, common)] = follow @ known
        free[np.ix_(common, inverse_upper)] = free[np.ix_(inverse_upper, common)].T
        free[np.ix_(inverse_upper, inverse_upper)] = own_covariance + follow @ known @ follow.T
    return free


def _run_motion(solution: Solution, covariance: Array, index: int, run: Run) -> ModelledMotion:
    """The modelled motion of one run, its segments joined."""
    mine = [r for r in solution.responses if r.piece.run == index]
    unmodelled_parts = [unmodelled_motion(r, run, ALPHA_UNMODELLED / len(mine)) for r in mine]
    parts = [
        _segment_motion(solution, covariance, r, unmodelled)
        for r, unmodelled in zip(mine, unmodelled_parts, strict=True)
    ]
    parts = [replace(part, segment=part.segment + i) for i, part in enumerate(parts)]
    columns = [f.name for f in fields(ModelledMotion) if f.metadata.get("column")]
    whole: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in columns}
    unique_frames = np.unique(whole["t"], return_index=True)[1]  # neighbouring segments share a frame
    whole["t"] = run.displacement.t[np.concatenate([r.piece.frames for r in mine])]
    return ModelledMotion(
        **{name: column[unique_frames] for name, column in whole.items()},
        run=run.name,
        notes=_unmodelled_notes(unmodelled_parts),
    )


def _segment_motion(
    solution: Solution, covariance: Array, response: PieceResponse, unmodelled: UnmodelledMotion
) -> ModelledMotion:
    """The modelled motion of one segment with its bands."""
    piece = response.piece
    x, v = response.motion.x_edge[piece.at], response.motion.v_edge[piece.at]
    force, a = _motion_function(solution, response)(solution.p, x, v)
    sigma = np.array(
        [np.sqrt(np.sum(m**2, axis=1)) for m in _independent_changes(solution, covariance, response, x, v)]
    )
    unmodelled_rms = np.array([*unmodelled.rms, unmodelled.rms[2] * piece.mass])
    sigma_x, sigma_v, sigma_a, sigma_F = np.hypot(unmodelled.factor * sigma, unmodelled_rms[:, None])
    return ModelledMotion(
        t=piece.t,
        x=x,
        v=v,
        a=a,
        F=force,
        sigma_x=sigma_x,
        sigma_v=sigma_v,
        sigma_a=sigma_a,
        sigma_F=sigma_F,
        blow=frames_of_impact(solution, covariance, piece),
        segment=np.zeros(len(x), dtype=np.int_),
    )


def _motion_function(solution: Solution, response: PieceResponse) -> MotionFunction:
    """Function of unknowns p (P,) and path x, v (n,) that returns friction force (N) and acceleration at the frames.

    A fitted mass acts as one more force, and every coefficient stands for `mass_ratio` times itself.
    """
    piece, problem = response.piece, solution.problem
    known = make_interp_spline(piece.panels.t, piece.known, k=1)(piece.t)  # the first frame lies before the first node
    friction = without_mass(problem.model)

    def force_and_acceleration(p: Array, x: Array, v: Array) -> tuple[Array, Array]:
        values, level = problem.layout.values(p, piece.run)
        path = piece.at_frames(x, v, level)
        force = friction.force(path, values) / mass_ratio(problem.layout, p)
        return force, known - problem.model.force(path, values) / piece.mass

    return force_and_acceleration


def _independent_changes(
    solution: Solution, covariance: Array, response: PieceResponse, x: Array, v: Array
) -> list[Array]:
    """Changes of x, v, a and F at the frames, (n, k) each, along k independent directions of one standard deviation.

    The start is least squares for any unknowns, so it follows them; it has an error of its own as well.
    """
    piece, active, p = response.piece, response.active, solution.p
    n = len(active)
    inverse_upper = np.linalg.inv(response.upper)
    root = _square_root(covariance[np.ix_(active, active)])
    parameter_moves = np.block([[root, np.zeros((n, 2))], [-inverse_upper @ response.on_start @ root, inverse_upper]])
    moved = solution.problem.motion_sensitivities(piece, p, response.motion, response.linear)
    dx, dv = (moved @ parameter_moves).transpose(1, 0, 2)
    unknown = np.zeros((len(p), n + 2))
    unknown[active] = parameter_moves[:n]
    force_and_acceleration = _motion_function(solution, response)
    changes = []
    for u, ex, ev in zip(unknown.T, dx.T, dv.T, strict=True):
        after, before = (
            force_and_acceleration(p + h * u, x + h * ex, v + h * ev) for h in (DIFFERENCE_STEP, -DIFFERENCE_STEP)
        )
        changes.append((np.array(after) - np.array(before)) / (2 * DIFFERENCE_STEP))
    force, a = np.array(changes).transpose(1, 2, 0)
    return [dx, dv, a, force]


def _square_root(covariance: Array) -> Array:
    """A square root (n, n) of a covariance whose variances may differ by many powers of ten."""
    power_beyond_noise = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    value, vector = np.linalg.eigh(covariance / power_beyond_noise[:, None] / power_beyond_noise)
    return np.asarray(power_beyond_noise[:, None] * vector * np.sqrt(np.maximum(value, 0.0)))


@dataclass(frozen=True)
class UnmodelledMotion:
    """The significant part of a residual beyond white noise.

    Attributes
    ----------
    rms : tuple of float
        Root mean square of x (m), v (m/s) and a (m/s^2).
    factor : float
        Factor on the model's own band, for coloured noise.
    hertz : float or None
        Frequency at which it is strongest; None if nothing is missed.

    """

    rms: tuple[float, float, float] = (0.0, 0.0, 0.0)
    factor: float = 1.0
    hertz: float | None = None  # frequency of the largest significant coefficient


def unmodelled_motion(response: PieceResponse, run: Run, alarms: float = ALPHA_UNMODELLED) -> UnmodelledMotion:
    """Find the significant part of one segment's residual.

    The cosine transform of the residual is white if only noise is left. Significant coefficients belong to motion
    that the model misses. Excess power without significant coefficients counts as coloured noise and widens the band.

    Parameters
    ----------
    response : PieceResponse
        The segment under the model.
    run : Run
        Its run.
    alarms : float
        Probability that white noise is taken for missed motion.

    Returns
    -------
    UnmodelledMotion
        What the model misses.

    """
    piece = response.piece
    n = len(piece.t)
    z = dct(piece.whitened(piece.y - response.model_y), norm="ortho")
    significant = np.abs(z) > ndtri(1 - alarms / (2 * n))
    power = float(np.mean(z**2))
    level = noise_level(run.displacement.x, run.displacement.valid)[1]
    excessive = power > 1 + EXCESS_STD * float(np.sqrt(2 / n + (2 * level) ** 2))
    if not (excessive or np.any(significant)):
        return UnmodelledMotion()
    omega = np.pi * np.arange(n) / (piece.t[-1] - piece.t[0]) * (n - 1) / n
    power_beyond_noise = np.where(significant, z**2 - 1, 0.0) / n * np.mean(piece.noise**2)
    x, v, a = (float(np.sqrt(power_beyond_noise @ omega**k)) for k in (0, 2, 4))
    peak_frequency = omega[int(np.argmax(np.abs(z)))] / (2 * np.pi)
    remaining = float(np.mean(z[~significant] ** 2)) if excessive and not np.all(significant) else 1.0
    return UnmodelledMotion((x, v, a), max(1.0, float(np.sqrt(remaining))), peak_frequency)


def _unmodelled_notes(unmodelled_parts: Sequence[UnmodelledMotion]) -> tuple[str, ...]:
    """A note on what the segments of a run miss: that of the worst one."""
    found = [unmodelled for unmodelled in unmodelled_parts if unmodelled.hertz is not None]
    if not found:
        return ()
    x, _, a = max(found, key=lambda unmodelled: unmodelled.rms[2]).rms
    hertz = max(found, key=lambda unmodelled: unmodelled.rms[2]).hertz
    where = f" in {len(found)} of {len(unmodelled_parts)} segments" if len(unmodelled_parts) > 1 else ""
    return (
        f"the model misses something{where}: its residual shows {1e6 * x:.2g} µm beyond the noise, most near "
        f"{hertz:.0f} Hz, which is {a:.2g} m/s² rms; the bands hold only if nothing faster is missing, and at single "
        "places the error may be larger; `frictrack diagnose` names what is missing",
    )


def band_summary(motion: ModelledMotion, run: Run) -> dict[str, Any]:
    """Compute rms bands of the modelled motion, and of the smoothed acceleration at the same frames, as JSON.

    Frames of unresolved collisions are left out of both.
    """
    rows = np.searchsorted(run.motion.t, motion.t - 1e-9)[~motion.blow]

    def rms(values: Array) -> float:
        return float(np.sqrt(np.mean(values**2)))

    return {
        "sigma_x_um": 1e6 * rms(motion.sigma_x[~motion.blow]),
        "sigma_v": rms(motion.sigma_v[~motion.blow]),
        "sigma_a": rms(motion.sigma_a[~motion.blow]),
        "sigma_F_N": rms(motion.sigma_F[~motion.blow]),
        "sigma_a_smoothed": rms(run.motion.sigma_a[rows]),
        "notes": list(motion.notes),
    }
