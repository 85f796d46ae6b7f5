"""Check the samples of a displacement: outliers, rounding, repeated and missing frames, clock, copies of a record."""

# ruff: noqa: F401 - the imports are the interface

from frictrack.sampling.clock import (
    EvenClock,
    base_interval,
    common_unevenness,
    count_intervals,
    is_even,
    jittered_clock,
    moved_to_grid,
    robust_speed,
    rounded_clock,
    stamp_rounding,
    unevenness,
)
from frictrack.sampling.outlier_search import outliers
from frictrack.sampling.screen import copies, describe_frames, describe_length, frame_numbers, screened
from frictrack.sampling.slips import SampledPath, Slip, correct_ticks, find_slips
from frictrack.sampling.steps import quantum, rounding_noise, unwrapped
