"""Separate the static scene from moving foreground, on reduced pictures of sampled frames.

Some frames spread over the film are reduced and aligned if the whole picture shakes. What most of them, or far more
neighbours among them, agree on is the background. Regions that differ from it by more than noise, after normalising the
light, move.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any
from weakref import ref

import cv2
import numpy as np
from numpy.typing import NDArray

from frictrack.base.distributions import MEDIAN_TO_SIGMA, normal_ppf
from frictrack.base.errors import FrictrackError
from frictrack.recording import Frame, Recording
from frictrack.records import Array, Mask
from frictrack.tracking.correlation import Rectangle

MAX_SAMPLES = 32  # frames of a film that are looked at
MAX_REGISTERED_FRAMES = 15  # of the samples, where fewer are enough
# Of the differences, which shows noise where a body covers a place in up to two thirds of the frames.
NOISE_QUANTILE = 0.3
MAX_NOISE_RATIO = 4.0  # to the least noise of a picture, at edges that shake
WIDE_PX, WIDE_NOISE_RATIO = 13, 8.0  # px of a reduced picture that are no edge, and ratio to the least noise there
MIN_GHOST_FRAMES = 2  # that show a place without the body
# of noise, that equal grey values differ by; and more samples than at the median
CLUSTER_SIGMAS, FREQUENT_RATIO = 3.0, 1.5
GHOST_REACH = 6  # px about the outline of a region that are compared
CLEAR_OUTLINE, CLEAR_TEXTURE = 2.0, 0.5  # ratios of the gradients of a clear outline to another, and to those around
ENERGY_BLUR, TAIL_PROBABILITY, ENERGY_LIMITS = 1.5, 1e-5, (9.0, 50.0)  # px; and variances of noise
MIN_BUSY_INTERVALS = 10  # between samples in which something must change
MAX_SAMPLE_BYTES = 40_000_000  # memory of the samples
REDUCED_PIXELS = 40_000  # of a reduced picture
MIN_AREA_REDUCED = 40  # px of a reduced picture
MIN_SIDE_PX = 8  # of a target
MAX_POINTS = 32  # that are followed to detect camera shake
MIN_STILL_POINTS, SAME_SHIFT_PX = 3, 0.3  # of the static scene, which move together
MIN_TOGETHER = 0.8  # of the frames that show two points, in which these do
MIN_SPREADS = 0.4, 0.6  # of the picture's sides, over which these points lie
MIN_SHAKE_REDUCED = 0.15  # px of a reduced picture
MAX_SHAKE_SHARE = 0.05  # of the picture's longer side

Picture = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Blob:
    """Connected region of foreground in a reduced frame: box, its pixels in that, area, whether it is cut off."""

    box: Rectangle
    mask: Mask  # (h, w)
    area: int
    cut: bool  # by the edge of the picture: it goes on outside

    @cached_property
    def middle(self) -> Array:
        """Mean position (2,) of its pixels, px."""
        return np.mean(np.argwhere(self.mask)[:, ::-1], axis=0) + self.box[:2]

    @cached_property
    def lengths(self) -> Array:
        """Principal standard deviations (2,) of its pixels, px: the same at any angle."""
        return np.sqrt(np.linalg.eigvalsh(np.cov(np.argwhere(self.mask).T)) + 1 / 12)


@dataclass(frozen=True, eq=False)
class SampledScene:
    """Frames spread over a recording, reduced and aligned, with background and foreground.

    Attributes
    ----------
    index, frames : list
        Numbers of the frames, and the frames at full size.
    factor : int
        By which they are reduced.
    shake : array (k, 2)
        Position of the static scene in each frame relative to the background, reduced px.
    small : list of array
        Reduced and aligned frames, DN.
    background : array
        What is behind all that moves, DN.
    foreground : list of array of bool
        Pixels that differ from the background.
    light : array (k,)
        Brightness of each frame over that of the background.
    rim : list of array of bool
        Pixels at the edge of the picture that are not background.

    """

    index: list[int]
    frames: list[Frame]
    factor: int
    shake: Array  # (k, 2) px, reduced: where the still scene is in each frame, relative to the background
    small: list[Picture]
    background: Picture
    foreground: list[Mask]
    light: Array  # (k,) by how much each frame is brighter than the background
    rim: list[Mask]  # pixels at the picture's edge that are not background

    @cached_property
    def blobs(self) -> list[list[Blob]]:
        """Regions of foreground in every sampled frame, the largest first; one that fills the picture is ignored."""
        return [_blobs(mask, rim) for mask, rim in zip(self.foreground, self.rim, strict=True)]

    @property
    def min_side_reduced(self) -> int:
        """Shortest side of a body, reduced px."""
        return max(MIN_SIDE_PX // self.factor, 4)


def sample_scene(recording: Recording, also: Iterable[int] = (), steady: bool = True) -> SampledScene:
    """Sample frames spread over a film and separate foreground from background.

    Parameters
    ----------
    recording : Recording
        Film.
    also : iterable of int
        Further frames to include.
    steady : bool
        Whether to look for camera shake and remove it.

    Returns
    -------
    SampledScene
        The sampled frames.

    Raises
    ------
    FrictrackError
        For a film without contrast.

    """
    wanted = (*also,)
    if wanted or not steady:
        return _sample_scene(recording, wanted, steady)
    film, scene = _LAST.get("scene", (lambda: None, None))
    if film() is not recording or scene is None:
        scene = _sample_scene(recording, (), True)
        _LAST["scene"] = ref(recording, lambda _: _LAST.clear()), scene
    return scene


# Film and scene of the last call: target and reference are looked for in the same frames of a film.
_LAST: dict[str, tuple[Any, SampledScene | None]] = {}


def _sample_scene(recording: Recording, also: Iterable[int], steady: bool) -> SampledScene:
    """Sample frames spread over a film; see `sample_scene`."""
    index, frames = _pick_frames(recording, also)
    factor = max(1, round(float(np.sqrt(recording.shape[0] * recording.shape[1] / REDUCED_PIXELS))))
    small = [_reduced(frame, factor) for frame in frames]
    more = _busy_frames(index, small)
    if more:
        extra = [i for i in more if i not in index]
        pairs = [*zip(index, frames, small, strict=True)]
        pairs += [(i, f, _reduced(f, factor)) for i, f in zip(extra, recording.pick(extra), strict=False)]
        index, frames, small = (list(part) for part in zip(*sorted(pairs, key=lambda p: p[0]), strict=True))
    shake = _estimate_shake(small) if steady else np.zeros((len(small), 2))
    if shake.any():
        small = [_shifted(picture, at) for picture, at in zip(small, shake, strict=True)]
    background = _still_scene(np.stack(small))
    return _without_ghosts(_build_scene(index, frames, (factor, shake, small), background))


def _still_scene(stack: Picture) -> Picture:
    """Background (h, w) of samples (k, h, w): their median, or a grey value that far more neighbouring ones share.

    A textured body that passes slowly covers a place in most samples, but with another grey value in each.
    """
    middle = np.median(stack, axis=0)
    stack = stack / np.array([light_ratio(picture, middle) for picture in stack], np.float32)[:, None, None]
    middle = np.median(stack, axis=0)
    # most may be a body's
    steps = np.quantile(np.abs(np.diff(stack, axis=0)), NOISE_QUANTILE, axis=0).astype(np.float32)
    steps = cv2.blur(steps, (5, 5)) / np.float32(np.sqrt(2) * normal_ppf(0.5 + 0.5 * NOISE_QUANTILE))
    least = max(float(np.quantile(steps, NOISE_QUANTILE)), 0.5)
    near = CLUSTER_SIGMAS * np.clip(steps, least, MAX_NOISE_RATIO * least)
    best, count = middle.astype(np.float32), FREQUENT_RATIO * _agreeing_pairs(stack, middle, near)
    unsure = count < len(stack) - 1  # elsewhere no other grey value can be so frequent
    some, reach, level, most = stack[:, unsure], near[unsure], middle[unsure], count[unsure]
    for values in some:
        each = _agreeing_pairs(some, values, reach)
        level, most = np.where(each > most, values, level), np.maximum(each, most)
    alike = np.where(np.abs(some - level) < reach, some, np.inf)
    best[unsure] = np.where(level == middle[unsure], level, _middle_of_known(alike))
    return best


def _agreeing_pairs(stack: Picture, level: NDArray[Any], near: NDArray[Any]) -> Array:
    """Number of neighbouring samples (k, ...) that both have a grey value near a level."""
    alike = np.abs(stack - level) < near
    return np.count_nonzero(alike[1:] & alike[:-1], axis=0).astype(np.float64)


def _build_scene(index: list[int], frames: list[Frame], reduced: Any, background: Picture) -> SampledScene:
    """Compute foreground for a background; `reduced` holds factor, shake and reduced frames."""
    factor, shake, small = reduced
    lights = np.array([light_ratio(picture, background) for picture in small])
    differences = [p - np.float32(ratio) * background for p, ratio in zip(small, lights, strict=True)]
    noise = _noise(differences, background)
    energies = [cv2.GaussianBlur((d / noise) ** 2, (0, 0), ENERGY_BLUR) for d in differences]
    limit = _energy_limit(energies)
    foreground = [clean_mask(np.asarray(energy > limit), close=7) for energy in energies]
    rim = [_rim(d, noise) for d in differences]
    return SampledScene(index, frames, factor, shake, small, background, foreground, lights, rim)


def _noise(differences: list[Picture], background: Picture) -> Picture:
    """Standard deviation (h, w) of the reduced frames about the background: larger at edges that shake.

    Saturated pixels have no noise; they do not enter the least value.
    """
    off = np.abs(np.stack(differences))
    k = int(NOISE_QUANTILE * (len(off) - 1))
    each = np.partition(off, k, axis=0)[k] / np.float32(normal_ppf(0.5 + 0.5 * NOISE_QUANTILE))
    sparse, lit = off[:, ::2, ::2], background[::2, ::2] < 0.97 * background.max()
    least = float(np.median(np.median(sparse, axis=(1, 2))))
    if least <= 0.1 and lit.mean() >= 0.02:
        least = float(np.median(np.median(sparse[:, lit], axis=1)))
    least = max(MEDIAN_TO_SIGMA * least, 0.5)
    # Where a wide place changes always, a body moves without leaving it; edges are narrow.
    wide = cv2.morphologyEx(each, cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8))
    wide = cv2.morphologyEx(wide, cv2.MORPH_OPEN, np.ones((WIDE_PX, WIDE_PX), np.uint8))
    each[wide > WIDE_NOISE_RATIO * least] = least
    return np.clip(cv2.blur(each, (3, 3)), least, MAX_NOISE_RATIO * least)


def _without_ghosts(scene: SampledScene) -> SampledScene:
    """Remove bodies from the background that rest there in most frames, with the frames that show them elsewhere."""
    shown: list[Picture] = []
    for picture, light, blobs in zip(scene.small, scene.light, scene.blobs, strict=True):
        ghosts = np.full(picture.shape, np.inf, np.float32)
        for blob in blobs:
            if min(blob.box[2:]) < scene.min_side_reduced:
                continue
            x, y, w, h = blob.box
            left, top = max(x - GHOST_REACH, 0), max(y - GHOST_REACH, 0)
            near = slice(top, y + h + GHOST_REACH), slice(left, x + w + GHOST_REACH)
            inside = np.zeros(picture[near].shape, np.uint8)
            inside[y - top : y - top + h, x - left : x - left + w] = blob.mask
            (outline, _), (ghost, around) = (_outline_strength(p[near], inside) for p in (picture, scene.background))
            if ghost > CLEAR_OUTLINE * max(outline, 0.0) + CLEAR_TEXTURE * around:
                ghosts[near][inside > 0] = picture[near][inside > 0] / light
        if np.isfinite(ghosts).any():
            shown.append(ghosts)
    if len(shown) < MIN_GHOST_FRAMES:
        return scene
    stack = np.stack(shown)
    replaced = np.count_nonzero(np.isfinite(stack), axis=0) >= MIN_GHOST_FRAMES
    background = np.where(replaced, _middle_of_known(stack), scene.background)
    return _scene_before(scene, background)


def _scene_before(scene: SampledScene, background: Picture) -> SampledScene:
    """The same samples before another background (h, w), DN."""
    return _build_scene(scene.index, scene.frames, (scene.factor, scene.shake, scene.small), background)


def _outline_strength(picture: Picture, inside: NDArray[np.uint8]) -> tuple[float, float]:
    """How far gradients at some depth below the outline of a region exceed those around it, and these, DN/px."""
    gradient = cv2.magnitude(cv2.Sobel(picture, cv2.CV_32F, 1, 0), cv2.Sobel(picture, cv2.CV_32F, 0, 1)) / 8
    depth = cv2.distanceTransform(inside, cv2.DIST_L1, 3).astype(np.int64)
    depth = np.minimum(depth, GHOST_REACH)
    count = np.maximum(np.bincount(depth.ravel(), minlength=GHOST_REACH + 1), 1)
    mean = np.bincount(depth.ravel(), gradient.ravel(), GHOST_REACH + 1) / count
    return float(mean[1:].max() - mean[0]), float(mean[0])


def _middle_of_known(stack: Picture) -> Picture:
    """Median (h, w) of what is finite in a stack (k, h, w); infinite where nothing is."""
    known = np.count_nonzero(np.isfinite(stack), axis=0)
    return np.take_along_axis(np.sort(stack, axis=0), np.maximum((known - 1) // 2, 0)[None], axis=0)[0]


def scene_without(scene: SampledScene, box: Rectangle, corner: Array) -> SampledScene:
    """The same samples before the background of the frames in which a body, at corners (k, 2) px, is elsewhere."""
    usable = np.flatnonzero(np.isfinite(corner[:, 0]))
    rows = np.unique(usable[np.linspace(0, len(usable) - 1, MAX_REGISTERED_FRAMES).astype(int)])
    stack = np.stack([scene.small[k] / np.float32(scene.light[k]) for k in rows])
    for picture, (x, y) in zip(stack, np.rint(corner[rows]).astype(int), strict=True):
        picture[max(y - 1, 0) : y + box[3] + 1, max(x - 1, 0) : x + box[2] + 1] = np.inf
    middle = _middle_of_known(stack)
    uncovered = np.isfinite(middle) & ~np.all(np.isfinite(stack), axis=0)
    return _scene_before(scene, np.where(uncovered, middle, scene.background).astype(np.float32))


def _busy_frames(index: list[int], small: list[Picture]) -> list[int]:
    """Further frames to sample where all change lies between a few of the samples."""
    steps = np.abs(np.diff(np.stack(small)[:, ::2, ::2], axis=0))
    noise = MEDIAN_TO_SIGMA * max(float(np.median(steps)), 0.3)
    busy = np.flatnonzero(np.sum(steps > 6 * noise, axis=(1, 2)) > MIN_AREA_REDUCED / 4)
    if not 0 < len(busy) < MIN_BUSY_INTERVALS:
        return []
    each = 2 * MIN_BUSY_INTERVALS // len(busy) + 1
    return sorted({int(i) for k in busy for i in np.linspace(index[k], index[k + 1], each + 1)})


def _pick_frames(recording: Recording, also: Iterable[int]) -> tuple[list[int], list[Frame]]:
    """Frames that show something, and their numbers."""
    size = recording.shape[0] * recording.shape[1] * (2 if recording.bit_depth > 8 else 1)
    count = min(recording.n_frames, int(np.clip(MAX_SAMPLE_BYTES // size, 9, MAX_SAMPLES)))
    spread = np.linspace(0, recording.n_frames - 1, count).astype(int)
    index = np.unique([*spread, *also]).astype(int).tolist()
    # A truncated file gives fewer frames; a damaged frame is uniformly grey.
    pairs = zip(index, recording.pick(index), strict=False)
    usable = [(i, frame) for i, frame in pairs if int(np.ptp(frame[::2, ::2])) >= 2]
    if not usable:
        raise FrictrackError(
            f"{recording.path.name}: the film has no contrast, its frames are all one grey; "
            "check lighting, exposure and lens cap"
        )
    return [i for i, _ in usable], [frame for _, frame in usable]


def _reduced(frame: Frame, factor: int) -> Picture:
    """Frame reduced by a whole factor, float32; remaining rows and columns are cut off."""
    h, w = (s // factor for s in frame.shape)
    whole = frame[: h * factor, : w * factor]
    small = whole if factor == 1 else cv2.resize(whole, (w, h), interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.float32)


def _estimate_shake(small: list[Picture]) -> Array:
    """Shift (k, 2) px of the whole picture against the middle frame; zero where the picture stands still.

    Corner points are followed by optical flow (Lucas & Kanade 1981). Those that move together in most frames must lie
    all over the picture: a large body before a plain wall is no camera shake.
    """
    middle = len(small) // 2
    high = max(float(np.percentile(small[middle], 99.5)), 1.0)
    pictures = [np.clip(p * (255 / high), 0, 255).astype(np.uint8) for p in small]
    inside = np.zeros(small[0].shape, np.uint8)
    inside[8:-8, 8:-8] = 1
    apart = float(np.sqrt(inside.size / MAX_POINTS / 2))  # so that they lie all over the picture
    points = cv2.goodFeaturesToTrack(pictures[middle], MAX_POINTS, 0.02, apart, mask=inside, blockSize=7)
    limit = MAX_SHAKE_SHARE * max(small[0].shape)
    out = np.zeros((len(small), 2))
    if np.size(points) < 2 * MIN_STILL_POINTS:
        return out
    shifts = np.full((len(small), len(points), 2), np.nan, np.float32)
    for picture, shift in zip(pictures, shifts, strict=True):
        at, status, _ = cv2.calcOpticalFlowPyrLK(
            pictures[middle], picture, points, points.copy(), winSize=(15, 15), maxLevel=2
        )
        followed = status.ravel() > 0
        shift[followed] = (at - points)[followed, 0]
    off = np.linalg.norm(shifts[:, :, None] - shifts[:, None], axis=3)
    together = np.sum(off < SAME_SHIFT_PX, axis=0) >= MIN_TOGETHER * np.maximum(np.sum(np.isfinite(off), axis=0), 1)
    still = together[int(np.argmax(together.sum(axis=1)))]
    spread = np.ptp(points[still, 0], axis=0) / np.array(small[0].shape[::-1])
    if still.sum() < MIN_STILL_POINTS or min(spread) < MIN_SPREADS[0] or max(spread) < MIN_SPREADS[1]:
        return out
    for k, (shift, near) in enumerate(zip(shifts[:, still], off[:, still][:, :, still] < SAME_SHIFT_PX, strict=True)):
        common = _common_shift(points[still, 0], shift, near, small[0].shape)
        if np.hypot(*common) < limit:
            out[k] = common
    return out if np.max(np.hypot(*out.T)) > MIN_SHAKE_REDUCED else np.zeros_like(out)


def _common_shift(points: Array, shift: Array, near: Mask, shape: tuple[int, ...]) -> Array:
    """Shift in a frame of those of the points (n, 2) that agree over the widest part of the picture; else zero."""
    spread = [max(np.ptp(points[agree], axis=0) / shape[::-1]) if agree.any() else 0.0 for agree in near]
    widest = near[int(np.argmax(spread))]
    return np.asarray(np.median(shift[widest], axis=0)) if max(spread) >= MIN_SPREADS[0] else np.zeros(2)


def _shifted(picture: Picture, by: Array) -> Picture:
    """Picture read at positions shifted by `by` px, its edge continued."""
    matrix = np.array([[1, 0, by[0]], [0, 1, by[1]]], dtype=np.float64)
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    size = (picture.shape[1], picture.shape[0])
    return np.asarray(cv2.warpAffine(picture, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE))


def light_ratio(picture: Picture, background: Picture) -> float:
    """Compute how much brighter a picture is than the background.

    Parameters
    ----------
    picture, background : array (h, w)
        Grey values.

    Returns
    -------
    float
        Median ratio of bright pixels; 1 where it is implausible.

    Examples
    --------
    >>> light_ratio(np.full((9, 9), 60.0, np.float32), np.full((9, 9), 50.0, np.float32))
    1.2000000476837158

    """
    sparse, still = picture[::3, ::3], background[::3, ::3]
    bright = still > 0.5 * np.median(still)
    ratio = float(np.median(sparse[bright] / np.maximum(still[bright], 1)))
    return ratio if 0.2 < ratio < 5 else 1.0


def _energy_limit(energies: list[Picture]) -> float:
    """Smoothed squared difference, in variances of the noise, that noise does not reach.

    White noise scatters by a quarter of its mean and never reaches nine times it. That of a codec scatters more: the
    limit is extrapolated from the middle of a log-normal distribution to its tail.
    """
    middle, upper = np.quantile(np.stack(energies)[:, ::3, ::3], (0.5, 0.7))
    tail = middle * (upper / max(middle, 1e-6)) ** (normal_ppf(1 - TAIL_PROBABILITY) / normal_ppf(0.7))
    return float(np.clip(tail, *ENERGY_LIMITS))


def clean_mask(mask: Mask, close: int) -> Mask:
    """Close gaps of a mask (h, w) narrower than `close` px and remove specks."""
    bits = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((close, close), np.uint8))
    return np.asarray(cv2.morphologyEx(bits, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0)


def _rim(difference: Picture, noise: Picture) -> Mask:
    """Single pixels along the picture's edge that differ from the background."""
    rim = np.abs(difference) > 4 * noise
    rim[1:-1, 1:-1] = False
    return np.asarray(rim)


def _blobs(mask: Mask, rim: Mask) -> list[Blob]:
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    out = np.bincount(labels[rim], minlength=len(stats))
    large = [k for k in range(1, len(stats)) if MIN_AREA_REDUCED <= stats[k, 4] < 0.6 * mask.size]
    blobs = [
        Blob((x, y, w, h), labels[y : y + h, x : x + w] == k, a, bool(out[k] > 3))
        for k in large
        for x, y, w, h, a in [stats[k].tolist()]
    ]
    return sorted(blobs, key=lambda blob: -blob.area)


def cut_window(picture: NDArray[Any], corner: NDArray[Any], shape: tuple[int, int]) -> Picture:
    """Cut a window out of a picture, continued by its edge where it reaches beyond.

    Parameters
    ----------
    picture : array (H, W)
        Grey values.
    corner : array of int (2,)
        Upper left corner (x, y), px.
    shape : tuple of int
        Height and width, px.

    Returns
    -------
    array (h, w)
        float32.

    """
    height, width = picture.shape
    rows = np.clip(np.arange(shape[0]) + corner[1], 0, height - 1)
    columns = np.clip(np.arange(shape[1]) + corner[0], 0, width - 1)
    return picture[np.ix_(rows, columns)].astype(np.float32)


def read_subpixel(picture: NDArray[Any], corner: Array, shape: tuple[int, int]) -> Picture:
    """Read a window of a height and width at a position (x, y) px between the pixels, by cubic interpolation."""
    whole = np.floor(corner).astype(int)
    part = cut_window(picture, whole - 2, (shape[0] + 5, shape[1] + 5))
    return _shifted(part, corner - whole)[2 : 2 + shape[0], 2 : 2 + shape[1]]
