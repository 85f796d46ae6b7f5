"""Check the samples of a displacement: outliers, rounding, repeated and missing frames, clock, copies of a record."""

from frictrack.samples.copies import copies
from frictrack.samples.outliers import Outliers, outliers
from frictrack.samples.quantisation import quantum, rounding_noise
from frictrack.samples.screen import describe_frames, screened
from frictrack.samples.slips import SampledPath, Slip, correct_ticks, find_slips

__all__ = [
    "Outliers",
    "SampledPath",
    "Slip",
    "copies",
    "correct_ticks",
    "describe_frames",
    "find_slips",
    "outliers",
    "quantum",
    "rounding_noise",
    "screened",
]
