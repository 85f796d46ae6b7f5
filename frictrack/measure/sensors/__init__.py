"""Align further sensors with the camera's clock, compare them with the camera, and prepare them for fusion."""

from frictrack.measure.sensors.alignment import Alignment, AlignmentProblem, align, align_drive
from frictrack.measure.sensors.camera_comparison import (
    SensorComparison,
    compare_with_camera,
    known_acceleration,
    release_energy,
)
from frictrack.measure.sensors.sensor_record import SensorRecord, second_differences

__all__ = [
    "Alignment",
    "AlignmentProblem",
    "SensorComparison",
    "SensorRecord",
    "align",
    "align_drive",
    "compare_with_camera",
    "known_acceleration",
    "release_energy",
    "second_differences",
]
