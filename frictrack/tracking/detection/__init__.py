"""Locate what to track: the moving body, a click, a rectangle, an outline, a picture; and a fixed reference."""

from frictrack.tracking.detection.moving_bodies import find_target, rests_while_others_move
from frictrack.tracking.detection.reference_patch import find_reference
from frictrack.tracking.detection.target_input import Target, resolve_areas, resolve_target

__all__ = ["Target", "find_reference", "find_target", "resolve_areas", "resolve_target", "rests_while_others_move"]
