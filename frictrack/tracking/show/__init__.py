"""Show a track: a contact sheet, and a video with the target drawn in."""

from frictrack.tracking.show.overlay import overlay_video
from frictrack.tracking.show.sheet import contact_sheet, target_line

__all__ = ["contact_sheet", "overlay_video", "target_line"]
