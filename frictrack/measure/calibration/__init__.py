"""Calibrate pixels to metres: scale, lens, plane and direction of the course, and correction of camera shake.

Every kind of scale yields a `PlaneMap` from the picture to the plane of the course; `calibrate` applies it to a track.
"""

# ruff: noqa: F401 - the imports are for type checkers; at run time the names are imported on first use

from typing import TYPE_CHECKING

from frictrack.base import lazy_names

if TYPE_CHECKING:
    from frictrack.measure.calibration.circle import on_circle
    from frictrack.measure.calibration.displacement import MIN_ROTATION, calibrate, plane_map
    from frictrack.measure.calibration.scale import PlaneMap, Scale, parse_scale
    from frictrack.measure.calibration.shake import Shake, estimate_shake, significant_motion, subtract_shake

__getattr__, __all__ = lazy_names(__name__)
