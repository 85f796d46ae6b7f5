"""Find the moving body: what differs from the still scene, looks the same from frame to frame, and travels.

Everything is searched on reduced pictures; only the outline of the body that is chosen is drawn on full ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from frictrack.errors import FrictrackError
from frictrack.recording import Recording
from frictrack.records import Array, Mask
from frictrack.tracking.finding.outline import outline
from frictrack.tracking.finding.rotating import rotating_body
from frictrack.tracking.finding.scene import Blob, Picture, Scene, sample, without
from frictrack.tracking.finding.subpixel import most_moving
from frictrack.tracking.match import Rectangle, correlate, vertex

LEAST_TRAVEL = 1.5  # px
MATCH = 0.6
NEARER = 0.3  # score that a match on the other side of the picture must be better by
SHADING = 0.15  # share of the contrast that a plane leaves of a slope of light
HOPS = 8  # finds of which some must be on the way
ROWS = 6  # sampled frames from which candidates are taken
PURSUED = 8
CUT_OFF = 0.2  # worth of a body that the picture's edge cuts off all the time: an arm, a rod
# A second body is worth a question when it is as large and travels as far as this share of the first ...
RIVAL_SIDE, RIVAL_AREA, RIVAL_TRAVEL, RIVAL_SCORE, RIVAL_SEEN = 16, 0.25, 0.5, 0.7, 0.6  # the side in px
APART = 0.3  # ... and moves against it by this share of the way; shadow, reflection and rod in contact do not


@dataclass(frozen=True, eq=False)
class Body:
    """A moving thing on the reduced pictures: its bounding box in sampled frame `row`, and where that went."""

    box: Rectangle
    row: int
    corner: Array  # (k, 2) px, NaN where not seen
    score: Array  # (k,)
    merit: float

    @property
    def seen(self) -> Mask:
        """Sampled frames (k,) that show the body."""
        return np.isfinite(self.corner[:, 0])


def find_target(recording: Recording) -> Rectangle:
    """Rectangle (x, y, w, h) px of the moving body; in the first frame, unless `locate` names another one."""
    return locate(recording)[0]


def locate(recording: Recording) -> tuple[Rectangle, int]:
    """Rectangle of the body that moves farthest, slightly inside its outline, and the frame it refers to.

    A body that turns as it goes never looks the same: then it is the patch of steady size that travels. Where nothing
    travels by more than a pixel or two, it is the patch whose smaller motion stands out of the noise most; where none
    does, the patch that is tracked best. Raises `FrictrackError` when the film has no contrast, no patch has enough
    texture, or two bodies move apart.
    """
    scene, bodies = _looked(sample(recording))
    rotating = rotating_body(scene, bodies[0].box[2] * bodies[0].box[3] if bodies else 0.0)
    if rotating is not None:
        return rotating
    if not bodies and scene.shake.any():  # perhaps what filled the picture was the body, and no shake
        scene, bodies = _looked(sample(recording, steady=False))
    if not bodies:
        return _subtle(recording, scene)
    rivals = [body for body in bodies[1:] if _rivals(scene, bodies[0], body)]
    if rivals:
        raise FrictrackError(_which(recording, scene, (bodies[0], rivals[0])))
    return drawn(scene, bodies[0])


def _subtle(recording: Recording, scene: Scene) -> tuple[Rectangle, int]:
    """The patch that moves by less than bodies are seen by, in the first of the sampled frames."""
    found = most_moving(scene)
    if found is None:
        raise FrictrackError(
            f"{recording.path.name}: expected a moving target but nothing in the film moves or has enough texture to "
            "be tracked; check the film, or give target = [x, y, w, h]"
        )
    return found, scene.index[0]


def _looked(scene: Scene) -> tuple[Scene, list[Body]]:
    """The moving bodies; looked for once more where the best of them was part of the background."""
    bodies = moving(scene)
    clean = without(scene, bodies[0].box, bodies[0].corner) if bodies else None
    again = moving(clean) if clean else []
    return (clean, again) if clean and again else (scene, bodies)


def drawn(scene: Scene, body: Body, frame: int | None = None) -> tuple[Rectangle, int]:
    """Rectangle of a body on the full picture and the frame it refers to; `frame` if given and sampled."""
    return outline(scene, body.box, body.row, body.corner, frame)


def moving(scene: Scene) -> list[Body]:
    """The bodies that travel, the one most worth tracking first."""
    tried: list[Body] = []
    for row, box in _candidates(scene):
        if len(tried) < PURSUED and not any(_is(body, row, box) for body in tried):
            tried.append(pursue(scene, row, box))
    return sorted((body for body in tried if body.merit > 0), key=lambda body: -body.merit)


def _candidates(scene: Scene) -> Iterator[tuple[int, Rectangle]]:
    """Boxes of foreground in frames spread over the film: the largest of each, then the second."""
    least = scene.least_side
    boxes = [[b.box for b in blobs if min(b.box[2:]) >= least] for blobs in scene.blobs]
    busy = [row for row, found in enumerate(boxes) if found]
    if not busy:
        return
    rows = [busy[i] for i in np.unique(np.linspace(0, len(busy) - 1, ROWS).astype(int))]
    for rank in range(2):
        yield from ((row, boxes[row][rank]) for row in rows if len(boxes[row]) > rank)


def _is(body: Body, row: int, box: Rectangle) -> bool:
    """Whether this box is the body, as pursued already."""
    if not body.seen[row] or body.score[row] < 0.8:
        return False
    size = np.array(body.box[2:])
    low, high = np.maximum(body.corner[row], box[:2]), np.minimum(body.corner[row] + size, np.add(box[:2], box[2:]))
    common = np.prod(np.maximum(high - low, 0))
    return bool(common > 0.5 * (size.prod() + box[2] * box[3] - common))


def pursue(scene: Scene, row: int, box: Rectangle) -> Body:
    """Look for the contents of `box` in every sampled frame, among what is foreground there."""
    x, y, w, h = box
    patch = scene.small[row][y : y + h, x : x + w]
    n = len(scene.small)
    corner, score = np.full((n, 2), np.nan), np.full(n, np.nan)
    for frames in (range(row, n), range(row - 1, -1, -1)):
        last = np.array([x, y], dtype=np.float64)
        for k in frames:
            at, best, moves = _match(scene.small[k], scene.foreground[k], patch, last)
            if best > MATCH and moves:
                corner[k], score[k], last = at, best, at
    known = _known_axes(patch)
    # Along a stripe nothing can be told: a find far along it is another stripe.
    strays = np.hypot(*((corner - (x, y)) @ (np.eye(2) - known)).T) > 0.5 * max(w, h)
    corner[strays], score[strays] = np.nan, np.nan
    merit = 0.0 if _shading(patch) else _merit(scene, box, corner, score, known)
    return Body(box, row, corner, score, merit)


def _match(picture: Picture, foreground: Mask, patch: Picture, last: Array) -> tuple[Array, float, bool]:
    """Corner (x, y) of the best match where it was `last` or is foreground by a third; its score; whether it is.

    Among matches that are about as good, the nearest to the last: a bar looks the same all along, and a body
    that rests must not be seen elsewhere.
    """
    part = _surrounding(foreground, patch.shape, last)
    scores = correlate(picture[part], patch)
    share = cv2.boxFilter(foreground[part].astype(np.float32), -1, patch.shape[::-1], anchor=(0, 0))
    rows, columns = np.arange(scores.shape[0]) + part[0].start, np.arange(scores.shape[1]) + part[1].start
    away = np.abs(rows - last[1])[:, None] + np.abs(columns - last[0])
    scores[(share[: scores.shape[0], : scores.shape[1]] < 0.3) & (away > 2)] = 0
    _, _, _, (i, j) = cv2.minMaxLoc(scores - NEARER / max(picture.shape) * away)
    at = (columns[i] + vertex(scores[j], i), rows[j] + vertex(scores[:, i], j))
    return np.array(at), float(scores[j, i]), bool(share[j, i] >= 0.3)


def _surrounding(foreground: Mask, size: tuple[int, ...], last: Array) -> tuple[slice, slice]:
    """The part of the picture that has room for a patch of `size` (h, w) round all foreground and where it was."""
    fx, fy, fw, fh = cv2.boundingRect(foreground.astype(np.uint8))
    x, y = np.rint(last).astype(int)
    x0, y0, x1, y1 = x - 3, y - 3, x + size[1] + 4, y + size[0] + 4
    if fw:
        x0, y0 = min(x0, fx - size[1]), min(y0, fy - size[0])
        x1, y1 = max(x1, fx + fw + size[1]), max(y1, fy + fh + size[0])
    return slice(max(y0, 0), y1), slice(max(x0, 0), x1)


def _shading(patch: Picture) -> bool:
    """Whether the patch is little more than a slope of light, which moves when the light changes."""
    y, x = (c.ravel() - c.mean() for c in np.mgrid[: patch.shape[0], : patch.shape[1]].astype(np.float64))
    values = patch.ravel() - patch.mean()
    explained = (values @ x) ** 2 / (x @ x) + (values @ y) ** 2 / (y @ y)
    return bool(values @ values - explained < SHADING * (values @ values))


def _known_axes(patch: Picture) -> Array:
    """Projection (2, 2) onto the directions in which the patch's place can be told; a stripe has only one."""
    gy, gx = np.gradient(patch)
    power, axes = np.linalg.eigh([[np.sum(gx * gx), np.sum(gx * gy)], [np.sum(gx * gy), np.sum(gy * gy)]])
    known = axes[:, power > 0.02 * power[1]]
    return np.asarray(known @ known.T, dtype=np.float64)


def _merit(scene: Scene, box: Rectangle, corner: Array, score: Array, known: Array) -> float:
    """How much a body is worth tracking: seen often and well, large, far travelled; 0 for what does not move."""
    seen = np.isfinite(corner[:, 0])
    far = travel(corner[seen] @ known)
    if far * scene.factor <= LEAST_TRAVEL or _hops(corner[seen] @ known, far):
        return 0.0
    cut = np.mean([_cut_off(scene, row, box, corner[row]) for row in np.flatnonzero(seen).tolist()]) > 0.8
    alike = np.sum((score[seen] - MATCH) ** 2)
    return float(alike * far * np.sqrt(box[2] * box[3]) * (CUT_OFF if cut else 1.0))


def travel(corner: Array) -> float:
    """Distance covered by the finds (k, 2), px; a stray match in ten does not count, nor a single one."""
    if len(corner) < 2:
        return 0.0
    away = np.sort(np.hypot(*(corner - np.median(corner, axis=0)).T))
    return 2 * float(away[-max(2, len(corner) // 10)])


def _hops(corner: Array, far: float) -> bool:
    """Whether the finds (k, 2) jump between places without ever being on the way: scraps that look alike."""
    steps = np.hypot(*np.diff(corner, axis=0).T)
    return len(corner) >= HOPS and float(np.sum(steps[steps < 0.45 * far])) < 0.2 * far


def _cut_off(scene: Scene, row: int, box: Rectangle, corner: Array) -> bool:
    """Whether the foreground that a body is part of goes on beyond the picture."""
    centre = corner + np.array(box[2:]) / 2
    return any(blob.cut for blob in scene.blobs[row] if _holds(blob, centre))


def _holds(blob: Blob, point: NDArray[np.float64]) -> bool:
    x, y, w, h = blob.box
    return bool(x <= point[0] < x + w and y <= point[1] < y + h)


def _rivals(scene: Scene, first: Body, second: Body) -> bool:
    """Whether the second body moves on its own, so far and so plainly that one must ask which is meant."""
    both = first.seen & second.seen
    if both.sum() < max(min(3, len(both)), RIVAL_SEEN * first.seen.sum()):
        return False
    a, b = first.corner[both], second.corner[both]
    size = np.array([first.box[2:], second.box[2:]])
    if (
        size.min() * scene.factor < RIVAL_SIDE
        or size[1].prod() < RIVAL_AREA * size[0].prod()
        or np.median(second.score[both]) < RIVAL_SCORE
    ):
        return False
    apart = np.any(np.abs(a + size[0] / 2 - b - size[1] / 2) > 0.35 * size.sum(axis=0), axis=1)
    if apart.mean() < 0.5 or _span(b) < RIVAL_TRAVEL * _span(a):
        return False
    if np.mean([_cut_off(scene, row, second.box, second.corner[row]) for row in np.flatnonzero(both).tolist()]) > 0.5:
        return False
    return _span(b - a) > APART * _span(a) + 2


def _span(at: Array) -> float:
    """Diagonal of the box that holds the places (k, 2), px."""
    return float(np.hypot(*np.ptp(at, axis=0)))


def _which(recording: Recording, scene: Scene, bodies: tuple[Body, Body]) -> str:
    """The question which of two bodies is meant."""
    lines = []
    for body in sorted(bodies, key=lambda body: float(np.nanmin(body.corner[:, 0]))):
        (x, y, w, h), frame = drawn(scene, body)
        line = f"target = [{x}, {y}, {w}, {h}]" + (f" with template = {frame}" if frame else "")
        lines.append(f"{line} (moves {_span(body.corner[body.seen]) * scene.factor:.0f} px)")
    return f"{recording.path.name}: expected one moving target but two move; give " + " or ".join(lines)
