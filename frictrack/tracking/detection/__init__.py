"""Locate what to track: the moving body, a click, a rectangle, an outline, a picture; and a fixed reference."""

from frictrack.tracking.detection.moving_bodies import target_fault
from frictrack.tracking.detection.patches import find_reference
from frictrack.tracking.detection.targets import Target, find_target, resolve_areas, resolve_target

__all__ = ["Target", "find_reference", "find_target", "resolve_areas", "resolve_target", "target_fault"]
