"""Judge what is tracked without a given target on the films of `obstructed`."""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.records import Track
from frictrack.tracking import track

from .obstructed import Body, DrawnFilm, Scene, scene

MIN_BODY_SHARE = 0.5  # of the target's rectangle, that lies in the body's
MAX_ERROR_PX, MAX_ERROR_SHARE = 1.0, 0.02  # beyond which a position is wrong, and share of such frames
MIN_FOUND_SHARE = 0.5  # of the frames that show the whole body


class Outcome(NamedTuple):
    """Outcome of a film, what is wrong, rms of error over stated deviation, CPU time, message."""

    outcome: str
    detail: str
    z: float
    seconds: float
    message: str


def judge(film: Scene) -> Outcome:
    """Track a film without a target and compare with its truth."""
    start = time.process_time()
    try:
        found = track(DrawnFilm(film.frames))
    except FrictrackError as e:
        seconds, message = time.process_time() - start, str(e)
        boxes = re.findall(r"target = \[(\d+), (\d+), (\d+), (\d+)\](?: with template = (\d+))?", message)
        shown = [_on(film.body, [float(q) for q in box[:4]], int(box[4] or 0)) for box in boxes]
        outcome = ("choices" if any(shown) else "wrong") if len(boxes) > 1 else "refused"
        return Outcome(outcome, "" if outcome != "wrong" else "choices without it", np.nan, seconds, message)
    seconds = time.process_time() - start
    assert found.target is not None
    if not _on(film.body, found.target, found.template):
        second = film.second is not None and _on(film.second, found.target, found.template)
        return Outcome("wrong", "second body" if second else "elsewhere", np.nan, seconds, str(found.target))
    error, seen = _error(film, found), found.found & film.visible
    if seen.sum() < MIN_FOUND_SHARE * film.visible.sum():
        return Outcome("wrong", "lost", np.nan, seconds, str(found.lost.most_common(2)))
    if np.mean(np.max(np.abs(error[seen]), axis=1) > MAX_ERROR_PX) > MAX_ERROR_SHARE:
        return Outcome("wrong", "path", np.nan, seconds, f"{np.max(np.abs(error[seen])):.1f} px")
    sigma = np.hypot(found.sigma_px, found.systematic)[seen]
    return Outcome("right", "", float(np.sqrt(np.mean((error[seen, 0] / sigma) ** 2))), seconds, "")


def _on(body: Body, target: Iterable[float], frame: int) -> bool:
    """Whether a rectangle lies on the body of a frame."""
    x, y, w, h = target
    reach = body.half if body.round else np.abs(body.half)
    low, high = body.centre[frame] - reach, body.centre[frame] + reach
    common = np.minimum((x + w - 0.5, y + h - 0.5), high) - np.maximum((x - 0.5, y - 0.5), low)
    return bool(np.prod(np.maximum(common, 0)) > MIN_BODY_SHARE * w * h)


def _error(film: Scene, found: Track) -> np.ndarray:
    """Error (n, 2) px, constant removed: a point of the body turns with it, an outline does not."""
    at, body = np.stack([found.x_px, found.y_px], axis=1), film.body
    offset = at[found.template] - body.centre[found.template]
    turn = body.angle - body.angle[found.template]
    c, s = np.cos(turn), np.sin(turn)
    turned = np.stack([c * offset[0] - s * offset[1], s * offset[0] + c * offset[1]], axis=1)
    errors = [at - body.centre - np.nanmedian(at - body.centre, axis=0)]
    with_turn = at - body.centre - turned
    errors.append(with_turn - np.nanmedian(with_turn, axis=0))
    return min(errors, key=lambda e: float(np.nanmedian(np.abs(e))))


def run(count: int, say: Callable[[str], None]) -> dict[str, object]:
    """Judge the first `count` films."""
    rows = []
    for seed in range(count):
        film = scene(seed)
        rows.append(judge(film))
        say(f"{seed:4d} {rows[-1].outcome:8s} {rows[-1].detail:12s} {rows[-1].seconds:5.2f} s  z {rows[-1].z:5.2f}  "
            f"{', '.join(film.tags)}  {rows[-1].message[:150]}")  # fmt: skip
    return {
        "outcomes": dict(Counter(row.outcome for row in rows)),
        "wrong": dict(Counter(row.detail for row in rows if row.outcome == "wrong")),
        "seconds": float(np.mean([row.seconds for row in rows])),
        "median z": float(np.nanmedian([row.z for row in rows])),
    }
