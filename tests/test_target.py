"""What the user points at, and the fixed reference: films of known truth."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from blocks import SHAPE, SIZE, SLIDE, N, a_film, holds, pasted, shaking, shown, two_blocks

from frictrack.base.errors import FrictrackError
from frictrack.records import Track
from frictrack.tracking import Areas, driver, find_reference, followed_target, learning_rounds, track
from frictrack.tracking.detection import resolve_target, target_fault


def a_track(x, y=31.5, size=SIZE):
    """A track of a block, as the tracker would return it."""
    n = len(x)
    one = np.full(n, 0.003)
    where = (float(x[0] - size[1] / 2), y - size[0] / 2, float(size[1]), float(size[0]))
    return Track(np.arange(n) / 4000, x, np.full(n, y), 0 * one, one, one, one, np.full(n, ""), target=where)


@pytest.mark.parametrize(("frame", "dx", "dy"), [(0, 0, 0), (40, 15, -10), (79, -20, 12)])
def test_a_click_on_the_moving_body(frame, dx, dy):
    rect, at = resolve_target(a_film(SLIDE), [SLIDE[frame] + dx, 31.5 + dy], frame)
    assert at == frame
    assert holds(rect, SLIDE[frame], 31.5, SIZE), rect


def test_a_click_chooses_between_two():
    recording = two_blocks()
    assert holds(resolve_target(recording, [40, 20])[0], 40, 20, (26, 40))
    assert holds(resolve_target(recording, [200, 48])[0], 200, 48, (22, 36))


def test_a_click_on_what_rests():
    """A textured patch on a plain still wall, away from the block's path."""

    def spoil(i, frame):
        frame[:12, 190:] = 110
        rng = np.random.default_rng(3)
        patch = cv2.GaussianBlur(rng.normal(128, 120, (31, 27)), (0, 0), 1.5)
        frame[33:, 205:232] = np.clip(patch, 0, 255)
        frame[12:33, 190:] = 110
        frame[33:, 190:205] = 110
        frame[33:, 232:] = 110
        return frame

    (x, y, w, h), at = resolve_target(a_film(60 + 0.8 * np.arange(N), spoil), [218, 48])
    assert at == 0
    assert 200 <= x <= 209
    assert 30 <= y <= 37
    assert 227 <= x + w <= 236
    assert 58 <= y + h <= 64


@pytest.mark.parametrize("click", [(120, 30), (112, 36), (125, 24)])
def test_a_click_on_a_plain_disc_takes_its_outline(click):
    rng = np.random.default_rng(0)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]

    def draw(i):
        picture = np.where((x - 120) ** 2 + (y - 30) ** 2 < 20**2, 205.0 + 0.3 * (x - 120), 70.0 + 0.05 * x)
        return cv2.GaussianBlur(picture, (0, 0), 1.0) + rng.standard_normal(SHAPE)

    left, top, w, h = resolve_target(shown(draw), click)[0]
    assert (left, top) == pytest.approx((98, 8), abs=2)  # the disc begins at 100 and 10
    assert (w, h) == pytest.approx((45, 45), abs=3)


def test_a_place_that_rests_while_a_body_moves_is_no_target(monkeypatch):
    film, empty = a_film(SLIDE), np.full(N, 215.0)
    assert target_fault(film, a_track(empty))
    assert not target_fault(film, a_track(SLIDE))
    assert not target_fault(shown(lambda i: pasted()[0]), a_track(empty))  # nothing moves
    x, y, w, h = (round(v) for v in a_track(empty).target)
    monkeypatch.setattr(driver, "resolve_areas", lambda *_: (Areas([x, y, w, h]), (x, y, w, h), 0))
    with pytest.raises(FrictrackError, match=r"that was found, \[.*\], does not go along .* frame \d+ at \["):
        track(film)
    assert np.ptp(track(film, [x, y, w, h]).x_px) < 1  # what the user has drawn is tracked


def test_what_moves_contradicts_a_track_that_is_not_of_the_body():
    """A match score would not tell: here the tracks themselves are wrong."""
    film, k = a_film(SLIDE), np.arange(N)
    slips = SLIDE - 12 * k / N  # along a plain body, say
    jumps, lost = np.where(k < N / 2, 30.0, 180.0), np.where(k < N / 3, SLIDE, np.nan)
    for wrong in (slips, jumps, lost):
        assert "does not go along with what moves" in target_fault(film, a_track(wrong))


def test_a_second_body_is_asked_about_after_tracking_too():
    one = replace(a_track(SLIDE, 20, (26, 40)), score=np.ones(N))
    assert "expected one moving target but two move; give target = [" in target_fault(two_blocks(), one)


def test_a_film_none_of_whose_frames_fits_the_learnt_picture_is_refused(monkeypatch):
    """It is said so, and nothing divides by a number of frames that is none."""
    monkeypatch.setattr(learning_rounds._Round, "usable", property(lambda one: np.zeros(len(one.cuts), np.bool_)))
    assert track(a_film(SLIDE), [20, 16, 40, 30]).found.all()  # with the picture of the first frame
    monkeypatch.setattr(followed_target, "_loss_reasons", lambda _, rows, __: ["poor"] * len(rows))
    with pytest.raises(FrictrackError, match="is found in fewer than two frames"):
        track(a_film(SLIDE), [20, 16, 40, 30])


def test_a_picture_of_the_target(tmp_path):
    """Cut out of frame 50 of another recording of the same block, it is found wherever the block is."""
    other = a_film(SLIDE + 3)
    left = round(SLIDE[50] + 3) - 18
    picture = other.frame(50)[20:44, left : left + 36]
    assert cv2.imwrite(str(tmp_path / "block.png"), picture)
    for target in (picture, tmp_path / "block.png", str(tmp_path / "block.png")):
        (x, y, w, h), at = resolve_target(a_film(SLIDE, seed=0), target)
        assert (w, h) == (36, 24)
        assert abs(x - (SLIDE[at] - 18)) < 1.5
        assert abs(y - 20) < 1.5


def test_a_picture_that_fits_late():
    x = np.where(np.arange(N) < 77, -80.0, 100.0)
    film = a_film(x)
    (left, _, _, _), at = resolve_target(film, film.frame(78)[20:44, 80:116].copy())
    assert at >= 77
    assert left == 80


@pytest.mark.parametrize(
    ("target", "said"),
    [
        (
            [10, 10, 20],
            r"expected a target \[x, y, w, h\] in px but got \[10.0, 10.0, 20.0\]; give a rectangle, a click",
        ),
        ([10, np.nan], r"expected a target \[x, y, w, h\] in px but got \[10.0, nan\]"),
        ([300, 10], r"expected a click inside the 240x64 px picture but got \[300, 10\]"),
        ([230, 10, 20, 20], r"a target inside the 240x64 px picture but got \[230, 10, 20, 20\]"),
        ([10, 10, 4, 20], "expected a target of at least 8x8 px but got 4x20 px"),
        ("nowhere.png", "nowhere.png: expected a picture of the target but it cannot be read; check the path"),
        (np.zeros((20, 20), np.uint8), "the template picture: expected a picture of the target but it is all one grey"),
        (np.eye(100, dtype=np.uint8), "expected a template from 8x8 to 240x64 px but got 100x100 px"),
        (255 * np.eye(30, dtype=np.uint8), r"film.test: the template picture fits nowhere, its best score is 0\.\d\d"),
    ],
)
def test_what_is_no_target_is_said(target, said):
    with pytest.raises(FrictrackError, match=said):
        resolve_target(a_film(SLIDE[::8]), target)


# ---- the fixed reference


def test_a_reference_is_never_touched():
    x, y, w, h = find_reference(a_film(SLIDE), a_track(SLIDE))
    below, above = 31.5 + SIZE[0] / 2, 31.5 - SIZE[0] / 2
    aside = x > SLIDE.max() + SIZE[1] / 2
    assert y >= below or y + h <= above or aside
    assert x >= 0
    assert x + w <= SHAPE[1]
    assert y + h <= SHAPE[0]


def test_a_reference_that_shakes_with_the_camera():
    shake, recording = shaking(2.0)
    rect = find_reference(recording, a_track(SLIDE + shake[:, 0]))
    assert rect is not None
    x, y, _, h = rect
    reach = 2.0
    assert (
        y >= 31.5 + SIZE[0] / 2 + reach or y + h <= 31.5 - SIZE[0] / 2 - reach or x > SLIDE.max() + SIZE[1] / 2 + reach
    )


def test_no_reference_on_a_plain_scene():
    """A plain wall, and one with stripes only: nothing there can be tracked along both axes."""
    _, paste = pasted()
    for stripes in (0.0, 60.0):

        def draw(i, stripes=stripes):
            picture = np.full(SHAPE, 120.0) + stripes * np.sin(np.arange(SHAPE[0]) / 2.0)[:, None]
            paste(picture, SLIDE[i], 31.5, SIZE, 1)
            return picture

        assert find_reference(shown(draw), a_track(SLIDE)) is None
