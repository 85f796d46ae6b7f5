"""Check the samples of a displacement: outliers, rounding, repeated and missing frames, the clock, copies of a record."""

from frictrack.samples.outliers import Outliers, outliers
from frictrack.samples.quantisation import quantum, rounding_noise
from frictrack.samples.screen import screened

__all__ = ["Outliers", "outliers", "quantum", "rounding_noise", "screened"]
