"""Targets that move by hundredths of a pixel: followed where one is given, found where the motion can be seen."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from film import Film, expose, moved, speckle

from frictrack.records import Array
from frictrack.tracking import find_reference, track
from frictrack.tracking.checks import moves_with
from frictrack.tracking.detection import resolve_target

SHAPE, N = (96, 144), 60
K = np.arange(N)
MASK_X, MASK_Y = (40, 100), (30, 70)  # px, of the body that moves


def swung(size: float) -> tuple[Array, Array]:
    """Places x and y (n,) px of a body that vibrates."""
    return size * np.sin(2 * np.pi * K / 17.3 + 0.4), 0.5 * size * np.cos(2 * np.pi * K / 17.3)


@lru_cache
def body_film(size: float, seed: int = 0, shake: float = 0.0) -> tuple[Film, Array, Array]:
    """A speckled body with soft edges over a speckled wall, both moved exactly (by Fourier phases)."""
    rng = np.random.default_rng(seed)
    texture, wall = speckle(SHAPE, rng, contrast=30.0), speckle(SHAPE, rng, contrast=15.0)
    x, y = swung(size)
    wobble = shake * np.sin(2 * np.pi * K / 5.1)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)

    def draw(i: int) -> np.ndarray:
        at = columns - x[i] - wobble[i], rows - y[i]
        inside = [np.minimum(a - low, high - a) for a, (low, high) in zip(at, (MASK_X, MASK_Y), strict=True)]
        mask = 1 / (1 + np.exp(-3 * np.minimum(*inside)))
        behind, before = moved(wall, wobble[i], 0.0), moved(texture, x[i] + wobble[i], y[i])
        return expose(110 + (1 - mask) * behind + mask * (20 + before), np.random.default_rng([seed, i]))

    frames = [draw(i) for i in range(N)]
    return Film(lambda i: frames[i], N, SHAPE, fps=1000.0), x + wobble, y


def on_body(rectangle: tuple[int, int, int, int]) -> float:
    """Share of a rectangle that lies on the body."""
    x, y, w, h = rectangle
    wide = min(x + w, MASK_X[1] + 1) - max(x, MASK_X[0])
    tall = min(y + h, MASK_Y[1] + 1) - max(y, MASK_Y[0])
    return max(wide, 0) * max(tall, 0) / (w * h)


@pytest.mark.few(2)
@pytest.mark.parametrize("size", [0.01, 0.03, 0.1, 0.3, 1.0])
def test_what_moves_by_less_than_a_pixel_is_found_and_followed(size: float) -> None:
    recording, x, y = body_film(size)
    rectangle, frame = resolve_target(recording)
    assert on_body(rectangle) > 0.9, rectangle
    result = track(recording, rectangle, template=frame)
    assert result.found.all()
    for found, true, sigma in ((result.x_px, x, result.sigma_px), (result.y_px, y, result.sigma_y_px)):
        error = (found - found.mean() - true + true.mean()) / sigma
        assert np.sqrt(np.mean(error**2)) == pytest.approx(1.0, abs=0.35)  # three of 1 / sqrt(2 n), and a little bias
    assert not any("does not move" in note for note in result.notes)


@pytest.mark.parametrize("size", [0.01, 0.1, 1.0])
def test_a_target_that_is_given_is_followed_however_little_it_moves(size: float) -> None:
    recording, x, _ = body_film(size, seed=1)
    result = track(recording, [52, 36, 32, 28])
    assert result.found.all()
    slope = np.polyfit(x, result.x_px, 1)[0]
    error = np.median(result.sigma_px) / (np.std(x) * np.sqrt(N))
    assert slope == pytest.approx(1.0, abs=3.5 * error + 0.005)


def test_a_film_at_rest_is_followed_and_said_to_rest() -> None:
    recording, _, _ = body_film(0.0)
    result = track(recording)
    assert result.found.all()
    assert np.std(result.x_px) < 0.01
    (note,) = [note for note in result.notes if "does not move" in note]
    assert "by more than the noise of its places, 0.00" in note
    assert "give its rectangle as target = [x, y, w, h]" in note


def test_a_small_motion_is_found_in_a_picture_that_shakes_as_little() -> None:
    recording, _, _ = body_film(0.1, shake=0.1)
    assert on_body(resolve_target(recording)[0]) > 0.9


@pytest.mark.parametrize("size", [0.03, 0.3])
def test_a_reference_does_not_lie_on_what_moves_by_less_than_a_pixel(size: float) -> None:
    recording, _, _ = body_film(size)
    found = find_reference(recording, track(recording, [52, 50, 24, 16]))
    assert found is None or on_body(found) == 0


def test_a_reference_that_moves_as_the_target_does_tells_no_shake() -> None:
    recording, _, _ = body_film(0.1)
    target, other, wall = (track(recording, [*corner, 24, 16]) for corner in ((46, 36), (70, 50), (8, 8)))
    assert moves_with(target, other)
    assert not moves_with(target, wall)
    assert not moves_with(wall, target)  # what rests does not move with anything


def test_the_noise_of_a_picture_from_one_frame_draws_no_place_of_a_short_film() -> None:
    """Four frames teach no picture: that of the first is moved together with its noise, and its deviation holds."""
    shifts, error, stated = np.array([0.0, 0.15, 0.3, 0.45]), [], []
    for seed in range(40):
        rng = np.random.default_rng([11, seed])
        texture = 120 + speckle((56, 72), rng, contrast=26.0)
        frames = [expose(moved(texture, x, 0.0), rng) for x in shifts]
        result = track(Film(lambda i, f=frames: f[i], 4, (56, 72), fps=1000.0), [18, 14, 36, 28])
        error.append((result.x_px - result.x_px[0] - shifts)[1:])
        stated.append(result.sigma_px[1:])
    bias = np.mean(error, axis=0)
    assert np.max(np.abs(bias)) < 0.005  # 40 films tell it to 0.0012 px
    assert np.sqrt(np.mean((np.array(error) / stated) ** 2)) == pytest.approx(1.0, abs=0.2)
