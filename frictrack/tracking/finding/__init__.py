"""What to track: the body that moves, a click, a rectangle, a picture; and something fixed to hold it against."""

from frictrack.tracking.finding.find import find_target
from frictrack.tracking.finding.reference import find_reference
from frictrack.tracking.finding.target import Target, resolve

__all__ = ["Target", "find_reference", "find_target", "resolve"]
