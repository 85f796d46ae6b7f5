"""What depends on the measured quantity (`Observation`), and the observation of the recorded motion."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from frictrack.fit.least_squares import PieceResponse, Solution, heldout_rms, white_noise_covariance
from frictrack.fit.modelled_motion import FreeRun, band_summary, free_errors, free_run, modelled_motion
from frictrack.fit.parameters import with_fitted_mass, without_mass
from frictrack.fit.routes import FittedRuns
from frictrack.fit.smooth_functions import rms
from frictrack.fit.uncertainty import linear_estimates
from frictrack.fit.uncertainty.estimates import Estimates, Misfit, estimate_parameters, misfit_of
from frictrack.measure.motion import filtered_acceleration
from frictrack.records import Array, Curve, Mask, ModelledMotion, Run, away_from_ends


class Observation(ABC):
    """What was observed of the runs: displacement, acceleration, or a friction force."""

    unit: str  # of errors in JSON keys: "um" or "N"
    metres_or_newtons: float  # factor from SI to that unit

    @abstractmethod
    def estimates(self, fitted: FittedRuns) -> Estimates:
        """Return the parameters with standard deviations."""

    @abstractmethod
    def estimates_of_candidate(self, solution: Solution) -> Estimates:
        """Return the parameters of a model on trial, without further fits."""

    @abstractmethod
    def noise(self, solution: Solution, reduced_chi2: float) -> tuple[float, float]:
        """Return the rms noise of a frame, m or N, and chi-squared per degree of freedom against it."""

    def weighted(self, solution: Solution) -> Solution:
        """Return the solution with its residuals weighted by the noise."""
        return solution

    @abstractmethod
    def remarks(self, fitted: FittedRuns) -> list[str]:
        """Return what such runs cannot separate, and what their noise is."""

    def misfit(self, fitted: FittedRuns) -> Misfit | None:
        """Return the force that the model misses; None where noise explains the residual."""
        return misfit_of(fitted.solution)

    def reduced_chi2(self, fitted: FittedRuns) -> float:
        """Return chi-squared per degree of freedom."""
        return fitted.solution.chi2 / max(fitted.degrees, 1)

    def heldout(self, fitted: FittedRuns) -> tuple[float, str]:
        """Return the held-out root mean square residual (m or N) and how data were held out: "run" or "frames"."""
        at_optimum = fitted.route.search == "varpro" and fitted.found.force is None
        return heldout_rms(fitted.solution, compared=None if at_optimum else fitted.compared)

    def heldout_summary(self, rms: float) -> dict[str, float | None]:
        """Return the two JSON keys of the held-out error, of which one is null."""
        keys: dict[str, float | None] = {"heldout_rms_um": None, "heldout_rms_N": None}
        return keys | {f"heldout_rms_{self.unit}": rms * self.metres_or_newtons}

    def curves(self, solution: Solution, runs: Sequence[Run], role: str) -> tuple[Curve, ...]:
        """Return measurement and model of every piece, with the forces of every effect."""
        return tuple(self.curve(solution, r, runs[r.piece.run], role) for r in solution.responses)

    @abstractmethod
    def curve(self, solution: Solution, response: PieceResponse, run: Run, role: str) -> Curve:
        """Return measurement and model of one piece."""

    def motion(self, fitted: FittedRuns, covariance: Callable[[], Array]) -> tuple[ModelledMotion, ...]:
        """Return the simulated motion of every run with bands; `covariance` gives that of the parameters, (P, P)."""
        return ()

    def free_runs(self, fitted: FittedRuns) -> dict[str, FreeRun | None]:
        """Return one simulation over each whole record, by run; None where it cannot be followed to the end."""
        return {}

    @abstractmethod
    def errors(self, fits: Sequence[FittedRuns], curves: Sequence[Curve]) -> dict[str, Any]:
        """Return the errors over all fitted runs, as JSON."""

    def per_run(
        self,
        fitted: FittedRuns,
        curves: Sequence[Curve],
        motion: Sequence[ModelledMotion],
        free_runs: Mapping[str, FreeRun | None],
    ) -> list[dict[str, Any]]:
        """Return one JSON entry per run, validation runs last."""
        rows = [self.row(fitted.solution, i, run, "fit", curves) for i, run in enumerate(fitted.weighed)]
        return rows + [
            self.row(s, 0, with_fitted_mass(run, fitted.reference.mass), "validation", curves)
            for s, run in zip(fitted.predictions, fitted.validation, strict=True)
        ]

    @abstractmethod
    def row(self, solution: Solution, index: int, run: Run, role: str, curves: Sequence[Curve]) -> dict[str, Any]:
        """Return level, noise and errors of one run of a solution, as JSON."""

    @abstractmethod
    def knows_load(self, fitted: FittedRuns) -> bool:
        """Return whether the normal load is known, so that a coefficient of friction can be quoted."""


class DisplacementObservation(Observation):
    """Residuals of the displacement."""

    unit, metres_or_newtons = "um", 1e6

    def estimates(self, fitted: FittedRuns) -> Estimates:
        """Return the parameters; intervals of badly determined ones come from profiles, at an optimum."""
        solution = fitted.solution
        return estimate_parameters(solution) if fitted.route.is_default else linear_estimates(solution)

    def estimates_of_candidate(self, solution: Solution) -> Estimates:
        """Return the parameters with standard deviations, without profiles."""
        return estimate_parameters(solution, profile=False)

    def noise(self, solution: Solution, reduced_chi2: float) -> tuple[float, float]:
        """Return the rms noise of a frame, m, and the reduced chi-squared of the fit."""
        return rms(np.concatenate([r.piece.noise for r in solution.responses])), reduced_chi2

    def remarks(self, fitted: FittedRuns) -> list[str]:
        """Return what such runs cannot separate."""
        out = []
        if len(fitted.runs) == 1:
            out.append("single run: slope, a cable and Coulomb friction cannot be distinguished")
        steady = [run.name for run in fitted.runs if run.drive is not None and np.ptp(run.drive) == 0 != run.drive[0]]
        if steady:
            words = "is taken to act throughout; if it ends within the run, as a weight reaches the floor, give until"
            out.append(f"the constant drive of {', '.join(steady)} {words}")
        if any(run.has_incline for run in fitted.runs):
            out.append(
                "on an incline, Coulomb friction and gravity act alike while the mass slides one way: with a nominal "
                "scale, mass or angle, only changes of the force along the run are meaningful"
            )
        return [
            *out,
            "a constant error of scale, frame rate or mass is absorbed exactly: "
            "forces go with mass and scale, and with fps^2",
        ]

    def misfit(self, fitted: FittedRuns) -> Misfit | None:
        """Return the force that the model misses; it is estimated about the optimum of the displacement alone."""
        return super().misfit(fitted) if fitted.route.is_default else None

    def curve(self, solution: Solution, response: PieceResponse, run: Run, role: str) -> Curve:
        """Return measured and simulated displacement of one piece."""
        piece, motion, problem = response.piece, response.motion, solution.problem
        values, level = problem.layout.values(solution.p, piece.run)
        x, v = motion.x_edge[piece.at], motion.v_edge[piece.at]
        path = piece.at_frames(x, v, level)
        parts = {
            name: np.asarray(block @ problem.model.coefficients(name, values))
            for name, block in without_mass(problem.model).force_columns(path, values).items()
        }
        total: Array = np.sum(list(parts.values()), axis=0)
        return Curve(
            t=run.displacement.t[piece.frames],
            x=piece.y,
            sigma_x=piece.noise,
            x_model=response.model_y,
            v_model=v,
            a_model=piece.known_at_frames - total / piece.mass,
            F_model=total,
            run=run.name,
            role=role,
            parts=parts,
            repaired=None if run.motion.repaired is None else run.motion.repaired[piece.frames],
        )

    def curves(self, solution: Solution, runs: Sequence[Run], role: str) -> tuple[Curve, ...]:
        """Return measurement and model of every piece, with the force of the model through the filter of its run."""
        found = super().curves(solution, runs, role)
        changes = {run.name: filtered_acceleration(run.motion, run.displacement, _misfit(run, found)) for run in runs}
        pairs = zip(found, solution.responses, strict=True)
        return tuple(_with_filtered_force(c, runs[r.piece.run], r.piece.mass, changes[c.run]) for c, r in pairs)

    def motion(self, fitted: FittedRuns, covariance: Callable[[], Array]) -> tuple[ModelledMotion, ...]:
        """Return x, v, a and F of the model with their bands, one table per run, validation runs last."""
        predicted = list(zip(fitted.predictions, fitted.validation, strict=True))
        return modelled_motion(fitted.solution, self._band_covariance(fitted, covariance), fitted.runs, predicted)

    def _band_covariance(self, fitted: FittedRuns, covariance: Callable[[], Array]) -> Array:
        # not widened for a scatter known from few runs: that would part each level from the coefficient it multiplies
        return white_noise_covariance(fitted.solution)[0]

    def free_runs(self, fitted: FittedRuns) -> dict[str, FreeRun | None]:
        """Return the simulations over the whole validation runs or, without these, over the fitted ones."""
        if fitted.validation:
            pairs = zip(fitted.predictions, fitted.validation, strict=True)
            return {run.name: free_run(s, run, fitted.reference) for s, run in pairs}
        return {run.name: free_run(fitted.solution, run, fitted.reference, i) for i, run in enumerate(fitted.runs)}

    def errors(self, fits: Sequence[FittedRuns], curves: Sequence[Curve]) -> dict[str, Any]:
        """Return displacement, acceleration and force errors over all fitted runs."""
        return errors_of([c for c in curves if c.role == "fit"], [run for fitted in fits for run in fitted.weighed])

    def per_run(
        self,
        fitted: FittedRuns,
        curves: Sequence[Curve],
        motion: Sequence[ModelledMotion],
        free_runs: Mapping[str, FreeRun | None],
    ) -> list[dict[str, Any]]:
        """Return level, noise, segments, errors and bands of every run; those of the free run where there is one."""
        rows, role = super().per_run(fitted, curves, motion, free_runs), "validation" if fitted.validation else "fit"
        for row, one, run in zip(rows, motion, fitted.runs + fitted.validation, strict=True):
            if row["role"] == role:
                row["errors"] |= free_errors([free_runs[row["run"]]])
            row["motion"] = band_summary(one, run)
        return rows

    def row(self, solution: Solution, index: int, run: Run, role: str, curves: Sequence[Curve]) -> dict[str, Any]:
        """Return level, noise, segments and errors of one run."""
        _, level = solution.problem.layout.values(solution.p, index)
        pieces = [p for p in solution.problem.pieces if p.run == index]
        return {
            "run": run.name,
            "role": role,
            "level": level,
            "noise_um": 1e6 * rms(np.concatenate([p.noise for p in pieces])),
            "segments": len(pieces),
            "segment_s": float(max(p.t[-1] - p.t[0] for p in pieces)),
            "errors": errors_of([c for c in curves if c.run == run.name and c.role == role], [run]),
        }

    def knows_load(self, fitted: FittedRuns) -> bool:
        """Return whether a mass was given, which presses on the course."""
        return fitted.runs[0].mass is not None


def _misfit(run: Run, curves: Sequence[Curve]) -> Array:
    """Measured minus modelled displacement (n,), m; 0 before the first fitted frame, linear in time after the last."""
    # Every segment has its own start. So that segments meet without a jump, what follows is moved by a shift and a
    # speed, which no filter changes.
    m = run.motion
    y = np.where(run.displacement.known, run.displacement.x, m.x)
    t, x, v, a = m.t, y.copy(), m.v.copy(), m.a.copy()
    segment = np.full(len(m), -1)
    for k, c in enumerate(c for c in curves if c.run == run.name):
        rows = _rows(run, c)
        x[rows], v[rows], a[rows], segment[rows] = c.x_model, c.v_model, c.a_model, k
    fitted = np.flatnonzero(segment >= 0)
    shift = speed = 0.0
    for i, end in pairwise([*(np.flatnonzero(np.diff(segment)) + 1), len(m)]):
        dt = t[i] - t[i - 1]
        shift += speed * dt
        if fitted[0] < i <= fitted[-1]:
            speed = v[i - 1] + dt * (a[i - 1] + a[i]) / 2 - v[i]
            shift = x[i - 1] + dt * v[i - 1] + dt**2 * (2 * a[i - 1] + a[i]) / 6 - x[i]
        x[i:end] += shift + speed * (t[i:end] - t[i])
        v[i:end] += speed
        shift += speed * (t[end - 1] - t[i])
    return y - x


def _with_filtered_force(curve: Curve, run: Run, mass: float, change: Array | None) -> Curve:
    """Curve with the force of the model through the filter K, which is linear: K y_model = K y - K (y - y_model)."""
    if change is None:
        return curve
    rows = _rows(run, curve)
    a_filtered = run.motion.a[rows] - change[rows]
    return replace(curve, F_filtered=curve.F_model + mass * (curve.a_model - a_filtered))


def _unsmeared(run: Run, curves: Sequence[Curve]) -> Mask:
    """Fitted frames (n,) away from the ends, which the filter smears; those of a short section are all kept."""
    fitted = np.zeros(len(run.motion), dtype=bool)
    for c in curves:
        if c.run == run.name:
            fitted[_rows(run, c)] = True
    return away_from_ends(fitted, run.motion.guard)


def _rows(run: Run, curve: Curve) -> Any:
    """Rows of a run at which a curve was fitted."""
    return np.searchsorted(run.motion.t, curve.t - 1e-9)


def errors_of(curves: Sequence[Curve], runs: Sequence[Run]) -> dict[str, Any]:
    """Return the errors of some curves against the runs that they came from, as JSON.

    Accelerations and forces of the model are compared after the filter that the measured ones went through, where that
    does not smear them.
    """
    by_name = {r.name: (r, _unsmeared(r, curves)) for r in runs}
    a_error, f_error, f_measured = [], [], []
    for c in curves:
        run, unsmeared = by_name[c.run]
        mass, rows = run.inertia or 1.0, _rows(run, c)
        kept, force = unsmeared[rows], c.F_as_measured
        error = run.motion.a[rows] - c.a_model + (force - c.F_model) / mass
        a_error.append(error[kept])
        f_error.append(mass * error[kept])
        f_measured.append((force - mass * error if run.drive is None else run.drive[rows])[kept])
    accelerations = np.concatenate(a_error)
    scale = max(float(np.linalg.norm(np.concatenate(f_measured))), 1e-30)
    return {
        "rms_displacement_um": 1e6 * rms(np.concatenate([c.residual for c in curves])),
        "rms_acceleration": rms(accelerations),
        "sse_acceleration": float(np.sum(accelerations**2)),
        "relative_force_error": float(np.linalg.norm(np.concatenate(f_error)) / scale),
    }
