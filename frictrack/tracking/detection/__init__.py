"""What to track: the body that moves, a click, a rectangle, a picture; and something fixed to hold it against."""

from frictrack.tracking.detection.moving_bodies import find_target
from frictrack.tracking.detection.reference_patch import find_reference
from frictrack.tracking.detection.target_input import Target, resolve_target

__all__ = ["Target", "find_reference", "find_target", "resolve_target"]
