"""Camera shake told by a fixed reference: on tracks whose shake is known."""

from __future__ import annotations

import numpy as np
import pytest

from frictrack.base.errors import FrictrackError
from frictrack.measure.calibration import estimate_shake, subtract_shake
from frictrack.records import Track

N, FPS, SIGMA = 1000, 4000.0, 0.02


def a_track(x, y=0.0, sigma=SIGMA, seed=0, **given):
    rng, n = np.random.default_rng(seed), len(x)
    one = np.full(n, sigma)
    x, y = x + sigma * rng.standard_normal(n), y + sigma * rng.standard_normal(n)
    return Track(np.arange(n) / FPS, x, y, 0 * one, one, one, one, np.full(n, ""), **given)


def tone(amplitude, frequency=87.0):
    return amplitude * np.sin(2 * np.pi * frequency * np.arange(N) / FPS + 1.0)


def knock():
    t = np.arange(N) / FPS - 0.05
    return np.where(t > 0, 0.5 * np.exp(-t / 0.03) * np.sin(2 * np.pi * 140 * t), 0.0)


def test_a_camera_that_rests_costs_nothing():
    """In 200 films none shakes by chance but one in five hundred (two axes, 1e-3 each)."""
    seen = [estimate_shake(a_track(np.zeros(N), seed=seed)).detected for seed in range(200)]
    assert sum(seen) <= 2
    still = a_track(np.arange(N) * 0.3, sigma=0.001, seed=900)
    steady, notes = subtract_shake(still, a_track(np.zeros(N), name="reference", target=(8.0, 9.0, 32.0, 24.0)))
    assert steady is still
    assert notes[0].startswith("no camera shake: the fixed reference [8, 9, 32, 24] moves by 0.02 px along x and 0.02")


@pytest.mark.parametrize("moves", [tone(0.03), tone(1.0), tone(0.3, 1400.0), 0.2 * np.arange(N) / N, knock()])
def test_shake_is_told_and_its_own_noise_is_not(moves):
    """The error of the movement is a small share of the noise that plain subtraction would bring in."""
    wrong, claimed = [], []
    for seed in range(10):
        found = estimate_shake(a_track(moves, seed=seed))
        assert found.detected
        wrong.append(np.std(found.movement[:, 0] - moves))
        claimed.append(found.sigma[0])
    assert np.median(wrong) < (0.6 if moves[0] == 0 and np.max(moves) > 0.25 else 0.15) * SIGMA  # a knock is sudden
    assert np.median(wrong) < 2.5 * np.median(claimed)
    assert found.floor == pytest.approx(SIGMA, rel=0.1)
    assert not found.movement[:, 1].any()


def test_the_words_and_what_is_lost():
    moves = tone(0.5)
    reference = a_track(moves, -moves, name="reference", target=(8.0, 9.0, 32.0, 24.0), notes=("dim",))
    gap = np.where(np.arange(N) == 10, np.nan, 0.0)
    reference = Track(**{**vars(reference), "x_px": reference.x_px + gap})
    mass = a_track(300 + 0.3 * np.arange(N) + moves, 40 - moves, sigma=0.001, seed=1)
    steady, notes = subtract_shake(mass, reference)
    left = steady.x_px - 0.3 * np.arange(N)
    assert np.nanstd(left) < 0.004
    assert np.nanmedian(steady.sigma_px) == pytest.approx(np.hypot(0.001, estimate_shake(reference).sigma[0]))
    assert np.flatnonzero(~steady.found).tolist() == [10]
    assert steady.reason[10] == "the reference is lost"
    assert notes[0] == "dim"
    assert notes[1].startswith("camera shake of 0.35 px along x and 0.35 px along y (rms), strongest at 87 Hz, is seen")
    assert 'reference = "none"' in notes[1]


def test_a_reference_without_noise_of_its_own():
    """A rendered film may have none: rounding is no shake."""
    still = a_track(1e-6 * np.random.default_rng(1).standard_normal(N), sigma=0.0)
    quiet = Track(**{**vars(still), "sigma_px": np.full(N, 0.001), "sigma_y_px": np.full(N, 0.001)})
    assert not estimate_shake(quiet).detected


def test_what_is_too_short_is_not_judged():
    short = a_track(tone(1.0)[:20])
    assert not estimate_shake(short).detected
    assert (
        "is seen in 20 frames, which are too few to separate camera shake from noise"
        in subtract_shake(short, short)[1][0]
    )
    with pytest.raises(FrictrackError, match="expected a reference track of 10 frames but got 20"):
        subtract_shake(a_track(np.zeros(10)), a_track(np.zeros(20)))
    assert subtract_shake(a_track(np.zeros(10)), None)[1] == ()


def test_small_shake_may_be_left_in():
    """What other films of the study would not show is left to the diagnosis, and said."""
    reference = a_track(tone(0.02), name="reference", target=(8.0, 9.0, 32.0, 24.0))
    track = a_track(np.arange(N) * 0.3, sigma=0.001)
    assert estimate_shake(reference).detected
    steady, notes = subtract_shake(track, reference, min_rms=0.02)
    assert steady is track
    assert notes[0].startswith("camera shake of 0.01")  # 0.014 and its error
    assert "is seen in the fixed reference [8, 9, 32, 24] and left in" in notes[0]
    assert notes[0].endswith("reference = [8, 9, 32, 24] subtracts it")


def test_shake_that_is_half_known_is_not_subtracted():
    for seed in range(20):
        found = estimate_shake(a_track(tone(0.004), seed=seed))
        assert not found.detected or np.std(found.movement[:, 0]) > 5 * found.sigma[0]
