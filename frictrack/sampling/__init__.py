"""Check the samples of a displacement: outliers, rounding, repeated and missing frames, clock, copies of a record."""

from frictrack.sampling.duplicate_records import copies
from frictrack.sampling.even_clock import (
    EvenClock,
    base_interval,
    count_intervals,
    is_even,
    jittered_clock,
    moved_to_grid,
    robust_speed,
    rounded_clock,
    stamp_rounding,
)
from frictrack.sampling.outlier_search import Outliers, outliers
from frictrack.sampling.quantisation import quantum, rounding_noise, unwrapped
from frictrack.sampling.screen import describe_frames, describe_length, frame_numbers, screened
from frictrack.sampling.slips import SampledPath, Slip, correct_ticks, find_slips
from frictrack.sampling.uneven_samples import common_unevenness, unevenness

__all__ = [
    "EvenClock",
    "Outliers",
    "SampledPath",
    "Slip",
    "base_interval",
    "common_unevenness",
    "copies",
    "correct_ticks",
    "count_intervals",
    "describe_frames",
    "describe_length",
    "find_slips",
    "frame_numbers",
    "is_even",
    "jittered_clock",
    "moved_to_grid",
    "outliers",
    "quantum",
    "robust_speed",
    "rounded_clock",
    "rounding_noise",
    "screened",
    "stamp_rounding",
    "unevenness",
    "unwrapped",
]
