"""A fitted effect in the numbers of a study: what descriptions and direct checks are computed from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from frictrack.base.number_format import format_number
from frictrack.records import Array

N_MARKS = 20  # of a rule, or flashes of a diode, that are evaluated
FLASH_STD_FRAMES = 0.1  # of a frame: timing error of a flash or a time stamp
LEVEL_STD_RAD = np.deg2rad(0.05)  # angle error of a good spirit level
WEIGHT_RELATIVE_STD = 0.01  # of a known weight that is hung on the drive
ACCELEROMETER_STD = 0.2  # m/s^2, noise of one sample
N_STD_ACTIVE = 2.0  # standard deviations on either side of its middle within which a bell-shaped force acts
PLANNED_SHARE = 0.05  # of the friction force (rms), or of the momentum: size of an effect that a plan is made for


@dataclass(frozen=True)
class EffectRecord:
    """One effect along one run, at its n frames.

    Attributes
    ----------
    t : ndarray, shape (n,)
        Time since release, s.
    x, v : ndarray, shape (n,)
        Simulated displacement (m) and velocity (m/s).
    contribution : ndarray, shape (n,)
        What the effect adds: N, or m in the picture.
    noise : ndarray, shape (n,)
        Standard deviation of a measured position, m.
    whiten : callable
        Map a picture shift (n,) to residuals of unit variance, less what a change of the initial state
        would explain.
    mass : float
        Moving mass, kg.
    gravity : float
        Normal load per mass of a mass at rest, m/s^2.

    """

    t: Array
    x: Array
    v: Array
    contribution: Array
    noise: Array
    whiten: Callable[[Array], Array]
    mass: float
    gravity: float

    @property
    def frame_interval(self) -> float:
        """Median time between two frames, s."""
        return float(np.median(np.diff(self.t)))

    @property
    def marks(self) -> Array:
        """Rows of `N_MARKS` frames, evenly over the run."""
        return np.linspace(0, len(self.t) - 1, N_MARKS).astype(int)


class EffectInStudy(Protocol):
    """A fitted effect in the numbers of a study. `Effect.describe` and `DirectCheck.signal` take one.

    The "main run" is the run in which the effect is largest.
    """

    @property
    def run(self) -> str:
        """Name of the main run."""

    @property
    def mass(self) -> float:
        """Moving mass of the main run, kg."""

    @property
    def pixel_pitch(self) -> float | None:
        """Length of a pixel in the main run, m; None for a table."""

    @property
    def typical_speed(self) -> float:
        """Median speed of the main run, m/s."""

    @property
    def reference_weight(self) -> float:
        """Weight of the reference mass, N."""

    @property
    def stated_incline(self) -> float:
        """Incline of the main run as the study states it, rad; 0 where it states none."""

    @property
    def last_run(self) -> tuple[str, float]:
        """Name and duration (s since release) of the run that lasts longest."""

    @property
    def longest(self) -> EffectRecord:
        """The effect along the run with most frames."""

    @property
    def course(self) -> tuple[float, float]:
        """Smallest and largest place that any run reaches, m."""

    def value(self, parameter: str) -> float:
        """Fitted value of a parameter in the main run."""

    def rms(self, parameter: str) -> float:
        """Root mean square over the runs of the fitted values of a parameter."""

    def passes(self, place: float) -> str:
        """The first runs that pass a place (m), each with frame and speed, as text."""


@dataclass(frozen=True)
class DirectCheck:
    """A measurement other than a film of a run, which shows an effect itself.

    Attributes
    ----------
    key : str
        Short name of the measurement, such as "level".
    instruction : str
        What to do, as a sentence without a full stop.
    signal : callable
        Chi-squared that the effect would leave in the measurement if it is as large as fitted.

    """

    key: str
    instruction: str
    signal: Callable[[EffectInStudy], float]


def picture_shift_signal(effect: EffectInStudy) -> float:
    """Return chi-squared of the picture shift along one run, seen on a mark that does not follow the mass."""
    record = effect.longest
    return float(np.sum(record.whiten(record.contribution) ** 2))


def acceleration_signal(effect: EffectInStudy) -> float:
    """Return chi-squared of the force at an accelerometer on the mass; an error of the picture has no signal there."""
    record = effect.longest
    return float(np.sum((record.contribution / record.mass / ACCELEROMETER_STD) ** 2))


ACCELEROMETER_CHECK = DirectCheck(
    "accelerometer", "Fix an accelerometer to the mass and give it as `sensor`", acceleration_signal
)


def oscillation(effect: EffectInStudy) -> str:
    """Describe a frequency that all runs share.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> oscillation(SimpleNamespace(value={"frequency": 50.0}.get))
    '50.0 Hz, one swing every 20.0 ms in every run'

    """
    frequency = effect.value("frequency")
    return f"{format_number(frequency)} Hz, one swing every {format_number(1e3 / frequency)} ms in every run"
