"""List experiments that could be filmed next, within what the setup has shown."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from frictrack.costs import DEFAULT_COSTS, SAME_RATIO, Costs
from frictrack.diagnose.experiments.virtual_runs import RunDesign, longest_piece, max_frames_of_film
from frictrack.fit.least_squares import Solution

SLOWER_FACTOR, FASTER_FACTOR = 0.5, 1.5  # times the slowest and the fastest run so far
TILT_RAD = np.deg2rad(5.0)
MIN_SPEED_DIFFERENCE = 0.15  # relative; smaller ones count as the same speed
STOP_WITHIN_SHARE = 0.8  # of the course
SPEED_KEYS = (
    "slower",
    "faster",
    "to a stop",
    "repeat",
)  # experiments whose speeds are combined with mass and direction


@dataclass(frozen=True)
class Experiment:
    """One experiment: a key, the instruction without its reason, and the design of the run."""

    key: str
    words: str
    design: RunDesign


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
    setup = _setup(solution, costs)
    return [*_speeds(setup, *costs.speeds), *_changes(setup)]


def combined_experiments(solution: Solution, costs: Costs) -> list[Experiment]:
    """List runs that combine speed, direction and mass, within what the set-up can do, beside the single changes.

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
    setup, mass = _setup(solution, costs), longest_piece(solution.problem.pieces).mass
    ratios = [one / mass for one in costs.masses] or [1.0, 2.0]
    speeds = {abs(e.design.start[1]) for e in entries if e.key in SPEED_KEYS}
    known = {e.design for e in entries}
    for speed, direction, ratio in product(sorted(speeds), (setup.direction, -setup.direction), ratios):
        design = replace(setup.design(speed, direction), mass=1.0 if abs(ratio - 1) < SAME_RATIO else ratio)
        if design not in known:
            text = "" if direction == setup.direction else " the other way"
            load = "" if design.mass == 1 else f" with {mass * ratio:.3g} kg"
            words = f"{_instruction(setup)} a run{text} at about {speed:.1f} m/s{load}"
            entries.append(Experiment(f"{direction * speed:.1f} m/s{load}", words, design))
    return entries


@dataclass(frozen=True)
class _ObservedSetup:
    """The set-up: speeds m/s, main direction, course m, starts m, typical deceleration m/s^2, frames per film."""

    speeds: tuple[float, ...]
    direction: float
    both_directions: bool
    course: tuple[float, float]
    starts: dict[float, float]
    braking: float
    driven: bool
    frames: float

    def design(self, speed: float, direction: float | None = None) -> RunDesign:
        """A plain run at a speed."""
        direction = direction or self.direction
        typical = float(np.median(self.speeds))
        return RunDesign(
            (self.starts[direction], direction * speed),
            self.course,
            drive=direction * self.direction * speed / typical,
            frames=self.frames,
        )


def _setup(solution: Solution, costs: Costs) -> _ObservedSetup:
    first: dict[int, tuple[float, float]] = {}
    for piece, start in zip(solution.problem.pieces, solution.starts, strict=True):
        first.setdefault(piece.run, (float(start[0]), float(start[1])))
    directions = np.array([np.sign(v) for _, v in first.values()])
    span = solution.problem.layout.span
    course = span.x_min, span.x_max
    starts = {1.0: course[0], -1.0: course[1]}
    a = np.concatenate([r.piece.path.s * r.motion.a for r in solution.responses])
    return _ObservedSetup(
        speeds=tuple(sorted(abs(v) for _, v in first.values())),
        direction=1.0 if np.sum(directions) >= 0 else -1.0,
        both_directions=len(set(directions)) > 1,
        course=course,
        starts=starts,
        braking=max(-float(np.median(a)), 0.1),
        driven=any(p.path.drive is not None for p in solution.problem.pieces),
        frames=max_frames_of_film(solution, costs),
    )


def _speeds(setup: _ObservedSetup, low: float, high: float) -> Iterator[Experiment]:
    """Slower, faster, to a stop, reversed and repeated."""
    typical, what = float(np.median(setup.speeds)), _instruction(setup)
    slow = max(SLOWER_FACTOR * setup.speeds[0], low)
    if slow < (1 - MIN_SPEED_DIFFERENCE) * setup.speeds[0]:
        yield Experiment("slower", f"{what} a slower run, at about {slow:.1f} m/s", setup.design(slow))
    fast = min(FASTER_FACTOR * setup.speeds[-1], high)
    if fast > (1 + MIN_SPEED_DIFFERENCE) * setup.speeds[-1]:
        yield Experiment("faster", f"{what} a faster run, at about {fast:.1f} m/s", setup.design(fast))
    stop = float(np.sqrt(2 * setup.braking * STOP_WITHIN_SHARE * (setup.course[1] - setup.course[0])))
    if not setup.driven and low < stop < high:
        words = f"{what} a run until the mass stops by itself, released at about {stop:.1f} m/s"
        yield Experiment("to a stop", words, setup.design(stop))
    text = "the other way" if setup.both_directions else "in the other direction, which no run has had so far,"
    words = f"{what} a run {text} at about {typical:.1f} m/s"
    yield Experiment("reversed", words, setup.design(typical, -setup.direction))
    words = f"{what} another run like those at about {typical:.1f} m/s"
    yield Experiment("repeat", words, setup.design(typical))


def _changes(setup: _ObservedSetup) -> Iterator[Experiment]:
    """Another mass, a tilted course, more frames per second, another zoom, a longer run."""
    typical, what = float(np.median(setup.speeds)), _instruction(setup)
    plain, at = setup.design(typical), f"at about {typical:.1f} m/s"
    yield Experiment("double mass", f"{what} a run with the mass doubled, {at}", replace(plain, mass=2.0))
    yield Experiment("half mass", f"{what} a run with half the mass, {at}", replace(plain, mass=0.5))
    for sign, word in ((1.0, "raised"), (-1.0, "lowered")):
        words = f"{what} a run {at} with the far end of the course {word} by 5 degrees (give incline)"
        yield Experiment(f"tilt {sign:+.0f}", words, replace(plain, tilt=sign * TILT_RAD))
    words = f"{what} a run {at} at twice the frame rate, as long as the light allows"
    yield Experiment("frame rate", words, replace(plain, rate=2.0))
    words = f"{what} a run {at} at another zoom, a pixel being 0.7 times as large"
    yield Experiment("zoom", words, replace(plain, pitch=0.7, course=_visible_course(setup, 0.7)))
    words = f"{what} a longer run: half as far again, {at}, the camera moved back"
    yield Experiment("longer", words, replace(plain, pitch=1.5, course=_visible_course(setup, 1.5)))


def _visible_course(setup: _ObservedSetup, share: float) -> tuple[float, float]:
    """The part of the course that another zoom shows."""
    length = share * (setup.course[1] - setup.course[0])
    if setup.direction > 0:
        return setup.course[0], setup.course[0] + length
    return setup.course[1] - length, setup.course[1]


def _instruction(setup: _ObservedSetup) -> str:
    return "Drive and film" if setup.driven else "Film"
