"""Calibrate pixels to metres: scale, lens, plane and direction of the course, and correction of camera shake.

Every kind of scale yields a `PlaneMap` from the picture to the plane of the course; `calibrate` applies it to a track.
"""

# ruff: noqa: F401 - the imports are for type checkers; at run time the names are imported on first use

from typing import TYPE_CHECKING

from frictrack.base.lazy import lazy_names, module_of

if TYPE_CHECKING:
    from frictrack.measure.calibration.course_direction import MIN_ROTATION
    from frictrack.measure.calibration.displacement import calibrate, plane_map
    from frictrack.measure.calibration.scale import PlaneMap, Scale, parse_scale
    from frictrack.measure.calibration.shake import Shake, estimate_shake, significant_motion, subtract_shake

_MODULE_OF = module_of(
    {
        "displacement": "calibrate plane_map",
        "shake": "estimate_shake Shake significant_motion subtract_shake",
        "course_direction": "MIN_ROTATION",
        "scale": "parse_scale PlaneMap Scale",
    }
)

__all__ = [*_MODULE_OF]  # noqa: PLE0604 - they are strings
__getattr__ = lazy_names(__name__, _MODULE_OF)
