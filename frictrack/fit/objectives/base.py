"""The interface of an objective: everything about a fit that depends on which quantity was compared."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from frictrack.fit.least_squares import Solution
from frictrack.fit.parameters import with_fitted_mass
from frictrack.fit.pieces import Reference
from frictrack.fit.prediction import FreeRun
from frictrack.fit.routes import FitOutcome, Route
from frictrack.fit.uncertainty import Estimates, Misfit, misfit_of
from frictrack.records import Array, Curve, ModelledMotion, Run


@dataclass(frozen=True, eq=False)
class FittedRuns:
    """A fitted model with its runs.

    Attributes
    ----------
    found : FitOutcome
        The solution, and the optima that a search met.
    runs, validation : tuple of Run
        Runs that were fitted, and runs that were only predicted.
    predictions : tuple of Solution
        The model on every validation run, with the shared parameters of the fit.
    reference : Reference
        Mass (kg) and normal load (N) at which forces are quoted.
    route : Route
        Domain and search.
    lengths : tuple of int
        Frames per segment of every run, 0 where its stretches are whole.

    """

    found: FitOutcome
    runs: tuple[Run, ...]
    validation: tuple[Run, ...] = ()
    predictions: tuple[Solution, ...] = ()
    reference: Reference = field(default=Reference(1.0, 1.0))
    route: Route = field(default=Route())
    lengths: tuple[int, ...] = ()

    @property
    def solution(self) -> Solution:
        """The parameters, and the model linearised there."""
        return self.found.solution

    @property
    def weighed(self) -> tuple[Run, ...]:
        """The fitted runs, each with its mass: given, or the fitted one."""
        return tuple(with_fitted_mass(run, self.reference.mass) for run in self.runs)

    @property
    def degrees(self) -> int:
        """Degrees of freedom: frames less fitted numbers (levels count as what their scatter leaves)."""
        starts = sum(len(start) for start in self.solution.starts)
        return int(self.solution.problem.n_frames - starts - round(self.solution.fitted_numbers))


class Objective(ABC):
    """What a fit minimises: residuals of displacement, of acceleration, or of a measured friction force."""

    unit: str  # of held-out errors in JSON keys: "um" or "N"
    metres_or_newtons: float  # factor from SI to that unit

    @abstractmethod
    def estimates(self, fitted: FittedRuns) -> Estimates:
        """Return the parameters with standard deviations."""

    def misfit(self, fitted: FittedRuns) -> Misfit | None:
        """Return the force that the model misses; None where noise explains the residual."""
        return misfit_of(fitted.solution)

    def reduced_chi2(self, fitted: FittedRuns) -> float:
        """Return chi-squared per degree of freedom."""
        return fitted.solution.chi2 / max(fitted.degrees, 1)

    @abstractmethod
    def heldout(self, fitted: FittedRuns) -> tuple[float, str]:
        """Return the held-out root mean square residual (m or N) and how data were held out: "run" or "frames"."""

    def heldout_summary(self, rms: float) -> dict[str, float | None]:
        """Return the two JSON keys of the held-out error, of which one is null."""
        keys: dict[str, float | None] = {"heldout_rms_um": None, "heldout_rms_N": None}
        return keys | {f"heldout_rms_{self.unit}": rms * self.metres_or_newtons}

    @abstractmethod
    def curves(self, solution: Solution, runs: Sequence[Run], role: str) -> tuple[Curve, ...]:
        """Return measurement and model of every run."""

    @abstractmethod
    def motion(self, fitted: FittedRuns, covariance: Callable[[], Array]) -> tuple[ModelledMotion, ...]:
        """Return the simulated motion of every run with bands; `covariance` gives that of the parameters, (P, P)."""

    @abstractmethod
    def free_runs(self, fitted: FittedRuns) -> dict[str, FreeRun | None]:
        """Return one simulation over each whole record, by run; None where it cannot be followed to the end."""

    @abstractmethod
    def errors(self, fits: Sequence[FittedRuns], curves: Sequence[Curve]) -> dict[str, Any]:
        """Return the errors over all fitted runs, as JSON."""

    @abstractmethod
    def per_run(
        self,
        fitted: FittedRuns,
        curves: Sequence[Curve],
        motion: Sequence[ModelledMotion],
        free_runs: Mapping[str, FreeRun | None],
    ) -> list[dict[str, Any]]:
        """Return one JSON entry per run, validation runs last."""

    @abstractmethod
    def knows_load(self, fitted: FittedRuns) -> bool:
        """Return whether the normal load is known, so that a coefficient of friction can be quoted."""
