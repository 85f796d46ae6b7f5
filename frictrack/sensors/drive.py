"""The clock of a measured drive: its copy in  m a + F(v)  under a plain friction law."""

from __future__ import annotations

import numpy as np

from frictrack.records import Array, Displacement, Mask, Motion
from frictrack.sensors.alignment import Alignment, AlignmentProblem, align
from frictrack.sensors.frame_differences import FrameDifferences, second_differences
from frictrack.sensors.sensor_record import SensorRecord

MIN_SPEED_SIGMAS = 3.0  # |v| over sigma_v; above it friction has the sign of the motion


def align_drive(
    displacement: Displacement,
    motion: Motion,
    series: SensorRecord,
    *,
    offset: float | None = None,
    until: float = np.inf,
) -> Alignment:
    """Align a drive (N) with what the camera sees of it: a = D(t - offset) / m - F_c/m sgn v - F_v/m v + const.

    The gain is 1/m. Coulomb and viscous friction, gravity on an incline and a zero that is off are fitted along;
    what else acts is taken as white, its level estimated, and the offset's standard deviation comes from the scatter
    of the parts of the record. Frames at rest, where friction is whatever holds, and those after `until` (s) do not
    count. `offset` (s) is kept where it is given.
    """
    frames = second_differences(displacement.rows(displacement.span))
    moving = _moving(frames, motion) & (frames.ends()[1] <= until)
    frames = frames.select(moving)
    return align(AlignmentProblem(frames, series, _friction_regressors(frames, motion)), offset)


def _moving(frames: FrameDifferences, motion: Motion) -> Mask:
    """Differences (r,) all through which the slider moves one way."""
    v = motion.v[frames.map.indices.reshape(-1, 3)]
    sigma = motion.sigma_v[frames.map.indices.reshape(-1, 3)]
    return np.asarray(np.all(v > MIN_SPEED_SIGMAS * sigma, axis=1) | np.all(v < -MIN_SPEED_SIGMAS * sigma, axis=1))


def _friction_regressors(frames: FrameDifferences, motion: Motion) -> Array:
    """What a plain friction law and a constant force add, (r, 2 or 3)."""
    v = motion.v[frames.centre]
    columns = [-v, np.ones(len(v))]
    if np.ptp(np.sign(v)) > 0:
        columns.insert(0, -np.sign(v))
    return np.stack(columns, axis=1)
