"""Divide the motion of a run into strokes: one direction, accelerating or decelerating, with a fitted acceleration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frictrack.friction import is_moving, split_by_direction
from frictrack.records import Array, Mask, Run, stretches

MIN_FRAMES = 10  # of a stroke, for a parabola
TRIMMED_SHARE = 0.1  # of a stroke at either end; smoothing affects frames near a collision
EVENT_REACH_FRAMES = 3  # frames that an event affects beyond itself
CORRELATION_FACTOR = 3.0  # on standard deviations, for errors that neighbours share
MIN_SIGMAS = 5.0  # of an acceleration that differs from 0


@dataclass(frozen=True)
class Stroke:
    """A stretch of one direction between two collisions, stops or reversals, before or after its highest speed."""

    distance: float  # m, above 0
    direction: float  # 1 or -1
    a: float  # m/s^2 toward +x
    sigma_a: float
    speed: float  # m/s, the highest
    mid_speed: float  # m/s, in its middle
    misfit: float  # rms of what a constant acceleration leaves beyond the noise, over the way
    is_accelerating: bool  # before the highest speed
    partner_distance: float  # m, way of the same stretch on the other side of its highest speed

    @property
    def speed_gain(self) -> float:
        """Acceleration in the direction of motion, m/s^2."""
        return self.a * self.direction

    @property
    def is_significant(self) -> bool:
        """Whether the acceleration differs from 0."""
        return abs(self.a) > MIN_SIGMAS * self.sigma_a


def find_strokes(run: Run) -> tuple[Stroke, ...]:
    """Find the strokes of a run, in order; they exclude frames not found, events and rests.

    Parameters
    ----------
    run
        A run with displacement and motion.

    Returns
    -------
    tuple of Stroke

    """
    spans = split_by_direction(run, stretches(_free_frames(run)))
    return tuple(stroke for s in spans for stroke in _split_at_top_speed(run, s))


def total_distance(strokes: tuple[Stroke, ...]) -> float:
    """Distance of all strokes together, m."""
    return float(sum(stroke.distance for stroke in strokes))


def mean_acceleration(strokes: tuple[Stroke, ...]) -> float:
    """Mean acceleration of strokes, weighted by their variances, m/s^2."""
    floor = 1e-6 * max(stroke.sigma_a for stroke in strokes) + 1e-300
    return float(
        np.average([stroke.a for stroke in strokes], weights=[(stroke.sigma_a + floor) ** -2.0 for stroke in strokes])
    )


def _free_frames(run: Run) -> Mask:
    """Frames (n,) that were found, move, and lie in no event."""
    free = run.displacement.valid & is_moving(run)
    for first, last in run.motion.events:
        free[max(first - EVENT_REACH_FRAMES, 0) : last + EVENT_REACH_FRAMES + 1] = False
    return np.asarray(free)


def _split_at_top_speed(run: Run, s: slice) -> list[Stroke]:
    """Up to two strokes of a stretch: before and after its highest speed."""
    fastest = s.start + int(np.argmax(np.abs(run.motion.v[s])))
    x = run.motion.x
    distance_before, distance_after = abs(float(x[fastest] - x[s.start])), abs(float(x[s.stop - 1] - x[fastest]))
    parts = ((slice(s.start, fastest + 1), True, distance_after), (slice(fastest, s.stop), False, distance_before))
    found = (
        _fit_stroke(run, part, is_accelerating=is_accelerating, partner_distance=other)
        for part, is_accelerating, other in parts
    )
    return [stroke for stroke in found if stroke is not None]


def _fit_stroke(run: Run, s: slice, *, is_accelerating: bool, partner_distance: float) -> Stroke | None:
    """Fit the stroke of a slice; None if it is too short."""
    trimmed = int(TRIMMED_SHARE * (s.stop - s.start))
    t, x = run.motion.t[s.start + trimmed : s.stop - trimmed], run.displacement.x[s.start + trimmed : s.stop - trimmed]
    if len(t) < MIN_FRAMES:
        return None
    distance = float(abs(x[-1] - x[0]))
    if distance <= 0.0:
        return None
    (slope, a), sigma_a, residual_rms = _fit_parabola(t, x)
    noise = float(np.median(run.displacement.sigma_x[s.start + trimmed : s.stop - trimmed]))
    excess = float(np.sqrt(max(residual_rms**2 - noise**2, 0.0)))
    half = abs(a) * float(t[-1] - t[0]) / 2
    direction = float(np.sign(x[-1] - x[0]))
    return Stroke(
        distance,
        direction,
        a,
        sigma_a,
        abs(slope) + half,
        abs(slope),
        excess / distance,
        is_accelerating,
        partner_distance,
    )


def _fit_parabola(t: Array, x: Array) -> tuple[tuple[float, float], float, float]:
    """Mid velocity and acceleration, standard deviation of the latter, and rms residual, m."""
    u = t - (t[0] + t[-1]) / 2
    design = np.stack([np.ones_like(u), u, u**2 / 2], axis=1)
    solution = np.linalg.lstsq(design, x, rcond=None)[0]
    residual_rms = float(np.sqrt(np.sum((x - design @ solution) ** 2) / (len(u) - 3)))
    sigma = CORRELATION_FACTOR * residual_rms * float(np.sqrt(np.linalg.inv(design.T @ design)[2, 2]))
    return (float(solution[1]), float(solution[2])), sigma, residual_rms
