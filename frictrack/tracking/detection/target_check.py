"""Check the track of a target that was found automatically against what moves in the film.

A match score says nothing there: an empty place before a plain wall matches itself perfectly, and a plain region
slides along inside a plain body. What moves is known without the template, by its difference from the scene without the
target.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from frictrack.recording import Recording
from frictrack.records import Array, Mask, Track
from frictrack.tracking.correlation import Rectangle
from frictrack.tracking.detection.sampled_scene import (
    MIN_SIDE_PX,
    Blob,
    Picture,
    SampledScene,
    background_without,
    read_subpixel,
    sample_scene,
    scene_before,
)
from frictrack.tracking.detection.targets import MIN_TRAVEL_PX, is_sharp, jumps, travel_distance

MIN_BUSY_SHARE = 0.25  # of the samples, in which something must move outside a target that rests
MAX_MISSED_SHARE = 0.4  # of the samples, in which something moves and the target is not found
MAX_ASTRAY_SHARE = 0.25  # of the samples, in which what moves is not where the target was found ...
MAX_ASTRAY_PX = 2  # ... by more than this, reduced px
MAX_UNKNOWN_SHARE = 0.25  # of the frames, in which nothing in the picture looks like the target
MIN_UNCOVERED_SAMPLES = 3  # that show a place after the target has left it
MARGIN_PX, SEARCH_SHARE, MIN_SEARCH_PX = 4, 0.35, 8  # about the target: its outline, and where it is searched
MIN_THICKNESS = 0.5  # of the target's shorter side, for a region that may be what it should be
MAX_TURN = 0.2  # rad; the silhouette of a body that turns by more changes


def target_fault(recording: Recording, track: Track) -> str:
    """Return what contradicts a target that was found automatically; empty where nothing does.

    Parameters
    ----------
    recording : Recording
        Film.
    track : Track
        Track of the target.

    Returns
    -------
    str
        What moves where, and what to do.

    """
    assert track.target is not None
    scene = sample_scene(recording)
    size = np.array(track.target[2:]) / scene.factor
    at = np.stack([track.x_px, track.y_px], axis=1)
    corner = (at[scene.index] + 0.5) / scene.factor - scene.shake - size / 2
    low, high = np.nanquantile(at, (0.1, 0.9), axis=0)
    seen = np.isfinite(corner[:, 0])
    if np.hypot(*(high - low)) <= MIN_TRAVEL_PX:
        box = (*(np.array(track.target[:2]) / scene.factor), *size)
        outside = [[b for b in blobs if _is_body(scene, b) and not _overlaps(b.box, box)] for blobs in scene.blobs]
        busy = np.array([len(blobs) > 0 for blobs in outside])
        why = "rests while something else moves" if busy.mean() > MIN_BUSY_SHARE else ""
    else:
        around = (*(3 * np.rint(size)).astype(int).tolist(),)  # the body may be that much larger
        scene = scene_before(scene, background_without(scene, (0, 0, *around), corner - size))
        boxes = [(*(c - size / 4), *(1.5 * size)) for c in corner]
        outside = [
            _others(scene, k, box, MIN_THICKNESS * min(size)) if seen[k] else scene.blobs[k]
            for k, box in enumerate(boxes)
        ]
        busy = np.array([len(blobs) > 0 for blobs in outside])
        astray = _astray(scene, corner, size) if np.ptp(track.angle[track.found]) < MAX_TURN else np.zeros(0, np.bool_)
        rows, why = np.flatnonzero(busy & seen), ""
        if jumps(at[track.found], travel_distance(at[track.found])):
            why = "jumps between places that look alike"
        elif len(astray) and astray.mean() > MAX_ASTRAY_SHARE:
            why = f"does not go along with what moves in {astray.sum()} of {len(astray)} frames"
        elif np.mean(busy & ~seen) > MAX_MISSED_SHARE:
            why = "is not found in many frames in which something moves"
        elif np.mean(busy & seen) > MIN_BUSY_SHARE and _travels([outside[k][0].box for k in rows]):
            why = "is not all that moves"
        elif (unknown := np.mean(np.char.startswith(track.reason, "match score"))) > MAX_UNKNOWN_SHARE:
            why = f"is not recognised in {unknown:.0%} of the frames"
    if not why:
        return ""
    row = int(np.argmax([blobs[0].area if blobs else 0 for blobs in outside]))
    where = ""
    if outside[row]:
        where = f", in frame {scene.index[row]} at {[round(v * scene.factor) for v in outside[row][0].box]}"
    return (
        f"expected a moving target but the place that was found, {[round(v) for v in track.target]}, {why}{where}; "
        "draw the target, or give target = [x, y, w, h]"
    )


def _travels(boxes: Sequence[Rectangle]) -> bool:
    """Whether both sides of a region move: what a resting body uncovers has a side that does not."""
    sides = np.array([((x, x + w), (y, y + h)) for x, y, w, h in boxes], dtype=np.float64)
    spans = np.ptp(np.quantile(sides, (0.1, 0.9), axis=0), axis=0)
    return any(min(span) > MIN_SIDE_PX / 2 for span in spans)


def _others(scene: SampledScene, k: int, box: Sequence[float], thickness: float) -> list[Blob]:
    """Regions of a sample that may be the body instead of a target in a box: outside it, and no more cut off."""
    cut = any(b.cut and _overlaps(b.box, box) for b in scene.blobs[k])
    others = [b for b in scene.blobs[k] if not _overlaps(b.box, box) and (cut or not b.cut)]
    return [b for b in others if _thickness(b) > thickness and is_sharp(scene, k, b.box)]


def _astray(scene: SampledScene, corner: Array, size: Array) -> Mask:
    """Whether the silhouette of what moves lies elsewhere about the target, in samples that can show it (k,).

    These are samples whose place other samples show without the target.
    """
    room, reach = np.array(scene.background.shape[::-1]), max(MIN_SEARCH_PX, int(SEARCH_SHARE * max(size)))
    inside = np.all((corner > -MARGIN_PX) & (corner + size < room + MARGIN_PX), axis=1)
    away = np.any(np.abs(corner[:, None] - corner[None]) > 2 * size, axis=2)
    rows = np.flatnonzero(inside & (away.sum(axis=1) >= MIN_UNCOVERED_SAMPLES))
    if len(rows) < MIN_UNCOVERED_SAMPLES:
        return np.zeros(0, np.bool_)
    h, w = np.rint(size[::-1]).astype(int) + 2 * MARGIN_PX

    def silhouette(k: np.intp, margin: int) -> Picture:
        change = cv2.GaussianBlur(np.abs(scene.small[k] / np.float32(scene.light[k]) - scene.background), (0, 0), 1.0)
        return read_subpixel(change, corner[k] - MARGIN_PX - margin, (h + 2 * margin, w + 2 * margin))

    usual = np.median(np.stack([silhouette(k, 0) for k in rows]), axis=0).astype(np.float32)
    scores = [cv2.matchTemplate(silhouette(k, reach), usual, cv2.TM_CCOEFF_NORMED) for k in rows]
    off = np.abs([np.subtract(cv2.minMaxLoc(score)[3], reach) for score in scores])
    return np.asarray(off[:, int(np.argmax(np.ptp(corner[rows], axis=0)))] > MAX_ASTRAY_PX)


def _thickness(blob: Blob) -> float:
    """Diameter of the largest circle inside a region, px."""
    return 2 * float(cv2.distanceTransform(np.pad(blob.mask.astype(np.uint8), 1), cv2.DIST_L2, 3).max())


def _is_body(scene: SampledScene, blob: Blob) -> bool:
    return min(blob.box[2:]) >= scene.min_side_reduced


def _overlaps(a: Sequence[float], b: Sequence[float]) -> bool:
    return bool(a[0] < b[0] + b[2] and b[0] < a[0] + a[2] and a[1] < b[1] + b[3] and b[1] < a[1] + a[3])
