"""Test whether a misfit repeats from run to run: over place, time since release, speed, or with one frequency."""

from frictrack.diagnose.repeatability.axis_result import AxisRepeatability
from frictrack.diagnose.repeatability.common_curves import Repeatability, assess_repeatability
from frictrack.diagnose.repeatability.residual_curves import FailurePattern, find_failure_pattern

__all__ = ["AxisRepeatability", "FailurePattern", "Repeatability", "assess_repeatability", "find_failure_pattern"]
