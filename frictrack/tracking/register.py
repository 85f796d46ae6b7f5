"""The same point of the same body in another film: without it, places along the course would not agree.

Every film finds its target by itself, and the rectangle may sit a pixel further left. The averaged pictures of
the two targets tell by how much.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from frictrack.records import Array, Track

BORDER = 8  # px left out round the picture that is looked for: the furthest that two rectangles may differ
SAME_BODY = 0.8  # correlation below which the two bodies are taken for different ones


def aligned(track: Track, reference: Track) -> Track:
    """The track moved to the point of the body that `reference` follows, with a note of what was done.

    Unchanged, with a note, where the two pictures do not show the same body.
    """
    found = _offset(track.picture, reference.picture)
    if found is None:
        note = f"its target does not look like the first run's: places along the course agree to {BORDER} px only"
        return replace(track, notes=(*track.notes, note))
    dx, dy = found
    if np.hypot(dx, dy) < 0.02:
        return track
    note = f"tracked point moved by ({dx:+.2f}, {dy:+.2f}) px to that of the first run"
    return replace(track, x_px=track.x_px + dx, y_px=track.y_px + dy, notes=(*track.notes, note))


def _offset(picture: Array | None, reference: Array | None) -> tuple[float, float] | None:
    """From the centre of one target's picture to the point that is the centre of the other's, px."""
    if picture is None or reference is None or min(picture.shape) < 3 * BORDER:
        return None
    core = picture[BORDER:-BORDER, BORDER:-BORDER].astype(np.float32)
    if reference.shape[0] < core.shape[0] + 2 or reference.shape[1] < core.shape[1] + 2:
        return None
    match = np.asarray(cv2.matchTemplate(reference.astype(np.float32), core, cv2.TM_CCOEFF_NORMED), dtype=np.float64)
    row, col = np.unravel_index(int(np.argmax(match)), match.shape)
    if match[row, col] < SAME_BODY:
        return None
    at_x, at_y = col + _peak(match[row, :], int(col)), row + _peak(match[:, col], int(row))
    centre = [(s - 1) / 2 for s in picture.shape]
    wanted = [(s - 1) / 2 for s in reference.shape]
    return wanted[1] - (at_x - BORDER) - centre[1], wanted[0] - (at_y - BORDER) - centre[0]


def _peak(line: Array, i: int) -> float:
    """Top of the parabola through the best match and its neighbours, from the best match."""
    if not 0 < i < len(line) - 1:
        return 0.0
    left, top, right = (float(v) for v in line[i - 1 : i + 2])
    return 0.5 * (left - right) / (left - 2 * top + right)
