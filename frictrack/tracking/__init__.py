"""Frames -> Track: the moving body in pixels, with a standard deviation and a score per frame."""

from frictrack.tracking.areas import Areas, is_polygon
from frictrack.tracking.detection import find_reference, find_target
from frictrack.tracking.driver import learn_target, track
from frictrack.tracking.registration import aligned
from frictrack.tracking.show import contact_sheet, overlay_video, target_line
from frictrack.tracking.target_model import TargetModel

__all__ = [
    "Areas",
    "TargetModel",
    "aligned",
    "contact_sheet",
    "find_reference",
    "find_target",
    "is_polygon",
    "learn_target",
    "overlay_video",
    "target_line",
    "track",
]
