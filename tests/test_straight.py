"""The point of a turning target that moves on a straight course, against tracks of known arms."""

from __future__ import annotations

import numpy as np
import pytest

from frictrack.measure.calibration import calibrate
from frictrack.measure.calibration.displacement import follow_straight_point
from frictrack.records import Track

N, NOISE, TURN_NOISE = 300, 0.01, 1e-4
ARM = np.array([1.7, -2.4])  # px, of the middle of the mass from the followed point, in the target's directions


def turning(to: float, arm=ARM, seed: int = 0, slope: float = 0.1):
    """A mass that slows down along a sloped line while its target turns by `to` degrees; its places (n, 2) px."""
    rng, t = np.random.default_rng(seed), np.linspace(0.0, 1.0, N)
    way = 420 * t - 160 * t**2
    middle = np.stack([40 + way, 60 + slope * way], axis=1)
    angle = 0.4 + np.radians(to) * t
    return tracked(middle, angle, arm, rng), middle


def tracked(middle, angle, arm, rng):
    c, s = np.cos(angle), np.sin(angle)
    seen = middle - np.stack([c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]], axis=1)
    seen = seen + NOISE * rng.standard_normal(seen.shape)
    n, known = len(angle), np.full(len(angle), NOISE)
    turned = (angle + TURN_NOISE * rng.standard_normal(n) + np.pi) % (2 * np.pi) - np.pi
    reason = np.full(n, "", dtype=np.str_)
    return Track(
        *(np.arange(n) / 1000.0, seen[:, 0], seen[:, 1], turned, known, known, np.ones(n), reason),
        sigma_angle=np.full(n, TURN_NOISE),
    )


@pytest.mark.parametrize("degrees", [200.0, -330.0, 1500.0])
def test_the_middle_of_a_turning_mass_is_found_from_its_straight_course(degrees):
    track, middle = turning(degrees)
    found, (note,) = follow_straight_point(track)
    off = np.stack([found.x_px, found.y_px], axis=1) - middle
    assert np.std(track.x_px - middle[:, 0]) > 0.5
    stated = np.sqrt(np.mean(found.sigma_px**2) + found.systematic**2)
    assert np.sqrt(np.mean(off[:, 0] ** 2)) < 1.3 * stated < 5 * NOISE
    assert f"{np.hypot(*ARM):.3g} ±" in note


def test_the_stated_error_of_the_arm_is_its_scatter():
    along = []
    for seed in range(40):
        track, middle = turning(200.0, seed=seed)
        found, _ = follow_straight_point(track)
        slow = np.polyfit(np.arange(N), found.x_px - middle[:, 0], 5)
        along.append(np.mean(np.polyval(slow, np.arange(N)) ** 2) / found.systematic**2)
    assert 0.2 < np.mean(along) < 1.5  # its part along the course, beside some of the noise


def test_displacement_is_that_of_the_middle():
    track, middle = turning(400.0, slope=0.0)
    seen = calibrate(track, "1 mm/px")
    away = seen.x - 1e-3 * middle[:, 0]
    assert np.std(away) < 2e-3 * NOISE
    assert any("straight course" in note for note in seen.notes)


def test_a_target_that_rocks_on_its_course_is_left_as_it_is():
    t = np.linspace(0.0, 1.0, N)
    middle = np.stack([40 + 300 * t, np.full(N, 60.0)], axis=1)
    track = tracked(middle, 0.1 * np.sin(40 * t), ARM, np.random.default_rng(0))
    assert follow_straight_point(track) == (track, ())


def test_a_middle_that_is_followed_already_is_left_as_it_is():
    track, _ = turning(400.0, arm=np.zeros(2))
    assert follow_straight_point(track) == (track, ())


def test_a_swing_across_the_course_is_no_arm():
    t = np.linspace(0.0, 1.0, N)
    middle = np.stack([40 + 300 * t, 60 + 3 * np.sin(40 * t)], axis=1)
    track = tracked(middle, np.radians(250.0) * t, np.zeros(2), np.random.default_rng(0))
    assert follow_straight_point(track) == (track, ())
