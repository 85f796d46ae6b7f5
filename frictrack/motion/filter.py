"""The stage displacement -> low-passed displacement."""

from __future__ import annotations

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.motion.grid import Grid, frame_grid
from frictrack.motion.smoother import MISSING, best_cutoff, noise_variance, penalty, smooth, weights
from frictrack.records import Array, Displacement, Filtered, Mask

TOO_LOW = 0.7  # of the cut-off of the highest likelihood: one below it loses more than the deviations say
MIN_FRAMES = 8  # valid frames below which neither noise nor cut-off can be estimated


def low_pass(displacement: Displacement, cutoff: float | None = None) -> Filtered:
    """Low-pass a displacement and bridge its missing frames.

    `cutoff` (Hz) is where a sine keeps half of its amplitude. Without it, x and y each get the cut-off of
    the highest restricted likelihood. The noise level is estimated along with it; the standard deviations
    that come with the displacement count relative to each other.

    Raises FrictrackError for too few valid frames, a position that never changes, uneven time stamps, and a
    cut-off that is not between 0 and half the frame rate.
    """
    grid = frame_grid(displacement.t)
    known = displacement.valid & np.isfinite(displacement.x)
    _check_position(displacement.x[known], len(known))
    _check_cutoff(cutoff, grid)
    x, sigma_x, cutoff_x, reason = _low_pass_one(displacement.x, displacement.sigma_x, known, grid, cutoff)
    y = sigma_y = np.full(len(x), np.nan)
    cutoff_y = float("nan")
    known = displacement.valid & np.isfinite(displacement.y)
    if np.sum(known) >= MIN_FRAMES:
        y, sigma_y, cutoff_y, _ = _low_pass_one(displacement.y, displacement.sigma_y, known, grid, cutoff)
    return Filtered(displacement.t, x, y, sigma_x, sigma_y, cutoff_x, cutoff_y, reason)


def _low_pass_one(
    y: Array, sigma: Array, known: Mask, grid: Grid, cutoff: float | None
) -> tuple[Array, Array, float, str]:
    """Low-pass one coordinate: smoothed rows, the noise of each row, the cut-off and why it is this."""
    w = grid.spread(weights(sigma, known))
    full = grid.spread(np.where(known, y, 0.0))
    best = best_cutoff(full, w, grid.interval)
    level = np.sqrt(noise_variance(full, w, penalty(best, grid.interval)))  # whatever cut-off is given
    sigma_rows = np.full(len(y), MISSING)
    sigma_rows[known] = level / np.sqrt(w[grid.frames][known])
    used = best if cutoff is None else cutoff
    x = smooth(full, w, penalty(used, grid.interval))[grid.frames]
    return x, sigma_rows, used, _reason(used, best)


def _reason(used: float, best: float) -> str:
    if used == best:
        return f"cut-off {used:.3g} Hz by maximum likelihood"
    reason = f"cut-off {used:.3g} Hz as given"
    if used < TOO_LOW * best:
        reason += f", maximum likelihood would take {best:.3g} Hz: the deviations do not cover the signal lost"
    return reason


def _check_position(x: Array, n: int) -> None:
    if len(x) < MIN_FRAMES:
        raise FrictrackError(
            f"displacement: expected at least {MIN_FRAMES} valid frames but got {len(x)} of {n}; "
            "check that the target was found"
        )
    if np.all(x == x[0]):
        raise FrictrackError(
            f"displacement: expected a moving target but x is {x[0]:g} m in all {len(x)} valid frames; "
            "check which target was tracked"
        )


def _check_cutoff(cutoff: float | None, grid: Grid) -> None:
    nyquist = 0.5 / grid.interval
    if cutoff is not None and not 0.0 < cutoff < nyquist:
        raise FrictrackError(
            f"cutoff: expected a frequency between 0 and half the frame rate, {nyquist:g} Hz, but got "
            f"{cutoff:g} Hz; leave it out to have it chosen from the data"
        )
