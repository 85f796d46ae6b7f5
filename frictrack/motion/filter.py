"""The stage displacement -> low-passed displacement."""

from __future__ import annotations

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.motion.grid import Grid, frame_grid
from frictrack.motion.smoother import best_cutoff, noise_variance, penalty, smooth, weights
from frictrack.records import Array, Displacement, Filtered, Mask

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
    x, sigma_x, cutoff_x = _low_pass_one(displacement.x, displacement.sigma_x, known, grid, cutoff)
    y = sigma_y = np.full(len(x), np.nan)
    cutoff_y = float("nan")
    known_y = displacement.valid & np.isfinite(displacement.y)
    if np.sum(known_y) >= MIN_FRAMES:
        y, sigma_y, cutoff_y = _low_pass_one(displacement.y, displacement.sigma_y, known_y, grid, cutoff)
    reason = f"cut-off {cutoff_x:.3g} Hz " + ("by maximum likelihood" if cutoff is None else "as given")
    return Filtered(displacement.t, x, y, sigma_x, sigma_y, cutoff_x, cutoff_y, reason)


def _low_pass_one(y: Array, sigma: Array, known: Mask, grid: Grid, cutoff: float | None) -> tuple[Array, Array, float]:
    """Low-pass one coordinate: smoothed rows, the noise of each row (inf where missing), the cut-off."""
    w = grid.spread(weights(sigma, known))
    full = grid.spread(np.where(known, y, 0.0))
    best = best_cutoff(full, w, grid.interval)
    noise = np.sqrt(noise_variance(full, w, penalty(best, grid.interval)))  # no cut-off given may raise it
    cutoff = best if cutoff is None else cutoff
    with np.errstate(divide="ignore"):
        sigma_rows = noise / np.sqrt(w[grid.frames])
    return smooth(full, w, penalty(cutoff, grid.interval))[grid.frames], sigma_rows, cutoff


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
