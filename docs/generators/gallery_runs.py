"""Simulate the runs of the gallery: one fixed design per kind of effect, with the effect in a size that films show.

A mass of 0.35 kg slides on a course of 0.6 m under a friction coefficient of 0.3: slowly until it nearly stops, fast,
with the mass doubled, and the other way. An effect that needs reversals or a drive gets it: there the mass, or its
speed, swings under a sinusoidal drive.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any
from unittest import mock

import numpy as np

from frictrack.effects import models
from frictrack.effects.models import Model
from frictrack.measure.motion import differentiate, low_pass
from frictrack.records import Array, Displacement, EarlierRuns, Run
from frictrack.simulate import Conditions, Trajectory, simulate, trajectory

Values = Mapping[str, Mapping[str, float]]

MASS_KG = 0.35
FPS = 500.0
PITCH_M = 5e-4
NOISE_M = 1e-6
AGREEMENT_M = 2e-7  # of simulated motions: a fifth of the noise, where `simulate` asks for a ten-thousandth
COURSE_M = 0.6
MIN_SPEED_M_S = 0.1  # at which the film of a slow run ends
TUSTIN: dict[str, dict[str, float]] = {
    "coulomb": {"F_c": 1.0},
    "stribeck": {"F_s": 0.5, "v_s": 0.3, "delta": 1.0},  # F_s is the rise over F_c
    "viscous": {"F_v": 0.1},
}


@dataclass(frozen=True)
class PlannedRun:
    """One run of a design: its name, start speed (m/s), mass over the reference, longest duration (s), drive (N).

    `earlier` holds the rest (s) since each run before it, and the distance (m) that was slid in that.
    """

    name: str
    speed: float
    mass_ratio: float = 1.0
    duration: float = 0.6
    drive: Callable[[Array], Array] | None = None
    earlier: EarlierRuns | None = None


@dataclass(frozen=True)
class Example:
    """What is simulated for one effect.

    Attributes
    ----------
    truth
        Parameters of the whole law by effect, in the form in which effects use them.
    law
        Effects of the model that is fitted, without the effect.
    per_run
        Parameters that differ from run to run, by run, for the effect.
    design
        The runs.
    conditions
        What else acts in every run, fields of `Conditions`.
    axis, shows_in
        The axis over which the effect shows best, "t", "x" or "v", and the quantity, "residual" or "F".
    is_event
        Whether it acts for a moment only.
    fps
        Frames per second.

    """

    truth: Values
    law: tuple[str, ...] = tuple(TUSTIN)
    per_run: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    design: tuple[PlannedRun, ...] = ()
    conditions: Mapping[str, Any] = field(default_factory=dict)
    axis: str = "t"
    shows_in: str = "F"
    is_event: bool = False
    fps: float = FPS


@dataclass(frozen=True)
class SimulatedRun:
    """One run as it was simulated, with its truth."""

    run: Run
    truth: Trajectory


def swing(amplitude: float, frequency: float) -> Callable[[Array], Array]:
    """Sinusoidal drive, N, that grows from nothing within 20 ms."""
    return lambda t: amplitude * np.sin(2 * np.pi * frequency * t) * (1 - np.exp(-np.asarray(t) / 0.02))


def lift(t: Array) -> Array:
    """Vertical acceleration of a mass on a course that shakes, m/s^2."""
    return 3.0 * np.sin(2 * np.pi * 14.0 * t + 0.5)


def angle(t: Array) -> Array:
    """Angle of a target that rocks, rad."""
    return 0.02 * np.sin(2 * np.pi * 12.0 * t + 0.3)


def mean_and_swing(amplitude: float, frequency: float) -> Callable[[Array], Array]:
    """Drive, N, that balances friction on average and makes the speed swing."""
    return lambda t: 1.25 + amplitude * np.sin(2 * np.pi * frequency * t)


SLIDES = (
    PlannedRun("slow", 1.8),
    PlannedRun("fast", 3.0),
    PlannedRun("double mass", 2.6, 2.0),
    PlannedRun("reversed", -2.6),
)
SWINGS = (
    PlannedRun("small swing", 0.0, duration=0.4, drive=swing(2.6, 6.0)),
    PlannedRun("large swing", 0.0, duration=0.4, drive=swing(4.0, 6.0)),
)
SPEED_SWINGS = (
    PlannedRun("5 Hz", 0.15, duration=0.6, drive=mean_and_swing(2.0, 5.0)),
    PlannedRun("10 Hz", 0.15, duration=0.6, drive=mean_and_swing(4.0, 10.0)),
)
CREEPS = (  # less than a pixel per frame
    PlannedRun("0.3 m/s", 0.3),
    PlannedRun("0.2 m/s", 0.2),
    PlannedRun("double mass", 0.25, 2.0),
)
SERIES = (
    PlannedRun("first", 1.8, earlier=()),
    PlannedRun("after 60 s", 3.0, earlier=((60.0, 0.5),)),
    PlannedRun("after 5 s", -2.6, earlier=((65.0, 0.5), (5.0, 0.6))),
    PlannedRun("after 10 min", 2.6, earlier=((665.0, 0.5), (605.0, 0.6), (600.0, 0.6))),
)
PHASES = {"slow": 0.4, "fast": 2.1, "double mass": -1.3, "reversed": 3.0}


def _phases(name: str) -> dict[str, dict[str, float]]:
    """A phase of its own in every run."""
    return {run: {name: phase} for run, phase in PHASES.items()}


def simulate_example(effect: str, example: Example) -> list[SimulatedRun]:
    """Simulate the runs of one effect, with white noise of a good camera.

    Parameters
    ----------
    effect
        Name of the effect.
    example
        Its law and design.

    Returns
    -------
    list of SimulatedRun
        One per run of the design.

    """
    rng = np.random.default_rng(22)
    law = models.of(list(example.truth))
    return [_simulate_run(effect, example, law, planned, rng) for planned in example.design or SLIDES]


def _simulate_run(
    effect: str, example: Example, law: Model, planned: PlannedRun, rng: np.random.Generator
) -> SimulatedRun:
    values = {name: dict(own) for name, own in example.truth.items()}
    values[effect] |= example.per_run.get(planned.name, {})
    known = dict(example.conditions) | ({"drive": planned.drive} if planned.drive else {})
    known |= {} if planned.earlier is None else {"earlier": planned.earlier}
    ratio = planned.mass_ratio
    held = Conditions(MASS_KG * ratio, ratio, ratio, PITCH_M, **known)
    t = np.arange(round(planned.duration * example.fps)) / example.fps
    start = (0.0 if planned.speed >= 0 else COURSE_M, planned.speed)
    with mock.patch.object(trajectory, "AGREEMENT_M", AGREEMENT_M):
        truth = simulate(law, values, held, t, start)
    if not planned.drive:
        n = _frames_on_course(truth)
        truth = Trajectory(*(getattr(truth, column.name)[:n] for column in fields(Trajectory)))
    return SimulatedRun(_measured(planned, truth, known, rng), truth)


def _frames_on_course(motion: Trajectory) -> int:
    """Frames until the mass leaves the course, or has nearly stopped."""
    ended = (motion.x < 0) | (motion.x > COURSE_M) | (np.abs(motion.v) < MIN_SPEED_M_S)
    return int(np.argmax(ended)) if ended.any() else len(motion.t)


def _measured(planned: PlannedRun, truth: Trajectory, known: Mapping[str, Any], rng: np.random.Generator) -> Run:
    """The run as a camera records it, with what else was measured."""
    t, n = truth.t, len(truth.t)
    nan = np.full(n, np.nan)
    y = truth.x + truth.shift + NOISE_M * rng.standard_normal(n)
    turned = known["angle"](t) if "angle" in known else None
    seen = Displacement(t, y, nan, nan, np.full(n, NOISE_M), nan, np.ones(n, bool), pixel_pitch=PITCH_M)
    smoothed = low_pass(seen, method="kalman")
    motion = differentiate(replace(smoothed, x_measured=None))  # no picture shows the deviations of a lost signal
    if "lift" in known:
        motion = replace(motion, a_y=known["lift"](t))
    return Run(
        seen if turned is None else replace(seen, angle=turned),
        motion,
        mass=MASS_KG * planned.mass_ratio,
        name=planned.name,
        drive=known["drive"](t) if "drive" in known else None,
        **{key: known[key] for key in ("clamp_x", "beam_length", "earlier") if key in known},
    )


def _with(effect: str, values: Mapping[str, float], **settings: Any) -> Example:
    """Tustin's law and one effect."""
    return Example(TUSTIN | {effect: dict(values)}, **settings)


VISCOUS = {"viscous": {"F_v": 0.1}}
CONTACTS = {"F_0": 2.3, "A": 0.05, "B": 0.2, "D_c": 0.003, "v_0": 1e-4}  # they age at the reversals of a swing

EXAMPLES: dict[str, Example] = {
    "coulomb": Example({"coulomb": {"F_c": 1.0}, "viscous": {"F_v": 0.1}}, ("viscous",), axis="v"),
    "stribeck": Example(TUSTIN, ("coulomb", "viscous"), axis="v"),
    "viscous": Example(TUSTIN | {"viscous": {"F_v": 0.3}}, ("coulomb", "stribeck"), axis="v"),
    "drag": _with("drag", {"c": 0.08}, axis="v"),
    "vibration": _with("vibration", {"amplitude": 0.15, "frequency": 15.0}, per_run=_phases("phase")),
    "decaying_vibration": _with(
        "decaying_vibration", {"amplitude": 0.5, "frequency": 20.0, "tau": 0.08}, per_run=_phases("phase")
    ),
    "beam_vibration": _with(
        "beam_vibration",
        {"amplitude": 0.2, "frequency": 25.0, "r": 4.0, "beam_length": 0.8},
        per_run=_phases("phase"),
        conditions={"clamp_x": -0.1, "beam_length": 0.8},
    ),
    "texture": _with("texture", {"amplitude": 0.2, "period": 0.1, "phase": 0.7}, axis="x"),
    "patch": _with("patch", {"F": 0.3, "x_c": 0.25, "w": 0.02}, axis="x"),
    "spring": _with("spring", {"k": 1.5, "x_0": -0.45}, axis="x"),
    "collision": _with(
        "collision",
        {"J": 0.02, "time": 0.09, "width": 1e-3},
        per_run={"fast": {"time": 0.13}, "double mass": {"time": 0.11}, "reversed": {"J": -0.02, "time": 0.15}},
        is_event=True,
    ),
    "thermal": _with("thermal", {"dF": 0.4, "length": 0.1}, axis="x"),
    "drift": _with("drift", {"k": 1.0}),
    "asymmetry": _with("asymmetry", {"dF": 0.15, "dF_v": 0.05}, axis="v"),
    "slope": _with("slope", {"F": 0.15}, design=SWINGS, axis="v"),
    "load_modulation": _with("load_modulation", {"depth": 0.15, "frequency": 15.0}, per_run=_phases("phase")),
    "measured_load": _with("measured_load", {"coefficient": 1.0}, conditions={"lift": lift}),
    "viscous_modulation": Example(
        TUSTIN | {"viscous": {"F_v": 0.3}, "viscous_modulation": {"depth": 0.3, "frequency": 15.0}},
        per_run=_phases("phase"),
    ),
    "drive_offset": _with("drive_offset", {"D_0": 0.15}, design=SPEED_SWINGS),
    "drive_delay": _with("drive_delay", {"tau": 0.004}, design=SPEED_SWINGS),
    "drive_error": _with("drive_error", {"e": 0.1, "tau": 0.004}, design=SPEED_SWINGS),
    "lens": _with("lens", {"k": 0.02, "x_c": 0.25}, axis="x"),
    "peak_locking": _with(
        "peak_locking", {"amplitude": 0.05, "phase": 0.5}, design=CREEPS, axis="x", shows_in="residual", fps=4000.0
    ),
    "camera_shake": _with("camera_shake", {"amplitude": 5e-5, "frequency": 15.0}, per_run=_phases("phase")),
    "dropped_frame": _with(
        "dropped_frame",
        {"frames": 0.0, "time": 0.1 + 0.5 / FPS},
        per_run={"fast": {"frames": 1.0}},
        shows_in="residual",
        is_event=True,
    ),
    "timebase": _with("timebase", {"k": 0.02}),
    "clock_rate": _with("clock_rate", {"rate": 0.0}, per_run={"slow": {"rate": 0.2}}),
    "target_rotation": _with("target_rotation", {"along": 0.003, "across": 0.004}, conditions={"angle": angle}),
    "flash_weakening": _with("flash_weakening", {"dF": 0.6, "v_w": 0.8}, axis="v"),
    "log_velocity": _with("log_velocity", {"a": 0.03, "v_0": 1e-6}, axis="v"),
    "power_law_viscosity": _with("power_law_viscosity", {"c": 0.2, "n": 0.5}, axis="v"),
    "adhesion": _with("adhesion", {"F": 0.3}, axis="v"),
    "load_exponent": _with("load_exponent", {"excess": -0.33}, axis="v"),
    "run_in": _with("run_in", {"dF": 0.5, "length": 0.6}, design=SERIES, axis="x"),
    "heating": _with("heating", {"k": 0.5, "tau": 30.0}, design=SERIES, axis="x"),
    "rolling_shutter": _with("rolling_shutter", {"tau": 1e-3}, axis="v"),
    "out_of_plane": _with("out_of_plane", {"k": 0.01}, axis="x"),
    "presliding": _with("presliding", {"stiffness": 3e-4, "exponent": 1.0}, design=SWINGS, axis="x"),
    "friction_lag": Example(
        TUSTIN | {"stribeck": {"F_s": 1.0, "v_s": 0.2, "delta": 1.0}, "friction_lag": {"tau": 0.008}},
        design=SPEED_SWINGS,
        axis="v",
    ),
    "lugre": Example(
        {
            "lugre": {"F_c": 1.0, "sigma_1": 2.0, "sigma_0": 3e-4, "F_s": 1.5, "v_s": 0.1, "delta": 2.0},
            "viscous": {"F_v": 0.1},
        },
        design=SWINGS,
        axis="x",
    ),
    "bouc_wen": Example(
        {"viscous": {"F_v": 0.3}, "bouc_wen": {"alpha": 600.0, "gamma": 500.0, "delta": 0.5}},
        ("coulomb", "viscous"),
        design=SWINGS,
        axis="x",
    ),
    "elasto_plastic": _with("elasto_plastic", {"stiffness": 3e-4, "share": 0.6}, design=SWINGS, axis="x"),
    "maxwell_slip": _with("maxwell_slip", {"stiffness": 1e-3, "spread": 10.0}, design=SWINGS, axis="x"),
    "elastic_joint": _with("elastic_joint", {"mass": 0.01, "frequency": 15.0, "damping": 0.05}),
    "eddy_brake": Example(
        {"coulomb": {"F_c": 1.0}, "eddy_brake": {"c": 0.4, "v_0": 1.0}}, ("coulomb", "viscous"), axis="v"
    ),
    "hydrodynamic_hump": Example(
        {"coulomb": {"F_c": 1.0}, "hydrodynamic_hump": {"F": 0.8, "v_s": 0.8}}, ("coulomb", "viscous"), axis="v"
    ),
    "rate_state_ageing": Example(
        {"rate_state_ageing": CONTACTS} | VISCOUS, ("coulomb", "viscous"), design=SWINGS, axis="v"
    ),
    "rate_state_slip": Example(
        {"rate_state_slip": CONTACTS} | VISCOUS, ("coulomb", "viscous"), design=SWINGS, axis="v"
    ),
    "atm2:2": Example(
        {
            "atm2:2": {
                **{"f_c": 1.0, "f_s": 1.5, "f_v": 0.1, "v_s": 0.3},
                **{"sliding_frequency_1": 0.5, "sliding_phase_1": 1.2},
                **{"sliding_frequency_2": 15.0, "sliding_phase_2": 0.4},
                **{"viscous_frequency_1": 0.5, "viscous_phase_1": 1.2},
                **{"viscous_frequency_2": 12.0, "viscous_phase_2": 0.1},
            }
        }
    ),
}
