"""Targets that turn by any angle, on films of known truth, against the Cramer-Rao bound."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from film import FULL_WELL, READ_NOISE, Film, expose

from frictrack.records import Array, Track
from frictrack.tracking import track

SHAPE, RECTANGLE = (110, 170), [36, 38, 44, 32]
HALF = np.array([30.0, 24.0])  # of the block, px
CENTRE = np.array([57.5, 53.5])  # of the rectangle
WAVES = np.random.default_rng(7).normal(0, 0.075, (120, 2))  # cycles/px: speckles of about five pixels
PHASES = np.random.default_rng(8).uniform(0, 2 * np.pi, 120)


def pose(rate: float, n: int) -> Array:
    """A block whose centre is that of the rectangle at first, and that turns by `rate` degrees a frame: (3, n)."""
    k = np.arange(n)
    return np.array([CENTRE[0] + 1.3 * k, CENTRE[1] + 3 * np.sin(k / 9), np.radians(rate) * k])


def texture(seen: Array, order: int = 0) -> Array:
    """Grey values (n,) of the block at places (2, n) from its centre, or with `order` 1 their slopes (2, n)."""
    phase = 2 * np.pi * WAVES @ seen + PHASES[:, None]
    if order:
        return -4.5 * 2 * np.pi * WAVES.T @ np.sin(phase)
    return 128 + 4.5 * np.sum(np.cos(phase), axis=0)


def seen_from(at: Array) -> Array:
    """All pixels of the picture as seen from a block (2, h w)."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].reshape(2, -1).astype(float)
    c, s = np.cos(at[2]), np.sin(at[2])
    return np.array([c * (x - at[0]) + s * (y - at[1]), c * (y - at[1]) - s * (x - at[0])])


def drawn(at: Array) -> Array:
    """A frame without noise."""
    seen = seen_from(at)
    cover = 1 / (1 + np.exp(4 * np.max(np.abs(seen) - HALF[:, None], axis=0)))
    near = cover > 1e-6
    picture = np.full(seen.shape[1], 90.0)
    picture[near] += cover[near] * (texture(seen[:, near]) - 90.0)
    return picture.reshape(SHAPE)


def filmed(true: Array, change: Callable[[Array], Array] | None = None) -> tuple[Film, Array]:
    """Film of a block with these poses (3, n), which are returned as well."""
    n = true.shape[1]
    clean = [drawn(at) for at in true.T]
    shown = [c if change is None else change(c) for c in clean]
    frames = [expose(c, np.random.default_rng([3, i])) for i, c in enumerate(shown)]
    return Film(lambda i: frames[i], n, SHAPE, fps=1000.0), true


def bound(at: Array) -> Array:
    """Cramer-Rao bound of x, y (px) and angle (rad) of one frame; light and level free, the picture known."""
    seen = seen_from(at)
    seen = seen[:, np.all(np.abs(seen) <= np.array([[RECTANGLE[2] / 2], [RECTANGLE[3] / 2]]), axis=0)]
    light, (u, v) = texture(seen), texture(seen, 1)
    c, s = np.cos(at[2]), np.sin(at[2])
    columns = np.stack([c * u - s * v, s * u + c * v, v * seen[0] - u * seen[1], light, np.ones_like(light)])
    variance = (light / 255 * FULL_WELL + READ_NOISE**2) * (255 / FULL_WELL) ** 2 + 1 / 12
    return np.sqrt(np.diag(np.linalg.inv((columns / variance) @ columns.T)))[:3]


def off(result: Track, true: Array) -> Array:
    """Errors along x and y (2, n), px, without the offset of the tracked point, which turns with the block."""
    error = np.stack([result.x_px, result.y_px]) - true[:2]
    c, s = np.cos(true[2]), np.sin(true[2])
    turned = np.block([[c[:, None], -s[:, None]], [s[:, None], c[:, None]]])
    known = np.isfinite(error.ravel())
    offset = np.linalg.lstsq(turned[known], error.ravel()[known], rcond=None)[0]
    assert np.hypot(*offset) < 0.02
    return error - (turned @ offset).reshape(2, -1)


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "n"), [(2.0, 48), (-20.0, 30)])
def test_a_turning_target_is_tracked_to_the_noise_bound(rate: float, n: int) -> None:
    film, true = filmed(pose(rate, n))
    result = track(film, RECTANGLE)
    assert result.found.all()
    least = np.sqrt(np.mean([bound(at) ** 2 for at in true.T[::4]], axis=0))
    error = off(result, true)[:, 1:]  # the first frame has taught the picture where the block is
    assert np.sqrt(np.mean((error / least[:2, None]) ** 2)) < 1.2  # 1.0 is the floor; n frames tell it to 8 %
    stated = np.stack([result.sigma_px, result.sigma_y_px])[:, 1:]
    assert np.sqrt(np.mean((error / stated) ** 2)) == pytest.approx(1.0, abs=0.2)
    angle = (result.angle - true[2])[1:]
    assert np.std(angle) < 1.5 * least[2]
    assert np.std(angle / result.sigma_angle[1:]) == pytest.approx(1.0, abs=0.35)
    assert abs(result.angle[-1]) == pytest.approx(np.radians(abs(rate)) * (n - 1), abs=2e-3)  # whole turns count


@pytest.mark.slow
@pytest.mark.parametrize("rate", [2.0, 13.0])
def test_the_stated_deviations_of_a_turning_target_are_its_errors(rate: float) -> None:
    k = np.arange(300)
    swung = np.array([CENTRE[0] + 20 + 3 * np.sin(k / 7), CENTRE[1] + 3 * np.sin(k / 9), np.radians(rate) * k])
    film, true = filmed(swung)
    result = track(film, [RECTANGLE[0] + 20, *RECTANGLE[1:]])
    places, angle = off(result, true)[:, 1:], (result.angle - true[2])[1:]
    stated = np.stack([result.sigma_px, result.sigma_y_px])[:, 1:]
    assert np.mean((places / stated) ** 2) == pytest.approx(1.0, abs=0.2)
    assert np.var(angle / result.sigma_angle[1:]) == pytest.approx(1.0, abs=0.2)  # noise of the figure itself: 0.08


@pytest.mark.slow
def test_a_bar_before_a_turning_target_neither_moves_nor_turns_it() -> None:
    def bar(picture: Array) -> Array:
        picture[:, 92:102] = 240.0
        return picture

    film, true = filmed(pose(4.0, 40), bar)
    result = track(film, RECTANGLE)
    assert result.found.all()
    error = off(result, true)
    stated = np.stack([result.sigma_px, result.sigma_y_px])
    assert np.max(np.abs(error) / stated) < 5
    assert np.max(np.abs(error)) < 0.03
    assert np.max(np.abs(result.angle - true[2])) < 2e-3


def test_a_turning_target_that_leaves_the_picture_is_nan_with_the_reason() -> None:
    film, true = filmed(pose(5.0, 86))
    result = track(film, RECTANGLE)
    out = true[0] > SHAPE[1] - 8
    assert not result.found[out].any()
    assert set(result.reason[out]) == {"target leaves the frame"}
    inside = true[0] < SHAPE[1] - 36
    assert result.found[inside].all()
    assert np.nanmax(np.abs(off(result, true))) < 0.15


def test_a_target_that_does_not_turn_stays_upright() -> None:
    film, true = filmed(pose(0.0, 40))
    result = track(film, RECTANGLE)
    assert np.max(np.abs(result.angle)) < 2e-3
    assert np.std(result.x_px - true[0]) < 4e-3


@pytest.mark.slow
def test_a_small_turning_body_in_a_large_rectangle_is_not_held_by_the_background() -> None:
    """Twelve frames, three quarters of the rectangle are black, and a bar that rests stands in its edge."""
    n, arm = 12, np.array([45.0, 9.0])

    def draw(i: int) -> Array:
        seen = seen_from(np.array([85.0, 55.0, -np.radians(2.0) * i]))
        cover = 1 / (
            1 + np.exp(2 * np.minimum(*(np.max(np.abs(s) - arm[:, None], axis=0) for s in (seen, seen[::-1]))))
        )
        picture = (cover * texture(seen)).reshape(SHAPE)
        picture[5:105, 34:38] = 90.0
        return picture

    frames = [np.clip(np.rint(draw(i)), 0, 255).astype(np.uint8) for i in range(n)]
    result = track(Film(lambda i: frames[i], n, SHAPE, fps=10.0), [36, 6, 98, 98])
    assert result.found.all()
    assert np.max(np.abs(result.angle + np.radians(2.0) * np.arange(n))) < 1e-3
    assert np.max(np.hypot(result.x_px - 84.5, result.y_px - 54.5)) < 0.3  # 0.7 px off the centre of the turn


@pytest.mark.slow
def test_a_body_that_turns_is_found_without_a_target() -> None:
    film, true = filmed(pose(6.0, 48))
    found = track(film)
    assert found.found.all()
    turned = np.unwrap(found.angle)
    assert np.ptp(turned - true[2]) < 0.01
    assert min(found.target[2:]) > 20  # the body, and not a scrap of what it uncovers
