"""Compute what the next run costs: one more film, and every setting that differs from the last run."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from frictrack.base.arguments import checked

SAME_RATIO = 0.02  # relative difference below which two masses are the same
SAME_ANGLE_RAD = 0.005
COSTLY_CHECKS = ("accelerometer", "course sensor", "known weight")  # to buy, mount and synchronise


@checked
@dataclass(frozen=True)
class RunSettings:
    """What a person sets before a run is filmed.

    Parameters
    ----------
    speed
        Start speed, m/s; negative toward -x.
    mass
        Sliding mass, kg.
    incline
        Incline of the course, rad.
    fps
        Frame rate, 1/s.
    zoom
        Pixel pitch over that of the other runs.

    """

    speed: Annotated[float, "m/s"]
    mass: Annotated[float, "kg"]
    incline: Annotated[float, "rad"] = 0.0
    fps: Annotated[float, "Hz"] = 0.0
    zoom: float = 1.0

    def summary(self) -> dict[str, float]:
        """Return the JSON `settings` of an experiment; the incline is in degrees."""
        return {
            "speed": self.speed,
            "mass": self.mass,
            "incline_deg": math.degrees(self.incline),
            "fps": round(self.fps, 6),
            "zoom": self.zoom,
        }


@checked
@dataclass(frozen=True)
class Costs:
    """Costs of the next experiment in any one unit (minutes, euros), and what the set-up can do.

    The defaults rate every film alike, and a sensor that must be bought and mounted like ten films.

    Parameters
    ----------
    film
        One more film.
    mass, direction, incline, camera
        Added where the run differs from the last one filmed: another mass, the other direction, another incline,
        another frame rate or zoom. Infinite: not possible.
    sensor
        A sensor that must be bought, mounted and synchronised.
    check
        Any other measurement without a film, such as a rule, a level or a mark at rest.
    speeds
        Slowest and fastest start speed, m/s.
    masses
        Masses at hand, kg; empty for any.
    frames
        Largest number of frames in one film, which the memory of the camera limits; infinite for any number. None:
        not known.

    Examples
    --------
    >>> costs = Costs(film=5, mass=20)
    >>> last = RunSettings(4.0, 0.35)
    >>> costs.of_run(RunSettings(6.0, 0.35), last), costs.of_run(RunSettings(4.0, 0.70), last)
    (5.0, 25.0)
    >>> Costs(masses=(0.35, 0.5)).of_run(RunSettings(4.0, 0.70), last)
    inf

    """

    film: float = 1.0
    mass: float = 0.0
    direction: float = 0.0
    incline: float = 0.0
    camera: float = 0.0
    sensor: float = 10.0
    check: float = 1.0
    speeds: tuple[Annotated[float, "m/s"], Annotated[float, "m/s"]] = (0.3, 8.0)
    masses: tuple[Annotated[float, "kg"], ...] = ()
    frames: float | None = None

    @checked
    def of_run(self, new: RunSettings, last: RunSettings | None) -> float:
        """Return the cost of a run after the last one filmed; infinite where the set-up cannot do it."""
        if self.masses and not any(_same(new.mass, one) for one in self.masses):
            return math.inf
        if not self.speeds[0] * (1 - SAME_RATIO) <= abs(new.speed) <= self.speeds[1] * (1 + SAME_RATIO):
            return math.inf
        if last is None:
            return float(self.film)
        changes = (
            (self.mass, not _same(new.mass, last.mass)),
            (self.direction, new.speed * last.speed < 0),
            (self.incline, abs(new.incline - last.incline) > SAME_ANGLE_RAD),
            (self.camera, not (_same(new.fps, last.fps) and _same(new.zoom, last.zoom))),
        )
        return float(self.film + sum(cost for cost, changed in changes if changed))

    def of_check(self, key: str) -> float:
        """Return the cost of a measurement without a film, by the key of its kind."""
        return float(self.sensor if key in COSTLY_CHECKS else self.check)


def _same(a: float, b: float) -> bool:
    """Whether two positive values differ by less than `SAME_RATIO`."""
    return abs(a - b) <= SAME_RATIO * max(abs(a), abs(b))


DEFAULT_COSTS = Costs()
