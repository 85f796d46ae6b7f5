"""Finding the target by itself, on films of known truth."""

from __future__ import annotations

import cv2
import film
import numpy as np
import pytest
from film import Film, block_film, expose

from frictrack.tracking import find_target, target_line, track

SIZE, SHAPE = (36, 48), (64, 240)  # of the block and the picture, px
N = 80
SLIDE = 40 + 150 * (1 - np.exp(-np.arange(N) / 40))


def a_film(x, change=None, **given):
    """The block film, drawn once; `change(i, frame)` may spoil frames."""
    source = block_film(np.asarray(x), size=SIZE, shape=SHAPE, **given)
    frames = [source.frame(i) for i in range(len(source))]
    if change:
        frames = [change(i, frame.copy()) for i, frame in enumerate(frames)]
    return Film(lambda i: frames[i], len(frames), frames[0].shape)


def error(result, x):
    """Error of the track in px, constant offset removed."""
    off = result.x_px - x
    return off - np.nanmean(off)


@pytest.mark.parametrize(
    "x",
    [
        SLIDE,
        SLIDE[::-1],
        40 + 9.3 * np.arange(18.0),  # moves from the first frame on, nine pixels a frame
        np.where(np.arange(N) < 50, 60.0, 60 + 0.15 * (np.arange(N) - 50.0) ** 2),  # rests most of the time
        120 + 4 * np.sin(np.arange(N) / 5),  # never clears its own place
    ],
    ids=["slide", "reverse", "fast", "rest", "oscillation"],
)
def test_finds_the_block_by_itself(x):
    recording = a_film(x)
    result = track(recording)
    assert result.found.all()
    assert np.std(error(result, x)) < 0.005
    left, top, w, h = result.target
    assert find_target(recording) == (left, top, w, h)
    at = int(target_line(result).split("template = ")[-1]) if "template" in target_line(result) else 0
    assert x[at] - SIZE[1] / 2 <= left + 0.5
    assert left + w - 0.5 <= x[at] + SIZE[1] / 2
    assert w * h > 0.5 * SIZE[0] * SIZE[1]


def test_a_plain_body_is_found_by_its_outline():
    def draw(i):
        picture = np.full(SHAPE, 180.0)
        cover = np.outer(film.cover(SHAPE[0], 24, 38), film.cover(SHAPE[1], SLIDE[i] - 8, SLIDE[i] + 8))
        picture = cv2.GaussianBlur(picture * (1 - cover) + 60 * cover, (0, 0), 0.8)
        return expose(picture, np.random.default_rng([7, i]))

    result = track(Film(draw, N, SHAPE))
    assert result.found.all()
    left, _, w, _ = result.target
    assert left <= SLIDE[0] - 8
    assert left + w >= SLIDE[0] + 8
    assert np.std(error(result, SLIDE)) < 0.02
