"""What a run says of its own measurement: peak locking, scores, backward tracking, faults of the time base."""

from frictrack.tracking.checks.findings import forward_backward, key_frames, peak_locking, scores, self_test
from frictrack.tracking.checks.timing import corrected, slips, timing_note

__all__ = [
    "corrected",
    "forward_backward",
    "key_frames",
    "peak_locking",
    "scores",
    "self_test",
    "slips",
    "timing_note",
]
