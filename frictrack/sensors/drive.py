"""Align the clock of a measured drive force by its part in m a + F(v) under a plain friction law."""

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
    """Align a measured drive with the camera: a = D(t - offset) / m - F_c/m sgn v - F_v/m v + const.

    The gain is 1/m. Coulomb and viscous friction, gravity on an incline and a zero error are fitted as well. Other
    forces
    are taken as white, and their level is estimated. The standard deviation of the offset comes from the scatter over
    parts of the record. Frames at rest do not count, because static friction is undetermined.

    Parameters
    ----------
    displacement : Displacement
        Displacement of the slider, m.
    motion : Motion
        Its velocity, m/s.
    series : SensorRecord
        Drive force, N.
    offset : float, optional
        Known offset, s.
    until : float
        Time after which frames do not count, s.

    Returns
    -------
    Alignment
        Clock of the drive and 1/m.

    """
    frames = second_differences(displacement.rows(displacement.span))
    moving = _moving(frames, motion) & (frames.ends()[1] <= until)
    frames = frames.select(moving)
    return align(AlignmentProblem(frames, series, _friction_regressors(frames, motion)), offset)


def _moving(frames: FrameDifferences, motion: Motion) -> Mask:
    """Differences (r,) during which the slider moves in one direction."""
    v = motion.v[frames.map.indices.reshape(-1, 3)]
    sigma = motion.sigma_v[frames.map.indices.reshape(-1, 3)]
    return np.asarray(np.all(v > MIN_SPEED_SIGMAS * sigma, axis=1) | np.all(v < -MIN_SPEED_SIGMAS * sigma, axis=1))


def _friction_regressors(frames: FrameDifferences, motion: Motion) -> Array:
    """Regressors (r, 2 or 3) of Coulomb and viscous friction and a constant force."""
    v = motion.v[frames.centre]
    columns = [-v, np.ones(len(v))]
    if np.ptp(np.sign(v)) > 0:
        columns.insert(0, -np.sign(v))
    return np.stack(columns, axis=1)
