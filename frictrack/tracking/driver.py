"""The flow of tracking: find the target, search it coarsely, learn its template, refine every frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.recording import Recording
from frictrack.records import Array, Track
from frictrack.tracking.find import locate
from frictrack.tracking.findings import key_frames
from frictrack.tracking.follow import UNREAD, Coarse, follow
from frictrack.tracking.learn import learn
from frictrack.tracking.match import Rectangle, cut_out
from frictrack.tracking.refine import Fine, Template, refine

Progress = Callable[[int, int, str], None]

LEAST_SCORE = 0.7
LEAST_CONTRAST = 3  # grey values
CHUNK = 64  # cut-outs refined at once: their pictures fit a processor's cache


def track(
    recording: Recording,
    target: Sequence[float] | None = None,
    *,
    template: int = 0,
    name: str = "target",
    progress: Progress | None = None,
) -> Track:
    """Position of the moving body in every frame, in pixels, with a standard deviation and a score.

    `target` is its rectangle [x, y, w, h] px in frame number `template`; without it the body that moves
    farthest is found by itself. Position is that of the rectangle's centre. A frame in which the target is
    not found holds NaN and the reason. Raises `FrictrackError` for a rectangle that does not fit the
    picture, a film without contrast, or one in which nothing moves.
    """
    if progress:
        progress(0, recording.n_frames, "find the target")
    if target is None:
        rectangle, template = locate(recording)
    else:
        rectangle = _checked(target, recording)
    picture = recording.frame(template)
    x, y, w, h = rectangle
    if np.ptp(picture[y : y + h, x : x + w]) < LEAST_CONTRAST:
        raise FrictrackError(
            f"{recording.path.name}: the target {list(rectangle)} has no contrast in frame {template}; "
            "choose a rectangle that shows texture or an outline"
        )
    coarse = follow(recording, picture[y : y + h, x : x + w].copy(), (x, y) if template == 0 else None, progress)
    model = learn(coarse, cut_out(picture, np.array([x, y]), (h, w)))
    result = _assemble(recording, coarse, _refine_all(coarse, model, progress), rectangle, name)
    result = replace(result, template=template, picture=model.image)
    if np.count_nonzero(result.found) < 2:
        raise FrictrackError(
            f"{recording.path.name}: the target {list(rectangle)} is found in fewer than two frames; "
            "choose a rectangle that fits the moving body, in a frame that shows it well"
        )
    return result


def _checked(target: Sequence[float], recording: Recording) -> Rectangle:
    """The rectangle in whole pixels, inside the picture."""
    height, width = recording.shape
    if len(target) != 4 or not np.all(np.isfinite(target)):
        raise FrictrackError(f"expected a target [x, y, w, h] in px but got {list(target)}")
    x, y, w, h = (round(v) for v in target)
    if w < 8 or h < 8:
        raise FrictrackError(f"expected a target of at least 8x8 px but got {w}x{h} px")
    if x < 0 or y < 0 or x + w > width or y + h > height:
        raise FrictrackError(f"expected a target inside the {width}x{height} px picture but got [{x}, {y}, {w}, {h}]")
    return x, y, w, h


def _refine_all(coarse: Coarse, template: Template, progress: Progress | None) -> Fine:
    parts = []
    start, total = coarse.start, len(coarse.frame)
    for at in range(0, total, CHUNK):
        part = slice(at, at + CHUNK)
        parts.append(refine(np.asarray(coarse.patches[part]), start[part], template))
        if progress:
            progress(at, total, "refine")
    return Fine(**{key: np.concatenate([getattr(p, key) for p in parts]) for key in vars(parts[0])})


def _assemble(recording: Recording, coarse: Coarse, fine: Fine, rectangle: Rectangle, name: str) -> Track:
    """One row per frame: the fine position where it can be trusted, else NaN and the reason."""
    _, _, w, h = rectangle
    corner = coarse.origin + fine.at
    n = recording.n_frames
    reason = np.array(coarse.reason, dtype=object)
    reason[coarse.frame] = _reasons(corner, fine, (h, w), recording.shape)
    score = coarse.score.copy()
    score[coarse.frame] = fine.score
    kept = reason[coarse.frame] == ""

    def column(values: Array) -> Array:
        out = np.full(n, np.nan)
        out[coarse.frame[kept]] = values[kept]
        return out

    x, y = column(corner[:, 0] + (w - 1) / 2), column(corner[:, 1] + (h - 1) / 2)
    return Track(
        t=recording.t,
        x_px=x,
        y_px=y,
        angle=column(fine.angle),
        sigma_px=column(fine.sigma[:, 0]),
        sigma_y_px=column(fine.sigma[:, 1]),
        score=score,
        reason=reason.astype(str),
        name=name,
        target=(float(rectangle[0]), float(rectangle[1]), float(w), float(h)),
        notes=(*recording.notes, *_unread(coarse), *key_frames(coarse.change, x, y)),
    )


def _unread(coarse: Coarse) -> tuple[str, ...]:
    count = coarse.reason.count(UNREAD)
    total = len(coarse.reason)
    return (f"{total - count} of {total} frames could be read; the rest is missing or damaged",) if count else ()


def _reasons(corner: Array, fine: Fine, size: tuple[int, int], shape: tuple[int, int]) -> list[str]:
    """Why each cut-out's position cannot be trusted; "" where it can."""
    room = np.array(shape[::-1]) - np.array(size[::-1])
    out = np.any((corner < -0.5) | (corner > room + 0.5), axis=1)
    reasons = []
    for outside, settled, score in zip(out, fine.settled, fine.score, strict=True):
        if outside:
            reasons.append("target leaves the frame")
        elif not score >= LEAST_SCORE:
            reasons.append(f"match score {score:.2f} below {LEAST_SCORE}")
        else:
            reasons.append("" if settled else "sub-pixel search did not settle")
    return reasons
