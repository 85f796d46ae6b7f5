"""Compute the rectangle of a moving body on the full picture: inside its outline, or inside a rotating region."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from frictrack.base.polygons import Polygon
from frictrack.records import Array, Mask
from frictrack.tracking.correlation import Rectangle
from frictrack.tracking.detection.sampled_scene import (
    MIN_SIDE_PX,
    Picture,
    SampledScene,
    clean_mask,
    read_subpixel,
    scene_without,
)

MAX_NOISE_RATIO = 6  # variance of a pixel over that of the body, above which it does not belong to the body
MIN_CONTRAST_RATIO = 4  # squared difference from the background over the body's variance
REACH_PX = 3  # about the box of a body, that are looked at, reduced px
MARGIN_PX = 2  # round a plain body, so that its whole blurred edge is included
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


def body_outline(scene: SampledScene, body: Body, frame: int | None = None) -> tuple[Rectangle, int]:
    """Compute the rectangle of a body and the frame to which it refers.

    What belongs to the body is foreground in most of the sampled frames when these are laid over each other; of a body
    that rotates, in its own frame.

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
    seen = np.flatnonzero(body.seen)
    row = next((k for k in seen.tolist() if scene.index[k] == frame), int(seen[0]))
    rows = np.array([row]) if body.rotates else seen
    alone = scene_without(scene, body.box, body.corner)
    shape = body.box[3] + 2 * REACH_PX, body.box[2] + 2 * REACH_PX
    corners = np.nan_to_num(body.corner) - REACH_PX
    stack = np.stack([read_subpixel(alone.small[k], corners[k], shape) / np.float32(alone.light[k]) for k in rows])
    backgrounds = np.stack([read_subpixel(alone.background, corners[k], shape) for k in rows])
    share = np.mean([read_subpixel(alone.foreground[k].astype(np.float32), corners[k], shape) for k in rows], axis=0)
    picture = np.median(stack, axis=0).astype(np.float32)
    # what goes along with the body resembles its picture more than the background ...
    both = [cv2.GaussianBlur(np.median((stack - p) ** 2, axis=0), (0, 0), 0.7) for p in (picture, backgrounds)]
    spread, change = both
    member = (share > 0.5) & (spread < 0.5 * change)
    if member.any():  # ... and changes no more than it does: the scene is visible through a moving shadow
        noise = max(float(np.percentile(spread[member], 25)), 0.25)
        registered = 0.04 * np.sum(np.square(np.gradient(picture)), axis=0)  # an edge, to 0.2 px
        member &= (spread < MAX_NOISE_RATIO * noise + registered) & (change > MIN_CONTRAST_RATIO * noise)
    member = without_shadow(_largest_patches(clean_mask(member, close=5)), stack, backgrounds)
    x, y, w, h = _rectangle(member, picture, scene.factor)
    height, width = scene.frames[0].shape
    corner = np.rint((corners[row] + (x, y) + scene.shake[row]) * scene.factor).astype(int)
    low = np.clip(corner, 0, (width - MIN_SIDE_PX, height - MIN_SIDE_PX))
    high = np.clip(corner + np.multiply((w, h), scene.factor), low + MIN_SIDE_PX, (width, height))
    return (*low.tolist(), *(high - low).tolist()), scene.index[row]


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


def _largest_patches(mask: Mask) -> Mask:
    """The largest connected region, and those nearly as large (both edges of a plain body); everything without any."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    if len(stats) < 2:
        return np.ones(mask.shape, np.bool_)
    large = 1 + np.flatnonzero(stats[1:, 4] > 0.5 * stats[1:, 4].max())
    return np.asarray(np.isin(labels, large))


def _rectangle(member: Mask, picture: Picture, factor: int) -> Rectangle:
    """Rectangle inside the body where its texture lies there; round it where most contrast is in the outline."""
    bits = member.astype(np.uint8)
    energy = np.sum(np.square(np.gradient(picture)), axis=0)
    core = cv2.erode(bits, np.ones((7, 7), np.uint8)) > 0
    outlined = cv2.dilate(bits, np.ones((3, 3), np.uint8)) > 0
    if energy[core].sum() > MIN_INSIDE_CONTRAST * energy[outlined].sum():
        return inner_rectangle(member, factor)
    x, y, w, h = cv2.boundingRect(bits)
    return (x - MARGIN_PX, y - MARGIN_PX, w + 2 * MARGIN_PX, h + 2 * MARGIN_PX)


def inner_rectangle(member: Mask, factor: int = 1) -> Rectangle:
    """Compute a rectangle inside a mask.

    Sides move inward until nearly all their pixels are inside, then a little further: interpolation reaches across the
    edge, and background would leak in.

    Parameters
    ----------
    member : array of bool (h, w)
        Pixels of the body.
    factor : int
        Number of pixels of the film in one of these, along either axis.

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
    inset = -(-min(factor * min(x1 - x, y1 - y) // 12, 3) // factor)
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
