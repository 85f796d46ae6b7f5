"""The objective of a fit to a measured friction force: no motion is simulated and no mass is needed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from frictrack.fit import measured_friction
from frictrack.fit.least_squares import Solution
from frictrack.fit.objectives.base import FittedRuns, Objective
from frictrack.fit.prediction import FreeRun
from frictrack.fit.uncertainty import Estimates, linear_estimates
from frictrack.records import Array, Curve, ModelledMotion, Run


class MeasuredFrictionObjective(Objective):
    """Residuals of a friction force that a load cell or a tribometer measured."""

    unit, metres_or_newtons = "N", 1.0

    def estimates(self, fitted: FittedRuns) -> Estimates:
        """Return the parameters; their covariance comes from blocks of the residual, which is correlated."""
        return linear_estimates(fitted.solution, measured_friction.block_covariance(fitted.solution))

    def heldout(self, fitted: FittedRuns) -> tuple[float, str]:
        """Return the held-out root mean square residual, N, and how data were held out."""
        return measured_friction.heldout_rms(fitted.solution)

    def curves(self, solution: Solution, runs: Sequence[Run], role: str) -> tuple[Curve, ...]:
        """Return measured and modelled friction of every run; the motion is the measured one."""
        return measured_friction.curves(solution, runs, role)

    def motion(self, fitted: FittedRuns, covariance: Callable[[], Array]) -> tuple[ModelledMotion, ...]:
        """Return nothing: the model makes no motion."""
        return ()

    def free_runs(self, fitted: FittedRuns) -> dict[str, FreeRun | None]:
        """Return nothing: the model makes no motion."""
        return {}

    def errors(self, fits: Sequence[FittedRuns], curves: Sequence[Curve]) -> dict[str, Any]:
        """Return the errors in N; those of a displacement are null."""
        return measured_friction.errors_of([r for fitted in fits for r in fitted.solution.responses])

    def per_run(
        self,
        fitted: FittedRuns,
        curves: Sequence[Curve],
        motion: Sequence[ModelledMotion],
        free_runs: Mapping[str, FreeRun | None],
    ) -> list[dict[str, Any]]:
        """Return level, noise and errors of every run."""
        rows = [measured_friction.run_summary(fitted.solution, i, run, "fit") for i, run in enumerate(fitted.runs)]
        predicted = zip(fitted.predictions, fitted.validation, strict=True)
        return rows + [measured_friction.run_summary(s, 0, run, "validation") for s, run in predicted]

    def knows_load(self, fitted: FittedRuns) -> bool:
        """Return True: a measured friction force comes with its load."""
        return True
