"""Calibrate pixels to metres: scale, lens, plane and direction of the course, and correction of camera shake.

Every kind of scale yields a `PlaneMap` from the picture to the plane of the course; `calibrate` applies it to a track.
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
