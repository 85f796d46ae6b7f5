"""Compute the error budget of a run's friction force: of each frame, and of its mean.

Noise averages out in the mean according to its covariance; errors of scale, mass and time base do not. A source whose
size is not known stays in the table without a number.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.base.number_format import format_number, format_plus_minus
from frictrack.measure.friction import drive_noise, friction
from frictrack.measure.motion import unit_responses
from frictrack.measure.motion.derivative import Derivatives
from frictrack.measure.motion.grid import stencil_start
from frictrack.records import Array, Filtered, Mask, Run

if TYPE_CHECKING:
    from frictrack.results import RecordingInfo

NOISE, FILTER, SCALE, MASS, TIME = "pixel noise", "filter", "scale", "mass", "time base"
LOCKING, SHAKE, DRIVE, DRIVE_CLOCK, SENSOR = "peak locking", "camera shake", "drive sensor", "drive clock", "load cell"
EACH_FRAME, ALL_FRAMES, ALL_RUNS = "each frame", "all frames", "all runs"  # what shares one and the same error


@dataclass(frozen=True)
class Contribution:
    """One source of error of the friction force.

    Parameters
    ----------
    source
        Its name.
    size, unit
        Its standard deviation and unit; None if not known.
    known_from
        How the size is known.
    frame_N
        Effect on the force of one frame, rms over the free section, N; None if the size is not known.
    mean_N
        Effect on the mean force over the free section, N; None if the size is not known.
    common
        What shares one and the same error: each frame, all frames of a run, or all runs.

    """

    source: str
    size: float | None
    unit: str
    known_from: str
    frame_N: float | None
    mean_N: float | None
    common: str = EACH_FRAME

    def summary(self) -> dict[str, Any]:
        """Return the JSON of the row, without its shares."""
        return {"told" if key == "known_from" else key: value for key, value in vars(self).items()}


@dataclass(frozen=True)
class Budget:
    """Error budget of the friction force of one run.

    Parameters
    ----------
    run
        Name of the run.
    force_N
        Mean of the resisting force over the free section, N.
    rows
        All sources of error.

    """

    run: str
    force_N: float
    rows: tuple[Contribution, ...]

    @property
    def frame_N(self) -> float:
        """Standard deviation of the friction force of one frame, rms over the free section, N."""
        return _root_sum_square(row.frame_N for row in self.rows)

    @property
    def mean_N(self) -> float:
        """Standard deviation of the mean friction force, N."""
        return _root_sum_square(row.mean_N for row in self.rows)

    def row(self, source: str) -> Contribution | None:
        """Find the row of a source, such as "scale"; None if the budget has none."""
        return next((row for row in self.rows if row.source == source), None)

    def summary(self) -> dict[str, Any]:
        """Return the JSON: rows with their shares of both variances, the total last, and sentences."""
        total = Contribution("total", None, "", "", self.frame_N, self.mean_N, "")
        return {
            "force_N": self.force_N,
            "rows": [row.summary() | self._shares(row) for row in (*self.rows, total)],
            "says": list(_sentences(self)),
        }

    def _shares(self, row: Contribution) -> dict[str, float | None]:
        parts = (("frame", row.frame_N, self.frame_N), ("mean", row.mean_N, self.mean_N))
        return {f"share_{k}": None if part is None or not total else (part / total) ** 2 for k, part, total in parts}


def _root_sum_square(parts: Iterable[float | None]) -> float:
    """Root of the sum of squares of the parts that are known."""
    return float(np.sqrt(sum(p**2 for p in parts if p is not None)))


def _sentences(budget: Budget) -> Iterator[str]:
    """Errors of mean and frame with their largest source, and what is not known."""
    if not budget.mean_N or not budget.frame_N:
        yield "no error of this run is known"
        return
    share = f" ({100 * budget.mean_N / abs(budget.force_N):.2g} %)" if budget.force_N else ""
    yield (
        f"mean friction force: {format_plus_minus(budget.force_N, budget.mean_N)} N{share}, "
        f"{_largest_source(budget, 'mean_N')}; standard deviation of a single frame: "
        f"{format_number(budget.frame_N, 2)} N, {_largest_source(budget, 'frame_N')}"
    )
    unknown = [row.source for row in budget.rows if row.frame_N is None]
    if unknown:
        yield f"not counted because unknown: {', '.join(unknown)}"


def _largest_source(budget: Budget, key: str) -> str:
    """Name the largest contribution to the mean or to a frame, with its share of the variance."""
    row = max(budget.rows, key=lambda r: getattr(r, key) or 0.0)
    share = (getattr(row, key) / getattr(budget, key)) ** 2
    without_article = {FILTER: "signal lost in the filter", NOISE: NOISE, LOCKING: LOCKING}
    return f"largest source {without_article.get(row.source, f'the {row.source}')} ({100 * share:.0f} %)"


MIN_SIGMAS_LOCKING = 3.0  # standard deviations from which peak locking counts as found


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
        read = free & np.isfinite(run.friction_N)
        level = float(np.sqrt(np.mean(result.sigma_F[read] ** 2)))
        how = "white noise of the record, zero, sensitivity and lag are not known"  # nothing else counts
        only = Contribution(SENSOR, level, "N", how, level, level / float(np.sqrt(np.sum(read))))
        return Budget(run.name, mean, (only,))
    del result  # of a long run it takes much memory
    errors = _RunErrors(run, Derivatives.of_x(filtered), free, weights)
    rows = [*errors.noise_and_filter(film is not None), *errors.common_errors(film)]
    if quality and run.pixel_pitch is not None:
        rows += [errors.peak_locking(quality, run.pixel_pitch), *errors.camera_shake(quality, run.pixel_pitch)]
    return Budget(run.name, mean, (*rows, *errors.drive_errors((clocks or {}).get("drive", {}))))


AccelerationError = tuple[Array, float]  # deviations of the acceleration, m/s^2: per frame (n,), and of a weighted sum


class _RunErrors:
    """Effect of every source of error on one run: the filter and its derivatives are one linear map.

    `weights` (n,) are those of the forces in their mean.
    """

    def __init__(self, run: Run, derived: Derivatives, free: Mask, weights: Array) -> None:
        assert run.inertia is not None
        self.run, self.derived, self.free, self.weights, self.mass = run, derived, free, weights, run.inertia

    def effect(self, rows: Array) -> tuple[float, float]:
        """Return rms over the free section, and mean, of a force error (n,) that is common to all frames."""
        return float(np.sqrt(np.mean(rows[self.free] ** 2))), abs(float(self.weights @ rows))

    def noise_and_filter(self, filmed: bool) -> list[Contribution]:
        """Noise that the smoother transmits, and signal that it removes, the error of line frequencies included."""
        passed, passed_mean = self._transmitted_noise()
        lost = np.maximum(self.run.motion.sigma_a**2 - passed**2 - self.run.motion.shake_a**2, 0.0)
        total = float(self.derived.covariance(2, self.weights[:, None])[0, 0])
        lost_mean = float(np.sqrt(max(total - passed_mean**2, 0.0)))
        known_from = "estimated by maximum likelihood with the smoother" + ("; includes clock jitter" if filmed else "")
        if self.derived.sensor_weights is not None:
            known_from += "; the effect includes accelerometer noise"
        rms_noise, rms_lost = (float(np.sqrt(np.mean(square[self.free]))) for square in (passed**2, lost))
        cutoff = f"equivalent low-pass {self.run.motion.cutoff:.3g} Hz"
        how = f"removed by the smoother ({cutoff}), estimated from the record"
        noise = 1e6 * self.derived.noise  # of one frame of usual weight
        return [
            Contribution(NOISE, noise, "um", known_from, self.mass * rms_noise, self.mass * passed_mean),
            Contribution(FILTER, rms_lost, "m/s^2", how, self.mass * rms_lost, self.mass * lost_mean),
        ]

    def _transmitted_noise(self) -> AccelerationError:
        """Frame noise that the low-pass transmits, in every frame and in the sum."""
        derived, grid = self.derived, self.derived.grid
        if derived.smoother.method is not None:
            rows, total = np.zeros(len(self.weights)), 0.0
            for frames, response in unit_responses(derived.smoother.method, derived.w > 0, 2):
                second = response[grid.frames] * (derived.noise / np.sqrt(derived.w[frames]) / grid.interval**2)
                rows += np.sum(second**2, axis=1)
                total += float(np.sum((self.weights @ second) ** 2))
            return np.sqrt(rows), float(np.sqrt(total))
        factor = derived.factor
        passed = factor.noise_variances(stencil_start(grid.n), derived.stencil(2))
        smoothed = factor.posterior_covariance_times(derived.position_weights(2, self.weights[:, None])[:, 0])
        variance = float(np.sum(factor.data.apply_inverse_covariance(smoothed) * smoothed))
        if derived.sensor_weights is not None:
            variance += float(np.sum(derived.sensor_weights * np.diff(smoothed, 2) ** 2))
        return derived.noise * grid.to_rows(np.sqrt(passed)), derived.noise * float(np.sqrt(variance))

    def common_errors(self, film: RecordingInfo | None) -> list[Contribution]:
        """Errors that all runs share: of the scale, of the mass, and of the frame rate, squared in the acceleration."""
        inertia, weighed = self.mass * self.run.motion.a, self.run.motion.a - self.run.pull
        scale, mass = self.run.displacement.relative_scale_error, self.run.sigma_mass / (self.run.mass or 1.0)
        rate, rate_from = frame_rate_error(film)
        if self.run.displacement.clock_error:
            rate, rate_from = self.run.displacement.clock_error, "of the interval between rows, from their time stamps"
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

    def peak_locking(self, quality: Mapping[str, Any], pitch: float) -> Contribution:
        """The error that repeats from pixel to pixel."""
        size, error = quality.get("peak_locking_px"), quality.get("peak_locking_std_px")
        if size is None or error is None:
            return Contribution(LOCKING, None, "px", "not determined from this track", None, None, ALL_FRAMES)
        frame, mean = self._effect_of_wave(2 * np.pi * self.derived.x / pitch, pitch)  # of one px
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

    def camera_shake(self, quality: Mapping[str, Any], pitch: float) -> list[Contribution]:
        """What is left of a camera shake: the error of what was subtracted, or all of it if nothing was."""
        remaining, frequency = quality.get("shake_left_px"), quality.get("shake_Hz")
        if not remaining or not frequency:
            return []
        frame, mean = self._effect_of_wave(2 * np.pi * frequency * self.run.motion.t, pitch)
        rms = float(np.sqrt(2.0)) * remaining
        known_from = f"{quality.get('shake_left_told', 'not removed')}, at {frequency:.0f} Hz"
        return [Contribution(SHAKE, remaining, "px", known_from, rms * frame, rms * mean, ALL_FRAMES)]

    def _effect_of_wave(self, angle: Array, size: float) -> tuple[float, float]:
        """Effects of a displacement of amplitude `size` (m) with phase angle (n,), averaged over the phase, N."""
        apparent = self.derived.apparent_motion(size * np.stack([np.cos(angle), np.sin(angle)], axis=1))[2]
        effects = [self.effect(self.mass * column) for column in apparent.T]
        frame, mean = np.sqrt(np.mean(np.square(effects), axis=0))
        return float(frame), float(mean)

    def drive_errors(self, clock: Mapping[str, Any]) -> list[Contribution]:
        """White noise of a measured drive, and the uncertainty of its clock."""
        if self.run.drive is None:
            return []
        drive = np.asarray(self.run.drive, dtype=float)
        t, level = self.run.motion.t, drive_noise(self.run)
        per_sample = (self.run.drive_interval or 0.0) / float(np.median(np.diff(t)))  # frames
        n = float(np.sum(self.free)) / max(per_sample, 1.0)
        known_from = "white noise of the record; its lag is not known" if self.run.sigma_drive is None else "stated"
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
