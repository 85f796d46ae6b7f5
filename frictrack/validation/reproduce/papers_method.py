"""Simulate recordings of the papers' kind; identify a law on them by the papers' method and by frictrack's own fit.

The papers' method is a low-pass, two differences, F = -m a, and a search for all parameters. The error is the sum of
squared acceleration residuals over the frames of the free section. The papers do not specify the low-pass (here
Butterworth of order 4, forward and backward), its cut-off (here by residual analysis: Winter 2009, Biomechanics and
Motor Control of Human Movement), the frames left out at the ends (here one period of the cut-off), and the bounds of
the search. The lowest error that is known for a law separates what the law cannot do from what a search did not find.

Neither paper publishes its recordings, the mass, the field of view or the camera noise. Chosen here are 2 kg and 0.5 m
for the beam (the printed Tustin models then brake 5 and 8 m/s to rest in 0.26 and 0.29 s, and the fast mass leaves the
view while still fast), 0.35 kg for the struck slider (3.4 m/s from 2 J), and 10 um of noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from frictrack.base.errors import FrictrackError
from frictrack.effects import models
from frictrack.effects.models import Model, Values
from frictrack.fit import Fit, fit
from frictrack.measure.motion import differentiate, low_pass
from frictrack.records import Array, Displacement, Run
from frictrack.search import SearchResult, minimise
from frictrack.simulate import Conditions, Trajectory, simulate
from frictrack.validation.reproduce import laws
from frictrack.validation.reproduce.laws import PaperLaw, PrintedLaw, Real
from frictrack.validation.reproduce.sections import Effort

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
    """Simulate a recording of a printed law."""
    law = laws.law_by_name(source.law)
    return record_law(*laws.to_effects(law, laws.read_printed(source, unit)), bench, start_speed(source, bench), rng)


def start_speed(source: PrintedLaw, bench: TestRig) -> float:
    """The printed start speed, m/s, or that of the printed impact energy."""
    return source.speed or float(np.sqrt(2 * laws.IMPACT_ENERGY / bench.mass))


def record_with_dither(
    static: PrintedLaw, sines: PrintedLaw, share: float, speed: float, rng: np.random.Generator
) -> SyntheticRecording:
    """Simulate a recording of a printed Tustin model plus a share of printed sines."""
    p = laws.read_printed(sines, "sample")
    p[:4] = static.values
    p[4::3] *= share
    return record_law(*laws.to_effects(laws.law_by_name(sines.law), p), BEAM, speed, rng)


def record_law(
    model: Model, values: Values, bench: TestRig, speed: float, rng: np.random.Generator
) -> SyntheticRecording:
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


N_SEARCHES = 3  # differential evolutions for the lowest error
MIN_EVALUATIONS = 3000  # of each; with a smaller budget there is only one
OPTIMA_REFINED, MAX_REFINEMENTS = 6, 60  # optima of each that are refined, and evaluations of a refinement
BOUNDS = {
    "F_c": (0.0, 80.0),
    "F_s": (0.0, 120.0),
    "F_v": (0.0, 40.0),
    "v_s": (0.05, 3.0),
    "F": (0.0, 300.0),
    "f": (1.0, 490.0),
    "phi": (-np.pi, np.pi),
}  # N, N s/m, m/s, Hz, rad


@dataclass(frozen=True, eq=False)
class AccelerationSeries:
    """Velocity and acceleration by the papers' method, runs end to end.

    Attributes
    ----------
    t, v, a
        Time since release (s), velocity (m/s) and acceleration (m/s^2), each (n,).
    mass
        Mass, kg.

    """

    t: Array
    v: Array
    a: Array
    mass: float

    @property
    def force(self) -> Array:
        """Friction F = -m a, N."""
        return -self.mass * self.a

    def thinned(self) -> AccelerationSeries:
        """At most every fourth frame, and no fewer than 200 where possible; sufficient for all frequencies searched."""
        step = int(np.clip(len(self.t) // 200, 1, 4))
        return AccelerationSeries(self.t[::step], self.v[::step], self.a[::step], self.mass)

    @cached_property
    def single(self) -> tuple[Real, Real, Real]:
        """t, v, a in single precision, which evaluates a population three times as fast."""
        return self.t.astype(np.float32), self.v.astype(np.float32), self.a.astype(np.float32)


def measure_series(runs: Sequence[Run]) -> AccelerationSeries:
    """Join the motion of runs of one mass end to end, without one period of the cut-off at each end."""
    parts = []
    for run in runs:
        motion = run.motion
        guard = round(1 / (motion.cutoff * float(np.median(np.diff(motion.t)))))
        parts.append([column[guard:-guard] for column in (motion.t, motion.v, motion.a)])
    t, v, a = (np.concatenate(column) for column in zip(*parts, strict=True))
    return AccelerationSeries(t, v, a, float(runs[0].mass or 1.0))


def search_bounds(law: PaperLaw) -> Array:
    """Bounds of a search, (d, 2)."""
    keys = {"f_c": "F_c", "f_s": "F_s", "f_v": "F_v", "F_c": "F_c", "F_s": "F_s", "F_v": "F_v", "v_s": "v_s"}
    return np.array([BOUNDS[keys.get(name, name.partition("_")[0].rstrip("v"))] for name in law.names])


def misfit(law: PaperLaw, series: AccelerationSeries) -> Callable[[Array], Array]:
    """Build the error function that the searches minimise, in single precision."""
    t, v, a = series.single
    weight = np.float32(1 / series.mass)

    def cost(p: Array) -> Array:
        residual = law.force(p.astype(np.float32), v, t)
        residual *= weight
        residual += a
        return np.einsum("ij,ij->i", residual, residual).astype(np.float64)

    return cost


def squared_error(law: PaperLaw, p: Array, series: AccelerationSeries) -> float:
    """Compute the papers' error of one parameter set, in double precision."""
    residual = series.a + law.force(p[None], series.v, series.t)[0] / series.mass
    return float(residual @ residual)


def search_parameters(
    law: PaperLaw, series: AccelerationSeries, method: str, *, seed: int, budget: int, bounds: Array | None = None
) -> SearchResult:
    """Search all parameters by one method of the papers, without refinement."""
    bounds_of_search = search_bounds(law) if bounds is None else bounds
    rng = np.random.default_rng(seed)
    return minimise(misfit(law, series), bounds_of_search, method=method, rng=rng, max_evaluations=budget)


def lowest_error_parameters(
    law: PaperLaw, series: AccelerationSeries, starts: Sequence[Array], rng: np.random.Generator, budget: int
) -> Array:
    """Find the lowest error that a law can reach, independently of the papers' searches.

    Differential evolution searches all parameters; least squares refines its optima and `starts` within the bounds. For
    ATM2 a lower error may exist.
    """
    thinned, box = series.thinned(), search_bounds(law)
    times = N_SEARCHES if budget >= N_SEARCHES * MIN_EVALUATIONS else 1
    options: dict[str, Any] = {"method": "de", "rng": rng, "max_evaluations": budget * len(box) * 2 // N_SEARCHES}
    found = [minimise(misfit(law, thinned), box, **options) for _ in range(times)]
    optima = [p for result in found for p in result.optima[:OPTIMA_REFINED]]
    best = min((refine_parameters(law, thinned, p) for p in optima), key=lambda p: squared_error(law, p, thinned))
    refined = [refine_parameters(law, series, p) for p in (best, *starts)]
    return min((*starts, *refined), key=lambda p: squared_error(law, p, series))


def refine_parameters(law: PaperLaw, series: AccelerationSeries, start: Array) -> Array:
    """Refine parameters to the next minimum of the error within the bounds, by least squares."""
    low, high = search_bounds(law).T
    width = high - low
    inside = np.clip(start, low + 1e-6 * width, high - 1e-6 * width)

    def residual(p: Array) -> Array:
        return np.asarray(series.a + law.force(p[None], series.v, series.t)[0] / series.mass)

    found = least_squares(residual, inside, bounds=(low, high), x_scale=width, max_nfev=MAX_REFINEMENTS)
    return np.asarray(found.x)


TIME_UNITS = {"ATM1": "sample", "ATM2": "millisecond"}  # of the printed frequencies, as `time_units` finds
ADDRESSES = {"F_c": "coulomb.F_c", "F_s": "stribeck.F_s", "F_v": "viscous.F_v", "v_s": "stribeck.v_s"}
GROUPS = {"low": "low speed, 5 m/s", "high": "high speed, 8 m/s"}


@dataclass(frozen=True, eq=False)
class Identification:
    """Parameters of a law on one series: by the papers' search, and those of the lowest error known.

    Attributes
    ----------
    law, data
        The law and the series.
    found
        Parameters found with each seed, (d,) each.
    best
        Parameters of the lowest error known, (d,).

    """

    law: PaperLaw
    data: AccelerationSeries
    found: tuple[Array, ...]
    best: Array

    @cached_property
    def errors(self) -> Array:
        """Sum of squared acceleration residuals with each seed, m^2/s^4."""
        return np.array([squared_error(self.law, p, self.data) for p in self.found])

    @property
    def lowest(self) -> float:
        """Lowest error known, m^2/s^4."""
        return squared_error(self.law, self.best, self.data)

    @property
    def chosen(self) -> Array:
        """Best parameters that the search found, (d,)."""
        return self.found[int(np.argmin(self.errors))]

    def acceleration(self, p: Array) -> Array:
        """Acceleration of the law along the series."""
        out: Array = -self.law.force(p[None], self.data.v, self.data.t)[0] / self.data.mass
        return out


def identify(
    law: PaperLaw, data: AccelerationSeries, effort: Effort, rng: np.random.Generator, method: str = "mga"
) -> Identification:
    """Identify a law by the papers' search."""
    found = tuple(
        search_parameters(law, data, method, seed=i, budget=effort.budget).x for i in range(effort.identified)
    )
    best = min(found, key=lambda p: squared_error(law, p, data))
    return Identification(law, data, found, lowest_error_parameters(law, data, [best], rng, effort.lowest))


def mechanism_of_neither() -> tuple[models.Model, dict[str, dict[str, float]]]:
    """Build a mechanism of neither law: the beam's vibration modulates dry friction, and there is a collision."""
    p = dict(zip(laws.tustin().names, laws.ATM1["low"].values[:4], strict=True))
    model = models.of(["coulomb", "stribeck", "viscous", "load_modulation", "collision"])
    return model, {
        "coulomb": {"F_c": p["F_c"]},
        "stribeck": {"F_s": p["F_s"] - p["F_c"], "v_s": p["v_s"], "delta": 1.0},
        "viscous": {"F_v": p["F_v"]},
        "load_modulation": {"depth": 0.6, "frequency": 34.9, "phase": 0.4},
        "collision": {"J": 0.3, "time": 0.03, "width": 2e-3},
    }


def simulate_sources(group: str, rng: np.random.Generator) -> dict[str, SyntheticRecording]:
    """Simulate the recordings of one speed group."""
    speed = laws.ATM1[group].speed or 0.0
    return {
        "ATM1 tables": record_printed(laws.ATM1[group], TIME_UNITS["ATM1"], BEAM, rng),
        "ATM2 tables": record_printed(laws.ATM2[group], TIME_UNITS["ATM2"], BEAM, rng),
        "neither": record_law(*mechanism_of_neither(), BEAM, speed, rng),
    }


def fit_with_frictrack(law: str, run: Run) -> Fit | None:
    """Fit a law to one run in the displacement domain; None if the fit fails."""
    try:
        return fit(law, [replace(run, name="r")])
    except FrictrackError:
        return None


def estimate_text(found: Fit | None, address: str, form: str = ".3f") -> str:
    """An estimate of frictrack as text, with its standard deviation; `address` may be F_c, F_s, F_v or v_s."""
    if found is None:
        return "no fit"
    estimate = found.parameters[ADDRESSES.get(address, address)]
    if estimate.value is None:
        return "not determined"
    spread = "" if estimate.std is None else f" ± {estimate.std:{'.2g' if form.endswith('g') else form}}"
    return f"{estimate.value:{form}}{spread}"


def range_over_seeds(result: Identification, i: int) -> str:
    """Smallest and largest value of a parameter over the seeds, as text."""
    seeds = np.array(result.found)[:, i]
    return f"{seeds.min():.3g} to {seeds.max():.3g}"
