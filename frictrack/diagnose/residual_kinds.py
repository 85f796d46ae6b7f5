"""What a diagnosis does differently for residuals of displacement and for residuals of a measured friction force."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from frictrack.diagnose.auxiliary_signals import (
    AuxiliarySignals,
    Evidence,
    KnownFindings,
    assess_accelerometer,
    assess_auxiliary_signals,
)
from frictrack.diagnose.effect_description import describe_effect
from frictrack.diagnose.preparation import omitted_lines, subsample_frames, subsample_pieces
from frictrack.effects import Effect
from frictrack.fit import Fit, measured_friction
from frictrack.fit.least_squares import LeastSquaresProblem, Solution, heldout_rms
from frictrack.fit.uncertainty import Estimates, estimate_parameters, linear_estimates
from frictrack.records import Run


class ResidualKind:
    """The steps of a diagnosis that depend on what was compared: those for residuals of the displacement.

    Attributes
    ----------
    unit : str
        Unit of errors in the JSON, "um" or "N".
    imitates : bool
        Whether effects that were found may imitate a force of one variable.

    """

    unit, imitates = "um", True

    def prepare(self, start: Solution) -> tuple[Solution, list[str]]:
        """Leave out pieces and frames of long records."""
        start, omitted = subsample_pieces(start)
        start, coarse = subsample_frames(start)
        return start, [omitted, coarse]

    def reweighted(self, law: Solution) -> Solution:
        """Return a model as further effects are tried beside it."""
        return law

    def accelerometer(
        self, start: Solution, runs: Sequence[Run], auxiliary: AuxiliarySignals | None
    ) -> Evidence | None:
        """Return what an accelerometer on the mass says of the residual; None without one, or without a motion."""
        return assess_accelerometer(start, runs, auxiliary or {})

    def auxiliary_evidence(
        self,
        start: Solution,
        runs: Sequence[Run],
        rng: np.random.Generator,
        auxiliary: AuxiliarySignals | None,
        findings: KnownFindings,
    ) -> list[Evidence]:
        """Return which auxiliary signals move with the residual."""
        return assess_auxiliary_signals(start, runs, rng, auxiliary, findings)

    def noise(self, fit: Fit) -> tuple[float, float]:
        """Return the root mean square noise of a frame, m, and the reduced chi-squared of the fit."""
        noise = float(np.sqrt(np.mean(np.concatenate([r.piece.noise for r in fit.solution.responses]) ** 2)))
        return noise, fit.reduced_chi2

    def estimates(self, solution: Solution) -> Estimates:
        """Return the parameters with standard deviations, without profiles."""
        return estimate_parameters(solution, profile=False)

    def heldout_rms(self, solution: Solution, how: str | None = None) -> tuple[float, str]:
        """Return the held-out root mean square displacement, m, and how data were held out."""
        return heldout_rms(solution, how)

    def describe(self, effect: Effect, solution: Solution | None) -> dict[str, str]:
        """Return the texts about an effect, with the numbers of the study."""
        return describe_effect(effect, solution)

    def remarks(self, fit: Fit) -> list[str]:
        """Return what such runs cannot separate."""
        out = []
        if len(fit.runs) == 1:
            out.append("single run: slope, a cable and Coulomb friction cannot be distinguished")
        if any(run.has_incline for run in fit.runs):
            out.append(
                "on an incline, Coulomb friction and gravity act alike while the mass slides one way: with a nominal "
                "scale, mass or angle, only changes of the force along the run are meaningful"
            )
        return [
            *out,
            "a constant error of scale, frame rate or mass is absorbed exactly: "
            "forces go with mass and scale, and with fps^2",
        ]


class FrictionResiduals(ResidualKind):
    """Residuals of a measured friction force."""

    unit, imitates = "N", False

    def prepare(self, start: Solution) -> tuple[Solution, list[str]]:
        """Weight the residuals by the noise that differs between strokes; few frames of long records remain."""
        weighted = self.reweighted(start)
        return weighted, [omitted_lines(start, weighted)]

    def reweighted(self, law: Solution) -> Solution:
        """Return the model with residuals weighted by the noise."""
        return measured_friction.weight_by_noise(law)[0]

    def accelerometer(
        self, start: Solution, runs: Sequence[Run], auxiliary: AuxiliarySignals | None
    ) -> Evidence | None:
        """Return None: no motion is simulated that it could be compared with."""
        return None

    def auxiliary_evidence(
        self,
        start: Solution,
        runs: Sequence[Run],
        rng: np.random.Generator,
        auxiliary: AuxiliarySignals | None,
        findings: KnownFindings,
    ) -> list[Evidence]:
        """Return nothing: no motion is simulated that signals could be compared with."""
        return []

    def noise(self, fit: Fit) -> tuple[float, float]:
        """Return the noise of a sample, N, and the reduced chi-squared against it."""
        noise = measured_friction.weight_by_noise(fit.solution)[1].rms
        residual = np.concatenate([r.piece.coloured(r.r) for r in fit.solution.responses])
        return noise, float(np.sum(residual**2) / noise**2 / max(len(residual) - len(fit.solution.p), 1))

    def estimates(self, solution: Solution) -> Estimates:
        """Return the parameters; their standard deviations come from blocks of the residual."""
        return linear_estimates(solution, measured_friction.block_covariance(solution))

    def heldout_rms(self, solution: Solution, how: str | None = None) -> tuple[float, str]:
        """Return the held-out root mean square force, N, and how data were held out."""
        return measured_friction.heldout_rms(solution, how)

    def describe(self, effect: Effect, solution: Solution | None) -> dict[str, str]:
        """Return the texts about an effect."""
        return describe_effect(effect)

    def remarks(self, fit: Fit) -> list[str]:
        """Return what the noise is, and what a drifting sensor would explain."""
        noise = measured_friction.weight_by_noise(fit.solution)[1]
        return measured_friction.remarks(fit.solution, fit.runs, noise)


def residual_kind(problem: LeastSquaresProblem) -> ResidualKind:
    """Return the kind of residual that a problem has."""
    return ResidualKind() if problem.simulates else FrictionResiduals()
