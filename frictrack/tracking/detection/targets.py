"""Find the target: the moving body, or what a click, a rectangle, an outline or a picture of it gives.

Moving bodies are regions that differ from the static scene, keep their appearance, and travel. All searches use reduced
pictures; only the outline of the chosen body is found on full ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.base.polygons import polygon
from frictrack.recording import Frame, Recording
from frictrack.records import Array, Mask
from frictrack.tracking.areas import Areas, bounding_rectangle, is_polygon
from frictrack.tracking.correlation import Rectangle, best_match, correlate, parabola_vertex
from frictrack.tracking.detection.body_outline import Body, body_outline, foreground_at, round_outline
from frictrack.tracking.detection.patches import most_moving_patch
from frictrack.tracking.detection.sampled_scene import (
    MIN_SIDE_PX,
    Blob,
    Picture,
    SampledScene,
    sample_scene,
    scene_without,
)

MIN_TRAVEL_PX = 1.5  # of a moving body
MIN_SCORE = 0.6  # of a find, and of a picture of the target
DISTANCE_PENALTY = 0.3  # by which the score of a match on the other side of the picture must be better
MIN_SHARPNESS = 0.15  # steepest change of brightness over the largest, 1/px; less is a shadow or a gradient of light
MIN_FINDS = 8  # from which some must lie on the way, or the finds jump between similar objects
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
MIN_RELATIVE_TRAVEL = 0.3  # ... and moves relative to it by this share; shadows, reflections and attached rods do not
CLICK_MARGIN = 0.2  # of a body's size, by which a click may miss its rectangle
MIN_REGION_PX, MAX_REGION_PX = 17, 65  # side of the region that is grown round a click on a static object
OUTLINE_PX = 4  # round a plain body, so that its whole blurred edge is included
N_TOLERANCES, MIN_STABLE_TOLERANCES = 16, 3  # of grey values, tried from 1 to 50 % of the contrast
MIN_PLAIN_SHARE = 0.8  # of the region round the click, that must be as grey as the click
MAX_STABLE_GROWTH = 0.05  # of a body's area from one tolerance to the next
MIN_STRIP_TEXTURE = 0.3  # of the region's gradient energy, for a strip to be added
FIRST_SEARCH_FRAMES, FULL_SEARCH_FRAMES = 16, 500  # frames in which a template picture is searched
GOOD_SCORE = 0.85  # of a picture of the target, that ends the search


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
    scene = sample_scene(recording)
    bodies = moving_bodies(scene)
    if not bodies and scene.shake.any():  # perhaps what filled the picture was the body, and no shake
        scene = sample_scene(recording, steady=False)
        bodies = moving_bodies(scene)
    if not bodies:
        patch = most_moving_patch(scene)
        if patch is None:
            raise FrictrackError(
                f"{recording.path.name}: expected a moving target but nothing in the film moves or has enough texture "
                "to be tracked; check the film, or give target = [x, y, w, h]"
            )
        return patch, scene.index[0]
    if question := rival_question(scene, bodies[0]):
        raise FrictrackError(f"{recording.path.name}: {question}")
    return body_outline(scene, bodies[0])


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
    axes_known = _textured_axes(patch)
    # The position along a stripe is undetermined: a find far along it is another stripe.
    stray = np.hypot(*((corner - (x, y)) @ (np.eye(2) - axes_known)).T) > 0.5 * max(w, h)
    corner[stray], score[stray] = np.nan, np.nan
    merit = body_merit(scene, box, corner, score, axes_known) * is_sharp(scene, row, box)
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
    merit = body_merit(scene, blob.box, corner, score, np.eye(2)) * (travels and is_sharp(scene, row, blob.box))
    return Body(blob.box, row, corner, score, merit, rotates=True)


def is_sharp(scene: SampledScene, row: int, box: Rectangle) -> bool:
    """Whether a box holds an edge of its own: a shadow or a gradient of light changes brightness slowly."""
    x, y, w, h = box
    part = slice(max(y - 2, 0), y + h + 2), slice(max(x - 2, 0), x + w + 2)
    shown, still = (cv2.GaussianBlur(p[part], (0, 0), 1.0) for p in (scene.small[row], scene.background))
    change = (shown / np.float32(scene.light[row]) + 1) / (still + 1)
    change = np.log(np.maximum(change, 1e-3))
    slope = np.hypot(*np.gradient(change))
    return bool(np.quantile(slope, 0.97) > MIN_SHARPNESS * np.quantile(np.abs(change), 0.97))


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


def _textured_axes(patch: Picture) -> Array:
    """Projection (2, 2) onto the directions in which the position of a patch is determined; a stripe has only one."""
    gy, gx = np.gradient(patch)
    power, axes = np.linalg.eigh([[np.sum(gx * gx), np.sum(gx * gy)], [np.sum(gx * gy), np.sum(gy * gy)]])
    axes_known = axes[:, power > 0.02 * power[1]]
    return np.asarray(axes_known @ axes_known.T, dtype=np.float64)


def body_merit(scene: SampledScene, box: Rectangle, corner: Array, score: Array, axes_known: Array) -> float:
    """Suitability as a target: found often and well, large, far travelled; 0 for a body that does not move."""
    seen = np.isfinite(corner[:, 0])
    distance = _travel_distance(corner[seen] @ axes_known)
    if distance * scene.factor <= MIN_TRAVEL_PX or _jumps(corner[seen] @ axes_known, distance):
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


def _jumps(corner: Array, distance: float) -> bool:
    """Whether the finds (k, 2) jump between places without any on the way: several similar objects."""
    steps = np.hypot(*np.diff(corner, axis=0).T)
    return len(corner) >= MIN_FINDS and float(np.sum(steps[steps < 0.45 * distance])) < 0.2 * distance


def _is_cut_off(scene: SampledScene, row: int, box: Rectangle, corner: Array) -> bool:
    """Whether the foreground of a body continues beyond the picture."""
    centre = corner + np.array(box[2:]) / 2
    return any(blob.cut for blob in scene.blobs[row] if _contains(centre, blob.box))


def rival_question(scene: SampledScene, first: Body) -> str:
    """Ask which of two bodies is the target, where another moves before the scene without the first; else empty."""
    rest = scene_without(scene, first.box, first.corner)
    second = next((body for body in moving_bodies(rest) if _is_rival(rest, first, body)), None)
    if second is None:
        return ""
    lines = []
    for body in sorted((first, second), key=lambda body: float(np.nanmin(body.corner[:, 0]))):
        (x, y, w, h), frame = body_outline(rest, body)
        line = f"target = [{x}, {y}, {w}, {h}]" + (f" with template = {frame}" if frame else "")
        lines.append(f"{line} (moves {_span(body.corner[body.seen]) * scene.factor:.0f} px)")
    return "expected one moving target but two move; give " + " or ".join(lines)


def _is_rival(scene: SampledScene, first: Body, second: Body) -> bool:
    """Whether the second body moves independently and far enough to make the target ambiguous."""
    size, both = np.array([first.box[2:], second.box[2:]]), first.seen & second.seen
    rows = np.flatnonzero(second.seen).tolist()
    few = both.sum() < max(min(3, len(both)), MIN_RIVAL_FRAMES * min(first.seen.sum(), second.seen.sum()))
    small = second.merit < MIN_RIVAL_MERIT * first.merit or size[1].min() * scene.factor < MIN_RIVAL_SIDE_PX
    if few or small or np.mean([_is_cut_off(scene, k, second.box, second.corner[k]) for k in rows]) > 0.5:
        return False
    a, b = first.corner[both] + size[0] / 2, second.corner[both] + size[1] / 2
    separate = np.any(np.abs(a - b) > 0.35 * size.sum(axis=0), axis=1)
    return bool(separate.mean() >= 0.5 and _span(b - a) > MIN_RELATIVE_TRAVEL * max(_span(a), _span(b)) + 2)


def _span(at: Array) -> float:
    """Diagonal of the box that holds the places (k, 2), px."""
    return float(np.hypot(*np.ptp(at, axis=0)))


Target = Sequence[float] | Sequence[Sequence[float]] | NDArray[Any] | str | Path | None


def resolve_target(recording: Recording, target: Target = None, template: int = 0) -> tuple[Rectangle, int]:
    """Resolve a target to a rectangle and the frame to which it refers.

    Parameters
    ----------
    recording : Recording
        Film.
    target : list, array or path, optional
        Rectangle [x, y, w, h], outline [[x, y], ...] or click [x, y] in frame `template`, px; a picture of the target
        at
        the film's scale (a path or a 2-D array); None for the moving body.
    template : int
        Number of the frame in which `target` is given.

    Returns
    -------
    rectangle : tuple of int
        x, y, w, h in px.
    frame : int
        Number of the frame.

    Raises
    ------
    FrictrackError
        For a target that is malformed, outside the picture, or not in this film.

    """
    if target is None:
        return locate_target(recording)
    if isinstance(target, str | Path):
        return _find_picture(recording, _read_picture(Path(target)), Path(target).name)
    if is_polygon(target):
        return _check_rectangle(np.array(bounding_rectangle(polygon(target)), dtype=np.float64), recording), template
    if np.ndim(target) == 2:
        return _find_picture(recording, np.asarray(target), "the template picture")
    numbers = np.asarray(target, dtype=np.float64)
    if numbers.shape not in ((2,), (4,)) or not np.all(np.isfinite(numbers)):
        raise FrictrackError(
            f"expected a target [x, y, w, h] in px but got {list(numbers.tolist())}; "
            "give a rectangle, a click [x, y], or a picture of the target"
        )
    if numbers.size == 2:
        return _resolve_click(recording, numbers, template), template
    return _check_rectangle(numbers, recording), template


def resolve_areas(recording: Recording, areas: Areas, template: int = 0) -> tuple[Areas, Rectangle, int]:
    """Resolve a target to a rectangle, or to the outline of a round body that was found or clicked.

    Parameters
    ----------
    recording : Recording
        Film.
    areas : Areas
        Target with its areas.
    template : int
        Number of the frame in which the target is given.

    Returns
    -------
    areas : Areas
        With the rectangle or the outline as target.
    rectangle : tuple of int
        x, y, w, h in px.
    frame : int
        Number of the frame.

    Raises
    ------
    FrictrackError
        As `resolve_target` does.

    """
    rectangle, frame = resolve_target(recording, areas.target, template)
    if is_polygon(areas.target):
        return areas, rectangle, frame
    if areas.target is None or np.shape(areas.target) == (2,):
        outline = round_outline(foreground_at(_scene_with(recording, frame), rectangle, frame))
        if outline:
            return replace(areas, target=outline), bounding_rectangle(outline), frame
    return replace(areas, target=rectangle), rectangle, frame


def _scene_with(recording: Recording, frame: int) -> SampledScene:
    """Sampled frames with a wanted one among them, where it can be read."""
    scene = sample_scene(recording)
    return scene if frame in scene.index else sample_scene(recording, also=[frame])


def _check_rectangle(target: Array, recording: Recording) -> Rectangle:
    """Rectangle in whole pixels; it must lie in the picture."""
    height, width = recording.shape
    x, y, w, h = (round(float(v)) for v in target)
    if w < MIN_SIDE_PX or h < MIN_SIDE_PX:
        raise FrictrackError(f"expected a target of at least {MIN_SIDE_PX}x{MIN_SIDE_PX} px but got {w}x{h} px")
    if x < 0 or y < 0 or x + w > width or y + h > height:
        raise FrictrackError(f"expected a target inside the {width}x{height} px picture but got [{x}, {y}, {w}, {h}]")
    return x, y, w, h


# ---- a click


def _resolve_click(recording: Recording, click: Array, template: int) -> Rectangle:
    """The moving body under a click, else the textured region round it."""
    height, width = recording.shape
    if not (0 <= click[0] < width and 0 <= click[1] < height):
        raise FrictrackError(
            f"expected a click inside the {width}x{height} px picture but got [{click[0]:g}, {click[1]:g}]"
        )
    frame = recording.frame(template)
    scene = _scene_with(recording, template)
    body = _body_under_click(scene, click, template) if template in scene.index else None
    plain = _plain_region(frame, click) if body is None else None
    if plain is not None:
        x, y, w, h = cv2.boundingRect(plain.astype(np.uint8))
        return x - OUTLINE_PX, y - OUTLINE_PX, w + 2 * OUTLINE_PX, h + 2 * OUTLINE_PX
    return body or _grow_region(frame, click)


def _body_under_click(scene: SampledScene, click: Array, template: int) -> Rectangle | None:
    """Rectangle in frame `template` of the moving body under the click; None without one."""
    row = scene.index.index(template)
    at = click / scene.factor - scene.shake[row]
    boxes = sorted((b.box for b in scene.blobs[row] if _contains(at, b.box)), key=lambda box: box[2] * box[3])
    bodies: list[Body] = [match_body(scene, row, box) for box in boxes if min(box[2:]) >= scene.min_side_reduced]
    bodies += [b for b in moving_bodies(scene) if b.seen[row] and _contains(at, (*b.corner[row], *b.box[2:]))]
    for body in bodies:
        if body.merit > 0:
            rectangle, _ = body_outline(scene, body, template)
            if _contains(click, rectangle, CLICK_MARGIN):
                return rectangle
    return None


def _contains(point: Array, box: Sequence[float], grace: float = 0.0) -> bool:
    x, y, w, h = box
    return bool(-grace * w <= point[0] - x < (1 + grace) * w and -grace * h <= point[1] - y < (1 + grace) * h)


def _plain_region(frame: Frame, click: Array) -> Mask | None:
    """Pixels (H, W) of the evenly grey body under a click; None where the picture is textured there.

    Of the regions that a rising tolerance of grey values floods, the one that changes least is the body: the outline
    stops it (maximally stable extremal region: Matas et al. 2002, Proc. BMVC, p. 384).
    """
    picture = cv2.GaussianBlur(frame.astype(np.float32), (0, 0), 1.0)
    x, y = (int(c) for c in click)
    around = tuple(slice(max(c - MIN_REGION_PX // 2, 0), c + MIN_REGION_PX // 2 + 1) for c in (y, x))
    areas, regions = [], []
    for tolerance in np.geomspace(0.01, 0.5, N_TOLERANCES) * float(np.ptp(picture)):
        flooded = np.zeros((picture.shape[0] + 2, picture.shape[1] + 2), np.uint8)
        flags = 4 | cv2.FLOODFILL_FIXED_RANGE | cv2.FLOODFILL_MASK_ONLY | (1 << 8)
        area, _, _, box = cv2.floodFill(picture, flooded, (x, y), 0, float(tolerance), float(tolerance), flags)
        if flooded[1:-1, 1:-1][around].mean() < MIN_PLAIN_SHARE:
            continue
        left, top, w, h = box
        if min(left, top, picture.shape[1] - left - w, picture.shape[0] - top - h) < OUTLINE_PX:
            break  # it has run out of the body, or of the picture
        areas.append(area)
        regions.append(flooded[1:-1, 1:-1] > 0)
    if len(areas) < MIN_STABLE_TOLERANCES:
        return None
    growth = np.diff(np.log(areas))
    best = int(np.argmin(growth))
    return regions[best] if growth[best] < MAX_STABLE_GROWTH else None


def _grow_region(frame: Frame, click: Array) -> Rectangle:
    """Region round the click that includes everything about as textured as its middle."""
    gy, gx = np.gradient(cv2.GaussianBlur(frame.astype(np.float32), (0, 0), 1.0))
    energy = gx**2 + gy**2
    height, width = frame.shape
    x0, y0 = (
        int(np.clip(c - MIN_REGION_PX // 2, 0, max(s - MIN_REGION_PX, 0)))
        for c, s in zip(click, (width, height), strict=True)
    )
    x1, y1 = min(x0 + MIN_REGION_PX, width), min(y0 + MIN_REGION_PX, height)
    has_grown = True
    while has_grown:
        least = MIN_STRIP_TEXTURE * float(energy[y0:y1, x0:x1].mean())
        strips = (energy[y0:y1, max(x0 - 2, 0) : x0], energy[y0:y1, x1 : x1 + 2])
        left, right = (s.size > 0 and s.mean() > least and x1 - x0 < MAX_REGION_PX for s in strips)
        strips = (energy[max(y0 - 2, 0) : y0, x0:x1], energy[y1 : y1 + 2, x0:x1])
        up, down = (s.size > 0 and s.mean() > least and y1 - y0 < MAX_REGION_PX for s in strips)
        x0, x1 = max(x0 - 2 * left, 0), min(x1 + 2 * right, width)
        y0, y1 = max(y0 - 2 * up, 0), min(y1 + 2 * down, height)
        has_grown = bool(left or right or up or down)
    return x0, y0, x1 - x0, y1 - y0


# ---- a picture of the target


def _read_picture(path: Path) -> Frame:
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH) if path.is_file() else None
    if picture is None:
        raise FrictrackError(f"{path}: expected a picture of the target but it cannot be read; check the path")
    return np.asarray(picture)


def _find_picture(recording: Recording, picture: Frame, name: str) -> tuple[Rectangle, int]:
    """Locate a picture of the target: in a few frames first, then in the whole film."""
    h, w = picture.shape
    if min(h, w) < MIN_SIDE_PX or h > recording.shape[0] or w > recording.shape[1]:
        height, width = recording.shape
        raise FrictrackError(f"{name}: expected a template from 8x8 to {width}x{height} px but got {w}x{h} px")
    if float(np.ptp(picture)) < 2:
        raise FrictrackError(f"{name}: expected a picture of the target but it is all one grey")
    best, at, frame = _best_fit(recording, picture, FIRST_SEARCH_FRAMES)
    if best < GOOD_SCORE:
        best, at, frame = _best_fit(recording, picture, FULL_SEARCH_FRAMES)
    if best < MIN_SCORE:
        raise FrictrackError(
            f"{recording.path.name}: {name} fits nowhere, its best score is {best:.2f} in frame {frame}; "
            "cut it out of this film at full scale"
        )
    return (*at, w, h), frame


def _best_fit(recording: Recording, picture: Frame, most: int) -> tuple[float, tuple[int, int], int]:
    """Score, corner and frame of the first good match, or of the best, among frames spread over the film."""
    stride = max(1, recording.n_frames // most)
    wanted = picture.astype(np.float32)
    best, at, frame = -1.0, (0, 0), 0
    for k, shown in enumerate(recording.frames(step=stride)):
        corner, score = best_match(shown.astype(np.float32), wanted)
        if score > best:
            best, at, frame = score, (round(float(corner[0])), round(float(corner[1]))), k * stride
        if best >= GOOD_SCORE:
            break
    return best, at, frame
