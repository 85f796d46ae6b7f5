"""Check the samples of a displacement: noise, outliers, rounding, repeated or missing frames, clock, copied records."""

# ruff: noqa: F401 - the imports are the interface

from frictrack.sampling.clock import (
    MIN_SHORTEST,
    EvenClock,
    base_interval,
    count_intervals,
    frame_numbers,
    is_even,
    jittered_clock,
    moved_to_grid,
    quantum,
    robust_speed,
    rounded_clock,
    rounding_noise,
    stamp_rounding,
    unevenness,
    unwrapped,
)
from frictrack.sampling.difference_noise import (
    CORRELATION_COST,
    DIFFERENCE_ORDER,
    FALLBACK_ORDER,
    difference_order,
    difference_variance,
    independent_step,
    noise_level,
    noise_of_smooth,
    unusual_steps,
    white_noise,
)
from frictrack.sampling.screen import (
    copies,
    count_text,
    describe_frames,
    describe_length,
    interpolated,
    outliers,
    placeholders,
    screened,
)
from frictrack.sampling.slips import SampledPath, Slip, correct_ticks, find_slips
