"""Collect what the pieces of one run share: reference mass and load, release time, and the motion since release."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frictrack.calibration import significant_motion
from frictrack.friction import MIN_MOTION_SIGMAS, MIN_MOVING_SIGMAS, is_moving, release_time
from frictrack.records import GRAVITY, Array, Run

MIN_KNOWN_SHARE = 0.5  # least share of frames in which a series is known
MAX_REST_SPEED_SHARE = 0.1  # share of the highest speed; a certainly slower beginning is rest


@dataclass(frozen=True)
class Reference:
    """Mass (kg) and normal load (N) at which newtons are reported."""

    mass: float
    load: float


def reference_of(runs: Sequence[Run], mass: float | None = None) -> Reference:
    """Return the mass and the normal load at which newtons are reported.

    Parameters
    ----------
    runs : sequence of Run
        The fitted runs.
    mass : float, optional
        Mass of the study, kg; default that of the first run.

    Returns
    -------
    Reference
        The mass, and the normal load that belongs to it. The load is 1 where the mass is unknown.

    """
    first = runs[0]
    if first.mass is None:
        return Reference(mass or 1.0, 1.0)
    mass = mass or first.mass
    load = first.normal_load or mass * GRAVITY * float(np.cos(first.incline))
    return Reference(mass, load)


@dataclass(frozen=True)
class RunContext:
    """What the pieces of one run share: reference, release time (s), and the smoothed motion since release."""

    reference: Reference
    release: float
    way: Array  # t, x, v (3, k)
    slid: Array  # m since release, (k,)
    per_frame: int
    angle: Array | None  # rad, per frame; the significant part


def run_context(run: Run, reference: Reference) -> RunContext:
    """Compute what the pieces of a run share."""
    return RunContext(
        reference, *_motion_since_release(run), 1, _significant_angle(run.motion.t, run.displacement.angle)
    )


def _motion_since_release(run: Run) -> tuple[float, Array, Array]:
    """Release time, smoothed motion since then (3, k), and distance slid (k,) without steps at rest.

    A run that was seen at rest first begins with that rest, so that effects with memory start without history.
    """
    release, motion = release_time(run), run.motion
    moves, since = is_moving(run), motion.t >= release
    way = np.stack([motion.t - release, motion.x, motion.v])
    if rest := _frames_at_rest(run):
        way[1:, :rest] = np.array([[np.mean(motion.x[:rest])], [0.0]])
        since[:rest] = True
    way = way[:, since]
    slid = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(way[1])) * moves[since][1:])])
    if rest:  # the rest began before the record
        earlier = np.array([2 * way[0, 0] - way[0, 1], way[1, 0], 0.0])
        way, slid = np.column_stack([earlier, way]), np.append(0.0, slid)
    return release, way, slid


def _frames_at_rest(run: Run) -> int:
    """Number of frames at the beginning of a record in which a free mass rests; 0 if it slides from the first one.

    If the smoothed motion is never certainly slow, only the first frame is tested. With a load cell a mass may rest
    under any force, so no frame counts as rest.
    """
    if run.friction_N is not None:
        return 0
    motion, certain = run.motion, np.abs(run.motion.v) > MIN_MOTION_SIGMAS * run.motion.sigma_v
    resting = np.flatnonzero(~is_moving(run)[: int(np.argmax(certain))])
    rows = resting if len(resting) else np.array([0])
    v, sigma = motion.v[rows], motion.sigma_v[rows]
    at_most = abs(float(np.mean(v))) + MIN_MOVING_SIGMAS * float(np.sqrt(np.mean(sigma**2) / len(rows)))
    return (
        int(rows[-1]) + 1
        if at_most < MAX_REST_SPEED_SHARE * float(np.max(np.abs(motion.v[certain]), initial=0.0))
        else 0
    )


def _significant_angle(times: Array, angle: Array) -> Array | None:
    """The significant part of the target's angle (n,), gaps interpolated; None if most of it is unknown.

    Angle and place of one frame come from the same pixels, so the noise of the angle is correlated with that of the
    place. An angle that does not exceed its noise counts as constant zero.
    """
    known = np.isfinite(angle)
    if np.mean(known) <= MIN_KNOWN_SHARE:
        return None
    bridged = np.interp(times, times[known], angle[known])
    middle = float(np.mean(bridged))
    turned = significant_motion(bridged - middle, times)[0]
    return middle + turned if turned.any() else turned
