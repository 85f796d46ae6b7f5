"""Find moving bodies: regions that differ from the static scene, keep their appearance, and travel.

All searches use reduced pictures; only the outline of the chosen body is found on full ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.recording import Recording
from frictrack.records import Array, Mask, Track
from frictrack.tracking.correlation import Rectangle, correlate, parabola_vertex
from frictrack.tracking.detection.body_outline import Body, body_outline, rotating_body
from frictrack.tracking.detection.sampled_scene import Blob, Picture, SampledScene, sample_scene, without_body
from frictrack.tracking.detection.small_motion import most_moving_patch

MIN_TRAVEL_PX = 1.5  # of a moving body
MIN_BUSY_SHARE = 0.25  # of the samples, in which something must move outside a target that rests
MIN_SCORE = 0.6  # of a find
DISTANCE_PENALTY = 0.3  # by which the score of a match on the other side of the picture must be better
MAX_SHADING_SHARE = 0.15  # share of the contrast that a plane leaves; less is only a gradient of light
MIN_FINDS = 8  # from which some must lie on the way, or the finds jump between similar objects
N_CANDIDATE_FRAMES = 6  # sampled frames from which candidates are taken
MAX_BODIES = 8  # that are followed through the sampled frames
CUT_OFF_MERIT = 0.2  # factor for a body that the picture's edge always cuts off, such as an arm or a rod
# A second body makes the target ambiguous when it is this large (px, share of the area), travels this share of the
# first one's way, and matches this well in this share of the frames ...
MIN_RIVAL_SIDE_PX, MIN_RIVAL_AREA, MIN_RIVAL_TRAVEL, MIN_RIVAL_SCORE, MIN_RIVAL_FRAMES = (16, 0.25, 0.5, 0.7, 0.6)
MIN_RELATIVE_TRAVEL = 0.3  # ... and moves relative to it by this share; shadows, reflections and attached rods do not


RESTS = (
    "expected a moving target but the place that was found rests while something else moves; draw the target, or give "
    "target = [x, y, w, h]"
)


def find_target(recording: Recording) -> Rectangle:
    """Find the rectangle of the moving body.

    Parameters
    ----------
    recording : Recording
        Film.

    Returns
    -------
    tuple of int
        x, y, w, h in px, in the first frame; `locate_target` returns the frame if it is another one.

    Raises
    ------
    FrictrackError
        As `locate_target` does.

    """
    return locate_target(recording)[0]


def locate_target(recording: Recording) -> tuple[Rectangle, int]:
    """Find the rectangle of the body that moves farthest, and the frame to which it refers.

    A rotating body changes its appearance; it is found as a region of constant size that travels. If nothing travels by
    more than a pixel or two, the patch with the most significant smaller motion is used; if nothing moves, the patch
    that
    can be tracked best.

    Parameters
    ----------
    recording : Recording
        Film.

    Returns
    -------
    rectangle : tuple of int
        x, y, w, h in px, slightly inside the outline of the body.
    frame : int
        Number of the frame.

    Raises
    ------
    FrictrackError
        For a film without contrast or texture, or with two bodies that move independently.

    """
    scene, bodies = _find_bodies(sample_scene(recording))
    rotating = rotating_body(scene, bodies[0].box[2] * bodies[0].box[3] if bodies else 0.0)
    if rotating is not None:
        return rotating
    if not bodies and scene.shake.any():  # perhaps what filled the picture was the body, and no shake
        scene, bodies = _find_bodies(sample_scene(recording, steady=False))
    if not bodies:
        return _small_motion_patch(recording, scene)
    rivals = [body for body in bodies[1:] if _is_rival(scene, bodies[0], body)]
    if rivals:
        raise FrictrackError(_ambiguity_message(recording, scene, (bodies[0], rivals[0])))
    return body_outline(scene, bodies[0])


def rests_while_others_move(recording: Recording, track: Track) -> bool:
    """Return whether a target that was found automatically rests, while something outside it moves in the film.

    Its match score says nothing then: an empty place before a plain wall matches itself perfectly.

    Parameters
    ----------
    recording : Recording
        Film.
    track : Track
        Track of the target.

    """
    found = track.found
    low, high = np.quantile(np.stack([track.x_px[found], track.y_px[found]]), (0.02, 0.98), axis=1)
    if track.target is None or np.hypot(*(high - low)) > MIN_TRAVEL_PX:
        return False
    scene = sample_scene(recording)
    x, y, w, h = np.array(track.target) / scene.factor
    outside = [
        [b for b in blobs if min(b.box[2:]) >= scene.min_side_reduced and not _overlaps(b.box, (x, y, w, h))]
        for blobs in scene.blobs
    ]
    return bool(np.mean([len(blobs) > 0 for blobs in outside]) > MIN_BUSY_SHARE)


def _overlaps(a: Sequence[float], b: Sequence[float]) -> bool:
    return bool(a[0] < b[0] + b[2] and b[0] < a[0] + a[2] and a[1] < b[1] + b[3] and b[1] < a[1] + a[3])


def _small_motion_patch(recording: Recording, scene: SampledScene) -> tuple[Rectangle, int]:
    """The patch with the most significant small motion, in the first sampled frame."""
    found = most_moving_patch(scene)
    if found is None:
        raise FrictrackError(
            f"{recording.path.name}: expected a moving target but nothing in the film moves or has enough texture to "
            "be tracked; check the film, or give target = [x, y, w, h]"
        )
    return found, scene.index[0]


def _find_bodies(scene: SampledScene) -> tuple[SampledScene, list[Body]]:
    """Find the moving bodies; once more where the best of them was part of the background."""
    bodies = moving_bodies(scene)
    clean = without_body(scene, bodies[0].box, bodies[0].corner) if bodies else None
    found_again = moving_bodies(clean) if clean else []
    return (clean, found_again) if clean and found_again else (scene, bodies)


def moving_bodies(scene: SampledScene) -> list[Body]:
    """Find all bodies that travel.

    Parameters
    ----------
    scene : SampledScene
        Sampled frames.

    Returns
    -------
    list of Body
        The most suitable target first.

    """
    bodies: list[Body] = []
    for row, box in _candidates(scene):
        if len(bodies) < MAX_BODIES and not any(_is_same(body, row, box) for body in bodies):
            bodies.append(match_body(scene, row, box))
    return sorted((body for body in bodies if body.merit > 0), key=lambda body: -body.merit)


def _candidates(scene: SampledScene) -> Iterator[tuple[int, Rectangle]]:
    """Boxes of foreground in frames spread over the film: the largest of each, then the second largest."""
    min_side = scene.min_side_reduced
    boxes = [[b.box for b in blobs if min(b.box[2:]) >= min_side] for blobs in scene.blobs]
    busy = [row for row, found in enumerate(boxes) if found]
    if not busy:
        return
    rows = [busy[i] for i in np.unique(np.linspace(0, len(busy) - 1, N_CANDIDATE_FRAMES).astype(int))]
    for rank in range(2):
        yield from ((row, boxes[row][rank]) for row in rows if len(boxes[row]) > rank)


def _is_same(body: Body, row: int, box: Rectangle) -> bool:
    """Whether this box is a body that was already followed."""
    if not body.seen[row] or body.score[row] < 0.8:
        return False
    size = np.array(body.box[2:])
    low, high = np.maximum(body.corner[row], box[:2]), np.minimum(body.corner[row] + size, np.add(box[:2], box[2:]))
    common = np.prod(np.maximum(high - low, 0))
    return bool(common > 0.5 * (size.prod() + box[2] * box[3] - common))


def match_body(scene: SampledScene, row: int, box: Rectangle) -> Body:
    """Find the contents of a box in the foreground of every sampled frame.

    Parameters
    ----------
    scene : SampledScene
        Sampled frames.
    row : int
        Number of the sample with the box.
    box : tuple of int
        x, y, w, h on the reduced picture, px.

    Returns
    -------
    Body
        With `merit` 0 where it does not move.

    """
    x, y, w, h = box
    patch = scene.small[row][y : y + h, x : x + w]
    n = len(scene.small)
    corner, score = np.full((n, 2), np.nan), np.full(n, np.nan)
    for frames in (range(row, n), range(row - 1, -1, -1)):
        last = np.array([x, y], dtype=np.float64)
        for k in frames:
            at, best, moves = _match(scene.small[k], scene.foreground[k], patch, last)
            if best > MIN_SCORE and moves:
                corner[k], score[k], last = at, best, at
    axes_known = _textured_axes(patch)
    # The position along a stripe is undetermined: a find far along it is another stripe.
    stray = np.hypot(*((corner - (x, y)) @ (np.eye(2) - axes_known)).T) > 0.5 * max(w, h)
    corner[stray], score[stray] = np.nan, np.nan
    merit = 0.0 if _is_shading(patch) else _merit(scene, box, corner, score, axes_known)
    return Body(box, row, corner, score, merit)


def _match(picture: Picture, foreground: Mask, patch: Picture, last: Array) -> tuple[Array, float, bool]:
    """Best match near the last place or in foreground: corner (x, y), score, and whether it is foreground.

    Of matches that are nearly as good, the one nearest to the last is used: a bar looks the same all along, and a
    resting
    body must not jump.
    """
    part = _surrounding(foreground, patch.shape, last)
    scores = correlate(picture[part], patch)
    share = cv2.boxFilter(foreground[part].astype(np.float32), -1, patch.shape[::-1], anchor=(0, 0))
    rows, columns = np.arange(scores.shape[0]) + part[0].start, np.arange(scores.shape[1]) + part[1].start
    away = np.abs(rows - last[1])[:, None] + np.abs(columns - last[0])
    scores[(share[: scores.shape[0], : scores.shape[1]] < 0.3) & (away > 2)] = 0
    _, _, _, (i, j) = cv2.minMaxLoc(scores - DISTANCE_PENALTY / max(picture.shape) * away)
    at = (columns[i] + parabola_vertex(scores[j], i), rows[j] + parabola_vertex(scores[:, i], j))
    return np.array(at), float(scores[j, i]), bool(share[j, i] >= 0.3)


def _surrounding(foreground: Mask, size: tuple[int, ...], last: Array) -> tuple[slice, slice]:
    """Part of the picture that can hold a patch of `size` (h, w) round all foreground and the last place."""
    fx, fy, fw, fh = cv2.boundingRect(foreground.astype(np.uint8))
    x, y = np.rint(last).astype(int)
    x0, y0, x1, y1 = x - 3, y - 3, x + size[1] + 4, y + size[0] + 4
    if fw:
        x0, y0 = min(x0, fx - size[1]), min(y0, fy - size[0])
        x1, y1 = max(x1, fx + fw + size[1]), max(y1, fy + fh + size[0])
    return slice(max(y0, 0), y1), slice(max(x0, 0), x1)


def _is_shading(patch: Picture) -> bool:
    """Whether the patch is hardly more than a gradient of light, which moves when the light changes."""
    y, x = (c.ravel() - c.mean() for c in np.mgrid[: patch.shape[0], : patch.shape[1]].astype(np.float64))
    values = patch.ravel() - patch.mean()
    explained = (values @ x) ** 2 / (x @ x) + (values @ y) ** 2 / (y @ y)
    return bool(values @ values - explained < MAX_SHADING_SHARE * (values @ values))


def _textured_axes(patch: Picture) -> Array:
    """Projection (2, 2) onto the directions in which the position of a patch is determined; a stripe has only one."""
    gy, gx = np.gradient(patch)
    power, axes = np.linalg.eigh([[np.sum(gx * gx), np.sum(gx * gy)], [np.sum(gx * gy), np.sum(gy * gy)]])
    axes_known = axes[:, power > 0.02 * power[1]]
    return np.asarray(axes_known @ axes_known.T, dtype=np.float64)


def _merit(scene: SampledScene, box: Rectangle, corner: Array, score: Array, axes_known: Array) -> float:
    """Suitability as a target: found often and well, large, far travelled; 0 for a body that does not move."""
    seen = np.isfinite(corner[:, 0])
    distance = _travel_distance(corner[seen] @ axes_known)
    if distance * scene.factor <= MIN_TRAVEL_PX or _jumps(corner[seen] @ axes_known, distance):
        return 0.0
    cut = np.mean([_is_cut_off(scene, row, box, corner[row]) for row in np.flatnonzero(seen).tolist()]) > 0.8
    similarity = np.sum((score[seen] - MIN_SCORE) ** 2)
    return float(similarity * distance * np.sqrt(box[2] * box[3]) * (CUT_OFF_MERIT if cut else 1.0))


def _travel_distance(corner: Array) -> float:
    """Distance covered by the finds (k, 2), px; one stray match in ten is ignored."""
    if len(corner) < 2:
        return 0.0
    away = np.sort(np.hypot(*(corner - np.median(corner, axis=0)).T))
    return 2 * float(away[-max(2, len(corner) // 10)])


def _jumps(corner: Array, distance: float) -> bool:
    """Whether the finds (k, 2) jump between places without any on the way: several similar objects."""
    steps = np.hypot(*np.diff(corner, axis=0).T)
    return len(corner) >= MIN_FINDS and float(np.sum(steps[steps < 0.45 * distance])) < 0.2 * distance


def _is_cut_off(scene: SampledScene, row: int, box: Rectangle, corner: Array) -> bool:
    """Whether the foreground of a body continues beyond the picture."""
    centre = corner + np.array(box[2:]) / 2
    return any(blob.cut for blob in scene.blobs[row] if _contains(blob, centre))


def _contains(blob: Blob, point: NDArray[np.float64]) -> bool:
    x, y, w, h = blob.box
    return bool(x <= point[0] < x + w and y <= point[1] < y + h)


def _is_rival(scene: SampledScene, first: Body, second: Body) -> bool:
    """Whether the second body moves independently and far enough to make the target ambiguous."""
    both = first.seen & second.seen
    if both.sum() < max(min(3, len(both)), MIN_RIVAL_FRAMES * first.seen.sum()):
        return False
    a, b = first.corner[both], second.corner[both]
    size = np.array([first.box[2:], second.box[2:]])
    if (
        size.min() * scene.factor < MIN_RIVAL_SIDE_PX
        or size[1].prod() < MIN_RIVAL_AREA * size[0].prod()
        or np.median(second.score[both]) < MIN_RIVAL_SCORE
    ):
        return False
    separate = np.any(np.abs(a + size[0] / 2 - b - size[1] / 2) > 0.35 * size.sum(axis=0), axis=1)
    if separate.mean() < 0.5 or _span(b) < MIN_RIVAL_TRAVEL * _span(a):
        return False
    if (
        np.mean([_is_cut_off(scene, row, second.box, second.corner[row]) for row in np.flatnonzero(both).tolist()])
        > 0.5
    ):
        return False
    return _span(b - a) > MIN_RELATIVE_TRAVEL * _span(a) + 2


def _span(at: Array) -> float:
    """Diagonal of the box that holds the places (k, 2), px."""
    return float(np.hypot(*np.ptp(at, axis=0)))


def _ambiguity_message(recording: Recording, scene: SampledScene, bodies: tuple[Body, Body]) -> str:
    """Ask which of two bodies is the target."""
    lines = []
    for body in sorted(bodies, key=lambda body: float(np.nanmin(body.corner[:, 0]))):
        (x, y, w, h), frame = body_outline(scene, body)
        line = f"target = [{x}, {y}, {w}, {h}]" + (f" with template = {frame}" if frame else "")
        lines.append(f"{line} (moves {_span(body.corner[body.seen]) * scene.factor:.0f} px)")
    return f"{recording.path.name}: expected one moving target but two move; give " + " or ".join(lines)
