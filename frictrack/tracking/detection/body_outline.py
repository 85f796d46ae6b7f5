"""Compute the rectangle of a moving body on the full picture: inside its outline, or inside a rotating region."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from frictrack.base.polygons import Polygon
from frictrack.records import Array, Mask
from frictrack.tracking.correlation import Rectangle, best_match
from frictrack.tracking.detection.sampled_scene import (
    MAX_REGISTERED_FRAMES,
    MIN_SIDE_PX,
    Picture,
    SampledScene,
    background_without,
    clean_mask,
    cut_window,
    read_subpixel,
)

MAX_NOISE_RATIO = 6  # variance of a pixel over that of the body, above which it does not belong to the body
MARGIN_PX = 2  # round a plain body, so that its whole blurred edge is included
MIN_CONTRAST_RATIO = 4  # squared difference from the background over the body's variance
MIN_MEDIAN_FRAMES = 5  # with fewer frames the mean replaces the median
ROUND_MARGIN_PX = 1.0  # round a disc: half of its blurred edge, and hardly any background
# A body is round where this share of its edge lies within this share of the radius of a circle.
MIN_ROUND_SHARE, MAX_ROUGHNESS, N_ROUND_CORNERS = 0.85, 0.06, 24
SHARP_SHARE = 0.3  # of the steepest change of brightness, in a sharp edge
MIN_ENCLOSED_SHARE = 0.15  # of what moves, that sharp edges enclose
MIN_INSIDE_CONTRAST = 0.4  # share of the contrast that must lie inside the body, away from its edge


@dataclass(frozen=True, eq=False)
class Body:
    """Moving body on the reduced pictures.

    Attributes
    ----------
    box : tuple of int
        Its bounding box x, y, w, h in sampled frame `row`, px.
    row : int
        Number of that sample.
    corner : array (k, 2)
        Corner of the box in every sampled frame, px; NaN where the body is not found.
    score : array (k,)
        Match scores.
    merit : float
        How suitable it is as a target; 0 for a body that does not move.
    rotates : bool
        Whether it was found by its shape alone.

    """

    box: Rectangle
    row: int
    corner: Array  # (k, 2) px, NaN where not seen
    score: Array  # (k,)
    merit: float
    rotates: bool = False

    @property
    def seen(self) -> Mask:
        """Sampled frames (k,) in which the body is found."""
        return np.isfinite(self.corner[:, 0])


@dataclass(frozen=True, eq=False)
class BodyAppearance:
    """Appearance of a body, from sampled frames registered on it: a window somewhat larger than the body."""

    picture: Picture  # median of the registered frames
    member: Mask  # pixels that move with the body
    corner: NDArray[np.int64]  # (k, 2) px, corner of the window in each frame
    rows: NDArray[np.int64]  # (k,) those frames


def body_outline(scene: SampledScene, body: Body, frame: int | None = None) -> tuple[Rectangle, int]:
    """Compute the rectangle of a body and the frame to which it refers.

    Parameters
    ----------
    scene : SampledScene
        Sampled frames.
    body : Body
        Body on the reduced pictures.
    frame : int, optional
        Wanted frame. By default the first that shows the body.

    Returns
    -------
    rectangle : tuple of int
        x, y, w, h on the full picture, px.
    frame : int
        Number of the frame.

    """
    if body.rotates:
        return _rotating_outline(scene, body, frame)
    appearance = _register_body(scene, body.box, body.row, body.corner)
    x, y, w, h = _rectangle(appearance)
    index = np.array(scene.index)[appearance.rows]
    at = int(np.flatnonzero(index == frame)[0]) if frame in index else 0
    left, top = (int(c) for c in appearance.corner[at])
    height, width = scene.frames[0].shape
    x0, y0 = np.clip(left + x, 0, width - 8), np.clip(top + y, 0, height - 8)
    x1, y1 = np.clip(left + x + w, x0 + 8, width), np.clip(top + y + h, y0 + 8, height)
    return (int(x0), int(y0), int(x1 - x0), int(y1 - y0)), int(index[at])


def _register_body(scene: SampledScene, box: Rectangle, row: int, corner: Array) -> BodyAppearance:
    """Register the sampled frames on the body and find the pixels that move with it."""
    w, h = box[2] * scene.factor, box[3] * scene.factor
    reach = int(np.ceil(0.1 * max(w, h))) + 3
    shape = (h + 2 * reach, w + 2 * reach)
    seen = np.flatnonzero(np.isfinite(corner[:, 0]))
    rows = np.unique([row, *seen[np.linspace(0, len(seen) - 1, MAX_REGISTERED_FRAMES).astype(int)]])
    whole = _full_size_corners(scene, box, row, corner)[rows]
    at = whole - reach
    still = at - scene.shake[rows] * scene.factor
    background = background_without(scene, box, corner)
    if scene.factor > 1:
        background = np.asarray(cv2.resize(background, None, fx=scene.factor, fy=scene.factor), dtype=np.float32)
    stack = np.stack([read_subpixel(scene.frames[k], c, shape) / scene.light[k] for k, c in zip(rows, at, strict=True)])
    backgrounds = np.stack([read_subpixel(background, c, shape) for c in still])
    picture = np.median(stack, axis=0).astype(np.float32)
    member = without_shadow(_body_pixels(stack, backgrounds, picture), stack, backgrounds)
    return BodyAppearance(picture, member, np.rint(at).astype(np.int64), rows)


def _body_pixels(stack: Picture, backgrounds: Picture, picture: Picture) -> Mask:
    """Pixels that move with the body, from registered frames (k, h, w) and the background behind them."""
    # A plain background far brighter than the body must not leak in.
    differs = _typical_square(stack - backgrounds, 0.5)
    spread = _typical_square(stack - picture)
    member = _largest_patches(clean_mask(np.asarray(spread < 0.5 * differs), close=5))
    # The scene is visible through a moving shadow: it changes more than the body does in the same light.
    spread = _typical_square(_normalise_light(stack, picture, member) - picture)
    slope = np.sum(np.square(np.gradient(picture)), axis=0)  # of an edge that is registered to 0.2 px
    body_variance = float(np.percentile(spread[member], 25))
    similar = (spread < MAX_NOISE_RATIO * max(body_variance, 0.25) + 0.04 * slope).astype(np.uint8)
    similar = cv2.dilate(similar, np.ones((3, 3), np.uint8))
    contrasts = differs > np.maximum(2 * spread, MIN_CONTRAST_RATIO * body_variance)
    return _largest_patches(clean_mask(np.asarray((similar > 0) & contrasts), close=5))


def without_shadow(member: Mask, stack: Picture, backgrounds: Picture) -> Mask:
    """Remove what darkens the background without a sharp edge: a body is what sharp edges enclose.

    Parameters
    ----------
    member : array of bool (h, w)
        Pixels that move together.
    stack, backgrounds : array (k, h, w)
        Registered frames and the background behind them, DN.

    Returns
    -------
    array of bool (h, w)
        All pixels where sharp edges enclose little of them.

    """
    change = np.median(np.log(np.maximum(stack, 0) + 1) - np.log(np.maximum(backgrounds, 0) + 1), axis=0)
    slope = np.hypot(*np.gradient(cv2.GaussianBlur(change, (0, 0), 0.7)))
    sharp = (slope > SHARP_SHARE * np.quantile(slope[member], 0.98)).astype(np.uint8)
    sharp = cv2.morphologyEx(sharp, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    _, labels = cv2.connectedComponents(np.pad(1 - sharp, 1, constant_values=1), connectivity=4)
    enclosed = _largest_patches(clean_mask(member & (labels[1:-1, 1:-1] != labels[0, 0]), close=3))
    left = member & ~enclosed
    is_shadow = enclosed.sum() > MIN_ENCLOSED_SHARE * member.sum() and left.any() and np.median(change[left]) < 0
    return enclosed if is_shadow else member


def _typical_square(off: Picture, blur: float = 1.0) -> Picture:
    """Typical square (h, w) of deviations (k, h, w): the median, or the mean of few."""
    squares = off**2
    few = len(off) <= MIN_MEDIAN_FRAMES
    usual = np.sum(squares, axis=0) / max(len(off) - 1, 1) if few else np.median(squares, axis=0)
    return np.asarray(cv2.GaussianBlur(usual, (0, 0), blur), dtype=np.float32)


def _normalise_light(stack: Picture, picture: Picture, member: Mask) -> Picture:
    """Frames normalised to the light of the median picture, by the pixels of the body."""
    pixels, wanted = stack[:, member], picture[member] - picture[member].mean()
    level = pixels.mean(axis=1)
    gain = (pixels - level[:, None]) @ wanted / max(float(wanted @ wanted), 1e-6)
    gain = np.where(gain > 0.2, gain, 1.0).astype(np.float32)
    return (stack - level[:, None, None]) / gain[:, None, None] + picture[member].mean()


def _full_size_corners(scene: SampledScene, box: Rectangle, row: int, corner: Array) -> Array:
    """Corners (k, 2) px of the body on the full pictures, by a match there."""
    rough = np.rint(np.nan_to_num(corner + scene.shake) * scene.factor).astype(np.int64)
    fine = rough.astype(np.float64)
    size, reach = (box[3] * scene.factor, box[2] * scene.factor), scene.factor + 1
    patch = cut_window(scene.frames[row], rough[row], size)
    for k in np.flatnonzero(np.isfinite(corner[:, 0])):
        around = cut_window(scene.frames[k], rough[k] - reach, (size[0] + 2 * reach, size[1] + 2 * reach))
        fine[k] += best_match(around, patch)[0] - reach
    return fine


def _largest_patches(mask: Mask) -> Mask:
    """The largest connected region, and those nearly as large (both edges of a plain body); everything without any."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    if len(stats) < 2:
        return np.ones(mask.shape, np.bool_)
    large = 1 + np.flatnonzero(stats[1:, 4] > 0.5 * stats[1:, 4].max())
    return np.asarray(np.isin(labels, large))


def _rectangle(appearance: BodyAppearance) -> Rectangle:
    """Rectangle inside the body where its texture lies there; round it where most contrast is in the outline."""
    bits = appearance.member.astype(np.uint8)
    energy = np.sum(np.square(np.gradient(appearance.picture)), axis=0)
    core = cv2.erode(bits, np.ones((7, 7), np.uint8)) > 0
    outlined = cv2.dilate(bits, np.ones((3, 3), np.uint8)) > 0
    if energy[core].sum() > MIN_INSIDE_CONTRAST * energy[outlined].sum():
        return inner_rectangle(appearance.member)
    x, y, w, h = cv2.boundingRect(bits)
    return (x - MARGIN_PX, y - MARGIN_PX, w + 2 * MARGIN_PX, h + 2 * MARGIN_PX)


def inner_rectangle(member: Mask) -> Rectangle:
    """Compute a rectangle inside a mask.

    Sides move inward until nearly all their pixels are inside, then a little further: interpolation reaches across the
    edge, and background would leak in.

    Parameters
    ----------
    member : array of bool (h, w)
        Pixels of the body.

    Returns
    -------
    tuple of int
        x, y, w, h in px.

    Examples
    --------
    >>> mask = np.zeros((40, 40), bool)
    >>> mask[5:35, 8:38] = True
    >>> inner_rectangle(mask)
    (10, 7, 26, 26)

    """
    x, y, w, h = cv2.boundingRect(member.astype(np.uint8))
    x1, y1 = x + w, y + h
    while min(x1 - x, y1 - y) > 8:
        part = member[y:y1, x:x1]
        fill = [part[:, 0].mean(), part[0].mean(), part[:, -1].mean(), part[-1].mean()]
        side = int(np.argmin(fill))
        if fill[side] > 0.85:
            break
        x, y, x1, y1 = x + (side == 0), y + (side == 1), x1 - (side == 2), y1 - (side == 3)
    inset = int(np.clip(min(x1 - x, y1 - y) // 12, 0, 3))
    return (x + inset, y + inset, x1 - x - 2 * inset, y1 - y - 2 * inset)


def foreground_at(scene: SampledScene, rectangle: Rectangle, frame: int) -> Mask:
    """Mark the pixels of the body in and about a rectangle of a sampled frame.

    Parameters
    ----------
    scene : SampledScene
        Sampled frames.
    rectangle : tuple of int
        x, y, w, h on the full picture, px.
    frame : int
        Number of the frame.

    Returns
    -------
    array of bool (H, W)
        The region that holds most of the rectangle, to the middle of its blurred edge; empty without one.

    """
    height, width = scene.frames[0].shape
    found = np.zeros((height, width), np.bool_)
    if frame not in scene.index:  # it cannot be read
        return found
    row = scene.index.index(frame)
    x, y, w, h = rectangle
    reach = max(w, h)
    x0, y0, x1, y1 = max(x - reach, 0), max(y - reach, 0), min(x + w + reach, width), min(y + h + reach, height)
    size = y1 - y0, x1 - x0
    still = (np.array([x0, y0]) + 0.5) / scene.factor - 0.5 - scene.shake[row]
    matrix = np.array([[1 / scene.factor, 0, still[0]], [0, 1 / scene.factor, still[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    background = cv2.warpAffine(scene.background, matrix, size[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE)
    shown = scene.frames[row][y0:y1, x0:x1].astype(np.float32) / np.float32(scene.light[row])
    change = cv2.GaussianBlur(np.abs(shown - background), (0, 0), 1.0)
    level = 0.5 * float(np.median(change[y - y0 : y - y0 + h, x - x0 : x - x0 + w]))
    bits = cv2.morphologyEx((change > level).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    bits = cv2.morphologyEx(bits, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    _, labels = cv2.connectedComponents(bits)
    inside = labels[y - y0 : y - y0 + h, x - x0 : x - x0 + w]
    counts = np.bincount(inside.ravel())
    counts[0] = 0
    if counts.any():
        found[y0:y1, x0:x1] = labels == int(np.argmax(counts))
    return found


def round_outline(mask: Mask) -> Polygon:
    """Compute the outline of a round body, a little outside its edge.

    Parameters
    ----------
    mask : array of bool (H, W)
        Pixels of the body.

    Returns
    -------
    tuple of tuple of float
        Corners (x, y) px; empty where the body is not round or its outline leaves the picture.

    """
    edges, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not edges:
        return ()
    edge = max(edges, key=len)[:, 0].astype(np.float64)
    if np.ptp(edge, axis=0).min() < MIN_SIDE_PX:
        return ()
    middle, radius = _circle(edge)
    off = np.abs(np.hypot(*(edge - middle).T) - radius)
    turn = np.arange(N_ROUND_CORNERS) * 2 * np.pi / N_ROUND_CORNERS
    circumscribed = (radius + 0.5 + ROUND_MARGIN_PX) / np.cos(np.pi / N_ROUND_CORNERS)
    corners = middle + circumscribed * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    leaves = np.any(corners < 0) or np.any(corners > np.array(mask.shape[::-1]) - 1)
    if np.mean(off < max(1.0, MAX_ROUGHNESS * radius)) < MIN_ROUND_SHARE or leaves:
        return ()
    return tuple((round(float(x), 1), round(float(y), 1)) for x, y in corners)


def _circle(edge: Array) -> tuple[Array, float]:
    """Middle (2,) and radius of the circle that most points (n, 2) of an edge lie on, by reweighted least squares."""
    weight = np.ones(len(edge))
    for _ in range(10):  # x^2 + y^2 = 2 a x + 2 b y + c
        columns = np.column_stack([edge, np.ones(len(edge))]) * weight[:, None]
        a, b, c = np.linalg.lstsq(columns, weight * np.sum(edge**2, axis=1), rcond=None)[0]
        middle = np.array([a, b]) / 2
        radius = float(np.sqrt(max(c + middle @ middle, 1.0)))
        weight = 1 / (1 + (np.hypot(*(edge - middle).T) - radius) ** 2)
    return middle, radius


def _rotating_outline(scene: SampledScene, body: Body, frame: int | None) -> tuple[Rectangle, int]:
    """Rectangle inside the region of a body that rotates: in the wanted frame or the first that shows it."""
    index, seen = np.array(scene.index), np.flatnonzero(body.seen)
    row = int(np.flatnonzero(index == frame)[0]) if frame in index else int(seen[0])
    x0, y0 = np.rint(body.corner[row]).astype(int).tolist()
    size = body.box[3], body.box[2]
    mask = cut_window(scene.foreground[row].astype(np.uint8), np.array([x0, y0]), size) > 0
    shown, still = (cut_window(p, np.array([x0, y0]), size) for p in (scene.small[row], scene.background))
    mask = without_shadow(mask, shown[None] / np.float32(scene.light[row]), still[None])
    x, y, w, h = inner_rectangle(mask)
    at = np.rint((np.array([x0 + x, y0 + y]) + scene.shake[row]) * scene.factor).astype(int)
    height, width = scene.frames[0].shape
    left, top = np.clip(at, 0, (width - MIN_SIDE_PX, height - MIN_SIDE_PX)).tolist()
    w, h = (max(side * scene.factor, MIN_SIDE_PX) for side in (w, h))
    return (left, top, min(w, width - left), min(h, height - top)), scene.index[row]
