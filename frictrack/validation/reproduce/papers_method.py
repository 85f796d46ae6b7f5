"""Simulate recordings of the papers' kind; identify a law on them by the papers' method and by frictrack's own fit.

The papers' method is a low-pass, two differences, F = -m a, and a search for all parameters: a fit of measured friction
with ``search="mga"``. The error is the sum of squared acceleration residuals over the frames of the free section. The
papers do not specify the low-pass (here Butterworth of order 4, forward and backward), its cut-off (here by residual
analysis: Winter 2009, Biomechanics and Motor Control of Human Movement), the frames left out at the ends (here one
period of the cut-off), and the bounds of the search (here those of the fit, F_s no less than F_c). The lowest error
that is known for a law separates what the law cannot do from what a search did not find.

Neither paper publishes its recordings, the mass, the field of view or the camera noise. Chosen here are 2 kg and 0.5 m
for the beam (the printed Tustin models then brake 5 and 8 m/s to rest in 0.26 and 0.29 s, and the fast mass leaves the
view while still fast), 0.35 kg for the struck slider (3.4 m/s from 2 J), and 10 um of noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from frictrack.base.errors import result_or_none
from frictrack.base.number_format import format_plus_minus
from frictrack.effects import Path, models
from frictrack.effects.models import Model, Values
from frictrack.fit import Fit, fit
from frictrack.fit.uncertainty import reported_by_address
from frictrack.measure.motion import differentiate, low_pass
from frictrack.records import Array, Displacement, Run
from frictrack.search import search_method
from frictrack.simulate import Conditions, Trajectory, simulate
from frictrack.validation.reproduce import laws
from frictrack.validation.reproduce.laws import PrintedLaw
from frictrack.validation.reproduce.sections import Effort

Rng = np.random.Generator

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


def record_printed(source: PrintedLaw, unit: str, bench: TestRig, rng: Rng) -> SyntheticRecording:
    """Simulate a recording of a printed law."""
    law = laws.to_effects(source.law, laws.read_printed(source, unit))
    return record_law(*law, bench, start_speed(source, bench), rng)


def start_speed(source: PrintedLaw, bench: TestRig) -> float:
    """The printed start speed, m/s, or that of the printed impact energy."""
    return source.speed or float(np.sqrt(2 * laws.IMPACT_ENERGY / bench.mass))


def record_with_dither(
    static: PrintedLaw, sines: PrintedLaw, share: float, speed: float, rng: Rng
) -> SyntheticRecording:
    """Simulate a recording of a printed Tustin model plus a share of printed sines."""
    p = laws.read_printed(sines, "sample")
    p[:4] = static.values
    p[4::3] *= share
    return record_law(*laws.to_effects(sines.law, p), BEAM, speed, rng)


def record_law(model: Model, values: Values, bench: TestRig, speed: float, rng: Rng) -> SyntheticRecording:
    """Simulate a recording of any law: motion in view, white tracking noise, and the papers' filter and differences."""
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
    """
    p = laws.read_printed(source, unit)
    speed = start_speed(source, bench)
    trajectory = _simulate_in_view(*laws.to_effects(source.law, p), replace(bench, view=1e3), speed)
    lines = p[[laws.is_frequency(name) for name in laws.addresses(source.law)]]
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


def friction_run(run: Run, a: Array | None = None) -> Run:
    """The run as the papers see it: the friction -m a along its motion, without one period of the cut-off at each end.

    `a` is the acceleration by a sensor (n,), of which the first and the last frame are left out. At most every fourth
    frame is taken, and no fewer than 200 where possible: enough for all frequencies that pass the filter.
    """
    motion, mass = run.motion, run.mass or 1.0
    guard = 1 if a is not None else round(1 / (motion.cutoff * float(np.median(np.diff(motion.t)))))
    inside = float(motion.t[guard]), float(motion.t[len(motion.t) - 1 - guard])
    kept = slice(None, None, int(np.clip(len(motion.t) // 200, 1, 4)))
    friction = -mass * (motion.a if a is None else a)[kept]
    seen = run.displacement.rows(kept), motion.rows(kept)
    return replace(run, displacement=seen[0], motion=seen[1], friction_N=friction, free=inside)


def time_speed_force(run: Run) -> tuple[Array, Array, Array]:
    """Time since release (s), velocity (m/s) and friction (N) of a run of `friction_run`, each (n,)."""
    motion, (begin, end) = run.motion, run.free or (-np.inf, np.inf)
    inside = (motion.t >= begin) & (motion.t <= end)
    return motion.t[inside], motion.v[inside], np.asarray(run.friction_N)[inside]


def law_force(model: Model, values: Values, v: Array, t: Array | None = None) -> Array:
    """Force of a law (n,), N, at speeds v (n,), m/s, and times, s."""
    zero = np.zeros_like(v)
    return model.force(Path(zero if t is None else t, zero, v, zero + 1), values)


def as_points(runs: Sequence[Run]) -> Run:
    """Runs of `friction_run` as one, for a law without time: points of speed and friction, all of one weight."""
    _, v, force = (np.concatenate(column) for column in zip(*map(time_speed_force, runs), strict=True))
    return Run.from_curve(v, force, sigma=1.0, mass=runs[0].mass, name=laws.RUN)


def squared_error(found: Fit) -> float:
    """The papers' error: the sum of squared acceleration residuals, m^2/s^4."""
    rest = time_speed_force(found.runs[0])[2] - found.curves[0].F_model
    return float(rest @ rest) / (found.runs[0].mass or 1.0) ** 2


TIME_UNITS = {"ATM1": "sample", "ATM2": "millisecond"}  # of the printed frequencies, as `time_units` finds
GROUPS = {"low": "low speed, 5 m/s", "high": "high speed, 8 m/s"}


@dataclass(frozen=True, eq=False)
class Identification:
    """A law fitted to one run by the papers' search, once for each seed, and the best fit known.

    Attributes
    ----------
    law
        Name of the law.
    found
        Fit with each seed.
    best
        Fit of the lowest error known.

    """

    law: str
    found: tuple[Fit, ...]
    best: Fit

    @cached_property
    def errors(self) -> Array:
        """Sum of squared acceleration residuals with each seed, m^2/s^4."""
        return np.array([squared_error(one) for one in self.found])

    @cached_property
    def lowest(self) -> float:
        """Lowest error known, m^2/s^4."""
        return squared_error(self.best)

    @property
    def chosen(self) -> Fit:
        """Best fit that the search found."""
        return self.found[int(np.argmin(self.errors))]

    @property
    def fits(self) -> dict[str, Fit]:
        """Both fits that are drawn, with their labels."""
        return {"MGA": self.chosen, "lowest known": self.best}

    @property
    def data(self) -> tuple[Array, Array, Array]:
        """Time (s), velocity (m/s) and friction (N), each (n,)."""
        return time_speed_force(self.best.runs[0])

    @cached_property
    def over_seeds(self) -> Array:
        """Parameters found with each seed, in the papers' order, (seeds, d)."""
        return np.array([parameters_of(self.law, one) for one in self.found])

    @property
    def parameters(self) -> Array:
        """Parameters of `chosen`, in the papers' order, (d,)."""
        return self.over_seeds[int(np.argmin(self.errors))]


def parameters_of(law: str, found: Fit) -> Array:
    """All numbers of a fit in the papers' order, also those that the run does not determine, (d,).

    A fit counts the time of a sine from the first frame that is fitted, the papers from the release.
    """
    reported, own = reported_by_address(found.solution, found.solution.p), laws.addresses(law)
    p = np.array([reported[address] for address in own.values()])
    phases = np.array([name.startswith("phi") for name in own])
    # a phase follows its frequency
    since_release = p[phases] - 2 * np.pi * p[np.roll(phases, -1)] * found.curves[0].t[0]
    p[phases] = (since_release + np.pi) % (2 * np.pi) - np.pi
    return p


def identify(law: str, run: Run, effort: Effort, method: str = "mga", model: Model | None = None) -> Identification:
    """Identify a law on a run of `friction_run` by the papers' search of all parameters.

    `model` is the law with other bounds. The lowest error comes from variable projection and from differential
    evolution of the non-linear parameters. For ATM2 a lower error may exist.
    """
    own: Any = model or law
    search, de = (search_method(name, {"generations": effort.generations}) for name in (method, "de"))
    found = tuple(fit(own, [run], search=search, rng=seed) for seed in range(effort.identified))
    others = [fit(own, [run], search=de, over="nonlinear")]
    if effort.identified > 1:  # seconds for ATM2, which a quick run does without
        others.append(fit(own, [run]))
    return Identification(law, found, min((*found, *others), key=squared_error))


def mechanism_of_neither() -> tuple[models.Model, dict[str, dict[str, float]]]:
    """Build a mechanism of neither law: the beam's vibration modulates dry friction, and there is a collision."""
    p = dict(zip(laws.STATIC, laws.ATM1["low"].values[:4], strict=True))
    model = models.of(["coulomb", "stribeck", "viscous", "load_modulation", "collision"])
    return model, {
        "coulomb": {"F_c": p["F_c"]},
        "stribeck": {"F_s": p["F_s"] - p["F_c"], "v_s": p["v_s"], "delta": 1.0},
        "viscous": {"F_v": p["F_v"]},
        "load_modulation": {"depth": 0.6, "frequency": 34.9, "phase": 0.4},
        "collision": {"J": 0.3, "time": 0.03, "width": 2e-3},
    }


def simulate_sources(group: str, rng: Rng) -> dict[str, SyntheticRecording]:
    """Simulate the recordings of one speed group."""
    speed = laws.ATM1[group].speed or 0.0
    return {
        "ATM1 tables": record_printed(laws.ATM1[group], TIME_UNITS["ATM1"], BEAM, rng),
        "ATM2 tables": record_printed(laws.ATM2[group], TIME_UNITS["ATM2"], BEAM, rng),
        "neither": record_law(*mechanism_of_neither(), BEAM, speed, rng),
    }


def fit_with_frictrack(law: str, run: Run) -> Fit | None:
    """Fit a law to one run in the displacement domain; None if the fit fails."""
    return result_or_none(fit, law, [replace(run, name=laws.RUN)])


def estimate_text(found: Fit | None, address: str) -> str:
    """An estimate of frictrack as text, with its standard deviation."""
    if found is None:
        return "no fit"
    estimate = found.parameters[address]
    return format_plus_minus(estimate.value, estimate.std)


def range_over_seeds(result: Identification, i: int) -> str:
    """Smallest and largest value of a parameter over the seeds, as text."""
    seeds = result.over_seeds[:, i]
    return f"{seeds.min():.3g} to {seeds.max():.3g}"
