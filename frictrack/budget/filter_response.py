"""Compute what the low-pass makes of noise and of systematic displacement errors in the acceleration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from frictrack.motion import STENCIL_FRAMES, Derivatives, FilterMethod, stencil_start, stencil_weights
from frictrack.motion.smoother import FactoredSmoother, Structure
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
        self.motion, self._derived = motion, derived
        self._grid, self._noise = self._derived.grid, self._derived.noise
        self._structure, self._method = self._derived.smoother.structure, self._derived.smoother.method

    @property
    def x(self) -> Array:
        """Low-passed positions, m, (n,)."""
        return self._derived.x

    @property
    def noise(self) -> float:
        """Standard deviation of one frame of usual weight, m."""
        return self._noise

    @property
    def has_accelerometer(self) -> bool:
        """Whether an accelerometer was used in the smoother."""
        return self._derived.sensor_weights is not None

    def of(self, displacement: Array) -> Array:
        """Acceleration that a displacement error appears to be.

        Parameters
        ----------
        displacement
            Displacement errors, m, (n, k).

        Returns
        -------
        ndarray, shape (n, k)
            Apparent accelerations, m/s^2.

        """
        return np.asarray(self._derived.apparent_motion(displacement)[2])

    def transmitted_noise(self, weights: Array) -> AccelerationError:
        """Frame noise that the low-pass transmits.

        Parameters
        ----------
        weights
            Weights of the frames in the sum, (n,).

        Returns
        -------
        AccelerationError

        """
        if self._method is not None:
            return self._transmitted_by_method(self._method, weights)
        rows = self._grid.to_rows(
            np.sqrt(self._derived.factor.noise_variances(stencil_start(self._grid.n), self._stencils))
        )
        smoothed = self._derived.factor.posterior_covariance_times(self._position_weights(weights))
        variance = float(np.sum(self._derived.factor.data.apply_inverse_covariance(smoothed) * smoothed))
        if self._derived.sensor_weights is not None:
            variance += float(np.sum(self._derived.sensor_weights * np.diff(smoothed, 2) ** 2))
        return AccelerationError(self._noise * rows, self._noise * float(np.sqrt(variance)))

    def lost_signal(self, weights: Array, transmitted_noise: AccelerationError) -> AccelerationError:
        """Signal that the low-pass removes, the error of line frequencies included.

        Parameters
        ----------
        weights
            Weights of the frames in the sum, (n,).
        transmitted_noise
            The transmitted frame noise.

        Returns
        -------
        AccelerationError

        """
        total = float(np.sqrt(max(self.total_error(weights) ** 2 - transmitted_noise.total**2, 0.0)))
        rows = np.sqrt(np.maximum(self.motion.sigma_a**2 - transmitted_noise.rows**2 - self.motion.shake_a**2, 0.0))
        return AccelerationError(rows, total)

    def total_error(self, weights: Array) -> float:
        """Noise and lost signal together, in the weighted sum, m/s^2; see `Derivatives.best`."""
        if (best := self._derived.best) is not None:
            away = weights @ (self._derived.values() - best.values())[2]
            return float(np.hypot(FilterResponse(best, self.motion).total_error(weights), away))
        return self._noise * float(np.sqrt(self._unit_variance(self._derived.factor, weights * self._scale)))

    def noise_reductions(self, weights: Array, factors: Sequence[float]) -> dict[float, tuple[float, float]]:
        """Factors on both errors if the noise were lower by some factors.

        The signal stays the same, so the smoother would transmit more of it: errors fall by less than the noise.

        Parameters
        ----------
        weights
            Weights of the frames in the sum, (n,).
        factors
            Factors by which the noise is lower.

        Returns
        -------
        dict of float to tuple
            By factor: factor on sigma_a (rms where weights are not zero), and on the error of the sum.

        """
        if self._structure is None:
            return {times: (1.0 / times, 1.0 / times) for times in factors}
        scaled = weights * self._scale
        now = self._mean_and_sum(self._derived.factor, scaled)
        lower = {times: _with_less_noise(self._structure, 2.0 * np.log(times)) for times in factors}
        return {
            times: tuple(np.sqrt(self._mean_and_sum(self._derived.factor_smoother(s), scaled) / now) / times)
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
        return [self._grid.to_rows(change[2]) for change in self._derived.parameter_errors]

    @cached_property
    def _scale(self) -> Array:
        """Stated standard deviations over those of the posterior, (n,)."""
        stated = np.array(self._derived.deviations()[2])  # a copy, so that the others are released
        return np.asarray(stated / (self._noise * np.sqrt(self._variances(self._derived.factor))))

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
        for made, sigma in self._derived.unit_responses(method):
            second = made[2, self._grid.frames] * sigma
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
