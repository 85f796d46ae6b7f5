"""The audit of the time base: what is wrong with stamps and rates is found, said in one sentence, and handled."""

from __future__ import annotations

import numpy as np
import pytest

from frictrack.base.errors import FrictrackError
from frictrack.recording import Header, read_stamps
from frictrack.recording.timebase import audit

FPS = 4000.0


def stamps_of(ticks, *, fps=FPS, start=1234.5, noise=0.0, rounded=0.0):
    stamps = start + np.asarray(ticks, float) / fps
    stamps += noise / fps * np.random.default_rng(0).standard_normal(len(stamps))
    return np.round(stamps / rounded) * rounded if rounded else stamps


def judge(stamps, given=None, header=FPS, exposure=None, camera=True):
    about = Header(len(stamps), (32, 32), 8, header, stamps=np.asarray(stamps), exposure=exposure, camera=camera)
    return audit("film", given, about)


def row(found, name):
    return next((r.value, r.verdict) for r in found.rows if r.name == name)


def test_good_stamps_say_nothing():
    found = judge(stamps_of(np.arange(500), noise=0.02), exposure=1e-5)
    assert found.notes == ()
    assert found.kept is None
    np.testing.assert_allclose(found.t, np.arange(500) / FPS)
    assert row(found, "frame rate, stamps")[1] == "agrees"
    assert row(found, "exposure") == ("10 us", "4.0% of the frame interval")


def test_missing_frames_are_gaps_and_shift_nothing():
    ticks = np.delete(np.arange(400), [100, 200, 201, 202])
    found = judge(stamps_of(ticks, noise=0.05))
    np.testing.assert_allclose(found.t, ticks / FPS, rtol=1e-4)
    assert found.notes == ("4 frames are missing before frames 100, 199; left as gaps in time",)


def test_a_doubled_frame_is_left_out():
    found = judge(stamps_of([0, 1, 2, 3, 3, 4, 5, 6, 7, 8]))
    assert found.kept.tolist() == [0, 1, 2, 3, 5, 6, 7, 8, 9]
    np.testing.assert_allclose(found.t * FPS, np.arange(9))
    assert found.notes == ("1 frame has the time of the one before: frame 4; left out",)


def test_a_stamp_that_was_written_twice_is_repaired():
    found = judge(stamps_of([0, 1, 2, 3, 3, 5, 6, 7, 8, 9]))
    assert found.kept is None
    np.testing.assert_allclose(found.t * FPS, np.arange(10))
    assert found.notes == ("1 time stamp is corrupt: frame 4; passed over",)


@pytest.mark.parametrize("wrong", [2.5e7, -3.0, np.nan, 0.03])
@pytest.mark.parametrize("at", [0, 40, 99])
def test_a_corrupt_stamp_moves_no_frame(at, wrong):
    stamps = stamps_of(np.arange(100))
    stamps[at] += wrong
    found = judge(stamps)
    np.testing.assert_allclose(found.t * FPS, np.arange(100), atol=1e-6)
    assert found.notes == (f"1 time stamp is corrupt: frame {at}; passed over",)


def test_corrupt_stamps_are_listed():
    stamps = stamps_of(np.arange(100))
    stamps[10:80:10] = np.nan
    assert judge(stamps).notes == ("7 time stamps are corrupt: frames 10, 20, 30, 40, 50, 60, 70; passed over",)


def test_a_clock_that_was_set_goes_on_counting():
    stamps = stamps_of(np.arange(100))
    stamps[60:] -= 1000.0
    found = judge(stamps)
    np.testing.assert_allclose(found.t * FPS, np.arange(100), atol=1e-6)


def test_rounded_stamps_still_give_the_rate():
    """Microseconds on 28.5 us: every interval is 28 or 29."""
    read = read_stamps(stamps_of(np.arange(2000), fps=35087.0, rounded=1e-6, start=0))
    assert 1 / read.step == pytest.approx(35087.0, rel=1e-5)
    assert not read.uneven


def test_stamps_rounded_to_a_quarter_of_the_interval_still_tell_frames_apart():
    """Hundredths of a second at 24 frames per second; the difference of two of them has an error of 0.1 frames rms."""
    ticks = np.delete(np.arange(240), [50, 51, 120])
    read = read_stamps(stamps_of(ticks, fps=24.0, rounded=0.01, start=0))
    assert read is not None
    np.testing.assert_array_equal(read.ticks, ticks)
    assert 1 / read.step == pytest.approx(24.0, rel=1e-4)


def test_stamps_too_coarse_to_tell_frames_apart_are_not_used():
    found = judge(stamps_of(np.arange(400), rounded=1e-3))
    assert found.notes == ("the time stamps are too few or too coarse: not used, frames are taken as evenly spaced",)
    assert row(found, "time stamps") == ("400", "too few or too coarse: not used")


@pytest.mark.parametrize("share", [0.22, 0.24, 0.26, 0.28, 0.3, 0.45, 0.7])
def test_rounding_of_any_share_of_the_interval_tells_frames_apart(share):
    """The median interval of such stamps is off by up to a seventh."""
    ticks = np.delete(np.arange(400), [50, 51, 120] if share < 0.5 else [])
    read = read_stamps(stamps_of(ticks, fps=300.0, rounded=share / 300, start=0))
    assert read is not None
    np.testing.assert_array_equal(read.ticks, ticks)
    assert 1 / read.step == pytest.approx(300.0, rel=1e-4)


@pytest.mark.parametrize("blocks", [(9, 9), (9, 12), (12, 9)])
def test_a_changing_rate_is_the_clock(blocks):
    """A phone that doubles its interval in the dark: no frame is missing, whichever interval is the more frequent."""
    ticks = np.concatenate(([0], np.cumsum(np.tile(np.repeat([1, 2], blocks), 3))))
    average = 120 * (len(ticks) - 1) / ticks[-1]
    for given in (None, average):
        found = judge(stamps_of(ticks, fps=120.0, start=0), given=given, header=average, camera=False)
        np.testing.assert_allclose(found.t, ticks / 120, rtol=1e-9, atol=1e-12)
        assert found.notes == ("the frame rate changes; each frame has the time of its own stamp",)


@pytest.mark.parametrize("given", [None, 240.0])
@pytest.mark.parametrize("kind", ["blocks", "jitter", "phone"])
def test_stamps_that_rise_are_the_times_of_all_frames(kind, given):
    rng, n = np.random.default_rng(8), np.arange(100)
    stamps = {
        "blocks": np.cumsum(np.where(n % 60 < 30, 4, 8)) / 960,
        "jitter": np.round((n + 0.3 * rng.uniform(-1, 1, 100)) * 40) / 9600,
        "phone": np.cumsum(np.where(n // 40 % 2, 750, 1500)) / 90000 / (2 if given else 1),
    }[kind]
    found = judge(stamps, given, header=99 / np.ptp(stamps), camera=False)
    assert found.kept is None
    np.testing.assert_allclose(found.t, stamps - stamps[0], atol=1e-12)
    assert len([note for note in found.notes if "time of its own stamp" in note]) == 1
    assert not any("corrupt" in note or "of the one before" in note for note in found.notes)


def test_the_average_rate_of_uneven_stamps_is_a_rate_that_can_be_given():
    stamps = np.cumsum(np.random.default_rng(1).choice([17, 33, 34, 50], 120)) / 1000
    with pytest.raises(FrictrackError, match="speed of showing"):
        judge(stamps, header=119 / np.ptp(stamps), camera=False)
    found = judge(stamps, 119 / np.ptp(stamps), header=119 / np.ptp(stamps), camera=False)
    np.testing.assert_allclose(found.t, stamps - stamps[0], atol=1e-12)


def test_uneven_frames_have_the_times_of_their_stamps():
    ticks = np.cumsum(1 + 0.3 * np.sin(np.arange(300) / 20))
    found = judge(stamps_of(ticks, fps=240.0), header=None)
    np.testing.assert_allclose(found.t, (ticks - ticks[0]) / 240.0, rtol=1e-2)
    assert "not evenly spaced; each frame has the time of its own stamp" in found.notes[0]


@pytest.mark.parametrize(("header", "said"), [(4003.0, False), (4005.0, True), (3900.0, True)])
def test_rates_that_differ_by_a_thousandth_are_said(header, said):
    found = judge(stamps_of(np.arange(500)), header=header)
    assert bool(found.notes) == said
    assert found.fps == pytest.approx(4000.0 if said else header)


def test_the_users_rate_wins_and_the_others_are_said():
    found = judge(stamps_of(np.arange(500)), given=3900.0, header=3900.0)
    assert found.fps == 3900.0
    assert found.notes == (
        "the frame rate of the time stamps is 4000 fps but that given by the user is 3900 fps; 3900 fps is used",
    )
    np.testing.assert_allclose(found.t, np.arange(500) / 3900.0)


def test_the_speed_of_showing_is_no_disagreement():
    ticks = np.delete(np.arange(100), 50)
    found = judge(stamps_of(ticks, fps=25.0), given=FPS, header=25.0, camera=False)
    assert found.notes == ("1 frame is missing before frame 50; left as gaps in time",)
    np.testing.assert_allclose(found.t, ticks / FPS, rtol=1e-6)
    with pytest.raises(FrictrackError, match="says 25 fps, which is the speed of showing it"):
        judge(stamps_of(ticks, fps=25.0), header=25.0, camera=False)


def test_exposure_longer_than_the_interval():
    assert judge(stamps_of(np.arange(50)), exposure=1e-3).notes == (
        "the exposure of 1000 us is longer than the frame interval of 250 us; one of the two is wrong",
    )


@pytest.mark.few(12)
@pytest.mark.parametrize("seed", range(60))
def test_no_stamps_whatever_break_the_times(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 60))
    stamps = stamps_of(np.sort(rng.integers(0, 2 * n, n)))
    for at in rng.integers(0, n, rng.integers(0, n)):
        stamps[at] = rng.choice([np.nan, np.inf, -np.inf, 0.0, 1e300, -1e300, stamps[0], stamps[at] + 0.1])
    found = judge(stamps)
    assert np.all(np.isfinite(found.t))
    assert np.all(np.diff(found.t) > 0)
    assert found.t[0] == 0
    assert len(found.t) == (n if found.kept is None else len(found.kept))
