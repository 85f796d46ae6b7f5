"""Finding the target by itself, on films of known truth."""

from __future__ import annotations

import re

import cv2
import film
import numpy as np
import pytest
from blocks import SHAPE, SIZE, SLIDE, N, a_film, holds, pasted, shaking, shown, two_blocks
from cost import within
from film import Film, block_film, expose, speckle

from frictrack.base.errors import FrictrackError
from frictrack.tracking import find_target, target_line, track
from frictrack.tracking.detection.sampled_scene import sample_scene
from frictrack.tracking.detection.targets import locate_target


def error(result, x):
    """Error of the track in px, constant offset removed."""
    off = result.x_px - x
    return off - np.nanmean(off)


@pytest.mark.few(1)
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


# ---- what could mislead it


def test_two_that_move_apart_are_asked_about():
    with pytest.raises(FrictrackError, match="expected one moving target but two move; give target") as failure:
        find_target(two_blocks())
    lines = re.findall(
        r"\[(\d+), (\d+), (\d+), (\d+)\](?: with template = (\d+))? \(moves (\d+) px\)", str(failure.value)
    )
    assert len(lines) == 2
    paths = [(SLIDE, 20, (26, 40), 130), (200 - 1.5 * np.arange(N), 48, (22, 36), 118)]
    for line in lines:
        rect, frame, far = [int(v) for v in line[:4]], int(line[4] or 0), int(line[5])
        assert any(holds(rect, x[frame], y, size) and abs(far - travel) < 5 for x, y, size, travel in paths)


def with_shadow(i, scene, paste):
    picture = scene.copy()
    shadow = np.outer(film.cover(SHAPE[0], 44, 60), film.cover(SHAPE[1], SLIDE[i] - 30, SLIDE[i] + 20))
    picture *= 1 - 0.5 * shadow
    paste(picture, SLIDE[i], 24, (36, 48), 1)
    return picture


def with_reflection(i, scene, paste):
    picture = scene.copy()
    paste(picture, SLIDE[i], 20, (30, 48), 1)
    mirror = picture[5:35][::-1]
    picture[35:] = 0.5 * picture[35:]
    picture[35:64] += 0.4 * mirror[:29] - 40
    return picture


def with_rod(i, scene, paste):
    """A rod pushes the block for a while and stays behind."""
    picture = scene.copy()
    tip = min(SLIDE[i], 110) - 24
    rod = np.outer(film.cover(SHAPE[0], 26, 36), film.cover(SHAPE[1], -1, tip))
    picture += rod * (200 - picture)
    paste(picture, SLIDE[i], 31, (36, 48), 1)
    return picture


def with_twin_at_rest(i, scene, paste):
    picture = scene.copy()
    paste(picture, 200, 46, (30, 44), 1)
    paste(picture, 30 + 1.1 * i, 17, (30, 44), 1)
    return picture


def with_glare(i, scene, paste):
    """A fixed highlight on whatever passes, and a lamp that flickers and drifts."""
    picture = scene.copy()
    paste(picture, SLIDE[i], 24, (36, 48), 1)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    glare = 90 * np.exp(-(((x - 120) / 14) ** 2) - ((y - 24) / 9) ** 2)
    return np.clip((picture + glare) * (1 + 0.1 * np.sin(0.8 * i) - 0.2 * i / N), 0, 255)


def with_post(i, scene, paste):
    """A post that the block passes behind."""
    picture = scene.copy()
    paste(picture, SLIDE[i], 31, (36, 48), 1)
    picture[:, 118:132] = 30
    return picture


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("draw", "x", "y", "size"),
    [
        (with_shadow, SLIDE, 24, (36, 48)),
        (with_reflection, SLIDE, 20, (30, 48)),
        (with_rod, SLIDE, 31, (36, 48)),
        (with_twin_at_rest, 30 + 1.1 * np.arange(N), 17, (30, 44)),
        (with_glare, SLIDE, 24, (36, 48)),
        (with_post, SLIDE, 31, (36, 48)),
    ],
    ids=["shadow", "reflection", "rod", "twin at rest", "glare", "post"],
)
def test_one_body_is_one_target(draw, x, y, size):
    scene, paste = pasted()
    rect, frame = locate_target(shown(lambda i: draw(i, scene, paste)))
    assert holds(rect, x[frame], y, size), (rect, frame, x[frame])


@pytest.mark.parametrize("n", [3, 5])
def test_a_short_film(n):
    x = 70 + 60 * np.arange(n) if n < 5 else 60 + 21.3 * np.arange(n)
    rect, frame = locate_target(a_film(x))
    assert holds(rect, x[frame], 31.5, SIZE), (rect, frame)


def test_a_short_move_in_a_long_rest():
    """A camera that waits for its trigger: one frame in twenty shows motion."""
    x = 60 + np.clip(np.arange(1200) - 900, 0, 60) * 1.7
    source = block_film(x, size=SIZE, shape=SHAPE)
    rect, frame = locate_target(source)
    assert holds(rect, x[frame], 31.5, SIZE), (rect, frame)


def test_a_camera_that_shakes():
    shake, recording = shaking()
    rect, frame = locate_target(recording)
    assert holds(rect, SLIDE[frame] + shake[frame, 0], 31.5 + shake[frame, 1], SIZE), (rect, frame)


def test_it_is_quick():
    recording = a_film(np.linspace(60, 180, 600), noise=False)
    with within(25):  # 2 measured
        find_target(recording)


def test_a_body_that_never_clears_its_place_on_a_plain_wall():
    """In the median of eight frames it is half background: no ghost of it may be taken in."""
    _, paste = pasted()

    def draw(i):
        picture = np.full(SHAPE, 60.0)
        paste(picture, 60 + 14.3 * i, 30, SIZE, 1)
        return picture

    rect, frame = locate_target(shown(draw, 8))
    left, top, w, h = rect
    x = 60 + 14.3 * frame
    assert abs(left - (x - 24)) < 6
    assert abs(left + w - (x + 24)) < 6
    assert abs(top - 12) < 6
    assert abs(top + h - 48) < 6


def test_a_body_that_passes_slowly_is_no_background():
    """It covers each place on its way in up to two thirds of the frames, never with the same grey value for long."""
    scene, paste = pasted()

    def draw(i):
        picture = scene.copy()
        paste(picture, 60 + 0.9 * i, 30, SIZE, 1)
        return picture

    assert np.quantile(np.abs(sample_scene(shown(draw)).background - scene), 0.98) < 5  # noise of a frame: 1.5


def test_noise_is_no_foreground_where_the_sensor_is_full_elsewhere():
    """A white wall without noise, a noisy course below: the body is found, not the course."""
    _, paste = pasted()
    course = 110 + speckle(SHAPE, np.random.default_rng(4))

    def draw(i):
        picture = np.where(np.arange(SHAPE[0])[:, None] > 48, course, 400.0)
        paste(picture, SLIDE[i], 26, (36, 48), 1)
        return picture

    rect, frame = locate_target(shown(draw))
    assert abs(rect[0] + rect[2] / 2 - SLIDE[frame]) < 4
    assert rect[1] + rect[3] < 52
