"""What the track itself says about the measurement, in words."""

from __future__ import annotations

import numpy as np

from frictrack.records import Array

PERIODS = range(5, 301)
LEAST_REPEATS = 6
SIGNIFICANT = 6.0  # standard errors above every other phase; the search covers some 10^4 phases


def key_frame_jumps(x: Array, y: Array) -> tuple[str, ...]:
    """A note when positions (n,) px jump once every so many frames, as the key frames of a codec make them.

    A jump stands out in two neighbouring second differences of one phase of the period; a vibration of the
    target raises many phases, so a phase must stand out from all the others.
    """
    bend = np.hypot(np.diff(x, 2), np.diff(y, 2))
    known = np.isfinite(bend)
    if np.count_nonzero(known) < 2 * LEAST_REPEATS:
        return ()
    clipped = np.minimum(bend, 6 * np.median(bend[known]))  # one collision must not make a period
    pairs = 0.5 * (clipped[:-1] + clipped[1:])
    best = max(((_standing_out(pairs, period), -period) for period in PERIODS), default=(0.0, 0))
    if best[0] < SIGNIFICANT:
        return ()
    return (f"positions jump every {-best[1]}th frame (key frames of the codec)",)


def _standing_out(values: Array, period: int) -> float:
    """How many standard errors the highest phase of `period` lies above the next that is no neighbour."""
    rows = len(values) // period
    if rows < LEAST_REPEATS:
        return 0.0
    folded = values[: rows * period].reshape(rows, period)
    count = np.sum(np.isfinite(folded), axis=0)
    if np.any(count < LEAST_REPEATS):
        return 0.0
    mean, error = np.nanmean(folded, axis=0), np.nanstd(folded, axis=0) / np.sqrt(count)
    top = int(np.argmax(mean))
    distance = np.abs(np.arange(period) - top)
    others = np.minimum(distance, period - distance) > 1
    rival = int(np.argmax(np.where(others, mean, -np.inf)))
    return float((mean[top] - mean[rival]) / max(np.hypot(error[top], error[rival]), 1e-12))
