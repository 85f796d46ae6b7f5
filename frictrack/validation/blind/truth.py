"""The truth of one blind study: law, runs, camera and hidden effects, and the motion that follows from them.

Hidden effects may be foreign to the library: a diagnosis must call them unexplained, or reproduce them by others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from inspect import signature

import numpy as np
from scipy.integrate import cumulative_trapezoid

from frictrack import effects
from frictrack.effects import Effect, Parameter, Path, Span, models
from frictrack.effects.models import Model
from frictrack.records import Array, EarlierRuns
from frictrack.simulate import Conditions, Trajectory, push_force, simulate
from frictrack.simulate.rendering import Oscillation

RESONANCE_WIDTH = 0.15  # width of a resonance in speed, over that speed
N_HARMONICS = 5  # one more than the harmonics of a sawtooth
UNITS = {"speed": "m/s", "place": "m", "length": "m", "frequency": "Hz", "time": "s"}
START_X_M = 0.05  # start of runs toward +x; runs toward -x start at the other end of the course
EffectValues = dict[str, dict[str, float]]  # effect -> parameter -> value (SI)


def _saw(path: Path, length: float) -> Array:
    """Overlapping plates of equal length: a sawtooth in place, with edges rounded by the length of the slider."""
    turns = 2 * np.pi * path.x / length
    return path.load * path.s * np.sum([np.sin(k * turns) / k for k in range(1, N_HARMONICS)], axis=0)


def _heat(path: Path, time: float) -> Array:
    """Friction falls with a temperature that follows the dissipated power with a delay: a memory of the speed."""
    t, v = path.t, path.v
    if path.before is not None:
        t, v = np.append(path.before[0], t), np.append(path.before[2], v)
    growth = np.exp((t - t[-1]) / time)
    temperature = np.append(0.0, cumulative_trapezoid(growth * np.abs(v), t)) / growth / time
    return -path.load * path.s * temperature[-len(path.t) :]


# Effects that are not in the library: shape of the force over its path, and over its non-linear parameters.
FOREIGN: dict[str, Callable[..., Array]] = {
    # The mounting resonates and takes energy at one sliding speed.
    "speed_resonance": lambda path, speed: (
        path.load * path.s * np.exp(-(((path.speed - speed) / (RESONANCE_WIDTH * speed)) ** 2) / 2)
    ),
    # Two halves of the course consist of different materials.
    "joint": lambda path, place: path.load * path.s * np.tanh((path.x - place) / 2e-3),
    "saw": _saw,
    # A magnet next to the course attracts the mass; the force does not depend on the direction of motion.
    "magnet": lambda path, place, length: (u := (path.x - place) / length) / (1 + u**2) ** 2,
    # A nearby machine runs up: a force with rising frequency.
    "chirp": lambda path, frequency: np.sin(2 * np.pi * frequency * (1 + 4 * path.t) * path.t),
    # A constant force begins at some time after release.
    "gust": lambda path, time: (1 + np.tanh((path.t - time) / 2e-3)) / 2,
    # The lubricant film is used up after some sliding distance, at any place.
    "breakdown": lambda path, length: path.load * path.s * (1 + np.tanh((path.distance - length) / 3e-3)) / 2,
    "heat": _heat,
}


def foreign_effect(name: str) -> Effect:
    """Build an effect that is not in the library.

    Returns the force effect with one coefficient, the amplitude in N.
    """
    shape = FOREIGN[name]
    needs = list(signature(shape).parameters)[1:]
    return Effect(
        name=name,
        acts_on="force",
        equation=f"amplitude {name}",
        parameters=(Parameter("amplitude", "N", linear=True), *(Parameter(n, UNITS[n], signed=True) for n in needs)),
        columns=lambda path, nonlinear: np.asarray(shape(path, *(nonlinear[n] for n in needs)))[:, None],
        scales_with="load",
    )


def parameter_range(name: str, span: Span) -> tuple[float, float]:
    """Range from which a non-linear parameter of a foreign effect is drawn.

    `name`: "place", "length" (m), "speed" (m/s), "frequency" (Hz) or "time" (s); `span`: range of place, speed and time
    that the runs cover. Returns the lowest and highest value.
    """
    travel = span.x_max - span.x_min
    return {
        "place": (span.x_min + 0.3 * travel, span.x_max - 0.3 * travel),
        "length": (0.06 * travel, 0.4 * travel),
        "speed": (max(0.15 * span.v_max, span.v_min), 0.8 * span.v_max),
        "frequency": (15.0, 60.0),
        "time": (0.1 * span.duration, 0.4 * span.duration),
    }[name]


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
