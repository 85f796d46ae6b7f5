"""What the film and the track say about the measurement, in words."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from frictrack.records import Array

PERIODS = range(5, 301)
LEAST_REPEATS = 6
SIGNIFICANT = 6.0  # standard errors above every other phase; the search covers some 10^4 phases


def key_frames(change: Array, x: Array, y: Array) -> tuple[str, ...]:
    """A note on the key frames of a codec: every so many frames the whole picture is coded anew.

    `change` (n,) is how much each picture differs from the one before, x and y (n,) the track in px. The note
    says whether the positions jump with the picture.
    """
    known = np.nan_to_num(change, nan=float(np.nanmedian(change)))
    excess = known - median_filter(known, size=9)  # what stands out of its neighbours, whatever else goes on
    significance, minus_period = max((_standing_out(excess, p), -p) for p in PERIODS)
    if significance < SIGNIFICANT:
        return ()
    period = -minus_period
    phase = int(np.nanargmax(_fold_mean(excess, period)))
    jump, error = _jump(x, y, np.arange(phase, len(x), period))
    every = f"every {period}th frame (key frames of the codec)"
    if np.isnan(jump):
        return (f"the picture jumps {every}",)
    if jump > 3 * error:
        return (f"positions jump by {jump:.3f} px {every}",)
    return (f"the picture jumps {every}; positions jump with it by less than {jump + 2 * error:.3f} px",)


def _jump(x: Array, y: Array, at: np.ndarray) -> tuple[float, float]:
    """Median step of the track on entering the frames `at`, and its standard error, px."""
    at = at[(at >= 2) & (at < len(x) - 1)]
    # A step of 1 between two frames leaves 2/3 after the mean slope of the frames around is taken off.
    steps = np.stack([1.5 * (q[at] - q[at - 1] - (q[at + 1] - q[at - 2]) / 3) for q in (x, y)])
    steps = steps[:, np.all(np.isfinite(steps), axis=0)]
    if steps.shape[1] < LEAST_REPEATS:
        return np.nan, np.nan
    middle = np.median(steps, axis=1)  # a bump or a bad frame must not make a jump
    spread = 1.4826 * np.median(np.abs(steps - middle[:, None]), axis=1)
    error = 1.2533 * spread / np.sqrt(steps.shape[1])
    return float(np.hypot(*middle)), float(np.hypot(*error))


def _standing_out(values: Array, period: int) -> float:
    """How many standard errors the highest phase of `period` lies above every other.

    A vibration or a beat of the light raises many phases; a codec's key frames raise one.
    """
    rows = len(values) // period
    if rows < LEAST_REPEATS:
        return 0.0
    folded = values[1 : 1 + (rows - 1) * period].reshape(rows - 1, period)
    ceiling = 6 * np.median(np.max(folded, axis=1))  # one flash must not make a period
    folded = np.minimum(folded, max(ceiling, 0.0))
    mean, error = folded.mean(axis=0), folded.std(axis=0) / np.sqrt(rows - 1)
    top, rival = np.argsort(mean)[[-1, -2]]
    return float((mean[top] - mean[rival]) / max(np.hypot(error[top], error[rival]), 1e-12))


def _fold_mean(values: Array, period: int) -> Array:
    """Mean of the values at each phase (period,), phases counted from the first value."""
    return np.array([np.nanmean(values[phase::period]) for phase in range(period)])
