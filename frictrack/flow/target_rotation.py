"""Report that a target rotates, if its angle shows it beyond the noise of its position."""

from __future__ import annotations

import numpy as np

from frictrack.calibration import MIN_ROTATION
from frictrack.records import Array, Mask, Track

WINDOW_FRAMES = 9  # over which an angle is averaged
MIN_FRAMES = 3 * WINDOW_FRAMES  # frames with an angle that can show a turn
MIN_SIGMAS = 5.0  # by which the rotation must exceed its standard deviation


def rotation_note(track: Track) -> tuple[str, ...]:
    """Return a note on a target that rotates; empty if it does not.

    A rotation counts if it moves the corners of the target by five standard deviations of its position.

    Parameters
    ----------
    track
        Positions and angles of the target.

    Returns
    -------
    tuple of str
        At most one sentence.

    """
    known = track.found & np.isfinite(track.angle)
    if track.target is None or np.count_nonzero(known) < MIN_FRAMES:
        return ()
    angle = np.unwrap(track.angle[known])
    mean = _running_mean(angle)
    arm = float(np.hypot(*track.target[2:])) / 2
    place = float(np.median(track.sigma_px[known])) / arm
    if np.ptp(mean) < MIN_SIGMAS * max(_range_std(track, angle, known, mean), place):
        return ()
    degrees = float(np.degrees(np.ptp(angle)))
    rate = float(np.degrees(np.max(np.abs(mean[WINDOW_FRAMES:] - mean[:-WINDOW_FRAMES])))) / WINDOW_FRAMES
    written = f"{degrees:.3g}" if degrees < 100 else f"{degrees:.0f}"
    rocks = "; its middle is followed, and a centre of mass elsewhere moves along another path"
    turns = f"the target turns by {written} deg, up to {rate:.2g} deg a frame"
    return (turns + (rocks if np.ptp(angle) < MIN_ROTATION else ""),)


def _range_std(track: Track, angle: Array, known: Mask, mean: Array) -> float:
    """Return the standard deviation of the range of the averaged angle, rad.

    The stated deviation is scaled to the scatter of neighbouring frames: a target that is half hidden has a poor angle.
    """
    sigma = np.ones(len(track.angle)) if track.sigma_angle is None else track.sigma_angle
    sigma = np.where(np.isfinite(sigma) & (sigma > 0), sigma, np.inf)[known]
    curvature = np.diff(angle, 2)
    expected = sigma[:-2] ** 2 + 4 * sigma[1:-1] ** 2 + sigma[2:] ** 2
    unit = np.mean(np.where(np.isfinite(expected), curvature**2 / expected, 0.0))
    doubt = np.sqrt(unit * _running_mean(sigma**2) / WINDOW_FRAMES)
    return float(np.hypot(doubt[np.argmax(mean)], doubt[np.argmin(mean)]))


def _running_mean(angle: Array) -> Array:
    """Return the running mean (n - `WINDOW_FRAMES` + 1,) of angles (n,)."""
    return np.convolve(angle, np.full(WINDOW_FRAMES, 1.0 / WINDOW_FRAMES), mode="valid")
