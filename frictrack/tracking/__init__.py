"""Frames -> Track: the moving body in pixels, with a standard deviation and a score per frame."""

from frictrack.tracking.areas import Areas
from frictrack.tracking.driver import learn_target, track
from frictrack.tracking.finding import find_reference, find_target
from frictrack.tracking.register import aligned
from frictrack.tracking.show import contact_sheet, overlay_video, target_line

__all__ = [
    "Areas",
    "aligned",
    "contact_sheet",
    "find_reference",
    "find_target",
    "learn_target",
    "overlay_video",
    "target_line",
    "track",
]
