"""Sensors beside the camera: their clocks aligned with the camera's, what they say compared, and fused."""

from frictrack.sensors.align import Alignment, Problem, align
from frictrack.sensors.drive import align_drive
from frictrack.sensors.energy import Energy, release_energy
from frictrack.sensors.frames import Frames, second_differences
from frictrack.sensors.series import Series
from frictrack.sensors.verdict import Comparison, compare, known_acceleration

__all__ = [
    "Alignment",
    "Comparison",
    "Energy",
    "Frames",
    "Problem",
    "Series",
    "align",
    "align_drive",
    "compare",
    "known_acceleration",
    "release_energy",
    "second_differences",
]
