"""Frames -> Track: the moving body in pixels, with a standard deviation and a score per frame."""

from frictrack.tracking.driver import track
from frictrack.tracking.find import find_target

__all__ = ["find_target", "track"]
