"""The rows of the budget, their sum, and how it would shrink."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from frictrack.budget.budget_summary import RATE, sentences
from frictrack.budget.filter_response import Response
from frictrack.budget.frame_rate import rate_error
from frictrack.errors import FrictrackError
from frictrack.friction import friction
from frictrack.motion import noise_level
from frictrack.records import GRAVITY, Array, Filtered, Mask, Run

if TYPE_CHECKING:
    from frictrack.results import Film

SURE = 3.0  # standard deviations from which on peak locking is taken to be there
NOISE, FILTER, SCALE, MASS, TIME = "pixel noise", "filter", "scale", "mass", "time base"
LOCKING, SHAKE, DRIVE, DRIVE_CLOCK, SENSOR = "peak locking", "camera shake", "drive sensor", "drive clock", "load cell"
EACH, RUN, ALL = "each frame", "all frames", "all runs"  # what an error is common to
FINER = (RATE, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0)  # times less noise that are tried


@dataclass(frozen=True)
class Contribution:
    """One source of error: its size and where that is known from, its effect on the friction force in N.

    `frame_N` is the rms over the free section, `mean_N` the effect on the mean force over it; None where the size is
    not known. `common` tells what shares one and the same error: a frame, all frames of the run, or all runs.
    """

    source: str
    size: float | None
    unit: str
    told: str
    frame_N: float | None
    mean_N: float | None
    common: str = EACH


@dataclass(frozen=True)
class Budget:
    """All sources of one run, the mean friction force they act on, and what is to be said of them."""

    run: str
    force_N: float  # mean of the resisting force over the free section
    rows: tuple[Contribution, ...]
    finer: dict[float, tuple[float, float]] = field(default_factory=dict)  # times less noise -> factors on both effects

    @property
    def frame_N(self) -> float:
        """Standard deviation of the friction force of one frame, rms over the free section."""
        return root(row.frame_N for row in self.rows)

    @property
    def mean_N(self) -> float:
        """Standard deviation of the mean friction force."""
        return root(row.mean_N for row in self.rows)

    def row(self, source: str) -> Contribution | None:
        """The row of a source."""
        return next((row for row in self.rows if row.source == source), None)

    def summary(self) -> dict[str, Any]:
        """As JSON: rows with their shares of both variances, the total last; `says` in words."""
        total = Contribution("total", None, "", "", self.frame_N, self.mean_N, "")
        return {
            "force_N": self.force_N,
            "rows": [asdict(row) | self._shares(row) for row in (*self.rows, total)],
            "says": list(sentences(self)),
        }

    def _shares(self, row: Contribution) -> dict[str, float | None]:
        both = (("frame", row.frame_N, self.frame_N), ("mean", row.mean_N, self.mean_N))
        return {f"share_{k}": None if part is None or not all_ else (part / all_) ** 2 for k, part, all_ in both}


def root(parts: Any) -> float:
    """Root of the sum of squares of those that are known."""
    return float(np.sqrt(sum(p**2 for p in parts if p is not None)))


def budget(
    run: Run,
    filtered: Filtered,
    quality: Mapping[str, Any] | None = None,
    film: Film | None = None,
    clocks: Mapping[str, Any] | None = None,
) -> Budget:
    """Every known error of the friction force of a run, in newtons.

    `filtered` is what the run's motion was derived from; `quality` is what a film says of its own measurement (peak
    locking, camera shake) and `film` its time base; `clocks` how sensors were aligned. Without them those sources
    stand as not known, or are left out where there is no camera.
    Raises FrictrackError for a run without a mass and without measured friction, and where nothing is free.
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
    made = _Sources(run, free, weights)
    response = Response(filtered, run.motion)
    rows = (
        *made.smoothed(response, film is not None),
        made.scale(),
        made.weighed(),
        made.timed(film),
        *made.pictured(response, quality),
        *made.driven((clocks or {}).get("drive", {})),
    )
    return Budget(run.name, mean, rows, {k: response.finer(weights, k) for k in FINER})


def _cell(sigma: Array, free: Mask) -> Contribution:
    """A load cell that measured friction itself: nothing else counts."""
    level = float(np.sqrt(np.mean(sigma[free] ** 2)))
    told = "white noise of the record, from its fifth differences; its zero and sensitivity are not known"
    return Contribution(SENSOR, level, "N", told, level, level / float(np.sqrt(np.sum(free))))


class _Sources:
    """The effect of every source on one run."""

    def __init__(self, run: Run, free: Mask, weights: Array) -> None:
        assert run.mass is not None
        self.run, self.free, self.weights, self.mass = run, free, weights, run.mass
        self.inertia = run.mass * run.motion.a

    def effect(self, rows: Array) -> tuple[float, float]:
        """Rms over the free section and mean of forces (n,) that belong to one and the same error."""
        return float(np.sqrt(np.mean(rows[self.free] ** 2))), abs(float(self.weights @ rows))

    def smoothed(self, response: Response, filmed: bool) -> list[Contribution]:
        """Noise that the smoother lets through, and signal that it takes away."""
        passed = response.passed(self.weights)
        lost = response.lost(self.weights, passed)
        told = "by maximum likelihood along with the smoother" + ("; jitter of the clock is in it" if filmed else "")
        if response.sensed:
            told += "; that of the accelerometer is in the effect"
        frame, frame_lost = (self.mass * float(np.sqrt(np.mean(s.rows[self.free] ** 2))) for s in (passed, lost))
        how = f"taken away by the smoother ({self.run.motion.cutoff:.3g} Hz as a plain low-pass), as the record shows"
        return [
            Contribution(NOISE, 1e6 * response.noise, "um", told, frame, self.mass * passed.total),
            Contribution(FILTER, _rms(lost.rows[self.free]), "m/s^2", how, frame_lost, self.mass * lost.total),
        ]

    def scale(self) -> Contribution:
        """Common to all frames, and to all runs of one camera."""
        relative = self.run.displacement.relative_scale_error
        if relative == 0.0:
            return Contribution(SCALE, None, "%", f"not given; {self._each(self.inertia)}", None, None, ALL)
        told = "standard deviation of the calibrated length of the path"
        return Contribution(SCALE, 100 * relative, "%", told, *self.effect(relative * self.inertia), ALL)

    def weighed(self) -> Contribution:
        """Common to all frames, and to all runs with this slider."""
        sigma = self.run.sigma_mass
        pull = self.run.motion.a + GRAVITY * np.sin(self.run.incline)
        if sigma == 0.0:
            told = f"not given; {self._each(self.mass * pull)}"
            return Contribution(MASS, None, "g", told, None, None, ALL)
        return Contribution(MASS, 1e3 * sigma, "g", "as given in the study", *self.effect(sigma * pull), ALL)

    def timed(self, film: Film | None) -> Contribution:
        """Acceleration goes with the square of the frame rate."""
        error, told = rate_error(film)
        if error is None:
            return Contribution(TIME, None, "%", f"{told}; {self._each(2 * self.inertia)}", None, None, ALL)
        return Contribution(TIME, 100 * error, "%", told, *self.effect(2 * error * self.inertia), ALL)

    def _each(self, rows: Array) -> str:
        """What 0.1 % would do to the mean."""
        return f"every 0.1 % would be {1e-3 * self.effect(rows)[1]:.2g} N"

    def pictured(self, response: Response, quality: Mapping[str, Any] | None) -> list[Contribution]:
        """Peak locking and camera shake: faults of the picture that are no noise."""
        pitch = self.run.pixel_pitch
        if not quality or pitch is None:
            return []
        return [self._locking(response, quality, pitch), *self._shake(response, quality, pitch)]

    def _locking(self, response: Response, quality: Mapping[str, Any], pitch: float) -> Contribution:
        size, error = quality.get("peak_locking_px"), quality.get("peak_locking_std_px")
        if size is None or error is None:
            return Contribution(LOCKING, None, "px", "could not be told from this track", None, None, RUN)
        frame, mean = self._wave(response, 2 * np.pi * response.filtered.x / pitch, pitch)  # of one px
        if size < SURE * error:
            most = size + 2 * error
            told = (
                f"none seen; at most {most:.2g} px, which would be {most * frame:.2g} N in a frame and "
                f"{most * mean:.2g} N in the mean"
            )
            return Contribution(LOCKING, 0.0, "px", told, 0.0, 0.0, RUN)
        true = float(np.sqrt(size**2 - error**2))
        return Contribution(
            LOCKING, true, "px", f"amplitude, measured to {error:.2g} px", true * frame, true * mean, RUN
        )

    def _shake(self, response: Response, quality: Mapping[str, Any], pitch: float) -> list[Contribution]:
        """What is left of a shake: the error of what was subtracted, or all of it where it was left in."""
        left, frequency = quality.get("shake_left_px"), quality.get("shake_Hz")
        if not left or not frequency:
            return []
        frame, mean = self._wave(response, 2 * np.pi * frequency * self.run.motion.t, pitch)
        rms = float(np.sqrt(2.0)) * left
        told = f"{quality.get('shake_left_told', 'left in')}, at {frequency:.0f} Hz"
        return [Contribution(SHAKE, left, "px", told, rms * frame, rms * mean, RUN)]

    def _wave(self, response: Response, angle: Array, size: float) -> tuple[float, float]:
        """Effects of a displacement of amplitude `size` (m) with the angle (n,), whatever its phase, N."""
        feigned = response.of(size * np.stack([np.cos(angle), np.sin(angle)], axis=1))
        both = [self.effect(self.mass * column) for column in feigned.T]
        frame, mean = np.sqrt(np.mean(np.square(both), axis=0))
        return float(frame), float(mean)

    def driven(self, clock: Mapping[str, Any]) -> list[Contribution]:
        """White noise of a measured drive, and the uncertainty of its clock."""
        if self.run.drive is None:
            return []
        drive = np.asarray(self.run.drive, dtype=float)
        level = float(np.nan_to_num(noise_level(drive, np.isfinite(drive))[0]))
        n, t = float(np.sum(self.free)), self.run.motion.t
        told = "white noise of the record, from its fifth differences"
        rows = [Contribution(DRIVE, level, "N", told, level, level / float(np.sqrt(n)))]
        late = clock.get("sigma_offset_s")
        if late:
            slope = np.gradient(drive, t)
            ragged = level / (float(np.median(np.diff(t))) * np.sqrt(2.0))  # what noise alone makes of a slope
            frame, mean = self.effect(late * slope)
            frame = float(np.sqrt(max(frame**2 - (late * ragged) ** 2, 0.0)))
            told = "of the offset between the drive's clock and the camera's"
            rows.append(Contribution(DRIVE_CLOCK, 1e3 * late, "ms", told, frame, mean, RUN))
        return rows


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
