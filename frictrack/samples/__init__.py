"""Check the samples of a displacement: outliers, rounding, repeated and missing frames, clock, copies of a record."""

from frictrack.samples.copies import copies
from frictrack.samples.outliers import Outliers, outliers
from frictrack.samples.quantisation import quantum, rounding_noise
from frictrack.samples.screen import screened

__all__ = ["Outliers", "copies", "outliers", "quantum", "rounding_noise", "screened"]
