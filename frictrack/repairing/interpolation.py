"""Bridge frames of a track by its smoothed motion, with standard deviations that grow with the gap."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.motion import differentiate, low_pass
from frictrack.records import MEASURED, Array, Displacement, Track
from frictrack.repairs import Repair

MIN_CONTEXT_FRAMES = 200  # to either side of the gap, from which the motion is smoothed
MIN_SIDE_FRAMES = 3  # that must be measured before and after a gap


def interpolated(track: Track, one: Repair) -> Track:
    """Bridge the frames of one repair by the smoothed motion of the frames around.

    Parameters
    ----------
    track : Track
        Track in which the frames of the repair are lost.
    one : Repair
        Repair with how = "interpolate".

    Returns
    -------
    Track
        With positions and standard deviations in these frames.

    Raises
    ------
    FrictrackError
        Where the target is not measured on both sides of the frames.

    """
    before, after = (np.flatnonzero(track.found[part]) for part in (slice(0, one.first), slice(one.last + 1, None)))
    if min(len(before), len(after)) < MIN_SIDE_FRAMES:
        raise FrictrackError(
            f"expected measured frames before and after the interpolated {one.frames_text} but there are "
            f'{len(before)} and {len(after)}; use how = "leave_out" at the ends of a film'
        )
    reach = max(MIN_CONTEXT_FRAMES, 4 * (one.last + 1 - one.first))
    start, stop = max(0, one.first - reach), min(len(track), one.last + 1 + reach)
    around, gap = track.rows(slice(start, stop)), slice(one.first - start, one.last + 1 - start)
    rows = slice(one.first, one.last + 1)
    columns: dict[str, Any] = {name: np.array(q) for name in MEASURED if (q := getattr(track, name)) is not None}
    for name, sigma in (("x_px", "sigma_px"), ("y_px", "sigma_y_px")):
        columns[name][rows], columns[sigma][rows] = _bridge(around, name, sigma, gap)
    known = track.found & np.isfinite(track.angle)
    columns["angle"][rows] = np.interp(track.t[rows], track.t[known], track.angle[known])
    if (sigma_angle := columns.get("sigma_angle")) is not None:
        turn = np.ptp(track.angle[known & _near(one, len(track))])
        sigma_angle[rows] = np.hypot(np.nanmedian(track.sigma_angle[known]), turn)  # type: ignore[index]
    return replace(track, **columns)


def _near(one: Repair, n: int) -> np.ndarray:
    """Frames (n,) next to a gap, as many on either side as it is long."""
    length = one.last + 1 - one.first
    frames = np.arange(n)
    return np.asarray((frames >= one.first - length) & (frames <= one.last + length))


def _bridge(track: Track, name: str, sigma: str, gap: slice) -> tuple[Array, Array]:
    """Positions and standard deviations in a gap along one axis of the picture, px."""
    nan = np.full(len(track), np.nan)
    known, values = track.found, getattr(track, name)
    if np.ptp(values[known]) == 0:  # a smoother has nothing to smooth
        return np.full(len(values[gap]), values[known][0]), np.full(
            len(values[gap]), np.nanmedian(getattr(track, sigma))
        )
    # The smoother counts in any unit; it only sees measured frames.
    course = Displacement(track.t, np.where(known, values, np.nan), nan, nan, getattr(track, sigma), nan, known)
    first = int(np.flatnonzero(known)[0])
    motion = differentiate(low_pass(course))
    inside = slice(gap.start - first, gap.stop - first)
    return motion.x[inside], np.hypot(motion.sigma_x[inside], track.systematic)  # which no smoother averages out
