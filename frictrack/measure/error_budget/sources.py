"""The sources of error of the friction force: what each adds to its mean and to one frame, after the low-pass."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.base.number_format import format_number
from frictrack.measure.error_budget.summary import (
    ALL_FRAMES,
    ALL_RUNS,
    DRIVE,
    DRIVE_CLOCK,
    FILTER,
    LOCKING,
    MASS,
    NOISE,
    NOISE_FACTOR_TWICE_FRAMES,
    SCALE,
    SENSOR,
    SHAKE,
    TIME,
    Budget,
    Contribution,
)
from frictrack.measure.friction import friction, white_noise
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
from frictrack.records import Array, Filtered, Mask, Motion, Run

if TYPE_CHECKING:
    from frictrack.results import RecordingInfo

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


MIN_SIGMAS_LOCKING = 3.0  # standard deviations from which peak locking counts as found
NOISE_FACTORS = (NOISE_FACTOR_TWICE_FRAMES, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0)  # noise reductions that are tried


def budget(
    run: Run,
    filtered: Filtered,
    quality: Mapping[str, Any] | None = None,
    film: RecordingInfo | None = None,
    clocks: Mapping[str, Any] | None = None,
) -> Budget:
    """Compute the error budget of a run's friction force.

    Parameters
    ----------
    run
        The run, with a mass or with measured friction.
    filtered
        The low-passed displacement from which its motion was derived.
    quality
        Self-checks of the film: peak locking and camera shake. Without them these sources are left out.
    film
        The film, for its time base; None for a table.
    clocks
        Alignment of the sensors' clocks.

    Returns
    -------
    Budget
        Every source with its effect in N; sources of unknown size have no number.

    Raises
    ------
    FrictrackError
        If the run has neither a mass nor measured friction, or no free frames.

    Notes
    -----
    Sources are independent and add in quadrature (JCGM 100:2008, GUM, section 5.1).

    Examples
    --------
    >>> import frictrack as ft
    >>> run = ft.samples.runs()[0]
    >>> found = ft.budget(run, ft.low_pass(run.displacement))
    >>> [row.source for row in found.rows][:2]
    ['pixel noise', 'filter']

    """
    if run.mass is None and run.friction_N is None:
        raise FrictrackError(f'run "{run.name}": expected a mass for an error budget but got none; weigh the slider')
    result = friction(run)
    free = result.free
    if not np.any(free):
        raise FrictrackError(f'run "{run.name}": expected free frames for an error budget but got none')
    weights = np.where(free, np.sign(run.motion.v), 0.0) / np.sum(free)
    mean = float(weights @ result.F)
    if run.friction_N is not None:
        return Budget(run.name, mean, (_cell(result.sigma_F, free),))
    del result  # of a long run it takes much memory
    errors = _RunErrors(run, free, weights)
    response = FilterResponse(Derivatives.of_x(filtered), run.motion)
    rows = (
        *errors.noise_and_filter(response, film is not None),
        *errors.common_errors(film),
        *errors.picture_errors(response, quality),
        *errors.drive_errors((clocks or {}).get("drive", {})),
    )
    reductions = response.noise_reductions(weights, NOISE_FACTORS)
    return Budget(run.name, mean, rows, reductions, filmed=film is not None)


def _cell(sigma: Array, free: Mask) -> Contribution:
    """Error of a load cell that measured friction itself; nothing else counts."""
    level = float(np.sqrt(np.mean(sigma[free] ** 2)))
    known_from = "white noise of the record, from its fifth differences; zero and sensitivity are not known"
    return Contribution(SENSOR, level, "N", known_from, level, level / float(np.sqrt(np.sum(free))))


class _RunErrors:
    """Effect of every source of error on one run."""

    def __init__(self, run: Run, free: Mask, weights: Array) -> None:
        assert run.inertia is not None
        self.run, self.free, self.weights, self.mass = run, free, weights, run.inertia

    def effect(self, rows: Array) -> tuple[float, float]:
        """Return rms over the free section, and mean, of a force error (n,) that is common to all frames."""
        return float(np.sqrt(np.mean(rows[self.free] ** 2))), abs(float(self.weights @ rows))

    def noise_and_filter(self, response: FilterResponse, filmed: bool) -> list[Contribution]:
        """Noise that the smoother transmits, and signal that it removes."""
        noise = response.transmitted_noise(self.weights)
        lost = response.lost_signal(self.weights, noise)
        known_from = "estimated by maximum likelihood with the smoother" + ("; includes clock jitter" if filmed else "")
        if response.derived.sensor_weights is not None:
            known_from += "; the effect includes accelerometer noise"
        rms_noise, rms_lost = (float(np.sqrt(np.mean(error.rows[self.free] ** 2))) for error in (noise, lost))
        cutoff = f"equivalent low-pass {self.run.motion.cutoff:.3g} Hz"
        how = f"removed by the smoother ({cutoff}), estimated from the record"
        return [
            Contribution(NOISE, 1e6 * response.noise, "um", known_from, self.mass * rms_noise, self.mass * noise.total),
            Contribution(FILTER, rms_lost, "m/s^2", how, self.mass * rms_lost, self.mass * lost.total),
        ]

    def common_errors(self, film: RecordingInfo | None) -> list[Contribution]:
        """Errors that all runs share: of the scale, of the mass, and of the frame rate, squared in the acceleration."""
        inertia, weighed = self.mass * self.run.motion.a, self.run.motion.a - self.run.pull
        scale, mass = self.run.displacement.relative_scale_error, self.run.sigma_mass / (self.run.mass or 1.0)
        rate, rate_from = frame_rate_error(film)
        length = "standard deviation of the calibrated length of the path"
        return [
            self._common(SCALE, scale, inertia, "%", length if scale else "not given"),
            self._common(MASS, mass, self.mass * weighed, "g", "as given in the study" if mass else "not given"),
            self._common(TIME, rate, 2 * inertia, "%", rate_from),
        ]

    def _common(self, source: str, error: float | None, force: Array, unit: str, known_from: str) -> Contribution:
        """A relative error, and the force (n,) that it multiplies; of an unknown one, what 0.1 % would do."""
        if not error:
            known_from += f"; each 0.1 % would add {format_number(1e-3 * self.effect(force)[1], 2)} N"
            return Contribution(source, None, unit, known_from, None, None, ALL_RUNS)
        size = error * (1e3 * (self.run.mass or 1.0) if unit == "g" else 100.0)
        return Contribution(source, size, unit, known_from, *self.effect(error * force), ALL_RUNS)

    def picture_errors(self, response: FilterResponse, quality: Mapping[str, Any] | None) -> list[Contribution]:
        """Peak locking and camera shake: systematic errors of the picture."""
        pitch = self.run.pixel_pitch
        if not quality or pitch is None:
            return []
        return [self._peak_locking(response, quality, pitch), *self._camera_shake(response, quality, pitch)]

    def _peak_locking(self, response: FilterResponse, quality: Mapping[str, Any], pitch: float) -> Contribution:
        size, error = quality.get("peak_locking_px"), quality.get("peak_locking_std_px")
        if size is None or error is None:
            return Contribution(LOCKING, None, "px", "not determined from this track", None, None, ALL_FRAMES)
        frame, mean = self._effect_of_wave(response, 2 * np.pi * response.derived.x / pitch, pitch)  # of one px
        if size < MIN_SIGMAS_LOCKING * error:
            largest = size + 2 * error
            most, in_frame, in_mean = (format_number(q, 2) for q in (largest, largest * frame, largest * mean))
            known_from = (
                f"none found; at most {most} px, which would add {in_frame} N in a frame and {in_mean} N in the mean"
            )
            return Contribution(LOCKING, 0.0, "px", known_from, 0.0, 0.0, ALL_FRAMES)
        true = float(np.sqrt(size**2 - error**2))
        known_from = f"amplitude, measured to {format_number(error, 2)} px"
        return Contribution(LOCKING, true, "px", known_from, true * frame, true * mean, ALL_FRAMES)

    def _camera_shake(self, response: FilterResponse, quality: Mapping[str, Any], pitch: float) -> list[Contribution]:
        """What is left of a camera shake: the error of what was subtracted, or all of it if nothing was."""
        remaining, frequency = quality.get("shake_left_px"), quality.get("shake_Hz")
        if not remaining or not frequency:
            return []
        frame, mean = self._effect_of_wave(response, 2 * np.pi * frequency * self.run.motion.t, pitch)
        rms = float(np.sqrt(2.0)) * remaining
        known_from = f"{quality.get('shake_left_told', 'not removed')}, at {frequency:.0f} Hz"
        return [Contribution(SHAKE, remaining, "px", known_from, rms * frame, rms * mean, ALL_FRAMES)]

    def _effect_of_wave(self, response: FilterResponse, angle: Array, size: float) -> tuple[float, float]:
        """Effects of a displacement of amplitude `size` (m) with phase angle (n,), averaged over the phase, N."""
        apparent = response.of(size * np.stack([np.cos(angle), np.sin(angle)], axis=1))
        effects = [self.effect(self.mass * column) for column in apparent.T]
        frame, mean = np.sqrt(np.mean(np.square(effects), axis=0))
        return float(frame), float(mean)

    def drive_errors(self, clock: Mapping[str, Any]) -> list[Contribution]:
        """White noise of a measured drive, and the uncertainty of its clock."""
        if self.run.drive is None:
            return []
        drive = np.asarray(self.run.drive, dtype=float)
        level, n, t = white_noise(drive), float(np.sum(self.free)), self.run.motion.t
        known_from = "white noise of the record, from its fifth differences"
        rows = [Contribution(DRIVE, level, "N", known_from, level, level / float(np.sqrt(n)))]
        offset_std = clock.get("sigma_offset_s")
        if offset_std:
            slope = np.gradient(drive, t)
            noise_slope = level / (float(np.median(np.diff(t))) * np.sqrt(2.0))  # what noise alone makes of a slope
            frame, mean = self.effect(offset_std * slope)
            frame = float(np.sqrt(max(frame**2 - (offset_std * noise_slope) ** 2, 0.0)))
            known_from = "of the offset between the drive's clock and the camera's"
            rows.append(Contribution(DRIVE_CLOCK, 1e3 * offset_std, "ms", known_from, frame, mean, ALL_FRAMES))
        return rows


RATE_PREFIX = "frame rate, "
PLAYBACK = "speed of showing"
STAMPS = "stamps"
MIN_RELATIVE_ERROR = 5e-7  # rounding of the rates in the audit
RATE_TEXTS = {"given": "the rate given", "header": "that of the header", STAMPS: "that of the time stamps"}


def frame_rate_error(film: RecordingInfo | None) -> tuple[float | None, str]:
    """Return the relative error of the frame rate, None if not known, and how it is known, or why not.

    The rates by the user, the header and the time stamps are compared with the one that is used; the largest difference
    counts. Agreement of user and header without camera time stamps proves nothing: both state the setting.
    """
    if film is None:
        return None, "not known: the table's times are used as given"
    rates = {
        name.removeprefix(RATE_PREFIX): float(value.split()[0])
        for name, value, verdict in film.audit
        if name.startswith(RATE_PREFIX) and verdict != PLAYBACK
    }
    error = max((abs(rate / film.fps - 1.0) for rate in rates.values()), default=0.0)
    if error < MIN_RELATIVE_ERROR and not (film.clocked and STAMPS in rates and len(rates) > 1):
        used = next((RATE_TEXTS.get(name, name) for name in rates), "the frame rate")
        return None, f"not known: {used} is used as given; there are no camera time stamps to check it"
    return max(error, MIN_RELATIVE_ERROR), f"difference of the frame rates ({' and '.join(rates)})"
