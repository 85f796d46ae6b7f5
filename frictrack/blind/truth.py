"""The truth of one blind study: law, runs, camera and hidden effects, and the motion that follows from them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from frictrack import effects, models
from frictrack.blind.foreign_effects import FOREIGN, foreign_effect
from frictrack.blind.memory_motion import simulate_memory
from frictrack.effects import Effect, Span
from frictrack.models import Model
from frictrack.records import Array, EarlierRuns
from frictrack.simulate import Conditions, Trajectory, push_force, simulate
from frictrack.simulate.rendering import Oscillation

START_X_M = 0.05  # start of runs toward +x; runs toward -x start at the other end of the course
EffectValues = dict[str, dict[str, float]]  # effect -> parameter -> value (SI)


@dataclass(frozen=True)
class RunTruth:
    """Truth of one run.

    Attributes
    ----------
    name
        Name of the run.
    speed
        Start speed, m/s; negative toward -x.
    mass_ratio
        Mass over the reference mass.
    level
        Dry friction over its mean.
    frames
        Number of frames.
    phase
        Phase of the vertical motion or rotation at release, rad.
    values
        Parameter values of the hidden effects that act in this run.
    earlier
        What was slid before, as in `Run`, where the study tells it.

    """

    name: str
    speed: float
    mass_ratio: float
    level: float
    frames: int
    phase: float = 0.0
    values: EffectValues = field(default_factory=dict)
    earlier: EarlierRuns | None = None


@dataclass(frozen=True)
class Truth:
    """Truth of one study, in SI units; its fields are keys of the sealed file.

    Attributes
    ----------
    seed, kind
        Seed of the draw; "one", "none", "two", "foreign" or "fault".
    model, law
        Effects of the base law, and their values as effects use them (F_s above F_c).
    mass, fps, pitch, noise
        Reference mass (kg), frame rate (1/s), pixel pitch (m) and standard deviation of a position (m).
    scatter
        Relative standard deviation of dry friction from run to run.
    course
        Length of the course, m.
    hidden
        Names of the hidden effects.
    push
        Duration of the measured push at the start, s; 0 where runs start in motion.
    lift
        Measured vertical motion: amplitude (m) and frequency (Hz).
    clamp
        Place of the beam's clamp, m.
    turn
        Rotation of the target that a film shows: amplitude (rad) and frequency (Hz).
    stated
        Whether the tables state the noise.
    film
        Whether the study consists of films.
    paused
        Whether the pauses between the runs are told.
    runs
        Truth of the runs.
    size, rise
        For each hidden effect its size over what the ideal detector sees in 95 of 100 repeats, and its expected rise of
        chi-squared.

    """

    seed: int
    kind: str
    model: tuple[str, ...]
    law: EffectValues
    mass: float
    fps: float
    pitch: float
    noise: float
    scatter: float
    course: float
    hidden: tuple[str, ...] = ()
    push: float = 0.0
    lift: tuple[float, float] | None = None
    clamp: float | None = None
    turn: tuple[float, float] | None = None
    stated: bool = True
    film: bool = False
    paused: bool = False
    runs: tuple[RunTruth, ...] = ()
    size: tuple[float, ...] = ()
    rise: tuple[float, ...] = ()

    @property
    def base(self) -> Model:
        """The base law, without hidden effects."""
        return models.of(self.model)

    def conditions(self, run: RunTruth) -> Conditions:
        """Conditions of one run."""
        return Conditions(
            mass=self.mass * run.mass_ratio,
            load=run.mass_ratio * run.level,
            mass_ratio=run.mass_ratio,
            pixel_pitch=self.pitch,
            drive=self.drive(run) if self.push else None,
            lift=None if self.lift is None else Oscillation(*self.lift, run.phase).second_derivative(),
            angle=None if self.turn is None else Oscillation(*self.turn, run.phase),
            clamp_x=self.clamp,
            earlier=run.earlier,
        )

    def drive(self, run: RunTruth) -> Callable[[Array], Array]:
        """Drive force of the push of a run as a function of time, N."""
        return push_force(self.mass * run.mass_ratio, run.speed, self.push)

    def start(self, run: RunTruth) -> tuple[float, float]:
        """Position (m) and velocity (m/s) in the first frame; a pushed run starts at rest."""
        return (START_X_M if run.speed > 0 else self.course + START_X_M), (0.0 if self.push else run.speed)

    def trajectory(self, run: RunTruth, *, hidden: bool = True) -> Trajectory:
        """Simulate the true motion of one run, with or without the hidden effects."""
        model, values = self.base, dict(self.law)
        for name in run.values if hidden else ():
            model = model + effect_named(name)
            values[name] = run.values[name]
        t = np.arange(run.frames) / self.fps
        if model.memory:
            return simulate_memory(model, values, self.conditions(run), t, self.start(run))
        return simulate(model, values, self.conditions(run), t, self.start(run))

    def span(self, trajectories: list[Trajectory]) -> Span:
        """Range of time, place and speed that motions cover."""
        return Span(
            duration=max(float(s.t[-1]) for s in trajectories),
            x_min=min(float(s.x.min()) for s in trajectories),
            x_max=max(float(s.x.max()) for s in trajectories),
            v_min=min(float(np.abs(s.v).min()) for s in trajectories),
            v_max=max(float(np.abs(s.v).max()) for s in trajectories),
            fps=self.fps,
            clamp_x=self.clamp,
            earlier=max((run.earlier or () for run in self.runs), key=len),
        )


def effect_named(name: str) -> Effect:
    """Get an effect of the library or a foreign effect by name.

    Examples
    --------
    >>> effect_named("drag").acts_on, effect_named("magnet").acts_on
    ('force', 'force')

    """
    return foreign_effect(name) if name in FOREIGN else effects.get(name)


def read_truth(raw: dict[str, Any]) -> Truth:
    """Read a truth from its JSON."""
    runs = tuple(_read_run(run) for run in raw["runs"])
    lists = {name: tuple(raw[name]) for name in ("model", "hidden", "size", "rise")}
    pairs = {name: raw[name] and tuple(raw[name]) for name in ("lift", "turn")}
    return Truth(**raw | lists | pairs | {"runs": runs})


def _read_run(raw: dict[str, Any]) -> RunTruth:
    """Read the truth of one run from its JSON."""
    earlier = raw.get("earlier")
    return RunTruth(**raw | {"earlier": None if earlier is None else tuple((rest, slid) for rest, slid in earlier)})
