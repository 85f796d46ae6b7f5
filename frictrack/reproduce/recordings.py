"""Recordings of the papers' kind, rendered from their tables: a 4 kHz camera, white tracking noise, a short view.

Neither paper publishes its recordings, nor the mass, the field of view or the camera's noise. Chosen here: 2 kg and
0.5 m for the beam (the printed Tustin models then bring 5 and 8 m/s to rest in 0.26 and 0.29 s, and the fast mass
leaves the view while still fast), 0.35 kg for the struck slider (3.4 m/s from 2 J), 10 um of noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.integrate import solve_ivp

from frictrack.effects import Path
from frictrack.models import Model, Values
from frictrack.motion import differentiate, low_pass
from frictrack.records import Array, Displacement, Run
from frictrack.reproduce import laws, printed
from frictrack.reproduce.printed import Printed
from frictrack.simulate import Conditions, Trajectory, simulate

FPS = 4000.0
SIGMA = 1e-5  # m, tracking noise of one frame
PITCH = 5e-4  # m/px
LONGEST = 0.3  # s, a recording
SENSOR = 0.5  # m/s^2, noise of the second paper's acceleration sensor
SLOWEST = 0.5  # m/s: filmed until the mass is nearly at rest, where the free section would end


@dataclass(frozen=True)
class Bench:
    """What the papers leave open about an experiment."""

    mass: float  # kg
    view: float  # m, over which the mass is filmed


BEAM = Bench(2.0, 0.5)
STRUCK = Bench(0.35, 0.5)


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording of known truth: the measured run, and the true slide at its frames."""

    run: Run
    truth: Trajectory


def of(source: Printed, unit: str, bench: Bench, rng: np.random.Generator, speed: float | None = None) -> Recording:
    """A recording of a printed law, its frequencies read as rad per `unit`."""
    law = laws.named(source.law)
    speed = source.speed if speed is None else speed
    if speed is None:
        speed = float(np.sqrt(2 * printed.IMPACT_ENERGY / bench.mass))
    return record(*laws.library(law, laws.read(source, unit)), bench, speed, rng)


def dithering(static: Printed, sines: Printed, share: float, speed: float, rng: np.random.Generator) -> Recording:
    """A recording of a printed Tustin model with a share of the printed sines (read per sample) on top of it."""
    p = laws.read(sines, "sample")
    p[:4] = static.values
    p[4::3] *= share
    return record(*laws.library(laws.named(sines.law), p), BEAM, speed, rng)


def record(model: Model, values: Values, bench: Bench, speed: float, rng: np.random.Generator) -> Recording:
    """A recording of any law: simulated, filmed at 4 kHz while in view and in motion, tracked with white noise.

    Its motion is that of the papers' chain: low-pass (Butterworth, cut-off by residual analysis) and two differences.
    """
    slide = _filmed(model, values, bench, speed)
    n = len(slide.t)
    nan = np.full(n, np.nan)
    x = slide.x + SIGMA * rng.standard_normal(n)
    seen = Displacement(slide.t, x, nan, nan, np.full(n, SIGMA), nan, np.ones(n, dtype=bool), pixel_pitch=PITCH)
    run = Run(seen, differentiate(low_pass(seen, method="butterworth")), mass=bench.mass, name=f"{speed:.3g} m/s")
    return Recording(run, slide)


def _filmed(model: Model, values: Values, bench: Bench, speed: float) -> Trajectory:
    """The slide while it is in view, moves and is not too long."""
    frames = int(_ends(model, values, bench, speed) * FPS) + 1
    t = np.arange(frames) / FPS
    return simulate(model, values, Conditions(bench.mass, pixel_pitch=PITCH), t, (0.0, speed))


def _ends(model: Model, values: Values, bench: Bench, speed: float) -> float:
    """When the mass leaves the view or gets slow, s."""

    def motion(t: float, state: Array) -> Array:
        x, v = (np.array([value]) for value in state)
        path = Path(np.array([t]), x, v, np.ones(1), pixel_pitch=PITCH)
        return np.array([state[1], -model.force(path, values)[0] / bench.mass])

    def slow(t: float, state: Array) -> float:
        return float(state[1] - SLOWEST)

    def gone(t: float, state: Array) -> float:
        return float(bench.view - state[0])

    slow.terminal = gone.terminal = True  # type: ignore[attr-defined]
    step = 2 / FPS  # no pulse is shorter
    solved = solve_ivp(motion, (0.0, LONGEST), [0.0, speed], events=[slow, gone], max_step=step, rtol=1e-5)
    return float(solved.t[-1])


def grouped(recordings: list[Recording], group: str) -> list[Run]:
    """The runs of some recordings as one group, each with a name of its own."""
    return [replace(r.run, group=group, name=f"{group}, {r.run.name}") for r in recordings]


def kind_of_curve(source: Printed, unit: str, bench: Bench) -> dict[str, float | bool]:
    """What a printed law looks like with its frequencies read as rad per `unit`: the test of the time unit.

    Curves of the described kind have several cycles of a dither in a slide of 0.1 to 0.3 s that brakes the mass, and
    no line above a tenth of the frame rate, which the low-pass would remove.
    """
    law = laws.named(source.law)
    p = laws.read(source, unit)
    speed = source.speed or float(np.sqrt(2 * printed.IMPACT_ENERGY / bench.mass))
    slide = _filmed(*laws.library(law, p), replace(bench, view=1e3), speed)
    lines = np.array([x for x, name in zip(p, law.names, strict=True) if name.startswith("f") and name[-1].isdigit()])
    duration = float(slide.t[-1])
    braked = float(1 - slide.v[-1] / speed)
    cycles = float(lines.max() * duration)
    return {
        "duration_ms": 1e3 * duration,
        "braked": braked,
        "lowest_Hz": float(lines.min()),
        "highest_Hz": float(lines.max()),
        "cycles": cycles,
        "mean_force_N": float(slide.F.mean()),
        "described": bool(braked > 0.5 and cycles >= 3 and lines.max() < FPS / 10),
    }
