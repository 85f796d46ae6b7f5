"""Find a fixed reference: a static patch that separates camera shake from the motion of the body."""

from __future__ import annotations

import cv2
import numpy as np

from frictrack.base.distributions import MEDIAN_TO_SIGMA
from frictrack.recording import Recording
from frictrack.records import Array, Mask, Track
from frictrack.tracking.correlation import Rectangle
from frictrack.tracking.detection.sampled_scene import Picture, SampledScene, light_ratio, read_subpixel, sample_scene
from frictrack.tracking.detection.small_motion import moving_cells

N_FRAMES = 9  # of which the static picture is the median
PATCH_SIZES_PX = (  # h, w px; where the body sweeps past, only narrow strips are left
    *((64, 128), (48, 96), (32, 96), (32, 48), (24, 24)),
    *((24, 192), (16, 256), (12, 256), (16, 128), (16, 64), (12, 48)),
)
MAX_SIGMA_PX = 0.05  # standard deviation above which a reference is useless
MAX_SIGMA_RATIO = 2.0  # to the best patch, for a patch below the path, on the course
MAX_SHAKE_ERROR_PX = 0.2  # of the estimated shake
MIN_CHANGE_SIGMAS = 5.0  # standard deviations beyond which a pixel has changed


def find_reference(recording: Recording, track: Track) -> Rectangle | None:
    """Find the patch that can be tracked best as a fixed reference.

    Nothing ever moves in it, and the target never covers it. Patches below the target's path, on the course, are
    preferred
    if they are nearly as good. The precision is the Cramer-Rao bound of a shift, from the gradients of the picture.

    Parameters
    ----------
    recording : Recording
        Film.
    track : Track
        Track of the target.

    Returns
    -------
    tuple of int or None
        x, y, w, h in px; None where no patch reaches `MAX_SIGMA_PX` on both axes in a single frame.

    """
    if track.target is None:
        return None
    scene = sample_scene(recording)
    still, noise, excluded = _static_picture(scene)
    excluded |= _covered_by_target(track, recording.shape) | moving_cells(scene)
    margin = 2 + int(np.ceil(np.max(np.abs(scene.shake)) * scene.factor))
    excluded[:margin], excluded[-margin:], excluded[:, :margin], excluded[:, -margin:] = True, True, True, True
    foot = float(np.nanmax(track.y_px) + 0.25 * track.target[3])
    return _choose_patch(_patch_sigmas(still, noise, excluded), max(int(np.ceil(foot)), 0))


def _static_picture(scene: SampledScene) -> tuple[Picture, Picture, Mask]:
    """Static picture at full size, noise of a frame (h, w), and where anything ever moved."""
    rows = np.unique(np.linspace(0, len(scene.frames) - 1, N_FRAMES).astype(int))
    shape = (scene.frames[0].shape[0], scene.frames[0].shape[1])
    frames = [scene.frames[k].astype(np.float32) for k in rows]
    if scene.shake.any():
        frames = [read_subpixel(scene.frames[k], scene.shake[k] * scene.factor, shape) for k in rows]
    still = np.median(np.stack(frames), axis=0).astype(np.float32)
    away = np.abs(np.stack([frame - light_ratio(frame, still) * still for frame in frames]))
    # Bright parts are noisier than dark ones, and saturated pixels have no noise.
    noise = np.maximum(MEDIAN_TO_SIGMA * cv2.blur(np.median(away, axis=0), (15, 15)), 0.3)
    slope = np.hypot(*np.gradient(still)) if scene.shake.any() else 0.0
    moved = cv2.blur(away.max(axis=0) - MAX_SHAKE_ERROR_PX * slope, (3, 3)) > MIN_CHANGE_SIGMAS * noise
    for mask in scene.foreground:
        small = cv2.resize(mask.astype(np.uint8), shape[::-1], interpolation=cv2.INTER_NEAREST)
        moved |= np.asarray(small) > 0
    return still, np.asarray(noise, dtype=np.float32), np.asarray(moved)


def _covered_by_target(track: Track, shape: tuple[int, int]) -> Mask:
    """Pixels that the target's rectangle, somewhat enlarged, ever covered."""
    assert track.target is not None
    size = np.array(track.target[2:])
    centre = np.stack([track.x_px, track.y_px], axis=1)[track.found]
    limit = np.array(shape[::-1])
    low = np.clip(np.floor(centre - 0.7 * size), 0, limit).astype(int)
    high = np.clip(np.ceil(centre + 0.7 * size) + 1, 0, limit).astype(int)
    corners = np.zeros((shape[0] + 1, shape[1] + 1))
    np.add.at(corners, (low[:, 1], low[:, 0]), 1)
    np.add.at(corners, (high[:, 1], high[:, 0]), 1)
    np.add.at(corners, (low[:, 1], high[:, 0]), -1)
    np.add.at(corners, (high[:, 1], low[:, 0]), -1)
    return np.asarray(np.cumsum(np.cumsum(corners, axis=0), axis=1)[:-1, :-1] > 0)


def _patch_sigmas(still: Picture, noise: Picture, excluded: Mask) -> dict[tuple[int, int], Array]:
    """For each patch size the Cramer-Rao bound on the worse axis at every corner, px; inf where excluded."""
    smooth = cv2.GaussianBlur(still, (0, 0), 0.7)
    gy, gx = (np.asarray(g / noise, dtype=np.float64) for g in np.gradient(smooth))
    found = {}
    for h, w in PATCH_SIZES_PX:
        if h + 4 > still.shape[0] or w + 4 > still.shape[1]:
            continue
        xx, yy, xy, blocked = (_box_sums(p, (h, w)) for p in (gx * gx, gy * gy, gx * gy, excluded.astype(np.float64)))
        weakest = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy**2)
        # The gradient of the noise that remains in the median is no texture.
        weakest -= 0.1 * h * w
        found[h, w] = np.where((blocked < 0.5) & (weakest > 0), 1 / np.sqrt(np.maximum(weakest, 1e-9)), np.inf)
    return found


def _box_sums(values: Array, size: tuple[int, int]) -> Array:
    """Sums over patches of `size` (h, w) with their corner at each pixel."""
    total = cv2.integral(values)
    h, w = size
    return np.asarray(total[h:, w:] - total[:-h, w:] - total[h:, :-w] + total[:-h, :-w])


def _choose_patch(found: dict[tuple[int, int], Array], foot: int) -> Rectangle | None:
    """Patch with the smallest standard deviation; one below row `foot` if it is nearly as good."""
    best, anywhere = _best_patch(found, 0)
    if best > MAX_SIGMA_PX:
        return None
    sigma, below = _best_patch(found, foot)
    return below if sigma <= min(MAX_SIGMA_RATIO * best, MAX_SIGMA_PX) else anywhere


def _best_patch(found: dict[tuple[int, int], Array], first_row: int) -> tuple[float, Rectangle]:
    """Smallest standard deviation of the patches from a row on, and that patch; infinite without any."""
    best, patch = np.inf, (0, 0, 0, 0)
    for (h, w), sigma in found.items():
        part = sigma[first_row:]
        if part.size and part.min() < best:
            y, x = np.unravel_index(int(np.argmin(part)), part.shape)
            best, patch = float(part.min()), (int(x), int(y) + first_row, w, h)
    return best, patch
