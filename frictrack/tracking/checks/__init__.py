"""Check a track: peak locking, match scores, backward tracking, motion, interlacing, faults of the time base."""

from frictrack.tracking.checks.interlacing import interlacing_note
from frictrack.tracking.checks.motion_test import at_rest, moves_with
from frictrack.tracking.checks.self_tests import forward_backward, key_frame_notes, peak_locking, scores, self_test
from frictrack.tracking.checks.timing import correct_ticks, slips, timing_note

__all__ = [
    "at_rest",
    "correct_ticks",
    "forward_backward",
    "interlacing_note",
    "key_frame_notes",
    "moves_with",
    "peak_locking",
    "scores",
    "self_test",
    "slips",
    "timing_note",
]
