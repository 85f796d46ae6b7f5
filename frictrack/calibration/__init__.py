"""Pixels -> metres: scale, lens, plane and direction of the course, and a fixed reference point to subtract.

Every way of giving the scale ends in one thing, a `PlaneMap` from the picture to the plane of the course; `calibrate`
sends the track through it.
"""

from frictrack.calibration.displacement import calibrate
from frictrack.calibration.plane import PlaneMap
from frictrack.calibration.rotating_target import MIN_ROTATION
from frictrack.calibration.scale import Scale, parse_scale
from frictrack.calibration.scale_to_map import plane_map
from frictrack.calibration.shake import Shake, estimate_shake, significant_motion, subtract_shake

__all__ = [
    "MIN_ROTATION",
    "PlaneMap",
    "Scale",
    "Shake",
    "calibrate",
    "estimate_shake",
    "parse_scale",
    "plane_map",
    "significant_motion",
    "subtract_shake",
]
