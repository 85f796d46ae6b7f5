"""The axes along which a misfit or a force may repeat: time, place, speed, acceleration and phase."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Along:
    """One axis."""

    word: str  # in a sentence
    label: str  # of a drawn axis, which says it once more in full
    unit: str


AXES = {
    "t": Along("time since release", "time since release t", "s"),
    "x": Along("place", "displacement x", "m"),
    "v": Along("speed", "speed |v|", "m/s"),
    "a": Along("acceleration", "acceleration along the motion", "m/s^2"),
    "phase": Along("phase", "phase", "cycles"),
}
