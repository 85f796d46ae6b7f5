"""Check the track of a target that was found automatically against what moves in the film.

A match score says nothing there: an empty place before a plain wall matches itself perfectly, and a plain region
slides along inside a plain body. What moves is known without the template, by its difference from the scene without the
target. A sample contradicts the track where that is elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from frictrack.recording import Recording
from frictrack.records import Array, Mask, Track
from frictrack.tracking.detection.body_outline import Body
from frictrack.tracking.detection.sampled_scene import (
    Blob,
    Picture,
    SampledScene,
    sample_scene,
    scene_without,
)
from frictrack.tracking.detection.targets import body_merit, is_sharp, rival_question

MAX_CONTRADICTED = 0.25  # of the samples that tell where the target is
LOST_WEIGHT = 0.5  # of samples in which the target is hidden or away: they are known to be missing
MIN_SAMPLES = 3  # that tell it, and that show a place after the target has left it
MAX_ASTRAY_PX = 2  # reduced px from the track, of the place where what moves looks as usual
MARGIN_PX, SEARCH_SHARE, MIN_SEARCH_PX = 4, 0.35, 8  # about the target: its outline, and where it is searched
MIN_THICKNESS = 0.5  # of the target's shorter side, for a region that may be what it should be


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
    seen = np.isfinite(corner[:, 0])
    around = (*(3 * np.rint(size)).astype(int).tolist(),)  # the body may be that much larger
    rest = scene_without(scene, (0, 0, *around), corner - size)
    found = [_where(rest, k, (*(c - size / 4), *(1.5 * size)), min(size)) for k, c in enumerate(corner)]
    unknown = np.char.startswith(track.reason[scene.index], "match score")
    here, others = np.array([h for h, _ in found]), [o for _, o in found]
    elsewhere = ~here & np.array([len(o) > 0 for o in others]) | unknown
    # samples that tell where the target is, and those that contradict the track
    evidence = (here | elsewhere, elsewhere), _silhouettes(rest, corner, size, np.nan_to_num(track.angle[scene.index]))
    for tells, wrong in evidence:
        weight = np.where(seen | unknown, 1.0, LOST_WEIGHT) @ wrong
        if weight >= MIN_SAMPLES and weight > MAX_CONTRADICTED * tells.sum():
            row = int(np.argmax(wrong * np.array([1 + (o[0].area if o else 0) for o in others])))
            where = f" at {[round(v * scene.factor) for v in others[row][0].box]}" if others[row] else ""
            return (
                f"expected a moving target but the place that was found, {[round(v) for v in track.target]}, does not "
                f"go along with what moves in {wrong.sum()} of {tells.sum()} sampled frames, such as frame "
                f"{scene.index[row]}{where}; draw the target, or give target = [x, y, w, h]"
            )
    if not seen.any():
        return ""
    box, row = (*np.rint([*corner[seen][0], *size]).astype(int).tolist(),), int(np.flatnonzero(seen)[0])
    score = np.where(seen, track.score[scene.index], np.nan)
    return rival_question(scene, Body(box, row, corner, score, body_merit(scene, box, corner, score, np.eye(2))))


def _where(scene: SampledScene, k: int, box: Sequence[float], side: float) -> tuple[bool, list[Blob]]:
    """Whether a region of a sample is in a box, and regions elsewhere that may be the body: as thick, and no more cut.

    Without a box (NaN) any region may be the body.
    """
    if np.isnan(box[0]):
        return False, scene.blobs[k]
    here = [b for b in scene.blobs[k] if _overlaps(b.box, box)]
    others = [b for b in scene.blobs[k] if not _overlaps(b.box, box) and (any(h.cut for h in here) or not b.cut)]
    return len(here) > 0, [b for b in others if _thickness(b) > MIN_THICKNESS * side and is_sharp(scene, k, b.box)]


def _silhouettes(scene: SampledScene, corner: Array, size: Array, angle: Array) -> tuple[Mask, Mask]:
    """Samples (k,) that show the silhouette of what moves, and those where it lies elsewhere about the target.

    These are samples whose place other samples show without the target. A target that turns is turned back.
    """
    room, reach = np.array(scene.background.shape[::-1]), max(MIN_SEARCH_PX, int(SEARCH_SHARE * max(size)))
    inside = np.all((corner > -MARGIN_PX) & (corner + size < room + MARGIN_PX), axis=1)
    away = np.any(np.abs(corner[:, None] - corner[None]) > 2 * size, axis=2)
    tells = inside & (away.sum(axis=1) >= MIN_SAMPLES)
    astray, rows = np.zeros_like(tells), np.flatnonzero(tells)
    if len(rows) < MIN_SAMPLES:
        return astray, astray
    shape = np.rint(size).astype(int) + 2 * MARGIN_PX

    def silhouette(k: np.intp, margin: int) -> Picture:
        change = cv2.GaussianBlur(np.abs(scene.small[k] / np.float32(scene.light[k]) - scene.background), (0, 0), 1.0)
        c, s, (w, h) = np.cos(angle[k]), np.sin(angle[k]), (shape + 2 * margin).tolist()
        turn = np.array([[c, -s], [s, c]])  # as the target stood in its own frame
        at = corner[k] + (size - 1) / 2 - turn @ ((w - 1) / 2, (h - 1) / 2)
        matrix = np.column_stack([turn, at])
        return np.asarray(cv2.warpAffine(change, matrix, (w, h), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP))

    usual = np.median(np.stack([silhouette(k, 0) for k in rows]), axis=0).astype(np.float32)
    scores = [cv2.matchTemplate(silhouette(k, reach), usual, cv2.TM_CCOEFF_NORMED) for k in rows]
    off = np.abs([np.subtract(cv2.minMaxLoc(score)[3], reach) for score in scores])
    astray[rows] = off[:, int(np.argmax(np.ptp(corner[rows], axis=0)))] > MAX_ASTRAY_PX
    return tells, astray


def _thickness(blob: Blob) -> float:
    """Diameter of the largest circle inside a region, px."""
    return 2 * float(cv2.distanceTransform(np.pad(blob.mask.astype(np.uint8), 1), cv2.DIST_L2, 3).max())


def _overlaps(a: Sequence[float], b: Sequence[float]) -> bool:
    return bool(a[0] < b[0] + b[2] and b[0] < a[0] + a[2] and a[1] < b[1] + b[3] and b[1] < a[1] + a[3])
