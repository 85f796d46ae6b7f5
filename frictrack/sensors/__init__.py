"""Align further sensors with the camera's clock, compare them with the camera, and prepare them for fusion."""

from frictrack.sensors.alignment import Alignment, AlignmentProblem, align
from frictrack.sensors.camera_comparison import SensorComparison, compare_with_camera, known_acceleration
from frictrack.sensors.drive import align_drive
from frictrack.sensors.energy import ReleaseEnergy, release_energy
from frictrack.sensors.frame_differences import FrameDifferences, second_differences
from frictrack.sensors.sensor_record import SensorRecord

__all__ = [
    "Alignment",
    "AlignmentProblem",
    "FrameDifferences",
    "ReleaseEnergy",
    "SensorComparison",
    "SensorRecord",
    "align",
    "align_drive",
    "compare_with_camera",
    "known_acceleration",
    "release_energy",
    "second_differences",
]
