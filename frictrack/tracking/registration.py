"""Register the targets of two films, so that positions along the course refer to the same point of the same body.

Every film finds its target by itself, and the rectangle may differ by a pixel. The averaged pictures of the two targets
show by how much.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import shift

from frictrack.records import Array, Track
from frictrack.tracking.correlation import correlate

MAX_OFFSET_SHARE = 0.25  # of the target's sides
MIN_SAME_BODY_SCORE = 0.8  # correlation of two pictures of the same body
MIN_CORRECTION_PX = 0.02  # a smaller offset is not corrected
MIN_CORE_PX = 12  # shortest side of the compared part
MAX_STEPS = 8  # of Gauss-Newton


@dataclass(frozen=True)
class TargetOffset:
    """Offset from the centre of one target's picture to the centre of the other's, with its error, px."""

    dx: float
    dy: float
    sigma_x: float
    sigma_y: float


def align_track(track: Track, reference: Track, name: str = "the reference") -> Track:
    """Move a track to the point of the body that a reference track follows.

    Parameters
    ----------
    track, reference : Track
        Tracks with the pictures of their targets.
    name : str
        What the notes call the reference.

    Returns
    -------
    Track
        With a note of what was done; unchanged, with a note, where the pictures do not show the same body.

    Examples
    --------
    >>> import frictrack as ft
    >>> film = ft.open_recording(ft.samples.films_folder() / "fast.avi")
    >>> track = ft.track(film)
    >>> aligned = ft.align_track(track, track)
    >>> bool(abs(aligned.x_px - track.x_px)[:140].max() < 0.01)
    True

    """
    found = target_offset(track.picture, reference.picture)
    if found is None:
        note = (
            f"its target does not look like that of {name}: it has an origin of its own along the course, which agrees "
            "with the other only as well as the two rectangles do, about a pixel; x_offset corrects it"
        )
        return replace(track, notes=(*track.notes, note))
    if np.hypot(found.dx, found.dy) < max(MIN_CORRECTION_PX, 2 * np.hypot(found.sigma_x, found.sigma_y)):
        return track
    note = (
        f"tracked point moved by ({found.dx:+.3f} +/- {found.sigma_x:.3f}, {found.dy:+.3f} +/- {found.sigma_y:.3f}) px "
        f"to that of {name}"
    )
    return replace(track, x_px=track.x_px + found.dx, y_px=track.y_px + found.dy, notes=(*track.notes, note))


def target_offset(picture: Array | None, reference: Array | None) -> TargetOffset | None:
    """Measure the offset between two pictures of the same body.

    The middle of one picture is located in the other by cross-correlation, then refined by Gauss-Newton on the grey
    values
    with free gain and offset.

    Parameters
    ----------
    picture, reference : array (h, w) or None
        Averaged pictures of the targets, DN.

    Returns
    -------
    TargetOffset or None
        None where they do not show the same body or are too small.

    """
    if picture is None or reference is None:
        return None
    edge = np.maximum((MAX_OFFSET_SHARE * np.array(picture.shape)).astype(int), 1)
    core = picture[edge[0] : -edge[0], edge[1] : -edge[1]].astype(np.float32)
    reference_image = reference.astype(np.float32)
    if min(core.shape) < MIN_CORE_PX or np.any(np.array(reference_image.shape) < np.array(core.shape) + 2):
        return None
    _, score, _, corner = cv2.minMaxLoc(correlate(reference_image, core))
    if score < MIN_SAME_BODY_SCORE:
        return None
    at, sigma = _refine_corner(core, reference_image, np.array(corner, dtype=np.float64))
    # The core has the same centre as the picture from which it was cut.
    middle = at + 0.5 * (np.array(core.shape[::-1]) - 1)
    centre_offset = 0.5 * (np.array(reference_image.shape[::-1]) - 1) - middle
    return TargetOffset(float(centre_offset[0]), float(centre_offset[1]), float(sigma[0]), float(sigma[1]))


def _refine_corner(core: NDArray[np.float32], reference_image: NDArray[np.float32], at: Array) -> tuple[Array, Array]:
    """Corner (x, y) px of the core in the reference image, and its standard deviation."""
    shape = (core.shape[0], core.shape[1])
    gy, gx = np.gradient(core)
    design = np.stack([gx, gy, core - core.mean(), np.ones(shape)], axis=2).reshape(-1, 4).astype(np.float64)
    inverse = np.linalg.pinv(design.T @ design)
    start, residuals = at.copy(), np.zeros(design.shape[0])
    for _ in range(MAX_STEPS):
        # Shift the reference such that the point `at` comes to the origin; OpenCV shifts by 1/32 px only.
        shifted = shift(reference_image, -at[::-1], order=5, mode="nearest")[: shape[0], : shape[1]].ravel()
        solution = inverse @ (design.T @ shifted)
        residuals = shifted - design @ solution
        # The reference read at `at` is the core shifted by -step, with its own gain and offset.
        step = solution[:2] / max(float(solution[2]), 1e-3)
        at = np.clip(at - step, start - 1.5, start + 1.5)
        if np.max(np.abs(step)) < 1e-3:
            break
    noise = float(residuals @ residuals) / max(len(residuals) - 4, 1)
    return at, np.sqrt(noise * np.diag(inverse)[:2]) / max(float(solution[2]), 1e-3)
