"""What the run says of its own measurement, against data whose faults are known."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from frictrack.flow.track_quality import lost_frames_note, rotation_note
from frictrack.records import Track
from frictrack.tracking.checks import (
    forward_backward,
    peak_locking,
    scores,
    self_test,
    slips,
    timing_note,
)

N, SIGMA = 600, 0.002
K = np.arange(N, dtype=float)


def slide(k):
    return 100 + 700 * (1 - np.exp(-k / 320))


def a_track(x, *, seed=0, locking=0.0, score=0.99, sigma=SIGMA):
    """A track of known places x with white noise and peak locking A sin(2 pi x)."""
    rng, n = np.random.default_rng(seed), len(x)
    one = np.full(n, sigma)
    x = x + locking * np.sin(2 * np.pi * x) + sigma * rng.standard_normal(n)
    y = 30 + sigma * rng.standard_normal(n)
    return Track(K[:n] / 4000, x, y, 0 * one, one, one, np.broadcast_to(score, n), np.full(n, ""))


# ---- a target that turns


def turned(angle):
    """A track whose target of 40 x 30 px has an angle."""
    return replace(a_track(slide(K)), angle=angle, target=(0.0, 0.0, 40.0, 30.0))


@pytest.mark.parametrize("rate", [0.05, 0.126, 5.0])
def test_a_target_that_turns_is_named_with_its_rate(rate):
    angle = np.radians(rate * K) + np.radians(0.02) * np.random.default_rng(0).standard_normal(N)
    (note,) = rotation_note(turned((angle + np.pi) % (2 * np.pi) - np.pi))
    said = [float(part) for part in re.findall(r"[\d.]+(?= deg)", note)]
    assert said == pytest.approx([rate * (N - 1), rate], rel=0.1)


def test_the_noise_of_an_angle_is_no_turn():
    assert rotation_note(turned(np.radians(0.002) * np.random.default_rng(0).standard_normal(N))) == ()
    assert rotation_note(turned(np.full(N, np.nan))) == ()
    assert rotation_note(a_track(slide(K))) == ()  # no target is known


def test_the_poor_angle_of_a_target_half_hidden_is_no_turn():
    poor = (K > 100) & (K < 112)
    sigma = np.where(poor, np.radians(0.2), np.radians(0.02))
    angle = sigma * np.random.default_rng(0).standard_normal(N)
    angle[poor] += np.radians(0.1)
    assert rotation_note(replace(turned(angle), sigma_angle=sigma)) == ()


# ---- frames without a place


def hidden(gap, reason="too much of the target is hidden"):
    """A track that is empty in some frames."""
    lost = np.isin(K, gap)
    whole = a_track(slide(K))
    columns = {
        name: np.where(lost, np.nan, getattr(whole, name)) for name in ("x_px", "y_px", "sigma_px", "sigma_y_px")
    }
    return replace(whole, **columns, reason=np.where(lost, reason, ""))


def test_frames_that_are_empty_on_the_way_are_named():
    (note,) = lost_frames_note(hidden(np.r_[50:80, 120:130]))
    assert note == (
        f"40 of {N} frames of the path are empty: too much of the target is hidden in 40; the longest gap is that of "
        "the frames 50 to 79"
    )


def test_what_lies_outside_the_path_is_no_gap():
    assert lost_frames_note(hidden(np.r_[0:40, N - 30 : N])) == ()
    assert lost_frames_note(hidden(np.r_[60:61])) == ()


# ---- peak locking


def vibrating(k):
    return slide(k) + 0.3 * np.sin(k / 9)


@pytest.mark.parametrize("motion", [slide, vibrating])
def test_peak_locking_is_measured(motion):
    found = peak_locking(a_track(motion(K), locking=0.004))
    assert found.amplitude == pytest.approx(0.004, abs=3 * found.error)
    assert found.error < 0.0003


def test_its_standard_deviation_and_false_alarms():
    """Without any, p is uniform and the amplitude is as the error states."""
    found = [peak_locking(a_track(slide(K), seed=seed)) for seed in range(60)]
    p = np.array([f.p for f in found])
    assert 0.3 < np.mean(p < 0.5) < 0.7
    assert np.all(p > 1e-4)
    # half of the range of a curve whose values scatter by the error
    rms = np.sqrt(np.mean([f.amplitude**2 for f in found]))
    assert rms == pytest.approx(1.65 * np.mean([f.error for f in found]), rel=0.2)


def test_the_tone_that_it_feigns():
    """At 0.25 px per frame and 4000 frames/s a pixel is passed 1000 times a second."""
    found = peak_locking(a_track(60 + 0.2503 * K, locking=0.005))
    assert found.frequency == pytest.approx(1001, rel=0.02)
    assert found.acceleration == pytest.approx(0.005 * (2 * np.pi * 1001) ** 2, rel=0.1)
    aliased = peak_locking(a_track(60 + 1.0503 * K, locking=0.005))
    assert aliased.frequency == pytest.approx(201, rel=0.05)


def test_where_peak_locking_cannot_be_told():
    assert peak_locking(a_track(60 + 1.0 * K)) is None  # always at the same place between the pixels
    assert peak_locking(a_track(60 + 0.3 * K[:20])) is None
    slow = peak_locking(a_track(60 + 0.02 * K, locking=0.001))
    assert slow is None or slow.error > 0.003


def test_a_note_only_where_it_matters():
    (note,) = self_test(a_track(slide(K), locking=0.004))
    assert "peak locking of 0.004" in note
    assert "at the typical speed an oscillation of" in note
    assert self_test(a_track(slide(K), locking=0.0)) == ()
    assert self_test(a_track(slide(K), locking=0.0002)) == ()


# ---- scores, forward and backward


def test_stretches_of_low_score():
    score = 0.99 + 0.001 * np.sin(K)
    score[100:103], score[400] = 0.6, 0.75
    found = scores(a_track(slide(K), score=score))
    assert found.low == ((100, 102), (400, 400))
    assert found.lowest == 0.6
    assert found.median == pytest.approx(0.99, abs=0.001)
    assert self_test(a_track(slide(K), score=score)) == (
        "match score low (usually 0.99, down to 0.60) in frames 100-102, 400",
    )
    assert scores(a_track(slide(K))).low == ()
    assert scores(a_track(slide(K), score=np.nan)) is None


def test_forward_and_backward():
    forward, backward = a_track(slide(K), seed=1), a_track(slide(K), seed=2)
    result = forward_backward(forward, backward)
    assert result.rms == pytest.approx(2 * SIGMA, rel=0.1)  # two coordinates, two tracks
    assert result.in_sigma == pytest.approx(np.sqrt(2), rel=0.1)
    assert result.summary.endswith("they depend on the direction of tracking")
    same = forward_backward(forward, forward)
    assert same.in_sigma == 0
    assert same.summary == "tracked backward, positions differ by 0 px rms (0 standard deviations)"


def test_a_doubled_frame_is_noted():
    x = slide(K)
    x[300:] = slide(K[:-300] + 299)
    assert timing_note(slips(a_track(x))) == ("1 frame is doubled, found from the motion: frame 300",)
