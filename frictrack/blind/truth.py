"""The truth of one blind study: a law, runs, a camera, what is hidden in it, and the motion that follows from all."""

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
from frictrack.records import Array
from frictrack.simulate import Conditions, Trajectory, simulate
from frictrack.simulate.rendering import Oscillation

START_X_M = 0.05  # m, where a run toward +x begins; one toward -x begins at the other end of the course
EffectValues = dict[str, dict[str, float]]


@dataclass(frozen=True)
class RunTruth:
    """One run: start speed (m/s, negative toward -x), mass over the reference, friction level, frames.

    `values` are those of the hidden causes as they act in this run (none of a cause that is absent from it), `phase`
    that of the vertical or rocking motion at release, rad.
    """

    name: str
    speed: float
    mass_ratio: float
    level: float
    frames: int
    phase: float = 0.0
    values: EffectValues = field(default_factory=dict)


@dataclass(frozen=True)
class Truth:
    """All that is known of a study and sealed; SI units.

    `law` holds the base law as its effects take it (F_s above F_c). `size` is every hidden cause over what the ideal
    detector sees in 95 of 100 repeats, `rise` its expected rise of chi-squared.
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
    push: float = 0.0  # s during which a drive that is measured pushes; 0: runs start moving
    lift: tuple[float, float] | None = None  # vertical motion that is measured: amplitude m, frequency Hz
    clamp: float | None = None  # m, where the beam is clamped
    turn: tuple[float, float] | None = None  # rocking of the target that a film shows: amplitude rad, frequency Hz
    stated: bool = True  # whether the tables state the noise
    film: bool = False
    runs: tuple[RunTruth, ...] = ()
    size: tuple[float, ...] = ()
    rise: tuple[float, ...] = ()

    @property
    def base(self) -> Model:
        """The law without what is hidden."""
        return models.of(self.model)

    def conditions(self, run: RunTruth) -> Conditions:
        """What holds in a run."""
        return Conditions(
            mass=self.mass * run.mass_ratio,
            load=run.mass_ratio * run.level,
            mass_ratio=run.mass_ratio,
            pixel_pitch=self.pitch,
            drive=self.drive(run) if self.push else None,
            lift=None if self.lift is None else _second_derivative(Oscillation(*self.lift, run.phase)),
            angle=None if self.turn is None else Oscillation(*self.turn, run.phase),
            clamp_x=self.clamp,
        )

    def drive(self, run: RunTruth) -> Callable[[Array], Array]:
        """The push of a run, N; without friction it would bring the mass to its speed."""
        strength = 2 * self.mass * run.mass_ratio * run.speed / self.push

        def push(t: Array) -> Array:
            return np.asarray(strength * np.sin(np.pi * np.clip(np.asarray(t) / self.push, 0.0, 1.0)) ** 2)

        return push

    def start(self, run: RunTruth) -> tuple[float, float]:
        """Place and speed in the first frame; a pushed run starts at rest."""
        return (START_X_M if run.speed > 0 else self.course + START_X_M), (0.0 if self.push else run.speed)

    def slide(self, run: RunTruth, *, hidden: bool = True) -> Trajectory:
        """The true motion of one run, with what is hidden or without."""
        model, values = self.base, dict(self.law)
        for name in run.values if hidden else ():
            model = model + effect_named(name)
            values[name] = run.values[name]
        t = np.arange(run.frames) / self.fps
        if model.memory:
            return simulate_memory(model, values, self.conditions(run), t, self.start(run))
        return simulate(model, values, self.conditions(run), t, self.start(run))

    def span(self, slides: list[Trajectory]) -> Span:
        """How far some of the runs reach."""
        return Span(
            duration=max(float(s.t[-1]) for s in slides),
            x_min=min(float(s.x.min()) for s in slides),
            x_max=max(float(s.x.max()) for s in slides),
            v_min=min(float(np.abs(s.v).min()) for s in slides),
            v_max=max(float(np.abs(s.v).max()) for s in slides),
            fps=self.fps,
            clamp_x=self.clamp,
        )


def effect_named(name: str) -> Effect:
    """The cause of that name, of the library or not."""
    return foreign_effect(name) if name in FOREIGN else effects.get(name)


def read_truth(raw: dict[str, Any]) -> Truth:
    """A truth from its JSON."""
    runs = tuple(RunTruth(**run) for run in raw["runs"])
    lists = {name: tuple(raw[name]) for name in ("model", "hidden", "size", "rise")}
    pairs = {name: raw[name] and tuple(raw[name]) for name in ("lift", "turn")}
    return Truth(**raw | lists | pairs | {"runs": runs})


def _second_derivative(swing: Oscillation) -> Oscillation:
    """Its second derivative."""
    return Oscillation(-swing.amplitude * (2 * np.pi * swing.frequency) ** 2, swing.frequency, swing.phase)
