"""The objectives of a fit to the recorded motion: residuals of displacement, or of acceleration (force domain)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from frictrack.fit import routes
from frictrack.fit.force_domain import reduced_chi2
from frictrack.fit.least_squares import PieceResponse, Solution, heldout_rms
from frictrack.fit.modelled_motion import band_summary, covariance_at_fitted_scatter, modelled_motion
from frictrack.fit.objectives.base import FittedRuns, Objective
from frictrack.fit.parameters import with_fitted_mass, without_mass
from frictrack.fit.prediction import FreeRun, free_errors, free_run
from frictrack.fit.uncertainty import Estimates, Misfit, estimate_parameters, linear_estimates
from frictrack.records import Array, Curve, ModelledMotion, Run


class DisplacementObjective(Objective):
    """Residuals of the displacement, fitted by variable projection."""

    unit, metres_or_newtons = "um", 1e6

    def estimates(self, fitted: FittedRuns) -> Estimates:
        """Return the parameters; intervals of badly determined ones come from profiles of the likelihood."""
        return estimate_parameters(fitted.solution)

    def heldout(self, fitted: FittedRuns) -> tuple[float, str]:
        """Return the held-out root mean square displacement, m, and how data were held out."""
        return heldout_rms(fitted.solution)

    def curves(self, solution: Solution, runs: Sequence[Run], role: str) -> tuple[Curve, ...]:
        """Return measured and simulated displacement of every piece, with the forces of every effect."""
        return tuple(_curve(solution, r, runs[r.piece.run], role) for r in solution.responses)

    def motion(self, fitted: FittedRuns, covariance: Callable[[], Array]) -> tuple[ModelledMotion, ...]:
        """Return x, v, a and F of the model with their bands, one table per run, validation runs last."""
        predicted = list(zip(fitted.predictions, fitted.validation, strict=True))
        return modelled_motion(fitted.solution, self._band_covariance(fitted, covariance), fitted.runs, predicted)

    def _band_covariance(self, fitted: FittedRuns, covariance: Callable[[], Array]) -> Array:
        return covariance_at_fitted_scatter(fitted.solution)

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
        rows = [_row(fitted.solution, i, run, "fit", curves) for i, run in enumerate(fitted.weighed)]
        rows += [
            _row(s, 0, with_fitted_mass(run, fitted.reference.mass), "validation", curves)
            for s, run in zip(fitted.predictions, fitted.validation, strict=True)
        ]
        role = "validation" if fitted.validation else "fit"
        for row in rows:
            if row["role"] == role:
                row["errors"] |= free_errors([free_runs[row["run"]]])
        described = zip(rows, motion, fitted.runs + fitted.validation, strict=True)
        return [row | {"motion": band_summary(one, run)} for row, one, run in described]

    def knows_load(self, fitted: FittedRuns) -> bool:
        """Return whether a mass was given, which presses on the course."""
        return fitted.runs[0].mass is not None


class SearchedObjective(DisplacementObjective):
    """Residuals of acceleration (the force domain of the papers), or of displacement, found by another search."""

    def estimates(self, fitted: FittedRuns) -> Estimates:
        """Return the parameters with standard deviations of the linearised model."""
        return linear_estimates(fitted.found.force or fitted.solution)

    def misfit(self, fitted: FittedRuns) -> Misfit | None:
        """Return None: the missing force is estimated from residuals of displacement alone."""
        return None

    def reduced_chi2(self, fitted: FittedRuns) -> float:
        """Return chi-squared per degree of freedom of what was compared."""
        return super().reduced_chi2(fitted) if fitted.found.force is None else reduced_chi2(fitted.found.force)

    def heldout(self, fitted: FittedRuns) -> tuple[float, str]:
        """Return the held-out root mean square displacement, m, of a model found in the same way."""
        return routes.heldout_rms(fitted.found, fitted.runs, fitted.route)

    def _band_covariance(self, fitted: FittedRuns, covariance: Callable[[], Array]) -> Array:
        return super()._band_covariance(fitted, covariance) if fitted.found.force is None else covariance()


def errors_of(curves: Sequence[Curve], runs: Sequence[Run]) -> dict[str, Any]:
    """Return errors of some curves against the runs that they came from.

    Parameters
    ----------
    curves : sequence of Curve
        Model and measurement.
    runs : sequence of Run
        Runs with their mass, by the names of the curves.

    Returns
    -------
    dict
        Root mean square of displacement (um) and acceleration (m/s^2), sum of squares of the acceleration
        (m^2/s^4), and the force error relative to the norm of the measured force.

    """
    by_name = {r.name: r for r in runs}
    residual, a_error, f_error, f_measured = [], [], [], []
    for c in curves:
        run = by_name[c.run]
        rows = np.searchsorted(run.motion.t, c.t - 1e-9)
        a = run.motion.a[rows]
        residual.append(c.residual)
        a_error.append(a - c.a_model)
        mass = run.mass or 1.0
        f_error.append(mass * (a - c.a_model))
        f_measured.append(run.drive[rows] if run.drive is not None else c.F_model - mass * (a - c.a_model))
    a_all = np.concatenate(a_error)
    return {
        "rms_displacement_um": float(np.sqrt(np.mean(np.concatenate(residual) ** 2)) * 1e6),
        "rms_acceleration": float(np.sqrt(np.mean(a_all**2))),
        "sse_acceleration": float(np.sum(a_all**2)),
        "relative_force_error": float(
            np.linalg.norm(np.concatenate(f_error)) / max(float(np.linalg.norm(np.concatenate(f_measured))), 1e-30)
        ),
    }


def _row(solution: Solution, index: int, run: Run, role: str, curves: Sequence[Curve]) -> dict[str, Any]:
    _, level = solution.problem.layout.values(solution.p, index)
    pieces = [p for p in solution.problem.pieces if p.run == index]
    return {
        "run": run.name,
        "role": role,
        "level": level,
        "noise_um": float(np.sqrt(np.mean(np.concatenate([p.noise for p in pieces]) ** 2)) * 1e6),
        "segments": len(pieces),
        "segment_s": float(max(p.t[-1] - p.t[0] for p in pieces)),
        "errors": errors_of([c for c in curves if c.run == run.name and c.role == role], [run]),
    }


def _curve(solution: Solution, response: PieceResponse, run: Run, role: str) -> Curve:
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
