"""The set-up as it is known before a film is taken, what is assumed of it, and the runs that could be filmed on it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from frictrack import models
from frictrack.diagnose.experiments.virtual_runs import RunConditions, RunDesign
from frictrack.effects import Path
from frictrack.models import Model
from frictrack.records import GRAVITY

PICTURE = 800  # px that a picture is wide, of which the course is as long
NOISE = 0.02  # px, of a frame
SCATTER = 0.03  # of dry friction from run to run
SPEEDS = (1.0, 2.0, 4.0, 6.0, 8.0)  # m/s
BACK = (2.0, 4.0, 8.0)  # m/s, the other way
MIDDLE = 4.0  # m/s, at which mass, tilt and frame rate are varied
TILT = np.deg2rad(5.0)
WITHIN = 0.85  # of the course, within which a run is to stop
BRAKING = 5.0  # m/s^2, by Coulomb friction
STATIC, STRIBECK, VISCOUS = 0.3, 0.3, 0.1  # rise at rest over Coulomb's level; m/s; per m/s of that level


@dataclass(frozen=True)
class Stand:
    """What a plan rests on: mass kg, frames per second, metres per pixel, noise m, the law with its values, scatter.

    `values` are those that the fit seeks (of `stribeck` the rise over Coulomb's level). `course` is how far the camera
    sees, m. `done` are runs that were filmed already. `assumed` says in words what nobody measured.
    """

    mass: float
    fps: float
    pitch: float
    noise: float
    law: Model
    values: dict[str, dict[str, float]]
    scatter: float = SCATTER
    course: float = PICTURE * 5e-4
    start: float = 0.0
    done: tuple[Entry, ...] = ()
    assumed: tuple[str, ...] = ()

    @property
    def friction(self) -> float:
        """Dry friction at speed, N."""
        return self.values.get("coulomb", {}).get("F_c", self.mass * BRAKING)

    @property
    def bench(self) -> RunConditions:
        """What holds for every planned run."""
        still = np.zeros(1)
        path = Path(t=still, x=still, v=still, s=still + 1, mass=self.mass, pixel_pitch=self.pitch, gravity=GRAVITY)
        return RunConditions(self.fps, self.noise, self.mass, max(self.friction / self.mass, 0.1), path)


@dataclass(frozen=True)
class Entry:
    """One run of the menu: what to do, and how it would be made."""

    key: str
    words: str
    film: RunDesign


def usual(mass: float, fps: float, pitch: float) -> Stand:
    """A set-up of which only mass and camera are known, with the usual law."""
    level = mass * BRAKING
    values = {
        "coulomb": {"F_c": level},
        "stribeck": {"F_s": STATIC * level, "v_s": STRIBECK, "delta": 1.0},
        "viscous": {"F_v": VISCOUS * level},
    }
    course = PICTURE * pitch
    assumed = (
        f"law: Coulomb friction that slows the mass by {BRAKING:g} m/s² ({level:.3g} N), {100 * STATIC:g} % more at "
        f"rest, gone within {STRIBECK:g} m/s, and {100 * VISCOUS:g} % more for every m/s",
        f"noise of a frame {NOISE:g} px ({1e6 * NOISE * pitch:.3g} µm), white",
        f"course of {course:.2g} m: a picture {PICTURE} px wide",
        f"dry friction that scatters by {100 * SCATTER:g} % from run to run",
    )
    law = models.of(list(values))
    return Stand(mass, fps, pitch, NOISE * pitch, law, values, course=course, assumed=assumed)


def menu(stand: Stand) -> list[Entry]:
    """Runs that could be filmed: speeds both ways, other masses, to a stop, tilted, at twice the frame rate."""
    return [*_speeds(stand), *_changes(stand)]


def film(stand: Stand, speed: float) -> RunDesign:
    """A plain run at a speed (m/s), negative the other way."""
    far = stand.start + stand.course
    return RunDesign((stand.start if speed > 0 else far, speed), (stand.start, far))


def _speeds(stand: Stand) -> Iterator[Entry]:
    for v in SPEEDS:
        yield Entry(f"{v:g} m/s", f"one run at {v:g} m/s", film(stand, v))
    for v in BACK:
        yield Entry(f"{-v:g} m/s", f"one run at {v:g} m/s the other way", film(stand, -v))
    stop = float(np.sqrt(2 * stand.bench.slowing * WITHIN * stand.course))
    yield Entry("to a stop", f"one run at {stop:.1f} m/s until the mass stops by itself", film(stand, stop))


def _changes(stand: Stand) -> Iterator[Entry]:
    plain, at = film(stand, MIDDLE), f"at {MIDDLE:g} m/s"
    yield Entry("double mass", f"one run {at} with the mass doubled", replace(plain, mass=2.0))
    yield Entry("half mass", f"one run {at} with half the mass", replace(plain, mass=0.5))
    for sign, word in ((1, "raised"), (-1, "lowered")):
        words = f"one run {at} with the far end of the course {word} by 5 degrees (give incline)"
        yield Entry(f"tilt {5 * sign:+d}", words, replace(plain, tilt=sign * TILT))
    yield Entry("frame rate", f"one run {at} at twice the frame rate", replace(plain, rate=2.0))
