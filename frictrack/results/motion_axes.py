"""Name the axes over which a misfit or a force may repeat: time, place, speed, acceleration and phase."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MotionAxis:
    """The texts of one axis.

    Attributes
    ----------
    name : str
        Name in a sentence.
    label : str
        Label of the axis in a figure.
    unit : str
        SI unit.

    """

    name: str
    label: str
    unit: str


AXES = {
    "t": MotionAxis("time since release", "time since release t", "s"),
    "x": MotionAxis("place", "displacement x", "m"),
    "v": MotionAxis("speed", "speed |v|", "m/s"),
    "a": MotionAxis("acceleration", "acceleration along the motion", "m/s^2"),
    "phase": MotionAxis("phase", "phase", "cycles"),
}
