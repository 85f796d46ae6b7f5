"""Judge the motion of a run: where only friction acts, the friction force there, events, and what was slid before."""

from frictrack.friction.events import after_run, find_events, with_earlier_runs
from frictrack.friction.force import (
    MIN_MOTION_SIGMAS,
    MIN_MOVING_SIGMAS,
    free_section,
    friction,
    impact,
    is_motion,
    is_moving,
    join_swings,
    moving_sections,
    release_time,
    split_by_direction,
)

__all__ = [
    "MIN_MOTION_SIGMAS",
    "MIN_MOVING_SIGMAS",
    "after_run",
    "find_events",
    "free_section",
    "friction",
    "impact",
    "is_motion",
    "is_moving",
    "join_swings",
    "moving_sections",
    "release_time",
    "split_by_direction",
    "with_earlier_runs",
]
