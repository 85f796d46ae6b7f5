"""Say that a target turns, and how fast, where its angle shows it beyond the noise of its place."""

from __future__ import annotations

import numpy as np

from frictrack.calibration.straight import LARGE
from frictrack.records import Array, Track

SPAN = 9  # frames over which an angle is averaged
FEWEST = 3 * SPAN  # frames with an angle that can show a turn
CLEAR = 5.0  # standard deviations


def turning_note(track: Track) -> tuple[str, ...]:
    """Return a finding on a target that turns; none where nothing stands out.

    Parameters
    ----------
    track
        Places and angles of the target. A turn counts that moves its corners by five deviations of its place.

    Returns
    -------
    tuple of str
        At most one sentence.

    """
    known = track.found & np.isfinite(track.angle)
    if track.target is None or np.count_nonzero(known) < FEWEST:
        return ()
    angle = np.unwrap(track.angle[known])
    mean = _averaged(angle)
    noise = float(np.sqrt(np.mean(np.diff(angle, 2) ** 2) / 6.0 / SPAN))
    arm = float(np.hypot(*track.target[2:])) / 2
    if np.ptp(mean) < CLEAR * max(noise, float(np.median(track.sigma_px[known])) / arm):
        return ()
    degrees = float(np.degrees(np.ptp(angle)))
    rate = float(np.degrees(np.max(np.abs(mean[SPAN:] - mean[:-SPAN])))) / SPAN
    written = f"{degrees:.3g}" if degrees < 100 else f"{degrees:.0f}"
    rocks = "; its middle is followed, and a centre of mass elsewhere moves along another path"
    turns = f"the target turns by {written} deg, up to {rate:.2g} deg a frame"
    return (turns + (rocks if np.ptp(angle) < LARGE else ""),)


def _averaged(angle: Array) -> Array:
    """Running means (n - `SPAN` + 1,) of angles (n,)."""
    return np.convolve(angle, np.full(SPAN, 1.0 / SPAN), mode="valid")
