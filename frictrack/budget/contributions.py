"""The rows of an error budget: one source of error with its size and its effect on the friction force."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

NOISE, FILTER, SCALE, MASS, TIME = "pixel noise", "filter", "scale", "mass", "time base"
LOCKING, SHAKE, DRIVE, DRIVE_CLOCK, SENSOR = "peak locking", "camera shake", "drive sensor", "drive clock", "load cell"
EACH_FRAME, ALL_FRAMES, ALL_RUNS = "each frame", "all frames", "all runs"  # what shares one and the same error


@dataclass(frozen=True)
class Contribution:
    """One source of error of the friction force.

    Parameters
    ----------
    source
        Its name.
    size, unit
        Its standard deviation and unit; None if not known.
    known_from
        How the size is known.
    frame_N
        Effect on the force of one frame, rms over the free section, N; None if the size is not known.
    mean_N
        Effect on the mean force over the free section, N; None if the size is not known.
    common
        What shares one and the same error: each frame, all frames of a run, or all runs.

    """

    source: str
    size: float | None
    unit: str
    known_from: str
    frame_N: float | None
    mean_N: float | None
    common: str = EACH_FRAME

    def summary(self) -> dict[str, Any]:
        """Return the JSON of the row, without its shares."""
        return {
            "source": self.source,
            "size": self.size,
            "unit": self.unit,
            "told": self.known_from,
            "frame_N": self.frame_N,
            "mean_N": self.mean_N,
            "common": self.common,
        }
