"""Find a body that turns as it travels: it never looks the same twice, and yet its patch keeps its size.

A picture that is only moved does not fit such a body in any later frame. What can be followed is the one patch of
foreground, of the same area in most frames, whose middle travels.
"""

from __future__ import annotations

import cv2
import numpy as np

from frictrack.records import Array, Mask
from frictrack.tracking.correlation import Rectangle
from frictrack.tracking.detection.body_outline import inner_rectangle
from frictrack.tracking.detection.sampled_scene import MIN_SIDE_PX, SampledScene

MAX_AREA_DEVIATION = 0.25  # relative to the typical area: shadows, and objects that it passes
MIN_FRAME_SHARE, MIN_FRAMES = 0.6, 4  # share and number of the sampled frames that must show the region
MIN_TRAVEL = 0.5  # of the region's centre, over the root of its area
MAX_STEP_SHARE = 0.4  # of the whole travel; a longer step between two samples is a jump to another object
MAX_KNOWN_AREA_SHARE = 0.25  # of the region; a smaller body with a constant appearance is background that it uncovers
MIN_AREA_SHARE = 0.6  # of the largest inner rectangle, for that of the first frame to be used


def rotating_body(scene: SampledScene, found_area: float = 0.0) -> tuple[Rectangle, int] | None:
    """Rectangle inside the one travelling patch of foreground, px, and the frame it refers to.

    None where no patch of a steady size travels, or where what was found already, `found_area` (px, reduced), is more
    than a scrap of it.
    """
    areas = np.array([blobs[0].area if blobs and not blobs[0].cut else 0 for blobs in scene.blobs], dtype=np.float64)
    if not np.any(areas):
        return None
    typical_area = float(np.median(areas[areas > 0]))
    rows = np.flatnonzero(np.abs(areas - typical_area) < MAX_AREA_DEVIATION * typical_area)
    if found_area >= MAX_KNOWN_AREA_SHARE * typical_area or len(rows) < max(MIN_FRAMES, MIN_FRAME_SHARE * len(areas)):
        return None
    masks = {row: _largest(scene, row) for row in rows.tolist()}
    return _rectangle(scene, masks) if _travels(masks, typical_area) else None


def _largest(scene: SampledScene, row: int) -> Mask:
    """The largest patch of foreground of a sampled frame."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(scene.foreground[row].astype(np.uint8))
    blob = scene.blobs[row][0]
    same = [k for k in range(1, len(stats)) if tuple(stats[k, :4]) == blob.box and stats[k, 4] == blob.area]
    return np.asarray(labels == same[0])


def _travels(masks: dict[int, Mask], area: float) -> bool:
    """Whether the middle of a patch goes a good part of its size, and does not jump."""
    middle = np.array([_middle(mask) for mask in masks.values()])
    distance = float(np.hypot(*np.ptp(middle, axis=0)))
    step = float(np.max(np.hypot(*np.diff(middle, axis=0).T)))
    return distance > MIN_TRAVEL * np.sqrt(area) and step < MAX_STEP_SHARE * distance


def _middle(mask: Mask) -> Array:
    rows, columns = np.nonzero(mask)
    return np.array([columns.mean(), rows.mean()])


def _rectangle(scene: SampledScene, masks: dict[int, Mask]) -> tuple[Rectangle, int] | None:
    """The largest rectangle inside the patch: in the first frame, unless that is much smaller than in another."""
    found = {row: inner_rectangle(mask) for row, mask in masks.items()}
    first, best = min(found), max(found, key=lambda row: found[row][2] * found[row][3])
    row = first if _area(found[first]) > MIN_AREA_SHARE * _area(found[best]) else best
    x, y, w, h = found[row]
    if min(w, h) * scene.factor < MIN_SIDE_PX:
        return None
    at = np.rint((np.array([x, y]) + scene.shake[row]) * scene.factor).astype(int)
    return (int(at[0]), int(at[1]), w * scene.factor, h * scene.factor), scene.index[row]


def _area(rectangle: Rectangle) -> int:
    return rectangle[2] * rectangle[3]
