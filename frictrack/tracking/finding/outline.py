"""The rectangle of a moving body on the full picture: the pixels that move with it, a little inside its edge."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array, Mask
from frictrack.tracking.finding.scene import LOOKS, Picture, Scene, behind_of, read, tidy, window
from frictrack.tracking.match import Rectangle, correlate, vertex

ALIKE = 0.1  # share left unexplained in a frame that still shows the body well
STEADY = 6  # times the body's own noise variance above which a pixel is not the body's
AROUND = 2  # px round a plain body, so that its whole edge is in, blurred as it is
SHOWS = 4  # times that variance by which a pixel must differ from the background
FEW = 5  # frames of which a median tells nothing
OUTLINE = 0.4  # least share of the contrast that must lie inside the body, away from its edge


@dataclass(frozen=True, eq=False)
class Look:
    """What a body looks like, from sampled frames registered on it: a window somewhat larger than it."""

    picture: Picture  # median of the registered frames
    member: Mask  # pixels that move with the body
    corner: NDArray[np.int64]  # (k, 2) px, corner of the window in each frame
    rows: NDArray[np.int64]  # (k,) those frames
    misfit: Array  # (k,) share of each that the median does not explain


def outline(scene: Scene, box: Rectangle, row: int, corner: Array, frame: int | None = None) -> tuple[Rectangle, int]:
    """The rectangle of a body and the frame it refers to: the first, unless that shows it badly, or `frame`.

    The body has this reduced `box` in sampled frame `row` and was seen at `corner` (k, 2), reduced, in the others.
    """
    look = _look(scene, box, row, corner)
    x, y, w, h = _rectangle(look)
    at = _row(scene, look, frame)
    left, top = (int(c) for c in look.corner[at])
    height, width = scene.frames[0].shape
    x0, y0 = np.clip(left + x, 0, width - 8), np.clip(top + y, 0, height - 8)
    x1, y1 = np.clip(left + x + w, x0 + 8, width), np.clip(top + y + h, y0 + 8, height)
    return (int(x0), int(y0), int(x1 - x0), int(y1 - y0)), scene.index[look.rows[at]]


def _row(scene: Scene, look: Look, frame: int | None) -> int:
    """Which of the registered frames the rectangle is given in."""
    index = np.array(scene.index)[look.rows]
    if frame is not None and frame in index:
        return int(np.flatnonzero(index == frame)[0])
    typical = int(np.argmin(look.misfit))
    return 0 if look.misfit[0] < max(2 * look.misfit[typical], ALIKE) else typical


def _look(scene: Scene, box: Rectangle, row: int, corner: Array) -> Look:
    """A pixel moves with the body if the body's median picture explains it better than the background does."""
    w, h = box[2] * scene.factor, box[3] * scene.factor
    reach = int(np.ceil(0.1 * max(w, h))) + 3
    shape = (h + 2 * reach, w + 2 * reach)
    seen = np.flatnonzero(np.isfinite(corner[:, 0]))
    rows = np.unique([row, *seen[np.linspace(0, len(seen) - 1, LOOKS).astype(int)]])
    whole = _full(scene, box, row, corner)[rows]
    at = whole - reach
    still = at - scene.shake[rows] * scene.factor
    background = behind_of(scene, box, corner)
    if scene.factor > 1:
        background = np.asarray(cv2.resize(background, None, fx=scene.factor, fy=scene.factor), dtype=np.float32)
    stack = np.stack([read(scene.frames[k], c, shape) / scene.light[k] for k, c in zip(rows, at, strict=True)])
    behind = np.stack([read(background, c, shape) for c in still])
    picture = np.median(stack, axis=0).astype(np.float32)
    member = _member(stack, behind, picture)
    return Look(picture, member, np.rint(at).astype(np.int64), rows, _misfit(stack[:, member], picture[member]))


def _member(stack: Picture, behind: Picture, picture: Picture) -> Mask:
    """The pixels that move with the body, of registered frames (k, h, w) and the scene behind them."""
    differs = _typical(stack - behind, 0.5)  # a plain background far brighter than the body must not leak in
    spread = _typical(stack - picture)
    member = _main(tidy(np.asarray(spread < 0.5 * differs), close=5))
    # In a shadow that goes along the scene shows through: it changes more than the body does in the same light.
    even = _evened(stack, picture, member)
    spread = _typical(even - picture)
    slope = np.sum(np.square(np.gradient(picture)), axis=0)  # of an edge that is registered to 0.2 px
    own = float(np.percentile(spread[member], 25))
    alike = (spread < STEADY * max(own, 0.25) + 0.04 * slope).astype(np.uint8)
    alike = cv2.dilate(alike, np.ones((3, 3), np.uint8))
    return _main(tidy(np.asarray((alike > 0) & (differs > np.maximum(2 * spread, SHOWS * own))), close=5))


def _typical(off: Picture, blur: float = 1.0) -> Picture:
    """Typical square (h, w) of deviations (k, h, w): their median, of few the mean."""
    squares = off**2
    usual = np.median(squares, axis=0) if len(off) > FEW else np.sum(squares, axis=0) / max(len(off) - 1, 1)
    return np.asarray(cv2.GaussianBlur(usual, (0, 0), blur), dtype=np.float32)


def _evened(stack: Picture, picture: Picture, member: Mask) -> Picture:
    """The frames in the light of the median picture, as told by the body's pixels."""
    pixels, wanted = stack[:, member], picture[member] - picture[member].mean()
    level = pixels.mean(axis=1)
    gain = (pixels - level[:, None]) @ wanted / max(float(wanted @ wanted), 1e-6)
    gain = np.where(gain > 0.2, gain, 1.0).astype(np.float32)
    return (stack - level[:, None, None]) / gain[:, None, None] + picture[member].mean()


def _full(scene: Scene, box: Rectangle, row: int, corner: Array) -> Array:
    """Corner (k, 2) px of the body's box on the full pictures, by one more match there."""
    rough = np.rint(np.nan_to_num(corner + scene.shake) * scene.factor).astype(np.int64)
    fine = rough.astype(np.float64)
    size, reach = (box[3] * scene.factor, box[2] * scene.factor), scene.factor + 1
    patch = window(scene.frames[row], rough[row], size)
    for k in np.flatnonzero(np.isfinite(corner[:, 0])):
        around = window(scene.frames[k], rough[k] - reach, (size[0] + 2 * reach, size[1] + 2 * reach))
        scores = correlate(around, patch)
        _, _, _, (i, j) = cv2.minMaxLoc(scores)
        fine[k] += np.array([i + vertex(scores[j], i), j + vertex(scores[:, i], j)]) - reach
    return fine


def _misfit(pictures: Picture, picture: Picture) -> Array:
    """Share (k,) of each picture (k, p) that the median picture (p,) does not explain, whatever the light."""
    pictures = pictures - pictures.mean(axis=1, keepdims=True)
    picture = picture - picture.mean()
    power = np.sum(pictures**2, axis=1) * np.sum(picture**2)
    return 1 - np.asarray(pictures @ picture, dtype=np.float64) ** 2 / np.maximum(power, 1e-12)


def _main(mask: Mask) -> Mask:
    """The largest connected patch, with those nearly as large (the two edges of a plain body); all if there is none."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    if len(stats) < 2:
        return np.ones(mask.shape, np.bool_)
    large = 1 + np.flatnonzero(stats[1:, 4] > 0.5 * stats[1:, 4].max())
    return np.asarray(np.isin(labels, large))


def _rectangle(look: Look) -> Rectangle:
    """Inside the body where its texture is; round it where most of its contrast is the outline."""
    bits = look.member.astype(np.uint8)
    energy = np.sum(np.square(np.gradient(look.picture)), axis=0)
    core = cv2.erode(bits, np.ones((7, 7), np.uint8)) > 0
    outlined = cv2.dilate(bits, np.ones((3, 3), np.uint8)) > 0
    if energy[core].sum() > OUTLINE * energy[outlined].sum():
        return inside(look.member)
    x, y, w, h = cv2.boundingRect(bits)
    return (x - AROUND, y - AROUND, w + 2 * AROUND, h + 2 * AROUND)


def inside(member: Mask) -> Rectangle:
    """Rectangle within the mask: sides come in until each is nearly all member, then a little further.

    The margin is what interpolation reaches across: background beyond the edge would leak in.
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
