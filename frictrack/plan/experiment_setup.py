"""Describe the experimental setup before filming: known and assumed values, and the runs that could be filmed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from frictrack import models
from frictrack.costs import DEFAULT_COSTS, Costs, RunSettings
from frictrack.diagnose.experiments import DEFAULT_SCATTER, Experiment, RunConditions, RunDesign
from frictrack.effects import Path
from frictrack.models import Model
from frictrack.number_format import format_plain
from frictrack.records import GRAVITY

PICTURE_WIDTH_PX = 800  # width of a picture, px
DEFAULT_NOISE_PX = 0.02  # position noise per frame, px
SPEEDS_M_S = (1.0, 2.0, 4.0, 6.0, 8.0)
RETURN_SPEEDS_M_S = (2.0, 4.0, 8.0)  # in the other direction
MIDDLE_SPEED_M_S = 4.0  # at which mass, tilt and frame rate are varied
TILT_RAD = np.deg2rad(5.0)
STOP_WITHIN_SHARE = 0.85  # of the course
COULOMB_DECELERATION = 5.0  # m/s^2
STATIC_RISE_RATIO = 0.3  # static over Coulomb friction, minus one
STRIBECK_VELOCITY = 0.3  # m/s
VISCOUS_RATIO = 0.1  # viscous friction per m/s, over Coulomb friction


@dataclass(frozen=True)
class ExperimentSetup:
    """Values on which a plan rests.

    Parameters
    ----------
    mass
        Mass of the slider, kg.
    fps
        Frames per second.
    pitch
        Pixel pitch, m/px.
    noise
        Standard deviation of the position per frame, m.
    law
        The assumed friction law.
    values
        Its parameters as the fit uses them (`stribeck`: rise over the Coulomb level).
    scatter
        Relative standard deviation of dry friction from run to run.
    course
        Length of the course in view, m.
    start
        Position where the course begins, m.
    completed
        Runs that were filmed already.
    assumed
        Assumptions as sentences.
    costs
        Costs of the runs, and what the set-up can do.

    """

    mass: float
    fps: float
    pitch: float
    noise: float
    law: Model
    values: dict[str, dict[str, float]]
    scatter: float = DEFAULT_SCATTER
    course: float = PICTURE_WIDTH_PX * 5e-4
    start: float = 0.0
    completed: tuple[Experiment, ...] = ()
    assumed: tuple[str, ...] = ()
    costs: Costs = DEFAULT_COSTS

    def settings(self, design: RunDesign) -> RunSettings:
        """Settings of a planned run."""
        return RunSettings(design.start[1], self.mass * design.mass, design.tilt, self.fps * design.rate, design.pitch)

    @property
    def friction(self) -> float:
        """Dry friction at speed, N."""
        return self.values.get("coulomb", {}).get("F_c", self.mass * COULOMB_DECELERATION)

    @property
    def conditions(self) -> RunConditions:
        """Conditions common to all planned runs."""
        zeros = np.zeros(1)
        path = Path(t=zeros, x=zeros, v=zeros, s=zeros + 1, mass=self.mass, pixel_pitch=self.pitch, gravity=GRAVITY)
        return RunConditions(self.fps, self.noise, self.mass, max(self.friction / self.mass, 0.1), path)


def default_setup(mass: float, fps: float, pitch: float) -> ExperimentSetup:
    """Make a setup of which only mass and camera are known; the friction law is typical.

    Parameters
    ----------
    mass
        Mass, kg.
    fps
        Frames per second.
    pitch
        Pixel pitch, m/px.

    Returns
    -------
    ExperimentSetup

    Examples
    --------
    >>> default_setup(0.35, 4000, 5e-4).values["coulomb"]
    {'F_c': 1.75}

    """
    level, noise = mass * COULOMB_DECELERATION, DEFAULT_NOISE_PX * pitch
    values = {
        "coulomb": {"F_c": level},
        "stribeck": {"F_s": STATIC_RISE_RATIO * level, "v_s": STRIBECK_VELOCITY, "delta": 1.0},
        "viscous": {"F_v": VISCOUS_RATIO * level},
    }
    course = PICTURE_WIDTH_PX * pitch
    assumed = (
        f"friction law: Coulomb friction decelerates the mass by {COULOMB_DECELERATION:g} m/s² ({level:.3g} N); static "
        f"friction is {100 * STATIC_RISE_RATIO:g} % higher (Stribeck velocity {STRIBECK_VELOCITY:g} m/s); viscous "
        f"friction adds {100 * VISCOUS_RATIO:g} % per m/s",
        f"position noise per frame: {DEFAULT_NOISE_PX:g} px ({format_plain(1e6 * noise, 3)} µm), white",
        f"course length: {course:.2g} m, a picture {PICTURE_WIDTH_PX} px wide",
        f"scatter of dry friction from run to run: {100 * DEFAULT_SCATTER:g} %",
    )
    law = models.of(list(values))
    return ExperimentSetup(mass, fps, pitch, noise, law, values, course=course, assumed=assumed)


def candidate_runs(setup: ExperimentSetup) -> list[Experiment]:
    """List runs that could be filmed: speeds in both directions, other masses, a stop, a tilt, twice the frame rate.

    Parameters
    ----------
    setup
        The experimental setup.

    Returns
    -------
    list of Experiment

    Examples
    --------
    >>> [run.key for run in candidate_runs(default_setup(0.35, 4000, 5e-4))][:3]
    ['1 m/s', '2 m/s', '4 m/s']

    """
    entries = [*_speeds(setup), *_changes(setup)]
    return [e for e in entries if np.isfinite(setup.costs.of_run(setup.settings(e.design), None))]


def plain_run(setup: ExperimentSetup, speed: float) -> RunDesign:
    """Design of a plain run at a speed, m/s; negative speeds go the other way."""
    far = setup.start + setup.course
    frames = np.inf if setup.costs.frames is None else setup.costs.frames
    return RunDesign((setup.start if speed > 0 else far, speed), (setup.start, far), frames=frames)


def _speeds(setup: ExperimentSetup) -> Iterator[Experiment]:
    for v in SPEEDS_M_S:
        yield Experiment(f"{v:g} m/s", f"one run at {v:g} m/s", plain_run(setup, v))
    for v in RETURN_SPEEDS_M_S:
        yield Experiment(f"{-v:g} m/s", f"one run at {v:g} m/s the other way", plain_run(setup, -v))
    stop = float(np.sqrt(2 * setup.conditions.deceleration * STOP_WITHIN_SHARE * setup.course))
    yield Experiment("to a stop", f"one run at {stop:.1f} m/s until the mass stops by itself", plain_run(setup, stop))


def _changes(setup: ExperimentSetup) -> Iterator[Experiment]:
    plain, at = plain_run(setup, MIDDLE_SPEED_M_S), f"at {MIDDLE_SPEED_M_S:g} m/s"
    yield Experiment("double mass", f"one run {at} with the mass doubled", replace(plain, mass=2.0))
    yield Experiment("half mass", f"one run {at} with half the mass", replace(plain, mass=0.5))
    for sign, word in ((1, "raised"), (-1, "lowered")):
        words = f"one run {at} with the far end of the course {word} by 5 degrees (give incline)"
        yield Experiment(f"tilt {5 * sign:+d}", words, replace(plain, tilt=sign * TILT_RAD))
    yield Experiment("frame rate", f"one run {at} at twice the frame rate", replace(plain, rate=2.0))
