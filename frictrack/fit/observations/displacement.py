"""What depends on the measured quantity (`Observation`), and the observation of the recorded motion."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from frictrack.fit.free_run import FreeRun, free_errors, free_run
from frictrack.fit.least_squares import PieceResponse, Solution, heldout_rms
from frictrack.fit.modelled_motion import band_summary, covariance_at_fitted_scatter, modelled_motion
from frictrack.fit.parameters import with_fitted_mass, without_mass
from frictrack.fit.routes import FittedRuns
from frictrack.fit.uncertainty import Estimates, Misfit, estimate_parameters, linear_estimates, misfit_of
from frictrack.records import Array, Curve, ModelledMotion, Run


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
        return _rms(np.concatenate([r.piece.noise for r in solution.responses])), reduced_chi2

    def remarks(self, fitted: FittedRuns) -> list[str]:
        """Return what such runs cannot separate."""
        out = []
        if len(fitted.runs) == 1:
            out.append("single run: slope, a cable and Coulomb friction cannot be distinguished")
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
            "noise_um": 1e6 * _rms(np.concatenate([p.noise for p in pieces])),
            "segments": len(pieces),
            "segment_s": float(max(p.t[-1] - p.t[0] for p in pieces)),
            "errors": errors_of([c for c in curves if c.run == run.name and c.role == role], [run]),
        }

    def knows_load(self, fitted: FittedRuns) -> bool:
        """Return whether a mass was given, which presses on the course."""
        return fitted.runs[0].mass is not None


def errors_of(curves: Sequence[Curve], runs: Sequence[Run]) -> dict[str, Any]:
    """Return the errors of some curves against the runs that they came from, as JSON."""
    by_name = {r.name: r for r in runs}
    a_error, f_error, f_measured = [], [], []
    for c in curves:
        run = by_name[c.run]
        rows = np.searchsorted(run.motion.t, c.t - 1e-9)
        a_error.append(run.motion.a[rows] - c.a_model)
        f_error.append((run.mass or 1.0) * a_error[-1])
        f_measured.append(c.F_model - f_error[-1] if run.drive is None else run.drive[rows])
    accelerations = np.concatenate(a_error)
    scale = max(float(np.linalg.norm(np.concatenate(f_measured))), 1e-30)
    return {
        "rms_displacement_um": 1e6 * _rms(np.concatenate([c.residual for c in curves])),
        "rms_acceleration": _rms(accelerations),
        "sse_acceleration": float(np.sum(accelerations**2)),
        "relative_force_error": float(np.linalg.norm(np.concatenate(f_error)) / scale),
    }


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
