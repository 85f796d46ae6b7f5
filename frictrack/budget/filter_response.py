"""What a low-pass makes, in the acceleration, of noise and of faults of the displacement: frames and their mean."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from frictrack.motion.derivative import Derivatives
from frictrack.motion.methods import FilterMethod
from frictrack.motion.posterior_deviations import line_frequency_errors
from frictrack.motion.stencil import STENCIL_FRAMES, stencils
from frictrack.motion.structure import Structure
from frictrack.motion.system import FactoredSmoother
from frictrack.records import Array, Filtered, Motion

CHUNK = 256  # columns at once


@dataclass(frozen=True)
class Spread:
    """Standard deviations of the acceleration, m/s^2: of every row (n,), and of a weighted sum of the rows."""

    rows: Array
    total: float


class Response:
    """The low-pass and the differences after it, as one linear map from the displacement to the acceleration."""

    def __init__(self, filtered: Filtered, motion: Motion) -> None:
        self.filtered, self.motion = filtered, motion
        self._derived = Derivatives.of_x(filtered)
        self._grid, self._noise = self._derived.grid, self._derived.noise
        self._structure, self._method = self._derived.smoother.structure, self._derived.smoother.method

    @property
    def noise(self) -> float:
        """Standard deviation of one frame of usual weight, m."""
        return self._noise

    @property
    def sensed(self) -> bool:
        """Whether an accelerometer was taken in."""
        return self._derived.worth is not None

    def of(self, ghost: Array) -> Array:
        """Accelerations (n, k), m/s^2, that displacements (n, k), m, would feign."""
        return np.asarray(self._derived.feigned(ghost)[2])

    def passed(self, weights: Array) -> Spread:
        """Noise of the frames that comes through, and what it does to the sum with some weights (n,)."""
        if self._method is not None:
            return self._passed_by(self._method, weights)
        start, table = self._stencils
        rows = np.sqrt(self._derived.factor.passed(start, table)[0])[self._grid.frames]
        answer = self._derived.factor.posterior_covariance_times(self._combined(weights))
        heard = float(np.sum(self._derived.factor.data.whitened(answer) * answer))
        if self._derived.worth is not None:
            heard += float(np.sum(self._derived.worth * np.diff(answer, 2) ** 2))
        return Spread(self._noise * rows, self._noise * float(np.sqrt(heard)))

    def lost(self, weights: Array, passed: Spread) -> Spread:
        """Signal that is taken away, and in structural smoothing the error of the frequencies of lines."""
        rows = np.sqrt(np.maximum(self.motion.sigma_a**2 - passed.rows**2 - self.motion.shake_a**2, 0.0))
        if self._method is None:
            both = self.both(weights)
            return Spread(rows, float(np.sqrt(max(both**2 - passed.total**2, 0.0))))
        measured = np.nan_to_num(np.asarray(self.filtered.x_measured))
        taken = self.of(np.stack([measured, self.filtered.x], axis=1))
        return Spread(rows, abs(float(weights @ (taken[:, 0] - taken[:, 1]))))

    def both(self, weights: Array) -> float:
        """Noise and lost signal of a structural smoother together, in the sum with some weights (n,)."""
        return self._noise * float(np.sqrt(self._unit(self._derived.factor, weights * self._scale)))

    def finer(self, weights: Array, times: float) -> tuple[float, float]:
        """Factors on sigma_a (rms where weights are not zero) and on that of the sum, were the noise `times` less.

        The signal stays what it is, so that the smoother would let more of it pass: errors fall by less than noise.
        """
        if self._structure is None:
            return 1.0 / times, 1.0 / times
        softer = self._derived.factor_smoother(_softened(self._structure, 2.0 * np.log(times)))
        inside = weights != 0
        now, then = (self._variances(f)[inside] for f in (self._derived.factor, softer))
        use = weights * self._scale
        sums = self._unit(softer, use) / self._unit(self._derived.factor, use)
        return float(np.sqrt(np.mean(then) / np.mean(now))) / times, float(np.sqrt(sums)) / times

    def _unit(self, factor: FactoredSmoother, weights: Array) -> float:
        """Variance of a sum for unit noise."""
        combined = self._combined(weights)
        found = float(combined @ factor.posterior_covariance_times(combined))
        return found + sum(float(weights @ turned) ** 2 for turned in self._turned)

    @cached_property
    def _turned(self) -> list[Array]:
        """Change of a (n,) by one standard deviation of the frequency of each line, for unit noise."""
        x = self._grid.to_frames(self.filtered.x) / self._noise
        return [
            change[2, self._grid.frames]
            for change in line_frequency_errors(self._derived.factor, x, self._grid.interval)
        ]

    @cached_property
    def _scale(self) -> Array:
        """Deviations that are stated over those of the posterior (n,)."""
        return np.asarray(
            self._derived.deviations()[2] / (self._noise * np.sqrt(self._variances(self._derived.factor)))
        )

    def _variances(self, factor: FactoredSmoother) -> Array:
        start, table = self._stencils
        found = factor.variances(start, table)[0][self._grid.frames]
        return np.asarray(found + sum(turned**2 for turned in self._turned))

    @cached_property
    def _stencils(self) -> tuple[np.ndarray, Array]:
        """Of the second derivative, on the grid."""
        start, table = stencils(self._grid.n, self._grid.interval)
        return start, table[2:]

    def _combined(self, weights: Array) -> Array:
        """Weights on smoothed positions (N,) that give a sum of accelerations."""
        start, table = self._stencils
        out, frames = np.zeros(self._grid.n), self._grid.frames
        np.add.at(out, start[frames][:, None] + np.arange(STENCIL_FRAMES), table[0, frames] * weights[:, None])
        return out

    def _passed_by(self, method: FilterMethod, weights: Array) -> Spread:
        """The same of another method, frame by frame."""
        rows, total = np.zeros(len(weights)), 0.0
        for made, sigma in self._derived.columns(method):
            second = made[2, self._grid.frames] * sigma
            rows += np.sum(second**2, axis=1)
            total += float(np.sum((weights @ second) ** 2))
        return Spread(np.sqrt(rows), float(np.sqrt(total)))


def _softened(s: Structure, by: float) -> Structure:
    """The same signal's structure beside less noise."""
    return replace(
        s,
        stiffness=tuple(v - by for v in s.stiffness),
        lines=tuple((omega, mu - by) for omega, mu in s.lines),
    )
