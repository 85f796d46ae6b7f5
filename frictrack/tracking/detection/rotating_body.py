"""Find a body that rotates as it travels: its appearance changes, but its region keeps its size."""

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
    """Find a rectangle inside the one travelling region of foreground.

    Parameters
    ----------
    scene : SampledScene
        Sampled frames.
    found_area : float
        Area of a body that was already found, reduced px.

    Returns
    -------
    tuple or None
        Rectangle (x, y, w, h) px and the number of its frame. None where no region of constant size travels, or where
        the
        body already found is more than a small part of it.

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
    """The largest region of foreground in a sampled frame."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(scene.foreground[row].astype(np.uint8))
    blob = scene.blobs[row][0]
    same = [k for k in range(1, len(stats)) if tuple(stats[k, :4]) == blob.box and stats[k, 4] == blob.area]
    return np.asarray(labels == same[0])


def _travels(masks: dict[int, Mask], area: float) -> bool:
    """Whether the centre of a region moves by a good part of its size, without jumps."""
    middle = np.array([_middle(mask) for mask in masks.values()])
    distance = float(np.hypot(*np.ptp(middle, axis=0)))
    step = float(np.max(np.hypot(*np.diff(middle, axis=0).T)))
    return distance > MIN_TRAVEL * np.sqrt(area) and step < MAX_STEP_SHARE * distance


def _middle(mask: Mask) -> Array:
    rows, columns = np.nonzero(mask)
    return np.array([columns.mean(), rows.mean()])


def _rectangle(scene: SampledScene, masks: dict[int, Mask]) -> tuple[Rectangle, int] | None:
    """Largest rectangle inside the region: in the first frame, unless it is much smaller than in another one."""
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
