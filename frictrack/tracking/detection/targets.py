"""Find the target: the moving body, or what a click, a rectangle, an outline or a picture of it gives.

All searches use reduced pictures; only the outline of the chosen body is found on full ones.
"""

from __future__ import annotations

from collections.abc import Sequence
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
from frictrack.tracking.correlation import Rectangle, best_match
from frictrack.tracking.detection.body_outline import Body, body_outline, foreground_at, round_outline
from frictrack.tracking.detection.moving_bodies import contains, match_body, moving_bodies, rival_question
from frictrack.tracking.detection.patches import most_moving_patch
from frictrack.tracking.detection.sampled_scene import MIN_SIDE_PX, SampledScene, sample_scene

CLICK_MARGIN = 0.2  # of a body's size, by which a click may miss its rectangle
MIN_REGION_PX, MAX_REGION_PX = 17, 65  # side of the region that is grown round a click on a static object
OUTLINE_PX = 4  # round a plain body, so that its whole blurred edge is included
N_TOLERANCES, MIN_STABLE_TOLERANCES = 16, 3  # of grey values, tried from 1 to 50 % of the contrast
MIN_PLAIN_SHARE = 0.8  # of the region round the click, that must be as grey as the click
MAX_STABLE_GROWTH = 0.05  # of a body's area from one tolerance to the next
MIN_STRIP_TEXTURE = 0.3  # of the region's gradient energy, for a strip to be added
FIRST_SEARCH_FRAMES, FULL_SEARCH_FRAMES = 16, 500  # frames in which a template picture is searched
GOOD_SCORE, MIN_PICTURE_SCORE = 0.85, 0.6  # of a picture of the target, that end the search, and that it must reach


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
    boxes = sorted((b.box for b in scene.blobs[row] if contains(at, b.box)), key=lambda box: box[2] * box[3])
    bodies: list[Body] = [match_body(scene, row, box) for box in boxes if min(box[2:]) >= scene.min_side_reduced]
    bodies += [b for b in moving_bodies(scene) if b.seen[row] and contains(at, (*b.corner[row], *b.box[2:]))]
    for body in bodies:
        if body.merit > 0:
            rectangle, _ = body_outline(scene, body, template)
            if contains(click, rectangle, CLICK_MARGIN):
                return rectangle
    return None


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
    if best < MIN_PICTURE_SCORE:
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
