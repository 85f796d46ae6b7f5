"""Find patches of a picture: those that move by less than a pixel, and a static one as a fixed reference.

For a motion u that is small against the texture, frame k differs from the mean picture R of the frames by

    I_k - R = -u_k . grad R + a_k R + b_k + noise        a_k, b_k: light of the window

and u_k is least squares in each window (Lucas & Kanade 1981, Proc. IJCAI, p. 674). A window moves where the motions of
all frames explain more than noise would (F test). All sums are taken over small cells once, so that any window costs a
few additions. A reference separates camera shake from the motion of the body.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from frictrack.base.distributions import MEDIAN_TO_SIGMA, f_isf
from frictrack.recording import Recording
from frictrack.records import Array, Mask, Track
from frictrack.tracking.correlation import Rectangle
from frictrack.tracking.detection.sampled_scene import Picture, SampledScene, light_ratio, read_subpixel, sample_scene

MIN_CELL_PX, MAX_CELLS = 4, 16_000  # smallest side of a cell, and largest number of cells in the picture
SMOOTHING_PX = 0.7  # blur of the mean picture before its gradient is taken
WINDOW_SIDES = 4, 6, 8, 12, 16, 24, 32  # cells
WINDOW_SHAPES = (1, 1), (1, 2), (2, 1)  # height to width
UNIFORMITY_SIDE = 6  # cells, side of the windows that test whether everything moves alike
ALPHA = 1e-4  # significance level of motion in any window
MIN_EVIDENCE = 6.0  # twice the log-likelihood ratio of motion to rest: strong evidence (Kass & Raftery 1995)
MIN_POWER_SHARE = 0.25  # of the largest power, that a seed window must have
MIN_FOLLOWING_SHARE = 0.9  # of the ratio expected of a moving cell: at most one part in twenty of a target may rest
MAX_ROUNDS = 4  # of adjusting a window to what moves with it
MAX_SIGMA_RATIO = 1.5  # to the last window; a window that is less precise is rejected
MAX_NOISE_RATIO = 2.0  # to the noise expected at that light; more shows that the scene changes
MAX_MOTION_PX = 1.0  # rms; beyond it the linear model is invalid
MIN_SIDE_CELLS = 2  # of a target
MAX_STATIC_SHARE = 0.05  # of the windows; where fewer rest, the camera shakes and only relative motion counts
MIN_TEXTURE_RATIO = 1.5  # to the gradients that noise makes in the mean picture
MAX_SHAKE_PX = 0.3  # of the whole picture; beyond it the linear model is too inaccurate
DEFAULT_SIDE_PX = 48  # of a patch that is chosen only for its texture
MAX_SIGMA_PX = 0.05  # in one frame, on the worse axis; beyond it a patch cannot be tracked
N_PARAMETERS = 4  # of a window in a frame: two of motion, two of light
N_FRAMES = 9  # of which the static picture is the median
PATCH_SIZES_PX = (  # h, w px; where the body sweeps past, only narrow strips are left
    *((64, 128), (48, 96), (32, 96), (32, 48), (24, 24)),
    *((24, 192), (16, 256), (12, 256), (16, 128), (16, 64), (12, 48)),
)
MAX_REFERENCE_SIGMA_RATIO = 2.0  # to the best patch, for a patch below the path, on the course
MAX_SHAKE_ERROR_PX = 0.2  # of the estimated shake
MIN_CHANGE_SIGMAS = 5.0  # standard deviations beyond which a pixel has changed


@dataclass(frozen=True, eq=False)
class WindowMotions:
    """Motion of some windows in all frames, with its information and noise."""

    motion: Array  # (m, k, 2) px
    information: Array  # (m, 2, 2), inverse covariance of one frame's motion times the variance of the noise
    noise: Array  # (m,) variance of a pixel, DN^2
    pixels: Array  # (m,)
    light: Array  # (m,) mean grey value

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.motion.shape[1]

    @property
    def sigma(self) -> Array:
        """Standard deviation of the motion in one frame (m,) px on the worse axis; infinite without texture."""
        noise_texture = MIN_TEXTURE_RATIO * self.pixels * self.noise / (2 * self.frames)
        weakest = np.linalg.eigvalsh(self.information)[:, 0] - noise_texture
        return np.where(weakest > 0, np.sqrt(self.noise / np.maximum(weakest, 1e-300)), np.inf)

    def moving(self, common: Array | None = None) -> Mask:
        """Windows (m,) that move by more than noise and by more than other changes in them."""
        free = self.motion_dof(common)
        explained = self.power(common)
        noisy = explained <= free * f_isf(ALPHA / len(self.pixels), free, self._residual_dof) * self.noise
        return ~noisy & self.explained

    def power(self, common: Array | None = None) -> Array:
        """Sum of squares (m,), DN^2, that motion explains beyond a part proportional to a `common` motion (k, 2)."""
        motion_left = self.motion
        if common is not None:  # an error of the linear model is in proportion to it
            basis = np.linalg.qr(common)[0]
            motion_left = motion_left - basis @ (basis.T @ motion_left)
        return np.asarray(np.einsum("mki,mij,mkj->m", motion_left, self.information, motion_left))

    def motion_dof(self, common: Array | None = None) -> int:
        """Degrees of freedom of the motion; the mean picture has taken those of one frame, a common motion two."""
        return 2 * max(self.frames - 1 - (0 if common is None else 2), 1)

    def agreement(self, motion: Array) -> Array:
        """Twice the log-likelihood ratio (m,) of a `motion` (k, 2) to rest."""
        motion_left = self.motion - motion
        residual = np.einsum("mki,mij,mkj->m", motion_left, self.information, motion_left)
        return np.asarray((self.power() - residual) / self.noise)

    def mean(self, among: Mask) -> Array:
        """Mean motion (k, 2) of some windows, weighted by their information."""
        weight = (self.information / self.noise[:, None, None])[among]
        both = np.einsum("mij,mkj->ik", weight, self.motion[among])
        return np.asarray(np.linalg.solve(weight.sum(axis=0), both).T)

    @property
    def _residual_dof(self) -> Array:
        return (self.frames - 1) * np.maximum(self.pixels - N_PARAMETERS, 1)

    @property
    def explained(self) -> Mask:
        """Windows (m,) in which a small motion explains more than remains beyond the noise at their light."""
        expected = np.median(self.noise) * np.maximum(self.light / max(float(np.median(self.light)), 1e-9), 1.0)
        small = np.sqrt(np.mean(np.sum(self.motion**2, axis=2), axis=1)) < MAX_MOTION_PX
        return np.asarray(small & (self.power() >= self._residual_dof * (self.noise - MAX_NOISE_RATIO * expected)))


@dataclass(frozen=True, eq=False)
class CellSums:
    """Cumulative sums over all cells above and left of each corner; those of any window follow by subtraction."""

    cell: int
    normal: Array  # (h + 1, w + 1, 4, 4)
    right: Array  # (h + 1, w + 1, 4, k)
    power: Array  # (h + 1, w + 1)
    level: float  # DN, mean of the picture

    @property
    def shape(self) -> tuple[int, int]:
        """Cells (h, w)."""
        return self.power.shape[0] - 1, self.power.shape[1] - 1

    def windows(self, boxes: NDArray[np.int64]) -> WindowMotions:
        """Motion of windows (m, 4): x, y, w, h in cells."""
        x, y, w, h = boxes.T
        normal, right, power = (
            s[y + h, x + w] - s[y, x + w] - s[y + h, x] + s[y, x] for s in (self.normal, self.right, self.power)
        )
        ridge = 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-12
        normal = normal + ridge * np.eye(N_PARAMETERS)
        found = np.linalg.solve(normal, right)
        k, pixels = right.shape[2], w * h * self.cell**2
        residual = np.maximum(power - np.einsum("mik,mik->m", found, right), 0.0)
        light = normal[:, 2, 3] / pixels + self.level
        free = (k - 1) * np.maximum(pixels - N_PARAMETERS, 1)
        information = np.linalg.inv(np.linalg.inv(normal)[:, :2, :2])
        motion = -found[:, :2].transpose(0, 2, 1)
        return WindowMotions(motion, information, np.maximum(residual / free, 1 / 12 / k), pixels, light)

    def agreement(self, window: WindowMotions, common: Array | None) -> Array:
        """Twice the log-likelihood ratio of each cell (h, w): motion with a window, or the `common` motion.

        The part that noise of the motion makes is subtracted, and so is the share that a moving cell must reach.
        """
        motion, noise = window.motion[0], window.noise[0]
        normal, right = (_per_cell(s)[:, :, :2] for s in (self.normal, self.right))
        normal, motion_left = normal[..., :2], motion if common is None else motion - common
        rest = right if common is None else right + np.einsum("yxij,kj->yxik", normal, common)
        chance = len(motion) * noise * np.einsum("yxij,ij->yx", normal, np.linalg.inv(window.information[0]))
        whole = np.einsum("ki,yxij,kj->yx", motion_left, normal, motion_left) - chance
        ratio = -2 * np.einsum("ki,yxik->yx", motion_left, rest) - whole
        return np.asarray((ratio - MIN_FOLLOWING_SHARE * np.maximum(whole, 0)) / noise)


def _per_cell(sums: Array) -> Array:
    """Cumulative sums (h + 1, w + 1, ...) -> sums of each cell."""
    return np.asarray(np.diff(np.diff(sums, axis=0), axis=1))


def _cell_sums(scene: SampledScene) -> CellSums:
    """Sums over the sampled frames of a scene, normalised to the light of the background."""
    mean = np.zeros(scene.frames[0].shape)
    for frame in _normalised_frames(scene):
        mean += frame / len(scene.frames)
    cell = max(MIN_CELL_PX, int(np.ceil(np.sqrt(mean.size / MAX_CELLS))))
    gy, gx = np.gradient(cv2.GaussianBlur(mean, (0, 0), SMOOTHING_PX))
    columns = np.stack([gx, gy, mean - mean.mean(), np.ones_like(mean)])
    normal = np.stack([_cumulated(columns * one, cell) for one in columns])
    right, power = [], np.zeros(normal.shape[2:])
    for frame in _normalised_frames(scene):
        differs = frame - mean
        right.append(_cumulated(columns * differs, cell))
        power += _cumulated(differs**2, cell)
    both = np.moveaxis(normal, (0, 1), (2, 3)), np.moveaxis(np.array(right), (0, 1), (3, 2))
    return CellSums(cell, *both, power, float(mean.mean()))


def _normalised_frames(scene: SampledScene) -> Iterator[Array]:
    """Sampled frames, normalised to the light of the background."""
    for frame, light in zip(scene.frames, scene.light, strict=True):
        yield frame.astype(np.float64) / light


def _cumulated(pictures: Array, cell: int) -> Array:
    """Cumulative cell sums (..., h + 1, w + 1) of pictures (..., H, W)."""
    *many, h, w = pictures.shape[:-2] + tuple(side // cell for side in pictures.shape[-2:])
    rows = pictures[..., : h * cell, : w * cell].reshape(*many, h, cell, w * cell).sum(axis=-2)
    out = np.zeros((*many, h + 1, w + 1))
    np.cumsum(np.cumsum(rows.reshape(*many, h, w, cell).sum(axis=-1), axis=-2), axis=-1, out=out[..., 1:, 1:])
    return out


def _boxes(shape: tuple[int, int], sides: Sequence[int] = WINDOW_SIDES) -> NDArray[np.int64]:
    """Half-overlapping windows (m, 4) of all sizes that fit, in cells."""
    found = []
    for side in sides:
        for tall, wide in WINDOW_SHAPES:
            h, w = side * tall, side * wide
            if h > shape[0] or w > shape[1]:
                continue
            y, x = (np.unique([*range(0, n - s, max(s // 2, 1)), n - s]) for n, s in ((shape[0], h), (shape[1], w)))
            xx, yy = np.meshgrid(x, y)
            found.append(np.stack([xx.ravel(), yy.ravel(), np.full(xx.size, w), np.full(xx.size, h)], axis=1))
    return np.concatenate(found).astype(np.int64) if found else np.zeros((0, 4), np.int64)


def most_moving_patch(scene: SampledScene) -> Rectangle | None:
    """Find the rectangle with the most significant motion; where nothing moves, the one with the best texture.

    Parameters
    ----------
    scene : SampledScene
        Sampled frames.

    Returns
    -------
    tuple of int or None
        x, y, w, h in px; None without texture.

    """
    sums = _cell_sums(scene)
    boxes = _boxes(sums.shape)
    if len(boxes) == 0 or len(scene.frames) < 2:
        return None
    windows = sums.windows(boxes)
    if not windows.moving().any():
        return _best_textured(sums, boxes, windows)
    common = _common_motion(windows, sums)
    moving = windows.moving() & windows.moving(common)
    if not moving.any():  # all that is seen moves alike
        moving, common = windows.moving(), None
    known = moving & np.isfinite(windows.sigma)
    seed = boxes[_seed_window(windows, known if known.any() else moving, common)]
    return _in_pixels(_adjust_window(sums, seed, common), sums.cell)


def _seed_window(windows: WindowMotions, among: Mask, common: Array | None) -> int:
    """Of the windows with significant motion, the one that moves farthest: in the others a part rests."""
    power = np.where(among, windows.power(common), 0.0)
    chance = windows.motion_dof(common) * windows.noise
    size = (power - chance) / np.trace(windows.information, axis1=1, axis2=2)
    return int(np.argmax(np.where(power > MIN_POWER_SHARE * power.max(), size, -np.inf)))


def _common_motion(windows: WindowMotions, sums: CellSums) -> Array | None:
    """Motion (k, 2) of the whole picture where hardly anything rests: camera shake. Otherwise None."""
    moving = windows.moving()
    if not moving.any():
        return None
    motion = windows.motion[np.argmax(np.where(moving, windows.power(), -np.inf))]
    each = sums.windows(_boxes(sums.shape, (UNIFORMITY_SIDE,)))
    agreement, uniform = each.agreement(motion), each.explained
    follows, rests = uniform & (agreement > MIN_EVIDENCE), uniform & (agreement < -MIN_EVIDENCE)
    if not follows.any() or rests.sum() > MAX_STATIC_SHARE * (rests.sum() + follows.sum()):
        return None
    median_motion = np.median(each.motion[follows], axis=0)
    uniform = follows & ~each.moving(median_motion)
    return each.mean(uniform) if uniform.any() else np.asarray(median_motion)


def moving_cells(scene: SampledScene) -> Mask:
    """Mark where a picture moves by more than its noise.

    Parameters
    ----------
    scene : SampledScene
        Sampled frames.

    Returns
    -------
    array of bool (H, W)
        All false where hardly anything rests: then the camera shakes.

    """
    out = np.zeros(scene.frames[0].shape, np.bool_)
    if np.max(np.abs(scene.shake)) * scene.factor > MAX_SHAKE_PX or len(scene.frames) < 2:
        return out
    sums = _cell_sums(scene)
    boxes = _boxes(sums.shape, WINDOW_SIDES[:5])
    if len(boxes) == 0:
        return out
    windows = sums.windows(boxes)
    if _common_motion(windows, sums) is not None:
        return out
    for x, y, w, h in boxes[windows.moving()] * sums.cell:
        part = out[y : y + h, x : x + w]
        if not part.any():  # else smaller windows, which come first, have shown where it moves
            part[:] = True
    return out


def _best_textured(sums: CellSums, boxes: NDArray[np.int64], windows: WindowMotions) -> Rectangle | None:
    """Patch of the default size, or the smallest, that can be tracked best."""
    side = int(np.clip(DEFAULT_SIDE_PX // sums.cell, WINDOW_SIDES[0], None))
    size = np.max(boxes[:, 2:], axis=1)
    sigma = np.where(size <= max(side, int(size.min())), windows.sigma, np.inf)
    best = int(np.argmin(sigma))
    return _in_pixels(boxes[best], sums.cell) if sigma[best] < MAX_SIGMA_PX else None


def _adjust_window(sums: CellSums, box: NDArray[np.int64], common: Array | None) -> NDArray[np.int64]:
    """Adjust a window (4,) to include what moves with it and exclude what rests."""
    for _ in range(MAX_ROUNDS):
        window = sums.windows(box[None])
        better = _largest(sums.agreement(window, common))
        if better is None or np.array_equal(better, box):
            break
        if sums.windows(better[None]).sigma[0] > MAX_SIGMA_RATIO * window.sigma[0]:
            break
        box = better
    return box


def _largest(values: Array) -> NDArray[np.int64] | None:
    """Box (x, y, w, h) with the largest sum of values (h, w); None where that is not positive.

    For each top row, the best bottom row and columns follow by running sums (Kadane: Bentley 1984, CACM 27:865).
    """
    total = np.pad(np.cumsum(np.cumsum(values, axis=0), axis=1), ((1, 0), (1, 0)))
    best, found = 0.0, None
    for top in range(len(values) + 1 - MIN_SIDE_CELLS):
        rows = total[top + MIN_SIDE_CELLS :] - total[top]
        low = np.minimum.accumulate(rows[:, :-MIN_SIDE_CELLS], axis=1)
        gain = rows[:, MIN_SIDE_CELLS:] - low
        bottom, right = np.unravel_index(int(np.argmax(gain)), gain.shape)
        if gain[bottom, right] > best:
            residual = int(np.argmin(rows[bottom, : right + 1]))
            best = float(gain[bottom, right])
            found = residual, top, int(right) + MIN_SIDE_CELLS - residual, int(bottom) + MIN_SIDE_CELLS
    return None if found is None else np.array(found, dtype=np.int64)


def _in_pixels(box: NDArray[np.int64], cell: int) -> Rectangle:
    x, y, w, h = (int(v) * cell for v in box)
    return x, y, w, h


def find_reference(recording: Recording, track: Track) -> Rectangle | None:
    """Find the patch that can be tracked best as a fixed reference.

    Nothing ever moves in it, and the target never covers it. Patches below the target's path, on the course, are
    preferred if they are nearly as good. The precision is the Cramer-Rao bound of a shift, from the gradients of the
    picture.

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
    return _choose_patch(still, noise, excluded, max(int(np.ceil(foot)), 0))


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
    half = 0.7 * np.array(track.target[2:])
    centre = np.stack([track.x_px, track.y_px], axis=1)[track.found]
    corners = np.hstack([np.floor(centre - half), np.ceil(centre + half) + 1]).clip(0).astype(int)
    covered = np.zeros(shape, np.bool_)
    for x0, y0, x1, y1 in np.unique(corners, axis=0).tolist():
        covered[y0:y1, x0:x1] = True
    return covered


def _choose_patch(still: Picture, noise: Picture, excluded: Mask, foot: int) -> Rectangle | None:
    """Patch with the smallest Cramer-Rao bound on its worse axis; one below row `foot` if it is nearly as good."""
    gy, gx = (np.asarray(g / noise, dtype=np.float64) for g in np.gradient(cv2.GaussianBlur(still, (0, 0), 0.7)))
    parts = [cv2.integral(p) for p in (gx * gx, gy * gy, gx * gy, excluded.astype(np.float64))]
    best: list[tuple[float, Rectangle]] = [(np.inf, (0, 0, 0, 0))] * 2  # anywhere, and below
    for h, w in PATCH_SIZES_PX:
        if h + 4 > still.shape[0] or w + 4 > still.shape[1]:
            continue
        xx, yy, xy, blocked = (s[h:, w:] - s[:-h, w:] - s[h:, :-w] + s[:-h, :-w] for s in parts)
        # The gradient of the noise that remains in the median is no texture.
        weakest = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy**2) - 0.1 * h * w
        sigma = np.where((blocked < 0.5) & (weakest > 0), 1 / np.sqrt(np.maximum(weakest, 1e-9)), np.inf)
        for k, first in enumerate((0, foot)):
            if sigma[first:].size and sigma[first:].min() < best[k][0]:
                y, x = np.unravel_index(int(np.argmin(sigma[first:])), sigma[first:].shape)
                best[k] = float(sigma[first:].min()), (int(x), int(y) + first, w, h)
    if best[0][0] > MAX_SIGMA_PX:
        return None
    return best[best[1][0] <= min(MAX_REFERENCE_SIGMA_RATIO * best[0][0], MAX_SIGMA_PX)][1]
