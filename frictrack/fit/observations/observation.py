"""The interface of an observation: everything about a fit that depends on which quantity was measured and compared."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from frictrack.fit.free_run import FreeRun
from frictrack.fit.least_squares import PieceResponse, Solution, heldout_rms
from frictrack.fit.parameters import with_fitted_mass
from frictrack.fit.routes import FittedRuns
from frictrack.fit.uncertainty import Estimates, Misfit, misfit_of
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
