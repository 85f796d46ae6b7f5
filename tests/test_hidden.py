"""Targets that pass behind something, and short films: a frame is right within its deviation, or empty."""

from __future__ import annotations

import numpy as np
import pytest
from film import Film, block_film, expose, moved, speckle
from scipy.special import expit

from frictrack.records import Array, Mask, Track
from frictrack.tracking import track

SIZE, SHAPE, N = (36, 48), (64, 300), 110
X = 45 + 2.2 * np.arange(N) - 0.002 * np.arange(N) ** 2
RECTANGLE = [25, 18, 40, 28]  # in the first frame


def passing(kind: str, width: float, level: float, seed: int, soft: float = 0.0) -> Film:
    """The block passes behind an upright bar in the middle of the course: flat, textured, or round and soft."""
    source = block_film(X, size=SIZE, shape=SHAPE, seed=seed, noise=False)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    away = np.abs(x - 160) if kind != "hand" else np.hypot(x - 160, 1.2 * (y - 50))
    cover = expit((width / 2 - away) / max(soft, 0.05))
    what = level + (0 if kind == "box" else speckle(SHAPE, np.random.default_rng(seed + 50), fwhm=6, contrast=20.0))

    def draw(i: int) -> Array:
        picture = source.frame(i) * (1 - cover) + cover * what
        return expose(picture, np.random.default_rng([seed, i]))

    frames = [draw(i) for i in range(N)]
    return Film(lambda i: frames[i], N, SHAPE)


def deviations(result: Track, clear: Mask) -> Array:
    """Errors along x and y over their standard deviations (2, n), zero on average where all is seen."""
    off = np.stack([result.x_px - X, result.y_px - (SHAPE[0] - 1) / 2])
    off -= np.nanmean(off[:, clear], axis=1)[:, None]
    return off / np.stack([result.sigma_px, result.sigma_y_px])


KINDS = [("box", 12.0, 40.0, 0.0), ("box", 70.0, 230.0, 0.0), ("texture", 60.0, 128.0, 0.0), ("hand", 60.0, 150.0, 2.0)]


@pytest.mark.few(1)
@pytest.mark.parametrize(("kind", "width", "level", "soft"), KINDS)
def test_a_target_that_passes_behind_something(kind: str, width: float, level: float, soft: float) -> None:
    result = track(passing(kind, width, level, seed=3, soft=soft), RECTANGLE)
    clear = np.abs(X - 160) > width / 2 + SIZE[1] / 2 + 6 * soft + 2
    assert result.found[clear].all()  # also after it has come out again
    behind = np.abs(X - 160) < width / 2 - SIZE[1] / 2
    assert not result.found[behind].any()
    assert all(result.reason[~result.found])
    z = deviations(result, clear)[:, result.found]
    assert np.max(np.abs(z)) < 5
    assert np.mean(z**2) == pytest.approx(1.1, abs=0.35)


@pytest.mark.slow
def test_many_passes_behind_rods_boxes_and_hands() -> None:
    squares, largest, seen = [], 0.0, 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        kind = ("box", "texture", "hand")[seed % 3]
        width, soft = float(rng.uniform(5, 80)), float(rng.uniform(0.5, 3)) if kind == "hand" else 0.0
        result = track(passing(kind, width, float(rng.uniform(10, 240)), seed, soft), RECTANGLE)
        clear = np.abs(X - 160) > width / 2 + SIZE[1] / 2 + 6 * soft + 2
        z = deviations(result, clear)[:, result.found]
        squares.append(np.mean(z**2))
        largest, seen = max(largest, float(np.max(np.abs(z)))), seen + z.shape[1]
    assert seen > 50 * N
    assert largest < 5.5  # of some 16 000 numbers, the largest of as many normal ones is 4.2
    assert np.mean(squares) == pytest.approx(1.05, abs=0.12)


@pytest.mark.parametrize("n", [2, 3, 6, 20])
def test_the_deviations_of_short_films_hold(n: int) -> None:
    """Few frames teach little: the noise of the picture that is learnt belongs to the deviation."""
    ratio = []
    for seed in range(5):
        rng = np.random.default_rng([n, seed])
        texture = speckle((100, 100), rng, contrast=25.0)
        shift = np.cumsum(np.vstack([[0.0, 0.0], rng.uniform(-0.6, 0.9, (n - 1, 2))]), axis=0)
        pictures = [128 + moved(texture, *s) + 2 * rng.standard_normal(texture.shape) for s in shift]
        frames = [np.clip(np.rint(p), 0, 255).astype(np.uint8) for p in pictures]
        result = track(Film(lambda i, f=frames: f[i], n, (100, 100)), [30, 30, 40, 40])
        for at, sigma, true in (
            (result.x_px, result.sigma_px, shift[:, 0]),
            (result.y_px, result.sigma_y_px, shift[:, 1]),
        ):
            moved_by = (at - at[0] - true)[1:]
            ratio.append(np.mean((moved_by / sigma[1:]) ** 2))
    # Between the single frame that is the picture (1) and a learnt one (2: the noise of both frames).
    assert 0.5 < np.sqrt(np.mean(ratio)) < 1.7


def test_a_shift_within_a_pixel_is_not_drawn_toward_the_first_frame() -> None:
    """What a single frame shows at its border says nothing of the next frame's: it pulled places by 15 mpx."""
    off = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        texture = speckle((96, 96), rng, contrast=25.0)
        noise = rng.standard_normal((2, 96, 96))
        frames = [
            np.rint(128 + moved(texture, s, s) + q).astype(np.uint8) for s, q in zip((0.0, 0.3), noise, strict=True)
        ]
        result = track(Film(lambda i, f=frames: f[i], 2, (96, 96)), [27, 27, 41, 41])
        off += [result.x_px[1] - result.x_px[0] - 0.3, result.y_px[1] - result.y_px[0] - 0.3]
    assert abs(np.mean(off)) < 3e-3
