"""Repair frames of a film in which the target was tracked wrongly or lost, and find the frames to look at.

repaired_track  `repair`: all repairs of a track
retracking      track the target again in some frames, with the template of the whole film
interpolation   bridge frames by the smoothed motion, with standard deviations
suspects        spans of frames that a user should look at
"""

from frictrack.repairing.repaired_track import repair, repaired_rows
from frictrack.repairing.suspects import SuspectSpan, suspect_spans

__all__ = ["SuspectSpan", "repair", "repaired_rows", "suspect_spans"]
