"""Doubled and missing frames found from the motion alone, on curves whose faults are known."""

from __future__ import annotations

import numpy as np
import pytest

from frictrack.records import Track
from frictrack.sampling import SampledPath, correct_ticks, find_slips
from frictrack.tracking.checks import slips, timing_note

N = 600
SIGMA = 0.003


def slide(k):
    return 100 + 820 * (1 - np.exp(-k / 320))


def a_track(x, y=30.0, seed=0, sigma=SIGMA):
    rng, n = np.random.default_rng(seed), len(x)
    one = np.full(n, sigma)
    places = (x + sigma * rng.standard_normal(n), y + sigma * rng.standard_normal(n))
    return Track(np.arange(n) / 4000, *places, 0 * one, one, one, one, np.full(n, ""))


def recorded(missing=(), doubled=(), n=N):
    """Numbers of the moments that the frames of a faulty recording really show."""
    shown = [k for k in range(2 * n) if k not in missing for _ in range(1 + (k in doubled))]
    return np.array(shown[:n])


def faults(found):
    return [(s.frame, s.frames) for s in found]


def test_faults_of_every_kind():
    k = recorded(missing={100, 302, 303, 304}, doubled={200})
    found = slips(a_track(slide(k)))
    # One frame lost before frame 100; 200 comes twice, as frames 199 and 200; three are lost before frame 302.
    assert faults(found) == [(100, 1), (200, -1), (302, 3)]
    ticks, keep = correct_ticks(np.arange(N), found)
    assert np.flatnonzero(~keep).tolist() == [200]
    np.testing.assert_array_equal(ticks[keep] - ticks[0], k[keep])


def test_a_frame_repeated_in_place_of_a_lost_one():
    x = slide(np.arange(N))
    x[250] = x[249]
    found = slips(a_track(x))
    assert faults(found) == [(250, 0)]
    ticks, keep = correct_ticks(np.arange(N), found)
    np.testing.assert_array_equal(ticks, np.arange(N))
    assert np.flatnonzero(~keep).tolist() == [250]


def test_along_an_inclined_course():
    k = recorded(missing={300})
    track = a_track(slide(k) * 0.8, 30 + 0.6 * slide(k))
    assert faults(slips(track)) == [(300, 1)]


@pytest.mark.parametrize("period", [5, 15])
def test_a_film_stretched_by_doubling(period):
    k = recorded(doubled=set(range(period - 1, N, period)), n=300)
    found = slips(a_track(60 + 1.3 * k))
    assert {s.frames for s in found} == {-1}
    _, keep = correct_ticks(np.arange(300), found)
    steps = np.diff(k[keep])
    assert np.mean(steps == 1) == 1.0 if period == 15 else np.mean(steps == 1) > 0.98


@pytest.mark.parametrize("speed", [0.15, 1.0, 6.0])
def test_where_it_is_fast_enough_none_is_missed(speed):
    for seed in range(8):
        at = int(np.random.default_rng(seed).integers(20, 180))
        k = recorded(missing={at}, n=200) if seed % 2 else recorded(doubled={at - 1}, n=200)
        assert faults(slips(a_track(60 + speed * k, seed=seed))) == [(at, 1 if seed % 2 else -1)]


def stick_slip(k):
    return 60 + np.cumsum((k % 50 < 20) * 1.3)


def collision(k):
    return np.where(k < 250.4, 60 + 1.9 * k, 60 + 1.9 * 250.4 - 0.9 * (k - 250.4))


def stop(k):
    return 60 + np.minimum(1.5 * k, 500.0)


def strike(k):
    return 60 + np.clip(2.3 * (k - 100.3), 0, None)


def starts_and_stops(k):
    return 60 + np.cumsum(np.clip(np.sin(k / 40), 0, None))


def vibration(k):
    return slide(k) + 0.3 * np.sin(k / 9) + 0.05 * np.sin(k / 3)


@pytest.mark.few(2)
@pytest.mark.parametrize("motion", [slide, stick_slip, collision, stop, strike, starts_and_stops, vibration])
def test_real_motion_is_no_fault(motion):
    for seed in range(5):
        assert slips(a_track(motion(np.arange(N, dtype=float)), seed=seed)) == ()


def test_noise_that_the_tracker_understates_and_lost_frames():
    track = a_track(slide(recorded(missing={300})), sigma=0.012)
    x = track.x_px.copy()
    x[[150, 151, 298]] = np.nan
    worse = Track(track.t, x, track.y_px, track.angle, np.full(N, 0.004), track.sigma_y_px, track.score, track.reason)
    assert faults(slips(worse)) == [(300, 1)]


def test_jumps_of_a_tracker_are_no_missing_frames():
    x = slide(np.arange(N)) + 0.37 * (np.arange(N) >= 200)
    assert slips(a_track(x)) == ()


def test_what_is_too_short_or_too_slow():
    assert slips(a_track(np.arange(10.0))) == ()
    assert slips(a_track(60 + 0.002 * recorded(missing={300}))) == ()


def test_the_words():
    found = slips(a_track(slide(recorded(missing={100, 302, 303, 304}, doubled={200}))))
    assert timing_note(found) == (
        "1 frame is doubled, found from the motion: frame 200",
        "4 frames are missing, found from the motion: before frames 100, 302",
    )
    assert timing_note(()) == ()


def _found(x: np.ndarray, sigma: float) -> list[tuple[int, int]]:
    n, seen = len(x), x + sigma * np.random.default_rng(1).standard_normal(len(x))
    path = SampledPath(seen, np.full(n, sigma), np.arange(n), np.ones(n, bool), 0.1)
    return [(slip.frame, slip.frames) for slip in find_slips(path)]


@pytest.mark.parametrize("period", [4, 5.7, 8, 20])
@pytest.mark.parametrize("depth", [0.5, 1.0])
def test_a_shake_is_no_missing_frame(period, depth):
    k = np.arange(400.0)
    x = k - 0.3 * k**2 / 400 + depth * period / (2 * np.pi) * np.sin(2 * np.pi * k / period + 0.3)
    assert _found(x, 1e-3) == []


def test_frames_are_missed_at_thirty_standard_deviations_a_step_and_on_a_swing():
    k, lost = np.arange(300.0), np.arange(25, 280, 20)
    slide, swing = k - 0.2 * k**2 / 300, 40 * np.sin(2 * np.pi * k / 150)
    truth = [(int(frame - i), 1) for i, frame in enumerate(lost)]
    for x, sigma in ((slide, 1 / 30), (swing, 1 / 100)):
        found = _found(np.delete(x, lost), sigma)
        assert set(found) <= set(truth)
        assert len(found) >= 0.7 * len(truth)
