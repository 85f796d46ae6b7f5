"""Find doubled and missing frames of a track from its motion, where no time stamps show them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from frictrack.records import Track
from frictrack.sampling import SampledPath, Slip, correct_ticks, describe_frames, find_slips, frame_numbers

__all__ = ["Slip", "correct_ticks", "slips", "timing_note"]

MIN_JUMP_PX = 0.1  # errors of the tracker may be as large
MIN_SIGMA_PX = 1e-4  # no track is more accurate


def slips(track: Track) -> tuple[Slip, ...]:
    """Find doubled and missing frames of a track.

    Parameters
    ----------
    track : Track
        Track of the target.

    Returns
    -------
    tuple of Slip
        In order; empty where the target is too slow.

    """
    return find_slips(_main_direction(track))


def timing_note(found: Sequence[Slip]) -> tuple[str, ...]:
    """Describe doubled and missing frames.

    Parameters
    ----------
    found : sequence of Slip
        Faults of the time base.

    Returns
    -------
    tuple of str
        At most one note on doubled and one on missing frames.

    """
    doubled = [s.frame for s in found if s.doubled]
    missing = [s for s in found if not s.doubled]
    notes = []
    if doubled:
        notes.append(
            f"{_count_frames(len(doubled), 'frame')} doubled, found from the motion: {describe_frames(doubled)}"
        )
    if missing:
        total = sum(s.frames for s in missing)
        notes.append(
            f"{_count_frames(total, 'frame')} missing, found from the motion: "
            f"before {describe_frames([s.frame for s in missing])}"
        )
    return tuple(notes)


def _count_frames(n: int, what: str) -> str:
    return f"{n} {what} is" if n == 1 else f"{n} {what}s are"


def _main_direction(track: Track) -> SampledPath:
    """The track along the line on which it moves most."""
    found = track.found & np.isfinite(track.y_px) & np.isfinite(track.sigma_px)
    at = np.stack([track.x_px, track.y_px], axis=1)
    if not found.any():
        return SampledPath(at[:, 0], at[:, 0], np.arange(len(at)), found, MIN_JUMP_PX)
    _, _, axes = np.linalg.svd(at[found] - at[found].mean(axis=0), full_matrices=False)
    sigma = np.hypot(axes[0, 0] * track.sigma_px, axes[0, 1] * track.sigma_y_px)
    ticks = frame_numbers(track.t).astype(np.int64)
    return SampledPath(at @ axes[0], np.maximum(sigma, MIN_SIGMA_PX), ticks, found, MIN_JUMP_PX)
