"""Test whether a misfit repeats from run to run: over place, time since release, speed, or with one frequency."""

from frictrack.diagnose.repeatability.axis_result import Repeat
from frictrack.diagnose.repeatability.common_curves import Repeats, repeats
from frictrack.diagnose.repeatability.residual_curves import where_it_fails

__all__ = ["Repeat", "Repeats", "repeats", "where_it_fails"]
