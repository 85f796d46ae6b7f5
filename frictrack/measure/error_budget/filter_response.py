"""Compute what the low-pass makes of noise and of systematic displacement errors in the acceleration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from frictrack.measure.motion import (
    STENCIL_FRAMES,
    Derivatives,
    FactoredSmoother,
    FilterMethod,
    Structure,
    stencil_start,
    stencil_weights,
    unit_responses,
)
from frictrack.records import Array, Motion

FRAMES_AT_ONCE = 1 << 16  # whose stencils are held


@dataclass(frozen=True)
class AccelerationError:
    """Standard deviations of the acceleration, m/s^2: per frame (n,), and of a weighted sum of the frames."""

    rows: Array
    total: float


class FilterResponse:
    """The low-pass and its derivatives as one linear map from displacement to acceleration."""

    def __init__(self, derived: Derivatives, motion: Motion) -> None:
        self.motion, self.derived, self._grid = motion, derived, derived.grid
        self.noise = derived.noise  # standard deviation of one frame of usual weight, m

    def of(self, displacement: Array) -> Array:
        """Accelerations (n, k), m/s^2, that displacement errors (n, k), m, appear to be."""
        return np.asarray(self.derived.apparent_motion(displacement)[2])

    def transmitted_noise(self, weights: Array) -> AccelerationError:
        """Frame noise that the low-pass transmits, in every frame and in a sum with weights (n,)."""
        if self.derived.smoother.method is not None:
            return self._transmitted_by_method(self.derived.smoother.method, weights)
        rows = self._grid.to_rows(
            np.sqrt(self.derived.factor.noise_variances(stencil_start(self._grid.n), self._stencils))
        )
        smoothed = self.derived.factor.posterior_covariance_times(self._position_weights(weights))
        variance = float(np.sum(self.derived.factor.data.apply_inverse_covariance(smoothed) * smoothed))
        if self.derived.sensor_weights is not None:
            variance += float(np.sum(self.derived.sensor_weights * np.diff(smoothed, 2) ** 2))
        return AccelerationError(self.noise * rows, self.noise * float(np.sqrt(variance)))

    def lost_signal(self, weights: Array, transmitted_noise: AccelerationError) -> AccelerationError:
        """Signal that the low-pass removes, the error of line frequencies included; see `transmitted_noise`."""
        total = float(np.sqrt(max(self.total_error(weights) ** 2 - transmitted_noise.total**2, 0.0)))
        rows = np.sqrt(np.maximum(self.motion.sigma_a**2 - transmitted_noise.rows**2 - self.motion.shake_a**2, 0.0))
        return AccelerationError(rows, total)

    def total_error(self, weights: Array) -> float:
        """Noise and lost signal together, in the weighted sum, m/s^2; see `Derivatives.best`."""
        if (best := self.derived.best) is not None:
            away = weights @ (self.derived.values() - best.values())[2]
            return float(np.hypot(FilterResponse(best, self.motion).total_error(weights), away))
        return self.noise * float(np.sqrt(self._unit_variance(self.derived.factor, weights * self._scale)))

    def noise_reductions(self, weights: Array, factors: Sequence[float]) -> dict[float, tuple[float, float]]:
        """Factors on both errors if the noise were lower by some factors.

        They are the factor on sigma_a (rms where weights are not zero) and that on the error of the sum. The signal
        stays the same, so the smoother would transmit more of it: errors fall by less than the noise.
        """
        structure = self.derived.smoother.structure
        if structure is None:
            return {times: (1.0 / times, 1.0 / times) for times in factors}
        scaled = weights * self._scale
        now = self._mean_and_sum(self.derived.factor, scaled)
        lower = {times: _with_less_noise(structure, 2.0 * np.log(times)) for times in factors}
        return {
            times: tuple(np.sqrt(self._mean_and_sum(self.derived.factor_smoother(s), scaled) / now) / times)
            for times, s in lower.items()
        }

    def _mean_and_sum(self, factor: FactoredSmoother, weights: Array) -> Array:
        """Mean variance where weights are not zero, and the variance of the weighted sum, for unit noise, (2,)."""
        return np.array([np.mean(self._variances(factor)[weights != 0]), self._unit_variance(factor, weights)])

    def _unit_variance(self, factor: FactoredSmoother, weights: Array) -> float:
        """Variance of a weighted sum for unit noise."""
        combined = self._position_weights(weights)
        found = float(combined @ factor.posterior_covariance_times(combined))
        return found + sum(float(weights @ change) ** 2 for change in self._line_changes)

    @cached_property
    def _line_changes(self) -> list[Array]:
        """Change of the acceleration (n,) by one standard deviation of each parameter, for unit noise."""
        return [self._grid.to_rows(change[2]) for change in self.derived.parameter_errors]

    @cached_property
    def _scale(self) -> Array:
        """Stated standard deviations over those of the posterior, (n,)."""
        stated = np.array(self.derived.deviations()[2])  # a copy, so that the others are released
        return np.asarray(stated / (self.noise * np.sqrt(self._variances(self.derived.factor))))

    def _variances(self, factor: FactoredSmoother) -> Array:
        found = self._grid.to_rows(factor.variances(stencil_start(self._grid.n), self._stencils))
        return np.asarray(found + sum(change**2 for change in self._line_changes))

    def _stencils(self, frames: slice) -> Array:
        """Weights (m, 6) of the second derivative in m frames of the grid."""
        return stencil_weights(self._grid.n, self._grid.interval, frames)[2]

    def _position_weights(self, weights: Array) -> Array:
        """Weights (N,) on smoothed positions that give a weighted sum of accelerations."""
        out, start, on_grid = np.zeros(self._grid.n), stencil_start(self._grid.n), self._grid.to_frames(weights)
        for first in range(0, self._grid.n, FRAMES_AT_ONCE):
            rows = slice(first, first + FRAMES_AT_ONCE)
            np.add.at(out, start[rows, None] + np.arange(STENCIL_FRAMES), self._stencils(rows) * on_grid[rows, None])
        return out

    def _transmitted_by_method(self, method: FilterMethod, weights: Array) -> AccelerationError:
        """Transmitted noise of another method, frame by frame."""
        rows, total = np.zeros(len(weights)), 0.0
        for frames, response in unit_responses(method, self.derived.w > 0, 2):
            sigma_a = self.noise / np.sqrt(self.derived.w[frames]) / self._grid.interval**2
            second = response[self._grid.frames] * sigma_a
            rows += np.sum(second**2, axis=1)
            total += float(np.sum((weights @ second) ** 2))
        return AccelerationError(np.sqrt(rows), float(np.sqrt(total)))


def _with_less_noise(s: Structure, by: float) -> Structure:
    """The structure of the same signal with the logarithm of the noise variance lower by `by`."""
    return replace(
        s,
        stiffness=tuple(v - by for v in s.stiffness),
        lines=tuple((omega, mu - by) for omega, mu in s.lines),
    )
