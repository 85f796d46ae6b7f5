"""Records of many thousand samples: a trend, lines and events, as in short ones."""

from __future__ import annotations

import time

import numpy as np
import pytest
from scipy.special import erf

from frictrack.measure.motion import differentiate, low_pass
from frictrack.records import Displacement

FPS, NOISE, LINE = 1000.0, 1e-5, 60.0
BLOWS = 2.5  # s between two
WIDTH, CHANGE = 8e-4, -0.06  # of a blow: s, m/s


def record(n):
    """Times, displacement and acceleration of a mass that is driven to and fro, vibrates and is struck."""
    t = np.arange(n) / FPS
    slow, fast = np.pi, 2 * np.pi * LINE
    x = 0.1 * np.sin(slow * t) + 4e-5 * np.sin(fast * t)
    a = -0.1 * slow**2 * np.sin(slow * t) - 4e-5 * fast**2 * np.sin(fast * t)
    for at in blows(n):
        z = (t - at) / WIDTH
        bell = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
        x += CHANGE * WIDTH * (0.5 * z * (1 + erf(z / np.sqrt(2))) + bell)
        a += CHANGE * bell / WIDTH
    return t, x, a


def blows(n):
    return np.arange(0.7, n / FPS, BLOWS)


def smoothed(n, seed=0):
    t, x, a = record(n)
    nan = np.full(n, np.nan)
    y = x + NOISE * np.random.default_rng(seed).standard_normal(n)
    filtered = low_pass(Displacement(t, y, nan, nan, nan, nan, np.ones(n, bool)))
    return filtered, differentiate(filtered), a


def judged(n):
    """Filtered record, rms of the acceleration's error away from blows, and its ratio to the stated deviation there."""
    filtered, motion, a = smoothed(n)
    near = np.min(np.abs(motion.t[:, None] - blows(n)), axis=1) < 0.01
    away = (motion.a - a)[~near]
    return filtered, float(np.sqrt(np.mean(away**2))), float(np.sqrt(np.mean((away / motion.sigma_a[~near]) ** 2)))


@pytest.mark.slow
def test_a_long_record_is_parted_as_a_short_one_is():
    n = 10_000
    filtered, error, ratio = judged(n)
    assert filtered.lines == pytest.approx([LINE], abs=0.01)
    assert len(filtered.events) == len(blows(n)) == 4
    middle = [filtered.t[[first, last]].mean() for first, last in filtered.events]
    np.testing.assert_allclose(np.sort(middle), blows(n), atol=0.01)
    assert error < 0.1  # 5.7 m/s^2 of the vibration alone
    assert 0.4 < ratio < 1.3


@pytest.mark.release
@pytest.mark.slow
def test_the_time_of_a_long_record_grows_with_its_length():
    begin = time.process_time()
    judged(10_000)
    short = time.process_time()
    filtered, error, ratio = judged(40_000)
    assert time.process_time() - short < 12 * (short - begin)  # 9 measured: one more search adds lines
    assert filtered.lines == pytest.approx([LINE], abs=0.003)
    assert len(filtered.events) == len(blows(40_000))
    assert error < 0.1
    assert 0.4 < ratio < 1.7
