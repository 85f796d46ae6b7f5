"""The same point of the same body in another film: pictures moved exactly, by a Fourier phase."""

from __future__ import annotations

import numpy as np
import pytest
from film import moved, speckle

from frictrack.records import Track
from frictrack.tracking import align_track
from frictrack.tracking.driver import target_offset

TEXTURE = 128 + speckle((100, 140), np.random.default_rng(0))
H, W = 53, 83


def cut(dx=0.0, dy=0.0, size=(H, W), noise=0.5, seed=0):
    """The texture's middle as a rectangle of `size` shows it whose centre lies (dx, dy) px further right and down."""
    h, w = size
    picture = moved(TEXTURE, -dx, -dy)
    top, left = (100 - h) // 2, (140 - w) // 2
    rng = np.random.default_rng(seed)
    return picture[top : top + h, left : left + w] + noise * rng.standard_normal(size)


@pytest.mark.parametrize(("dx", "dy"), [(0.0, 0.0), (0.37, -0.81), (-5.5, 3.25), (17.2, -9.6)])
def test_two_pictures_of_one_body(dx, dy):
    """The first shows the body from further right: its centre must go back by as much."""
    errors = []
    for seed in range(6):
        offset, sigma = target_offset(0.8 * cut(dx, dy, seed=seed) + 12, cut(seed=seed + 100))
        errors += [*((offset + np.array([dx, dy])) / sigma)]
        assert sigma[0] < 0.02
    assert np.sqrt(np.mean(np.square(errors))) < 2.0
    assert np.max(np.abs(errors)) < 5


def test_rectangles_of_different_size():
    offset, _ = target_offset(cut(3.0, 1.0, size=(45, 71)), cut(size=(53, 83)))
    assert offset == pytest.approx([-3, -1], abs=0.03)


def test_another_body_is_not_the_same():
    other = 128 + speckle((H, W), np.random.default_rng(5))
    assert target_offset(cut(), other) is None
    assert target_offset(cut(), None) is None
    assert target_offset(cut(size=(20, 20)), cut()) is None


def a_track(picture):
    n = 5
    one = np.ones(n)
    return Track(np.arange(n) / 100, one, one, one, one, one, one, np.full(n, ""), picture=picture)


def test_the_track_is_moved_and_says_so():
    result = align_track(a_track(cut(2.5, -1.0)), a_track(cut()))
    np.testing.assert_allclose(result.x_px, 1 - 2.5, atol=0.02)
    np.testing.assert_allclose(result.y_px, 1 + 1.0, atol=0.02)
    (note,) = result.notes
    assert note.startswith("tracked point moved by (-2.5")
    assert "+/- 0.0" in note
    assert align_track(a_track(cut()), a_track(cut(seed=3))).notes == ()
    (note,) = align_track(a_track(cut()), a_track(None)).notes
    assert note.startswith("its target does not look like that of the reference: it has an origin of its own")
