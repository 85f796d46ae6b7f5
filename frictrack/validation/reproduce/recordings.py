"""Simulate recordings of the papers' kind from their tables: a 4 kHz camera, white tracking noise, a short view.

Neither paper publishes its recordings, the mass, the field of view or the camera noise. Chosen here are 2 kg and 0.5 m
for the beam (the printed Tustin models then brake 5 and 8 m/s to rest in 0.26 and 0.29 s, and the fast mass leaves the
view while still fast), 0.35 kg for the struck slider (3.4 m/s from 2 J), and 10 um of noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from frictrack.effects.models import Model, Values
from frictrack.measure.motion import differentiate, low_pass
from frictrack.records import Displacement, Run
from frictrack.simulate import Conditions, Trajectory, simulate
from frictrack.validation.reproduce import laws, printed
from frictrack.validation.reproduce.printed import PrintedLaw

FPS = 4000.0
TRACKING_NOISE = 1e-5  # m, standard deviation per frame
PIXEL_PITCH = 5e-4  # m/px
MAX_DURATION_S = 0.3  # of a recording
SENSOR_NOISE = 0.5  # m/s^2, standard deviation of the second paper's acceleration sensor
MIN_SPEED = 0.5  # m/s, at which a recording ends: nearly at rest, as the free section would


@dataclass(frozen=True)
class TestRig:
    """What the papers do not specify: mass, kg, and length of the field of view, m."""

    mass: float
    view: float


BEAM = TestRig(2.0, 0.5)
STRUCK = TestRig(0.35, 0.5)


@dataclass(frozen=True, eq=False)
class SyntheticRecording:
    """A simulated recording: the measured run, and the true motion at its frames."""

    run: Run
    truth: Trajectory


def record_printed(source: PrintedLaw, unit: str, bench: TestRig, rng: np.random.Generator) -> SyntheticRecording:
    """Simulate a recording of a printed law.

    Parameters
    ----------
    source
        The printed law.
    unit
        Time unit of its frequencies, a key of `laws.UNITS`.
    bench
        Mass and field of view.
    rng
        Source of the noise.

    Returns
    -------
    SyntheticRecording
        Measured run and true motion.

    """
    law = laws.law_by_name(source.law)
    return record_law(*laws.to_effects(law, laws.read_printed(source, unit)), bench, start_speed(source, bench), rng)


def start_speed(source: PrintedLaw, bench: TestRig) -> float:
    """The printed start speed, m/s, or that of the printed impact energy."""
    return source.speed or float(np.sqrt(2 * printed.IMPACT_ENERGY / bench.mass))


def record_with_dither(
    static: PrintedLaw, sines: PrintedLaw, share: float, speed: float, rng: np.random.Generator
) -> SyntheticRecording:
    """Simulate a recording of a printed Tustin model plus a share of printed sines.

    Parameters
    ----------
    static, sines
        Printed Tustin model, and printed law with sines (frequencies per sample).
    share
        Share of the amplitudes of the sines.
    speed
        Start speed, m/s.
    rng
        Source of the noise.

    Returns
    -------
    SyntheticRecording
        Measured run and true motion.

    """
    p = laws.read_printed(sines, "sample")
    p[:4] = static.values
    p[4::3] *= share
    return record_law(*laws.to_effects(laws.law_by_name(sines.law), p), BEAM, speed, rng)


def record_law(
    model: Model, values: Values, bench: TestRig, speed: float, rng: np.random.Generator
) -> SyntheticRecording:
    """Simulate a recording of any law: motion in view, white tracking noise, and the papers' filter and differences.

    Parameters
    ----------
    model, values
        The law, and its parameters by effect.
    bench
        Mass and field of view.
    speed
        Start speed, m/s.
    rng
        Source of the noise.

    Returns
    -------
    SyntheticRecording
        Measured run and true motion.

    """
    trajectory = _simulate_in_view(model, values, bench, speed)
    n = len(trajectory.t)
    nan = np.full(n, np.nan)
    x = trajectory.x + TRACKING_NOISE * rng.standard_normal(n)
    displacement = Displacement(
        trajectory.t, x, nan, nan, np.full(n, TRACKING_NOISE), nan, np.ones(n, dtype=bool), pixel_pitch=PIXEL_PITCH
    )
    run = Run(
        displacement,
        differentiate(low_pass(displacement, method="butterworth")),
        mass=bench.mass,
        name=f"{speed:.3g} m/s",
    )
    return SyntheticRecording(run, trajectory)


def _simulate_in_view(model: Model, values: Values, bench: TestRig, speed: float) -> Trajectory:
    """True motion while the mass is in view and moves, at most `MAX_DURATION_S`."""
    conditions = Conditions(bench.mass, pixel_pitch=PIXEL_PITCH)
    t = np.arange(round(MAX_DURATION_S * FPS) + 1) / FPS
    whole = simulate(model, values, conditions, t, (0.0, speed))
    over = (whole.v < MIN_SPEED) | (whole.x > bench.view)
    frames = int(np.argmax(over)) if over.any() else len(t)
    return simulate(model, values, conditions, t[:frames], (0.0, speed))


def group_runs(recordings: list[SyntheticRecording], group: str) -> list[Run]:
    """Runs of recordings as one group, with distinct names."""
    return [replace(r.run, group=group, name=f"{group}, {r.run.name}") for r in recordings]


def describe_curve(source: PrintedLaw, unit: str, bench: TestRig) -> dict[str, float | bool]:
    """Describe the motion of a printed law with its frequencies read in one time unit.

    Curves as the papers describe them have several cycles of a dither in a slide of 0.1 to 0.3 s that brakes the mass,
    and no sine above a tenth of the frame rate, which the low-pass would remove.

    Parameters
    ----------
    source
        The printed law.
    unit
        Time unit of its frequencies, a key of `laws.UNITS`.
    bench
        Mass; the field of view is not limited here.

    Returns
    -------
    dict
        Duration, share of the speed lost, range of frequencies, cycles, mean force, and "described".

    """
    law = laws.law_by_name(source.law)
    p = laws.read_printed(source, unit)
    speed = start_speed(source, bench)
    trajectory = _simulate_in_view(*laws.to_effects(law, p), replace(bench, view=1e3), speed)
    lines = np.array([x for x, name in zip(p, law.names, strict=True) if name.startswith("f") and name[-1].isdigit()])
    duration = float(trajectory.t[-1])
    braked = float(1 - trajectory.v[-1] / speed)
    cycles = float(lines.max() * duration)
    return {
        "duration_ms": 1e3 * duration,
        "braked": braked,
        "lowest_Hz": float(lines.min()),
        "highest_Hz": float(lines.max()),
        "cycles": cycles,
        "mean_force_N": float(trajectory.F.mean()),
        "described": bool(braked > 0.5 and cycles >= 3 and lines.max() < FPS / 10),
    }
