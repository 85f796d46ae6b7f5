"""List experiments that could be filmed next, within what the set-up has shown."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from frictrack.costs import DEFAULT_COSTS, SAME_RATIO, Costs
from frictrack.diagnose.experiments.virtual_runs import RunConditions, RunDesign, max_frames_of_film
from frictrack.fit.least_squares import Solution

SLOWER_FACTOR, FASTER_FACTOR = 0.5, 1.5  # times the slowest and the fastest run so far
TILT_RAD = np.deg2rad(5.0)
MIN_SPEED_DIFFERENCE = 0.15  # relative; smaller ones count as the same speed
STOP_WITHIN_SHARE = 0.8  # of the course
SPEED_KEYS = ("slower", "faster", "to a stop", "repeat")  # whose speeds are combined with mass and direction


@dataclass(frozen=True)
class Experiment:
    """One experiment: a key, the instruction without its reason, and the design of the run."""

    key: str
    words: str
    design: RunDesign


def changed_runs(plain: RunDesign, run: str) -> Iterator[Experiment]:
    """List a plain run, which `run` describes, with another mass, a tilted course, and more frames per second."""
    yield Experiment("double mass", f"{run} with the mass doubled", replace(plain, mass=2.0))
    yield Experiment("half mass", f"{run} with half the mass", replace(plain, mass=0.5))
    for sign, word in ((1.0, "raised"), (-1.0, "lowered")):
        words = f"{run} with the far end of the course {word} by 5 degrees (give incline)"
        yield Experiment(f"tilt {sign:+.0f}", words, replace(plain, tilt=sign * TILT_RAD))
    yield Experiment(
        "frame rate", f"{run} at twice the frame rate, as long as the light allows", replace(plain, rate=2.0)
    )


def candidate_experiments(solution: Solution, costs: Costs = DEFAULT_COSTS) -> list[Experiment]:
    """List runs that could be filmed next.

    Parameters
    ----------
    solution
        A fit of the present runs.
    costs
        Slowest and fastest speed of the set-up, and largest number of frames in one film.

    Returns
    -------
    list of Experiment
        Slower, faster, to a stop, reversed, repeated; other mass, tilt, frame rate, zoom and length.

    """
    setup = _ObservedSetup(solution, costs)
    return [*setup.speeds(*costs.speeds), *setup.changes()]


def combined_experiments(solution: Solution, costs: Costs) -> list[Experiment]:
    """List runs that combine speed, direction and mass, within what the set-up can do, after the single changes.

    Parameters
    ----------
    solution
        A fit of the present runs.
    costs
        Costs, speeds and masses of the set-up.

    Returns
    -------
    list of Experiment
        Those of `candidate_experiments` first.

    """
    entries = candidate_experiments(solution, costs)
    setup, mass = _ObservedSetup(solution, costs), RunConditions.of_fit(solution).mass
    ratios = [one / mass for one in costs.masses] or [1.0, 2.0]
    speeds = {abs(e.design.start[1]) for e in entries if e.key in SPEED_KEYS}
    known = {e.design for e in entries}
    for speed, direction, ratio in product(sorted(speeds), (setup.direction, -setup.direction), ratios):
        design = replace(setup.design(speed, direction), mass=1.0 if abs(ratio - 1) < SAME_RATIO else ratio)
        if design not in known:
            text = "" if direction == setup.direction else " the other way"
            load = "" if design.mass == 1 else f" with {mass * ratio:.3g} kg"
            words = f"{setup.verb} a run{text} at about {speed:.1f} m/s{load}"
            entries.append(Experiment(f"{direction * speed:.1f} m/s{load}", words, design))
    return entries


@dataclass(frozen=True)
class _ObservedSetup:
    """The set-up as the present runs show it."""

    solution: Solution
    costs: Costs

    @cached_property
    def velocities(self) -> list[float]:
        """First velocity of every run, m/s, the slowest run first."""
        first: dict[int, float] = {}
        for piece, start in zip(self.solution.problem.pieces, self.solution.starts, strict=True):
            first.setdefault(piece.run, float(start[1]))
        return sorted(first.values(), key=abs)

    @cached_property
    def typical(self) -> float:
        """Typical speed, m/s."""
        return float(np.median(np.abs(self.velocities)))

    @property
    def direction(self) -> float:
        """Direction of most runs."""
        return 1.0 if np.sum(np.sign(self.velocities)) >= 0 else -1.0

    @property
    def verb(self) -> str:
        """What to do with a run."""
        return "Drive and film" if self.is_driven else "Film"

    @property
    def is_driven(self) -> bool:
        """Whether a drive was measured."""
        return any(p.path.drive is not None for p in self.solution.problem.pieces)

    @cached_property
    def course(self) -> tuple[float, float]:
        """Course of the runs, m."""
        span = self.solution.problem.layout.span
        return span.x_min, span.x_max

    @cached_property
    def frames(self) -> float:
        """Largest number of frames in a film."""
        return max_frames_of_film(self.solution, self.costs)

    def design(self, speed: float, direction: float | None = None) -> RunDesign:
        """A plain run at a speed."""
        direction = direction or self.direction
        start = self.course[0 if direction > 0 else 1]
        drive = direction * self.direction * speed / self.typical
        return RunDesign((start, direction * speed), self.course, drive=drive, frames=self.frames)

    def speeds(self, low: float, high: float) -> Iterator[Experiment]:
        """Slower, faster, to a stop, reversed and repeated."""
        slowest, fastest = abs(self.velocities[0]), abs(self.velocities[-1])
        slow, fast = max(SLOWER_FACTOR * slowest, low), min(FASTER_FACTOR * fastest, high)
        if slow < (1 - MIN_SPEED_DIFFERENCE) * slowest:
            yield Experiment("slower", f"{self.verb} a slower run, at about {slow:.1f} m/s", self.design(slow))
        if fast > (1 + MIN_SPEED_DIFFERENCE) * fastest:
            yield Experiment("faster", f"{self.verb} a faster run, at about {fast:.1f} m/s", self.design(fast))
        a = np.concatenate([r.piece.path.s * r.motion.a for r in self.solution.responses])
        braking = max(-float(np.median(a)), 0.1)
        stop = float(np.sqrt(2 * braking * STOP_WITHIN_SHARE * (self.course[1] - self.course[0])))
        if not self.is_driven and low < stop < high:
            words = f"{self.verb} a run until the mass stops by itself, released at about {stop:.1f} m/s"
            yield Experiment("to a stop", words, self.design(stop))
        both = len(set(np.sign(self.velocities))) > 1
        text = "the other way" if both else "in the other direction, which no run has had so far,"
        words = f"{self.verb} a run {text} at about {self.typical:.1f} m/s"
        yield Experiment("reversed", words, self.design(self.typical, -self.direction))
        words = f"{self.verb} another run like those at about {self.typical:.1f} m/s"
        yield Experiment("repeat", words, self.design(self.typical))

    def changes(self) -> Iterator[Experiment]:
        """Another mass, a tilted course, more frames per second, another zoom, a longer run."""
        plain, at = self.design(self.typical), f"at about {self.typical:.1f} m/s"
        yield from changed_runs(plain, f"{self.verb} a run {at}")
        words = f"{self.verb} a run {at} at another zoom, a pixel being 0.7 times as large"
        yield Experiment("zoom", words, replace(plain, pitch=0.7, course=self._visible_course(0.7)))
        words = f"{self.verb} a longer run: half as far again, {at}, the camera moved back"
        yield Experiment("longer", words, replace(plain, pitch=1.5, course=self._visible_course(1.5)))

    def _visible_course(self, share: float) -> tuple[float, float]:
        """The part of the course that another zoom shows."""
        low, high = self.course
        length = share * (high - low)
        return (low, low + length) if self.direction > 0 else (high - length, high)
