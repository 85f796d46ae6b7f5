"""Nothing is said of a motion before the first and after the last frame that shows the target."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from film import block_film

from frictrack import Run, calibrate, differentiate, friction, low_pass, track
from frictrack.base.errors import FrictrackError
from frictrack.flow import Session, open_study
from frictrack.measure.motion import KnownAcceleration, cutoff_tradeoff
from frictrack.records import Displacement
from frictrack.simulate.rendering import write_film

N, FPS = 90, 1000.0
T = np.arange(N) / FPS


def seen_between(first: int, last: int) -> Displacement:
    """A slide with 1 um of noise that is seen in some frames only, one of which is missing."""
    noise = 1e-6 * np.random.default_rng(0).standard_normal((2, N))
    valid = (np.arange(N) >= first) & (np.arange(N) <= last) & (np.arange(N) != (first + last) // 2)
    hidden = np.where(valid, 0.0, np.nan)
    x, y = np.array([0.8 * T - 0.5 * 4.0 * T**2, 0.0 * T]) + noise + hidden
    return Displacement(T, x, y, hidden, 1e-6 + hidden, 1e-6 + hidden, valid)


@pytest.mark.parametrize(("first", "last"), [(0, N - 1), (0, 60), (25, N - 1), (25, 60)])
def test_motion_begins_and_ends_with_the_frames_that_were_measured(first: int, last: int) -> None:
    seen = seen_between(first, last)
    filtered = low_pass(seen)
    motion = differentiate(filtered)
    np.testing.assert_array_equal(motion.t, T[first : last + 1])
    np.testing.assert_allclose(motion.v, 0.8 - 4.0 * motion.t, atol=5e-3)
    assert len(cutoff_tradeoff(seen, filtered, motion).frequency) > 0
    drive = 1.0 + 0.01 * np.arange(N)
    run = Run(seen, motion, mass=1.0, drive=drive)
    np.testing.assert_array_equal(run.displacement.t, motion.t)
    np.testing.assert_array_equal(run.drive, drive[first : last + 1])
    np.testing.assert_allclose(friction(run).F, run.drive + 4.0, atol=0.3)


def test_an_accelerometer_is_cut_to_the_frames_that_were_measured() -> None:
    seen = seen_between(25, 60)
    sensed = KnownAcceleration(np.full(N, -4.0), np.full(N, 0.1))
    motion = differentiate(low_pass(seen, acceleration=sensed))
    assert len(motion) == 36
    np.testing.assert_allclose(motion.a, -4.0, atol=0.5)


def test_a_motion_of_other_frames_is_refused() -> None:
    seen, motion = seen_between(0, 60), differentiate(low_pass(seen_between(0, N - 1)))
    with pytest.raises(FrictrackError, match="expected motion of the same 61 frames but got 90"):
        Run(seen.rows(seen.span), motion, mass=1.0)


def test_of_a_target_that_enters_and_leaves_the_frame_only_what_was_seen_is_measured(tmp_path: Path) -> None:
    x = -40 + 4.0 * np.arange(N)
    film = block_film(x, size=(36, 48), shape=(64, 240), fps=FPS)
    write_film((film.frame(i) for i in range(N)), tmp_path / "through.tif", FPS)
    head = f'[study]\nmass = "350 g"\n[camera]\nfps = {FPS:g}\nscale = "1 mm/px"\n'
    (tmp_path / "study.toml").write_text(head + '[[run]]\nvideo = "through.tif"\nreference = "none"\n')
    Session(open_study(tmp_path / "study.toml")).bring_up_to("friction")
    with h5py.File(tmp_path / "study_results" / "through.h5") as stored:
        found = np.isfinite(stored["track/x_px"][:])
        inside = np.flatnonzero(found)
        assert 0 < inside[0] < inside[-1] < N - 1
        span = stored["track/t"][inside[0]], stored["track/t"][inside[-1]]
        for group in ("displacement", "filtered", "motion", "friction"):
            t = stored[group]["t"][:]
            assert (t[0], t[-1]) == pytest.approx(span), group
        np.testing.assert_allclose(stored["motion/v"][:], 4.0, atol=0.05)  # 4 px a frame, 1 mm/px, 1000 fps


def test_the_api_says_nothing_outside_either() -> None:
    x = -40 + 4.0 * np.arange(N)
    seen = calibrate(track(block_film(x, size=(36, 48), shape=(64, 240), fps=FPS)), scale="1 mm/px")
    known = seen.t[seen.valid]
    motion = differentiate(low_pass(seen))
    assert (motion.t[0], motion.t[-1]) == (known[0], known[-1])
