"""Find the bodies that move in a film, ask where two do, and check the track of the one that was chosen.

A body is a region that differs from the static scene, keeps its texture or its shape, and travels. The same questions
are asked of a body that was picked and of one that was tracked: does another one move on its own before the scene
without it, and is what moves where it was found? A match score says nothing there: an empty place before a plain wall
matches itself perfectly, and a plain region slides along inside a plain body. What moves is known without the template,
by its difference from the scene without the body.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from frictrack.recording import Recording
from frictrack.records import Array, Mask, Track
from frictrack.tracking.correlation import Rectangle, correlate, parabola_vertex
from frictrack.tracking.detection.body_outline import Body, body_outline
from frictrack.tracking.detection.sampled_scene import Blob, Picture, SampledScene, sample_scene, scene_without

MIN_TRAVEL_PX = 1.5  # of a moving body
MIN_SCORE = 0.6  # of a find
DISTANCE_PENALTY = 0.3  # by which the score of a match on the other side of the picture must be better
MAX_BODIES = 8  # that are followed through the sampled frames
MAX_SIDE_CHANGE, MAX_SIDE_CHANGE_PX = 0.15, 2  # share or px, of boxes that may be the same body
MAX_SHAPE_CHANGE = 0.12  # of the principal lengths of a region that turns
MIN_REGION_TRAVEL = 0.5  # of a region, over the root of its area
MAX_STEP_SHARE = 0.4  # of its travel; a longer step between two samples is a jump to another region
MIN_TEXTURE_MERIT = 0.2  # of a region's merit, from which its texture is followed
CUT_OFF_MERIT = 0.2  # factor for a body that the picture's edge always cuts off, such as an arm or a rod
# A second body makes the target ambiguous when its sides (px) and its merit as a share of the first one's reach these,
# and both are seen in this share of the frames ...
MIN_RIVAL_SIDE_PX, MIN_RIVAL_MERIT, MIN_RIVAL_FRAMES = 12, 0.1, 0.3
MAX_CHOICES = 3  # bodies that are named
MIN_RELATIVE_TRAVEL = 0.3  # ... and moves relative to it by this share; shadows, reflections and attached rods do not
MAX_ELSEWHERE, MAX_ASTRAY = 0.25, 0.1  # of the samples that tell by regions and by silhouettes where the target is
LOST_WEIGHT = 0.5  # of samples in which the target is hidden or away: they are known to be missing
MIN_SAMPLES = 3  # that tell it, and that show a place after the target has left it
MAX_ASTRAY_PX = 2  # reduced px from the track, of the place where what moves looks as usual
MARGIN_PX, SEARCH_SHARE, MIN_SEARCH_PX = 4, 0.35, 8  # about the target: its outline, and where it is searched
BODY_MARGIN = 0.25  # of the target's sides, by which its body may be larger on each
MIN_THICKNESS = 0.5  # of the target's shorter side, for a region that may be what it should be


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
    for row, blob in _candidates(scene):
        if len(bodies) < MAX_BODIES and not any(_is_same(body, row, blob.box) for body in bodies):
            bodies.append(match_body(scene, row, blob.box, blob))
    return sorted((body for body in bodies if body.merit > 0), key=lambda body: -body.merit)


def _candidates(scene: SampledScene) -> list[tuple[int, Blob]]:
    """Regions of foreground in all frames; first the large ones that the most frames show with the same size."""
    side = scene.min_side_reduced
    found = [(row, b) for row, blobs in enumerate(scene.blobs) for b in blobs if min(b.box[2:]) >= side]
    if not found:
        return []
    sizes = np.array([b.box[2:] for _, b in found], dtype=np.float64)
    off = np.abs(sizes[:, None] - sizes[None])
    count = np.sum(np.all(off <= np.maximum(MAX_SIDE_CHANGE * sizes, MAX_SIDE_CHANGE_PX), axis=2), axis=1)
    merit = np.minimum(count, len(scene.blobs)) * np.array(
        [b.area * (CUT_OFF_MERIT if b.cut else 1.0) for _, b in found]
    )
    return [found[k] for k in np.argsort(-merit, kind="stable")]


def _is_same(body: Body, row: int, box: Rectangle) -> bool:
    """Whether this box is a body that was already followed."""
    if not body.seen[row] or body.score[row] < 0.8:
        return False
    size = np.array(body.box[2:])
    low, high = np.maximum(body.corner[row], box[:2]), np.minimum(body.corner[row] + size, np.add(box[:2], box[2:]))
    common = np.prod(np.maximum(high - low, 0))
    return bool(common > 0.5 * (size.prod() + box[2] * box[3] - common))


def match_body(scene: SampledScene, row: int, box: Rectangle, blob: Blob | None = None) -> Body:
    """Find the contents of a box in every sampled frame, by their texture or as a region of one shape.

    Parameters
    ----------
    scene : SampledScene
        Sampled frames.
    row : int
        Number of the sample with the box.
    box : tuple of int
        x, y, w, h on the reduced picture, px.
    blob : Blob, optional
        Region of foreground in the box.

    Returns
    -------
    Body
        With `merit` 0 where it does not move.

    """
    x, y, w, h = box
    patch = scene.small[row][y : y + h, x : x + w]

    def by_texture(k: int, last: Array) -> tuple[Array, float] | None:
        at, best, moves = _match(scene.small[k], scene.foreground[k], patch, last)
        return (at, best) if best > MIN_SCORE and moves else None

    corner, score = _followed(scene, row, np.array([x, y], dtype=np.float64), by_texture)
    merit = _merit(scene, box, corner, score)
    textured = Body(box, row, corner, score, merit)
    region = None if blob is None else _follow_region(scene, row, blob)
    return textured if region is None or merit >= MIN_TEXTURE_MERIT * region.merit else region


def _followed(
    scene: SampledScene, row: int, corner: Array, find: Callable[[int, Array], tuple[Array, float] | None]
) -> tuple[Array, Array]:
    """Corners (k, 2) and scores (k,) from sample `row` on to both sides; `find` takes a sample and the last corner."""
    corners, score = np.full((len(scene.small), 2), np.nan), np.full(len(scene.small), np.nan)
    for samples in (range(row, len(score)), range(row - 1, -1, -1)):
        last = corner
        for k in samples:
            if found := find(k, last):
                last, score[k] = found
                corners[k] = last
    return corners, score


def _follow_region(scene: SampledScene, row: int, blob: Blob) -> Body:
    """Find a region of foreground in every sampled frame by its shape: a body that rotates changes its texture."""
    half = np.array(blob.box[2:]) / 2

    def by_shape(k: int, last: Array) -> tuple[Array, float] | None:
        change = [float(np.max(np.abs(np.log(b.lengths / blob.lengths)))) for b in scene.blobs[k]]
        same = [
            (b.middle - half, 1 - 2 * c) for b, c in zip(scene.blobs[k], change, strict=True) if c < MAX_SHAPE_CHANGE
        ]
        return min(same, key=lambda each: np.hypot(*(each[0] - last)), default=None)

    corner, score = _followed(scene, row, blob.middle - half, by_shape)
    rows = np.flatnonzero(np.isfinite(corner[:, 0]))
    distance = _span(corner[rows])
    step = float(np.max(np.hypot(*np.diff(corner[rows], axis=0).T) / np.diff(rows), initial=0.0))
    travels = distance > MIN_REGION_TRAVEL * np.sqrt(blob.area) and step < MAX_STEP_SHARE * distance
    merit = _merit(scene, blob.box, corner, score) * travels
    return Body(blob.box, row, corner, score, merit, rotates=True)


def _match(picture: Picture, foreground: Mask, patch: Picture, last: Array) -> tuple[Array, float, bool]:
    """Best match near the last place or in foreground: corner (x, y), score, and whether it is foreground.

    Of matches that are nearly as good, the one nearest to the last is used: a bar looks the same all along, and a
    resting body must not jump.
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


def _merit(scene: SampledScene, box: Rectangle, corner: Array, score: Array) -> float:
    """Suitability as a target: found often and well, large, far travelled; 0 for a body that does not move."""
    seen = np.isfinite(corner[:, 0])
    distance = _travel_distance(corner[seen])
    if distance * scene.factor <= MIN_TRAVEL_PX:
        return 0.0
    cut = np.mean([_is_cut_off(scene, row, box, corner[row]) for row in np.flatnonzero(seen).tolist()]) > 0.8
    similarity = np.sum((score[seen] - MIN_SCORE) ** 3)
    return float(similarity * distance * np.sqrt(box[2] * box[3]) * (CUT_OFF_MERIT if cut else 1.0))


def _travel_distance(corner: Array) -> float:
    """Distance covered by the finds (k, 2), px; one stray match in ten is ignored."""
    if len(corner) < 2:
        return 0.0
    away = np.sort(np.hypot(*(corner - np.median(corner, axis=0)).T))
    return 2 * float(away[-max(2, len(corner) // 10)])


def _is_cut_off(scene: SampledScene, row: int, box: Rectangle, corner: Array) -> bool:
    """Whether the foreground of a body continues beyond the picture."""
    centre = corner + np.array(box[2:]) / 2
    return any(blob.cut for blob in scene.blobs[row] if contains(centre, blob.box))


def rival_question(scene: SampledScene, first: Body) -> str:
    """Ask which body is the target, where another moves before the scene without the first; else empty.

    Where one does, all others that move are named, too: which of them is meant is not known.
    """
    rest = scene_without(scene, first.box, first.corner)
    others = moving_bodies(rest)
    at_edge = _is_at_edge(scene, first)
    rivals = (body for body in others if _is_rival(rest, first, body))
    second = next((b for b in rivals if (at_edge or not _comes_from_outside(rest, b)) and _is_thick(rest, b)), None)
    if second is None:
        return ""
    chosen = [first, second]
    for body in others:
        strong = body.merit > MIN_RIVAL_MERIT * second.merit and all(_are_two(body, one) for one in chosen)
        if strong and _is_thick(rest, body):
            chosen.append(body)
    lines = []
    for body in sorted(chosen[:MAX_CHOICES], key=lambda body: float(np.nanmin(body.corner[:, 0]))):
        (x, y, w, h), frame = body_outline(rest, body)
        line = f"target = [{x}, {y}, {w}, {h}]" + (f" with template = {frame}" if frame else "")
        lines.append(f"{line} (moves {_span(body.corner[body.seen]) * scene.factor:.0f} px)")
    count = "two" if len(lines) == 2 else "three"
    return f"expected one moving target but {count} move; give {' or '.join(lines)}"


def _is_rival(scene: SampledScene, first: Body, second: Body) -> bool:
    """Whether the second body moves independently and far enough to make the target ambiguous."""
    size, both = np.array([first.box[2:], second.box[2:]]), first.seen & second.seen
    few = both.sum() < max(min(3, len(both)), MIN_RIVAL_FRAMES * min(first.seen.sum(), second.seen.sum()))
    extent = [q.seen.sum() * _travel_distance(q.corner[q.seen]) * np.sqrt(q.box[2] * q.box[3]) for q in (first, second)]
    small = extent[1] < MIN_RIVAL_MERIT * extent[0] or size[1].min() * scene.factor < MIN_RIVAL_SIDE_PX
    if few or small:
        return False
    return _are_apart(first, second) and _are_two(first, second)


def _are_two(first: Body, second: Body) -> bool:
    """Whether two bodies move relative to each other, as one does that a large shadow passes."""
    both = first.seen & second.seen
    a, b = (q.corner[both] + np.array(q.box[2:]) / 2 for q in (first, second))
    return not both.any() or _span(b - a) > MIN_RELATIVE_TRAVEL * max(_span(a), _span(b)) + 2


def _is_thick(scene: SampledScene, body: Body) -> bool:
    """Whether the outline of a body is no strip, as the edge of a scale is that shakes."""
    return min(body_outline(scene, body)[0][2:]) >= MIN_RIVAL_SIDE_PX


def _comes_from_outside(scene: SampledScene, body: Body) -> bool:
    """Whether the edge of the picture cuts off a body in most frames, such as an arm or a rod."""
    rows = np.flatnonzero(body.seen).tolist()
    is_cut = np.mean([_is_cut_off(scene, k, body.box, body.corner[k]) for k in rows]) > 0.5
    return bool(is_cut) and _is_at_edge(scene, body)


def _is_at_edge(scene: SampledScene, body: Body) -> bool:
    """Whether the outline of a body reaches the edge of the picture; its shadow may where the body does not."""
    (x, y, w, h), _ = body_outline(scene, body)
    height, width = scene.frames[0].shape
    return min(x, y, width - x - w, height - y - h) <= scene.factor


def _are_apart(first: Body, second: Body) -> bool:
    """Whether two bodies are at different places in most frames that show both."""
    size, both = np.array([first.box[2:], second.box[2:]]), first.seen & second.seen
    away = np.abs(first.corner[both] + size[0] / 2 - second.corner[both] - size[1] / 2)
    return bool(np.mean(np.any(away > 0.35 * size.sum(axis=0), axis=1)) >= 0.5) if both.any() else True


def _span(at: Array) -> float:
    """Diagonal of the box that holds the places (k, 2), px."""
    return float(np.hypot(*np.ptp(at, axis=0)))


def contains(point: Array, box: Sequence[float], grace: float = 0.0) -> bool:
    """Whether a point is in a box (x, y, w, h), or by less than the share `grace` of its sides beyond."""
    x, y, w, h = box
    return bool(-grace * w <= point[0] - x < (1 + grace) * w and -grace * h <= point[1] - y < (1 + grace) * h)


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
    margin = BODY_MARGIN * size  # the body may be that much larger
    rest = scene_without(scene, (0, 0, *np.rint(size + 2 * margin).astype(int).tolist()), corner - margin)
    found = [_where(rest, k, (*(c - margin), *(size + 2 * margin)), min(size)) for k, c in enumerate(corner)]
    unknown = np.char.startswith(track.reason[scene.index], "match score")
    low, high = np.nanquantile(at, (0.1, 0.9), axis=0)
    moves = bool(np.hypot(*(high - low)) > MIN_TRAVEL_PX)  # else nothing that moves can be it
    here, others = np.array([h and moves for h, _ in found]), [o for _, o in found]
    elsewhere = ~here & np.array([len(o) > 0 for o in others]) | unknown
    # samples that tell where the target is, those that contradict the track, and how many of them may
    silhouettes = _silhouettes(rest, corner, size, np.nan_to_num(track.angle[scene.index]))
    middle = np.nanmedian(corner, axis=0) if seen.any() else np.zeros(2)
    followed = int(np.sum(np.any(np.abs(corner - middle) > MAX_ASTRAY_PX, axis=1)))  # samples of it in motion
    for tells, wrong, most in ((here | elsewhere | (not moves), elsewhere, MAX_ELSEWHERE), (*silhouettes, MAX_ASTRAY)):
        weight = np.where(seen | unknown, 1.0, LOST_WEIGHT) @ wrong
        if weight >= MIN_SAMPLES and (weight > most * tells.sum() or wrong.sum() > followed):
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
    return rival_question(scene, Body(box, row, corner, score, _merit(scene, box, corner, score)))


def _where(scene: SampledScene, k: int, box: Sequence[float], side: float) -> tuple[bool, list[Blob]]:
    """Whether a region of a sample is in a box, and regions elsewhere that may be the body: as thick, and no more cut.

    Without a box (NaN) any region may be the body.
    """
    if np.isnan(box[0]):
        return False, scene.blobs[k]
    here = [b for b in scene.blobs[k] if _overlaps(b.box, box)]
    others = [b for b in scene.blobs[k] if not _overlaps(b.box, box) and (any(h.cut for h in here) or not b.cut)]
    return len(here) > 0, [b for b in others if _thickness(b) > MIN_THICKNESS * side]


def _silhouettes(scene: SampledScene, corner: Array, size: Array, angle: Array) -> tuple[Mask, Mask]:
    """Samples (k,) that show the silhouette of what moves, and those where it lies elsewhere about the target.

    These are samples whose place other samples show without the target. A target that turns is turned back.
    """
    room, reach = np.array(scene.background.shape[::-1]), max(MIN_SEARCH_PX, int(SEARCH_SHARE * max(size)))
    inside = np.all((corner > -MARGIN_PX) & (corner + size < room + MARGIN_PX), axis=1)
    away = np.any(np.abs(corner[:, None] - corner[None]) > (1 + BODY_MARGIN) * size, axis=2)
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
