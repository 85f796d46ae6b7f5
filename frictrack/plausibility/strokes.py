"""Cut the motion of a run into legs of one direction and of speeding up or slowing down, each with its acceleration."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from frictrack.friction import is_moving
from frictrack.records import Array, Mask, Run, stretches

MIN_FRAMES = 10  # of a leg, below which a parabola tells nothing
TRIMMED_SHARE = 0.1  # share of a leg at either end that is left out: smoothing reaches over a collision
EVENT_REACH_FRAMES = 3  # frames beyond an event that a difference may still see it
CORRELATION_FACTOR = 3.0  # factor on a standard deviation for errors that neighbours share
MIN_SIGMAS = 5.0  # standard deviations


@dataclass(frozen=True)
class Leg:
    """A stretch of one direction between two collisions, stops or reversals, before or after its highest speed."""

    way: float  # m, above 0
    direction: float  # 1 or -1
    a: float  # m/s^2 toward +x
    sigma_a: float
    speed: float  # m/s, the highest
    usual_speed: float  # m/s, in its middle
    misfit: float  # rms of what a constant acceleration leaves beyond the noise, over the way
    speeding: bool  # before the highest speed
    partner: float  # m, way of the same stretch on the other side of its highest speed

    @property
    def gains(self) -> float:
        """Acceleration in the direction of motion, m/s^2."""
        return self.a * self.direction

    @property
    def certain(self) -> bool:
        """Whether the acceleration is known to differ from 0."""
        return abs(self.a) > MIN_SIGMAS * self.sigma_a


def legs_of(run: Run) -> tuple[Leg, ...]:
    """The legs of a run, in order; frames that were not found, events and rests are in none."""
    return tuple(leg for s in _one_way(run) for leg in _both_sides(run, s))


def total(legs: tuple[Leg, ...]) -> float:
    """Way of all legs together, m."""
    return float(sum(leg.way for leg in legs))


def mean(legs: tuple[Leg, ...]) -> float:
    """Acceleration of several legs, weighted by how well each is known, m/s^2."""
    least = 1e-6 * max(leg.sigma_a for leg in legs) + 1e-300
    return float(np.average([leg.a for leg in legs], weights=[(leg.sigma_a + least) ** -2.0 for leg in legs]))


def _free(run: Run) -> Mask:
    """Frames (n,) that were found, move, and lie in no event."""
    free = run.displacement.valid & is_moving(run)
    for first, last in run.motion.events:
        free[max(first - EVENT_REACH_FRAMES, 0) : last + EVENT_REACH_FRAMES + 1] = False
    return np.asarray(free)


def _one_way(run: Run) -> list[slice]:
    """Stretches of free frames, cut where the direction changes."""
    out = []
    for s in stretches(_free(run)):
        turns = s.start + 1 + np.flatnonzero(np.diff(np.sign(run.motion.v[s])) != 0)
        out += [slice(int(i), int(j)) for i, j in pairwise([s.start, *turns, s.stop])]
    return out


def _both_sides(run: Run, s: slice) -> list[Leg]:
    """Up to two legs of a stretch: before and after its highest speed."""
    fastest = s.start + int(np.argmax(np.abs(run.motion.v[s])))
    x = run.motion.x
    before, after = abs(float(x[fastest] - x[s.start])), abs(float(x[s.stop - 1] - x[fastest]))
    parts = ((slice(s.start, fastest + 1), True, after), (slice(fastest, s.stop), False, before))
    found = (_leg(run, part, speeding=speeding, partner=other) for part, speeding, other in parts)
    return [leg for leg in found if leg is not None]


def _leg(run: Run, s: slice, *, speeding: bool, partner: float) -> Leg | None:
    """The leg of a slice, None where it is too short to tell anything."""
    edge = int(TRIMMED_SHARE * (s.stop - s.start))
    t, x = run.motion.t[s.start + edge : s.stop - edge], run.displacement.x[s.start + edge : s.stop - edge]
    if len(t) < MIN_FRAMES:
        return None
    way = float(abs(x[-1] - x[0]))
    if way <= 0.0:
        return None
    (slope, a), sigma_a, left = _parabola(t, x)
    noise = float(np.median(run.displacement.sigma_x[s.start + edge : s.stop - edge]))
    beyond = float(np.sqrt(max(left**2 - noise**2, 0.0)))
    half = abs(a) * float(t[-1] - t[0]) / 2
    direction = float(np.sign(x[-1] - x[0]))
    return Leg(way, direction, a, sigma_a, abs(slope) + half, abs(slope), beyond / way, speeding, partner)


def _parabola(t: Array, x: Array) -> tuple[tuple[float, float], float, float]:
    """Velocity in the middle and acceleration, the deviation of the latter, and the rms that is left, m."""
    u = t - (t[0] + t[-1]) / 2
    design = np.stack([np.ones_like(u), u, u**2 / 2], axis=1)
    solution = np.linalg.lstsq(design, x, rcond=None)[0]
    left = float(np.sqrt(np.sum((x - design @ solution) ** 2) / (len(u) - 3)))
    sigma = CORRELATION_FACTOR * left * float(np.sqrt(np.linalg.inv(design.T @ design)[2, 2]))
    return (float(solution[1]), float(solution[2])), sigma, left
