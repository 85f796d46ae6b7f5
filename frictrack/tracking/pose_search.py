"""Search a frame for a rotated target by matching a bank of rotated templates."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from frictrack.records import Array
from frictrack.tracking.correlation import Patch
from frictrack.tracking.pose import Pose, RotatableTemplate, refine_pose, to_target_frame

MAX_ANGULAR_STEP = np.radians(25.0)  # rad per frame
SEARCH_RADIUS_PX = 24  # round the prediction
GOOD_SCORE_SHARE = 0.8  # of the typical score; such a match near the prediction ends the search
# Pictures are reduced for searching to this shorter side of the target and this number of pixels in a frame, px.
SEARCH_TARGET_PX, SEARCH_FRAME_PX = 20, 400_000


def search_pose(
    frame: Patch,
    predicted: Pose,
    rotatable: RotatableTemplate,
    typical_score: float,
    *,
    everywhere: bool = True,
    typical_misfit: float = np.nan,
) -> Pose | None:
    """Search a frame for the target: near a prediction, then anywhere, then at any angle.

    Parameters
    ----------
    frame : array (H, W)
        Grey values.
    predicted : Pose
        Prediction from the frames before.
    rotatable : RotatableTemplate
        Template of the target.
    typical_score : float
        Match score of the last finds.
    everywhere : bool
        Whether to search beyond the neighbourhood of the prediction.
    typical_misfit : float
        Misfit of a frame that shows only target and noise; NaN where it is not known.

    Returns
    -------
    Pose or None
        The best pose; None where nothing could be matched.

    """
    step = 2.0 / rotatable.radius
    likely_angles = predicted.angle + np.arange(-MAX_ANGULAR_STEP, MAX_ANGULAR_STEP + step / 2, step)
    rounds = [
        (likely_angles, SEARCH_RADIUS_PX),
        (likely_angles, 0),
        (predicted.angle + np.arange(0, 2 * np.pi, step), 0),
    ]
    best: Pose | None = None
    for angles, reach in rounds if everywhere else rounds[:1]:
        start = _match_rotations(frame, predicted, rotatable, angles, reach)
        found = None if start is None else _refine_match(frame, start, rotatable, typical_misfit)
        if found is not None and (best is None or (found.converged, found.score) > (best.converged, best.score)):
            best = found
        if best is not None and best.converged and best.score >= GOOD_SCORE_SHARE * typical_score:
            break
    return best


def _refine_match(frame: Patch, start: Pose, rotatable: RotatableTemplate, typical_misfit: float) -> Pose:
    """Refine a rough match, first by its own residual scale and then by the typical misfit."""
    rough = refine_pose(frame, start, rotatable, trusted=True)
    if np.isnan(typical_misfit) or not rough.converged:
        return rough
    return refine_pose(frame, rough, rotatable, typical_misfit, trusted=True)


def _match_rotations(
    frame: Patch, predicted: Pose, rotatable: RotatableTemplate, angles: Array, reach: int
) -> Pose | None:
    """The best match of the template at some angles, within `reach` px of a prediction, or anywhere for 0."""
    scale = _scale(rotatable, frame)
    low, part = _crop(frame, predicted.centre, rotatable.radius + reach if reach else np.inf)
    small = cv2.resize(part.astype(np.float32), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    best, where, angle = -np.inf, np.zeros(2), 0.0
    for one in angles:
        patch, mask = _rotated_patch(rotatable, float(one), scale)
        if patch.shape[0] > small.shape[0] or patch.shape[1] > small.shape[1]:
            continue
        scores = cv2.matchTemplate(small, patch, cv2.TM_CCOEFF_NORMED, mask=mask)
        scores[~np.isfinite(scores) | (np.abs(scores) > 1.001)] = -1
        _, score, _, (x, y) = cv2.minMaxLoc(scores)
        if score > best:
            best, angle = score, float(one)
            where = (np.array([x, y]) + (np.array(patch.shape[::-1]) - 1) / 2 + 0.5) / scale - 0.5 + low
    return None if not np.isfinite(best) else replace(predicted, centre=where, angle=angle)


def _scale(rotatable: RotatableTemplate, frame: Patch) -> float:
    """Factor by which pictures are reduced for searching."""
    side = min(rotatable.template.weight.shape)
    return min(
        1.0,
        max(
            SEARCH_TARGET_PX / side,
            np.sqrt(SEARCH_FRAME_PX / frame.size) if side > 2 * SEARCH_TARGET_PX else SEARCH_TARGET_PX / side,
        ),
    )


def _crop(frame: Patch, centre: Array, reach: float) -> tuple[Array, Patch]:
    """Part of a frame within reach of a centre, and its upper left corner."""
    if np.isinf(reach):
        return np.zeros(2), frame
    low = np.floor(centre - reach).astype(int).clip(0, np.array(frame.shape[::-1]) - 1)
    high = np.ceil(centre + reach).astype(int) + 1
    high = np.maximum(high, low + 1)
    return low.astype(np.float64), frame[low[1] : high[1], low[0] : high[0]]


def _rotated_patch(rotatable: RotatableTemplate, angle: float, scale: float) -> tuple[Patch, Patch]:
    """Template rotated and reduced, and its mask of 1 and 0."""
    corners = _corners(rotatable, Pose(np.zeros(2), angle))
    w, h = (int(v) for v in 2 * np.ceil(np.abs(corners).max(axis=1) * scale) + 1)
    x, y = (np.arange(n) - (n - 1) / 2 for n in (w, h))
    places = np.stack(np.meshgrid(x, y)).reshape(2, -1) / scale
    at = to_target_frame(places, np.zeros(2), angle) + rotatable.middle[:, None]
    shown = rotatable.weight(at) > 0
    image = cv2.GaussianBlur(rotatable.template.image.astype(np.float32), (0, 0), 0.4 / scale) if scale < 1 else None
    if image is None:
        values = np.where(shown, rotatable.read(at)[0], 0.0)
    else:
        i, j = (np.rint(q).astype(int).clip(0, n - 1) for q, n in zip(at[::-1], image.shape, strict=True))
        values = np.where(shown, image[i, j], 0.0)
    return values.reshape(h, w).astype(np.float32), shown.reshape(h, w).astype(np.float32)


def _corners(rotatable: RotatableTemplate, pose: Pose) -> Array:
    """Corners (2, 4) px of the rotated rectangle."""
    x, y = rotatable.middle
    return to_target_frame(np.array([[-x, x, x, -x], [-y, -y, y, y]]), np.zeros(2), -pose.angle) + pose.centre[:, None]
