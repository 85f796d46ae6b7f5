"""Targets whose look changes along their path, under a lamp that stands still; targets that are gone after a slide."""

from __future__ import annotations

import numpy as np
import pytest
from film import Film, block_film, expose

from frictrack.records import Array, Track
from frictrack.tracking import driver, track

N, SHAPE, SIZE = 180, (72, 400), (34, 44)


def path() -> Array:
    """Places (N,) of a block that rests, speeds up along the picture and stays in it, px."""
    k = np.clip(np.arange(N) - 20.0, 0.0, None)
    return 50.3 + 0.0118 * k**2


def lit_by_a_lamp(seed: int, width: float = 90.0) -> Film:
    """The block under a lamp over the middle of its course: one side of it is bright before, the other one after."""
    plain = block_film(path(), size=SIZE, shape=SHAPE, seed=seed, noise=False)
    lamp = 0.35 + 0.65 * np.exp(-(((np.arange(SHAPE[1]) - 200.0) / width) ** 2))

    def draw(i: int) -> Array:
        return np.asarray(expose(plain.frame(i) * lamp, np.random.default_rng([seed, i])))

    return Film(draw, N, SHAPE)


def off(result: Track) -> Array:
    """Errors along the path (N,), px, their mean taken off."""
    error = result.x_px - path()
    return np.asarray(error - np.nanmean(error))


@pytest.mark.few(1)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_target_that_passes_under_a_lamp_is_found_all_the_way(seed: int) -> None:
    result = track(lit_by_a_lamp(seed), [30, 20, *SIZE[::-1]])
    error, stated = off(result), np.hypot(result.sigma_px, result.systematic)
    assert result.found.mean() > 0.95  # 0.69 to 0.91 where a changing look counts as hidden
    assert any("appearance of the target changes along its path" in note for note in result.notes)
    assert np.nanmean((error / stated) ** 2) < 2
    assert np.nanmax(np.abs(error / stated)) < 5
    assert result.systematic < 3 * np.nanstd(error)


def test_nothing_is_said_of_a_look_that_stays() -> None:
    result = track(block_film(path(), size=SIZE, shape=SHAPE, seed=3), [30, 20, *SIZE[::-1]])
    assert not any("appearance of the target" in note for note in result.notes)
    assert result.systematic < 2e-3


@pytest.mark.slow
def test_a_target_that_is_gone_is_not_followed_as_turning(monkeypatch: pytest.MonkeyPatch) -> None:
    """It falls off its course and lies turned for three frames, then it is gone: a few of the lost frames tell."""

    def never(*_: object) -> None:
        raise AssertionError("expected no attempt to follow a turning target")

    plain, scene = block_film(path(), size=SIZE, shape=SHAPE), block_film(np.full(2, -100.0), size=SIZE, shape=SHAPE)

    def draw(i: int) -> Array:
        if i < 60:
            return np.asarray(plain.frame(i))
        fallen = scene.frame(0).copy()
        if i < 63:
            fallen[14:58, 100:134] = np.rot90(plain.frame(0)[19:53, 28:72])
        return np.asarray(fallen)

    monkeypatch.setattr(driver, "track_rotating", never)
    result = track(Film(draw, N, SHAPE), [30, 20, *SIZE[::-1]])
    assert result.found[:60].all()
    assert not result.found[63:].any()
