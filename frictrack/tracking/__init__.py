"""Frames -> Track: the moving body in pixels, with a standard deviation and a score per frame."""

from frictrack.tracking.driver import learn_target, track
from frictrack.tracking.find import find_target
from frictrack.tracking.register import aligned
from frictrack.tracking.sheet import contact_sheet, target_line

__all__ = ["aligned", "contact_sheet", "find_target", "learn_target", "target_line", "track"]
