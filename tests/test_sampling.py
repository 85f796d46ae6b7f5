"""Bad samples of a displacement: what is left out, what is named, and that nothing else is touched."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline
from scipy.signal import butter, lfilter, sosfiltfilt

from frictrack.fit import fit
from frictrack.flow import Session, open_study
from frictrack.measure.friction import free_section
from frictrack.measure.motion import differentiate, low_pass
from frictrack.measure.table_clock import with_even_clock
from frictrack.measure.tables import displacement_of_table
from frictrack.records import Displacement, Run
from frictrack.sampling import (
    copies,
    correct_ticks,
    noise_level,
    outliers,
    quantum,
    rounding_noise,
    screened,
    unevenness,
    unwrapped,
)
from frictrack.study import TableData
from frictrack.tracking.checks import slips
from tests.test_timing import a_track

N, FPS, NOISE, PIXEL = 600, 4000.0, 1e-5, 5e-4
K = np.arange(N, dtype=float)
T = K / FPS
NAN = np.full(N, np.nan)


def slide(t):
    """A mass that loses 7 m/s in a second."""
    return 2.0 * t - 3.5 * t**2


def noisy(x, seed=0, noise=NOISE):
    return x + noise * np.random.default_rng(seed).standard_normal(len(x))


def displaced(x):
    n = len(x)
    nan = np.full(n, np.nan)
    return Displacement(np.arange(n) / FPS, x, nan, nan, nan, nan, np.ones(n, bool))


def spoilt(seed, size, share=0.02, burst=1):
    """A slide of which a share of the samples is off by about `size` m, in bursts, and which these are."""
    rng = np.random.default_rng(seed)
    bad = np.zeros(N, bool)
    for start in rng.choice(N - burst, max(1, round(share * N / burst)), replace=False):
        bad[start : start + burst] = True
    off = size * rng.uniform(0.9, 1.1, N) * rng.choice([-1, 1], N)
    return noisy(slide(T), seed) + off * bad, bad


@pytest.mark.parametrize("burst", [1, 5])
@pytest.mark.parametrize("size", [1e-3, 1e-2])
def test_two_per_cent_of_outliers_are_found_and_nothing_else(size, burst):
    for seed in range(6):
        x, bad = spoilt(seed, size, burst=burst)
        np.testing.assert_array_equal(outliers(K, x, np.ones(N)).rows, np.flatnonzero(bad))


def ring(k):
    """A slide that begins to ring and ceases, 50 times the noise."""
    return slide(k / FPS) + np.where(k > 300, PIXEL * np.exp(-(k - 300) / 20) * np.sin(np.pi * (k - 300) / 4), 0.0)


REAL = {
    "slide": lambda k: slide(k / FPS),
    "stick and slip": lambda k: PIXEL * np.cumsum((k % 50 < 20) * 1.3),
    "collision": lambda k: PIXEL * np.where(k < 250.4, 1.9 * k, 1.9 * 250.4 - 0.9 * (k - 250.4)),
    "stop": lambda k: PIXEL * np.minimum(1.5 * k, 500.0),
    "stop at the end": lambda k: PIXEL * np.minimum(1.5 * k, 1.5 * 597.5),
    "push": lambda k: PIXEL * np.clip(2.3 * (k - 100.3), 0, None),
    "push at the beginning": lambda k: PIXEL * np.clip(2.3 * (k - 0.3), 0, None),
    "starts and stops": lambda k: PIXEL * np.cumsum(np.clip(np.sin(k / 40), 0, None)),
    "vibration": lambda k: slide(k / FPS) + PIXEL * (0.3 * np.sin(k / 9) + 0.05 * np.sin(k / 3)),
    "ringing": ring,
    "lost frames": lambda k: slide((k + 30 * (k > 300)) / FPS),
}


@pytest.mark.few(8)
@pytest.mark.parametrize("noise", [1e-6, 1e-5, 1e-4])
@pytest.mark.parametrize("motion", REAL)
def test_what_really_happens_is_no_outlier(motion, noise):
    for seed in range(4):
        seen = displaced(noisy(REAL[motion](K), seed, noise))
        assert screened(seen) is seen


@pytest.mark.slow
def test_no_sample_of_a_clean_slide_is_left_out():
    """5000 runs of 600 frames: at a rate of 1e-4 a run, one in two such tests would find one."""
    assert all(len(outliers(K, noisy(slide(T), seed), np.ones(N)).rows) == 0 for seed in range(5000))


def test_outliers_are_named_with_frames_and_size_and_stay_as_measured():
    x = noisy(slide(T))
    x[[120, 240, 241]] += [9.5e-4, -1.05e-3, 1e-3]
    seen = screened(displaced(x))
    assert np.flatnonzero(~seen.valid).tolist() == [120, 240, 241]
    np.testing.assert_array_equal(seen.x, x)
    (note,) = seen.notes
    assert note.startswith("3 samples lie 0.9")
    assert note.endswith("mm off their course (frames 120, 240, 241): left out")


def test_frames_have_the_numbers_of_the_recording():
    x = noisy(slide(T))
    x[120] += 1e-3
    (note,) = screened(displaced(x), np.arange(N) + 7).notes
    assert note.endswith("off its course (frame 127): left out")


@pytest.mark.parametrize("row", [0, 1, 598, 599])
def test_an_outlier_at_an_end(row):
    x = noisy(slide(T))
    x[row] += 5e-3
    assert outliers(K, x, np.ones(N)).rows.tolist() == [row]


@pytest.mark.parametrize("row", [1, 2, N - 3, N - 2])
def test_an_outlier_that_the_first_or_last_row_shows_to_return(row):
    """It is smaller than the step of the mass; the course goes on through the row on its other side."""
    for seed in range(10):
        x = noisy(slide(T), seed)
        x[row] += 2e-4 * (-1) ** seed
        assert outliers(K, x, np.ones(N)).rows.tolist() == [row]


def test_noise_with_tails_is_not_thinned_out():
    x = slide(T) + 1e-5 * np.random.default_rng(0).standard_cauchy(N)
    assert len(outliers(K, x, np.ones(N)).rows) < 0.1 * N


# ---- quantised positions


def test_an_even_motion_is_not_taken_for_quantised():
    t = np.arange(20) / 1000
    assert quantum(2.0 * t) == 0.0
    assert quantum(2.0 * t - 0.2 * t**2) == 0.0
    assert quantum(np.repeat(2.0 * t, 2)) == pytest.approx(0.002)  # every position twice: a counter


def test_the_step_of_quantised_positions():
    rng = np.random.default_rng(0)
    assert quantum(np.round(np.linspace(0.0, 1.0, 50), 2)) == 0.01
    assert quantum(2 * np.pi / 4096 * np.round(1000 * rng.random(600))) == pytest.approx(2 * np.pi / 4096)
    assert quantum(rng.random(600)) == 0.0
    assert quantum(np.zeros(10)) == 0.0


def test_the_step_of_positions_that_skip_many_steps():
    step = 6.02765304e-5
    for seed in range(20):
        x = np.round(noisy(5.5 * T - 6.0 * T**2, seed, 2e-5) / step) * step
        written = np.array([float(f"{value:.9g}") for value in x])
        assert quantum(written) == pytest.approx(step, rel=1e-6)
        assert quantum(noisy(slide(T), seed)) == 0.0
        assert quantum(noisy(slide(T), seed)[:6]) == 0.0


def test_an_outlier_next_to_the_sample_before_is_no_repeated_one():
    """Ahead by a step of the mass, it makes two steps and none, as a lost and a doubled sample do."""
    for seed in range(12):
        rng = np.random.default_rng(seed)
        x = noisy(0.6 * T, seed)
        row = int(rng.integers(20, N - 20))
        x[row] += rng.choice([-1.0, 1.0]) * (0.6 / FPS + 1e-6 * rng.standard_normal())
        made = with_even_clock(TableData(T, x))
        assert made.notes == ()
        assert screened(displaced(x)).valid[row] == False  # noqa: E712 - a NumPy truth


def test_rounding_is_named_where_it_matters():
    step = 1e-3
    seen = screened(displaced(step * np.round(noisy(slide(T)) / step)))
    assert seen.resolution == step
    assert seen.valid.all()
    assert seen.notes[0].startswith("positions are whole multiples of 1 mm: rounding adds a noise of 289 um")
    assert screened(displaced(np.round(noisy(slide(T)), 8))).notes == ()


# ---- doubled and missing frames in any pattern


def recorded(kind, seed, n=176):
    """Numbers of the moments that the frames of a faulty recording really show."""
    rng, k = np.random.default_rng(seed), np.arange(2 * n)
    if kind == "three in a row":
        return np.sort(np.r_[k[: n - 3], [80, 80, 80]])
    if kind == "three in place of others":
        return np.where((k[:n] >= 80) & (k[:n] < 83), 79, k[:n])
    if kind == "16 scattered":
        return np.sort(np.r_[k[: n - 16], 2 + rng.choice(n - 20, 16, replace=False)])
    if kind == "all":
        return np.repeat(k[: n // 2], 2)
    return np.setdiff1d(k, 4 + 10 * np.arange(16) + rng.integers(0, 4, 16))[:n]  # 16 are lost


@pytest.mark.few(5)
@pytest.mark.parametrize("speed", [0.3, 1.0, 4.0])
@pytest.mark.parametrize("kind", ["three in a row", "three in place of others", "16 scattered", "all", "16 lost"])
def test_every_pattern_of_doubled_and_missing_frames(kind, speed):
    for seed in range(3):
        shown = recorded(kind, seed)
        n = len(shown)
        moments = a_track(100 + speed * (np.arange(2.0 * n) - 0.35 * np.arange(2.0 * n) ** 2 / n), seed=seed)
        columns = ("x_px", "y_px", "angle", "sigma_px", "sigma_y_px", "score", "reason")
        rows = {name: getattr(moments, name)[shown] for name in columns}  # a doubled frame is the same picture
        ticks, keep = correct_ticks(np.arange(n), slips(replace(moments, t=np.arange(n) / FPS, **rows)))
        assert not np.any(keep[1:] & (np.diff(shown) == 0))
        np.testing.assert_array_equal(np.diff(ticks[keep]), np.diff(shown[keep]))


# ---- clocks of tables


def table(t, x):
    return TableData(np.asarray(t), np.asarray(x))


def test_a_clean_table_stays_as_it_is():
    data = table(T, noisy(slide(T)))
    even = with_even_clock(data)
    np.testing.assert_array_equal(even.t, data.t)
    assert even.valid.all()
    assert even.notes == ()


def test_positions_that_were_held_are_left_out():
    x = noisy(slide(T))
    x[1::2] = x[::2]
    even = with_even_clock(table(T, x))
    np.testing.assert_array_equal(even.t, T)
    assert not even.valid[1:400:2].any()
    assert even.valid[::2].all()
    assert "samples repeat the one before: frames 1, 3, 5" in even.notes[0]


LONG = np.arange(4 * N) / FPS
MADE = {  # every so many rows are independent; what other programs do with measured positions
    "straight lines": (4, lambda x: np.interp(LONG, LONG[::4], x[::4])),
    "splines": (4, lambda x: make_interp_spline(LONG[::4], x[::4])(LONG)),
    "a low-pass": (8, lambda x: sosfiltfilt(butter(4, 0.1, output="sos"), x)),
}


@pytest.mark.parametrize("how", MADE)
def test_rows_that_another_program_made_are_left_out(how):
    every, made = MADE[how]
    even = with_even_clock(table(LONG, made(noisy(slide(LONG)))))
    np.testing.assert_allclose(np.diff(even.t), every / FPS)
    assert f"between every {every} rows: another program" in even.notes[0]
    assert noise_level(even.x, even.valid)[0] > 0.5 * np.std(even.x - slide(even.t))  # 0.001 before


@pytest.mark.parametrize(
    "x",
    [
        lfilter([1.0], [1.0, -0.97], NOISE * np.random.default_rng(1).standard_normal(4 * N)),
        1e-4 * np.sin(2 * np.pi * (47 + 20 * LONG) * LONG),  # computed, without any noise
        np.cumsum(np.cumsum(1e-8 * np.random.default_rng(1).standard_normal(4 * N))),  # a white force
        np.floor(np.arange(4 * N) / 5) * 1e-4 - slide(LONG),  # counts
        np.convolve(NOISE * np.random.default_rng(1).standard_normal(4 * N + 4), np.ones(5) / 5, "valid"),
    ],
)
def test_rows_that_only_follow_each_other_are_kept(x):
    assert len(with_even_clock(table(LONG, slide(LONG) + x)).t) == 4 * N


def test_outliers_one_step_ahead_are_no_missing_samples():
    x = noisy(slide(T))
    at = N // 3
    x[at : at + 2] += x[at] - x[at - 1]  # one step behind, they could be a doubled and a missing frame
    even = with_even_clock(table(T, x))
    assert not [note for note in even.notes if "missing" in note]
    np.testing.assert_array_equal(even.t, T)


def test_missing_samples_become_gaps_and_repeated_ones_go():
    x = noisy(slide(T))
    kept = np.setdiff1d(np.arange(N), [100, 200, 201])
    even = with_even_clock(table(T[: len(kept)], x[kept]))
    np.testing.assert_allclose(even.t, T[kept], atol=1e-12)
    assert even.notes[0].startswith("3 samples are missing, found from the motion: before frames 100, 199")
    twice = np.sort(np.r_[np.arange(N - 3), [80, 80, 300]])
    even = with_even_clock(table(T, x[twice]))
    np.testing.assert_allclose(even.t, T[: N - 3], atol=1e-12)
    assert even.notes[0].startswith("3 samples repeat the one before: frames 81, 82, 303")


def test_jitter_of_the_stamps_and_jitter_of_the_samples():
    late = 0.05 / FPS * np.random.default_rng(1).standard_normal(N)
    written = with_even_clock(table(T + late, noisy(slide(T), noise=1e-6)))
    sampled = with_even_clock(table(T + late, noisy(slide(T + late), noise=1e-6)))
    assert "the rows are taken as evenly spaced" in written.notes[0]
    assert "moved to the even clock" in sampled.notes[0]
    for even in (written, sampled):
        assert np.std(even.x - slide(even.t)) < 1.5e-6


@pytest.mark.parametrize("share", [0.01, 0.04, 0.2])
def test_uneven_samples_under_even_stamps_show_by_noise_that_grows_with_the_speed(share):
    rng = np.random.default_rng(5)
    t = np.arange(900) / FPS
    late = share / FPS * rng.standard_normal(900)
    x = 5.0 * (t + late) - 10.0 * (t + late) ** 2 + 3e-6 * rng.standard_normal(900)
    found, still = unevenness(t, x)
    assert found == pytest.approx(share / FPS, rel=0.15)
    assert 0.0 < still < 4e-6 + 0.5 * share / FPS
    seen = displacement_of_table(TableData(t, x))
    assert seen.notes[0].startswith("the noise grows with the speed, ")
    assert "as if samples jittered by " in seen.notes[0]
    assert seen.notes[0].endswith("deviations grow with it")
    assert seen.sigma_x[0] == pytest.approx(np.hypot(3e-6, 5.0 * share / FPS), rel=0.2)


def test_repeated_samples_that_are_left_out_are_no_jitter():
    """Samples in whose place the one before stands: the noise of the others is the same at every speed."""
    rng, t = np.random.default_rng(0), np.arange(900) / FPS
    x = 5.0 * t - 10.0 * t**2 + 1e-5 * rng.standard_normal(900)
    repeated = np.flatnonzero(rng.uniform(size=880) < 0.08) + 10
    for row in repeated:
        x[row] = x[row - 1]
    seen = displacement_of_table(TableData(t, x, sigma=np.full(900, 1e-5)))
    assert "repeat the one before" in seen.notes[0]
    assert not any("grows with the speed" in note for note in seen.notes)
    np.testing.assert_allclose(seen.sigma_x, 1e-5)


def test_jitter_adds_to_the_noise_at_rest_that_a_table_states():
    rng, t = np.random.default_rng(3), np.arange(900) / FPS
    late = t + 0.07 / FPS * rng.standard_normal(900)
    x = 4 * late - 8.8 * late**2 + 1e-5 * rng.standard_normal(900)
    seen = displacement_of_table(TableData(t, x, sigma=np.full(900, 1e-5)))
    speed = np.abs(4 - 17.6 * t)
    np.testing.assert_allclose(seen.sigma_x, np.hypot(1e-5, 0.07 / FPS * speed), rtol=0.15)


@pytest.mark.parametrize("coarse", [0.0, 5e-5])
def test_even_samples_show_no_jitter_whatever_their_motion(coarse):
    for seed in range(40):
        rng = np.random.default_rng(seed)
        t = np.arange(400) / FPS
        v, slows = rng.uniform(0.5, 6.0), rng.uniform(0.2, 1.0)
        x = noisy(v * t - slows * v * t**2 / (2 * t[-1]), seed)
        x = np.round(x / coarse) * coarse if coarse else x
        assert unevenness(t, x, coarse * FPS) == (0.0, 0.0)


@pytest.mark.parametrize(("digits", "said"), [(3, "time stamps are rounded to 0.001 s"), (9, "")])
def test_rounded_stamps(digits, said):
    even = with_even_clock(table(np.round(T, digits), noisy(slide(T))))
    np.testing.assert_allclose(np.diff(even.t), 1 / FPS, rtol=1e-3)
    assert said in "".join(even.notes)


def test_a_stamp_and_a_row_that_were_written_twice():
    x = noisy(slide(T))
    t = T.copy()
    t[100] = t[99]
    even = with_even_clock(table(t, x))
    np.testing.assert_allclose(even.t, T, atol=1e-6)
    assert even.notes == ("the time stamp is wrong in frame 100; the row stays in its place",)
    rows = np.sort(np.r_[np.arange(N - 1), 100])
    even = with_even_clock(table(T[rows], x[rows]))
    assert len(even.t) == N - 1
    assert even.notes == ("1 row has the time stamp of the row before: frame 101; left out",)


def test_a_rate_that_is_given_and_another_one_in_the_stamps():
    assert with_even_clock(table(T, noisy(slide(T))), 4000.0).notes == ()
    even = with_even_clock(table(T, noisy(slide(T))), 4200.0)
    said = "the time stamps say 4000 Hz but fps = 4200 is given; fps is used; one of the two is wrong and every force"
    assert even.notes == (f"{said} goes with its square",)
    np.testing.assert_allclose(np.diff(even.t), 1 / 4200, rtol=1e-6)


RATES = (30, 240, 300, 480, 700, 800, 960, 2000, 10000)
ROUNDINGS = (1e-6, 8.64e-6, 1e-4, 1e-3, 1e-2)
FAULTS = ("none", "missing", "doubled", "jitter", "fps")


@pytest.mark.parametrize(
    ("rate", "rounding", "fault"),
    [(r, ROUNDINGS[i % 5], FAULTS[(i + j) % 5]) for i, r in enumerate(RATES) for j in range(4)],
)
def test_rounded_clocks_whatever_the_rate(rate, rounding, fault):
    """0.35 kg, F = 0.9 N + 0.2 N s/m v from 3 m/s: the times are those of the samples, up to a shift."""
    rng, k, a = np.random.default_rng(rate), 0.2 / 0.35, 0.9 / 0.35
    n = min(int(0.97 * np.log(1 + 3 * k / a) / k * rate), 2000)
    taken = np.delete(np.arange(n), [9, n // 2]) if fault == "missing" else np.arange(n)
    taken = np.sort(np.append(taken, [9, n // 2])) if fault == "doubled" else taken
    t = taken / rate
    moment = t + (0.05 / rate * rng.standard_normal(len(t)) if fault == "jitter" else 0)
    x = (3 + a / k) * (1 - np.exp(-k * moment)) / k - a / k * moment
    x = (
        (x + 5e-6 * rng.standard_normal(n))[:]
        if fault not in ("missing", "doubled")
        else x + 5e-6 * np.sin(7.3 * taken)
    )
    stamps = np.maximum.accumulate(np.round(moment / rounding) * rounding)
    even = with_even_clock(table(stamps, x), rate if fault == "fps" else None)
    steps = np.diff(even.t) / np.median(np.diff(even.t))
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6 + 0.01 * (rounding < 0.01 / rate))
    off = even.t - t[even.numbers]
    error = 4 * max(rounding, 0.2 / rate if fault == "jitter" else 0.0) / np.sqrt(n) / t[-1]
    assert np.polyfit(t[even.numbers], off, 1)[0] == pytest.approx(0.0, abs=error + 1e-9)
    assert np.std(off) < 0.02 / rate + error * t[-1]


@pytest.mark.parametrize(
    ("full", "step", "said"),
    [
        (65536 * 5e-6, 5e-6, "a counter of 16 bits"),
        (4096e-4, 1e-4, "12 bits"),
        (360.0, 0.0, "angle"),
        (2 * np.pi, 0.0, ""),
    ],
)
def test_counters_that_roll_over_and_angles_that_wrap(full, step, said):
    t = np.arange(900) / 1000
    for course in (2.8 * full * t - 0.8 * full * t**2, 1.3 * full * np.sin(7 * t) * np.exp(-t)):
        x = noisy(course, noise=1e-4 * full)
        x = np.round(x / step) * step if step else x
        even = with_even_clock(table(t, (x + 0.3 * full) % full))
        np.testing.assert_allclose(np.diff(even.x), np.diff(x), atol=1e-9 * full)
        assert said in even.notes[0]
        assert even.notes[0].endswith(": unwrapped")


@pytest.mark.parametrize(("rate", "rounding"), [(300, 1e-3), (800, 1e-3), (2000, 1e-2)])
def test_the_law_of_a_rounded_clock(rate, rounding):
    """0.35 kg, F = 0.9 N + 0.2 N s/m v from 3 m/s; stamps repeat where they are rounded to more than the interval."""
    k, a = 0.2 / 0.35, 0.9 / 0.35
    t = np.arange(0, 0.97 * np.log(1 + 3 * k / a) / k, 1 / rate)
    x = (3 + a / k) * (1 - np.exp(-k * t)) / k - a / k * t + 5e-6 * np.random.default_rng(0).standard_normal(len(t))
    run = Run.from_arrays(np.round(t / rounding) * rounding, x, mass=0.35)
    found = fit("coulomb,viscous", [run]).parameters
    clock = 2 * rounding / np.sqrt(len(t)) / t[-1]  # relative error of the interval, which goes in twice
    for name, truth in (("coulomb.F_c", 0.9), ("viscous.F_v", 0.2)):
        assert abs(found[name].value - truth) < 3 * found[name].std + 2 * clock * truth


def test_a_jump_that_is_no_whole_range_stays():
    x = noisy(slide(T))
    for size in (0.7, 3.0):
        jumped = np.round((x + size * np.ptp(x) * (np.arange(N) > 200)) / 1e-6) * 1e-6
        assert unwrapped(jumped)[1] == ()


def test_uneven_times_are_moved_to_an_even_grid():
    rng = np.random.default_rng(2)
    t = np.cumsum(rng.uniform(0.7, 1.3, 400)) / FPS
    even = with_even_clock(table(t, noisy(slide(t), noise=1e-6)))
    grid = np.diff(even.t) / np.min(np.diff(even.t))
    np.testing.assert_allclose(grid, np.rint(grid), atol=1e-6)
    assert np.std(even.x - slide(even.t)) < 1.2e-6
    assert "moved along their course to the nearest times of an even grid" in even.notes[0]


@pytest.mark.parametrize("blocks", [(9, 9), (9, 12), (12, 9)])
def test_a_rate_that_changes_leaves_the_noise_as_it_is(blocks):
    t = np.cumsum(np.tile(np.repeat([1.0, 2.0], blocks), 12)) / FPS
    even = displacement_of_table(table(t, noisy(slide(t), noise=1e-6)))
    np.testing.assert_allclose(even.t, t)
    assert np.median(even.sigma_x) == pytest.approx(1e-6, rel=0.25)


# ---- copies


def test_a_copy_is_found_although_it_is_cut_and_shifted():
    one, other = (displaced(noisy(slide(T), seed)) for seed in range(2))
    cut = displaced(one.x[100:500] + 0.3)
    assert copies({"one": one, "other": other, "cut": cut}) == {("one", "cut")}


def test_noise_free_runs_of_one_law_are_no_copies():
    one, other = (displaced(slide(T) + s * T + 1e-4 * np.sin(400 * T + s)) for s in (0.0, 0.1))
    assert copies({"one": one, "other": other}) == set()
    assert copies({"one": one, "again": one}) == {("one", "again")}


# ---- the fit


def measured(x, name="run"):
    seen = screened(displaced(x))
    level = max(float(noise_level(seen.x, seen.valid)[0]), rounding_noise(seen.resolution))
    seen = replace(seen, sigma_x=np.full(len(x), level))
    return Run(seen, differentiate(low_pass(seen)), mass=0.35, name=name)


def law(x0, v0, force, viscous, t):
    """Coulomb and viscous friction in closed form, 0.35 kg."""
    tau = 0.35 / viscous
    end = force / viscous
    return x0 + (v0 + end) * tau * (1 - np.exp(-t / tau)) - end * t


FAULTS = {
    "clean": lambda x, rng: x,
    "outliers": lambda x, rng: x + np.isin(np.arange(len(x)), rng.choice(len(x), 12, replace=False)) * 1e-3,
    "rounded to 0.1 mm": lambda x, rng: 1e-4 * np.round(x / 1e-4),
    "rounded to 1 mm": lambda x, rng: 1e-3 * np.round(x / 1e-3),
}


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_deviations_hold_with_bad_samples(fault):
    away = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        speeds = (1.2, 2.0, 2.8)
        slides = [noisy(law(0.0, v, 2.0, 0.4, T), 10 * seed + i) for i, v in enumerate(speeds)]
        runs = [measured(FAULTS[fault](x, rng), f"v{i}") for i, x in enumerate(slides)]
        found = fit("coulomb,viscous", runs).parameters
        truth = {"coulomb.F_c": 2.0, "viscous.F_v": 0.4}
        away.append([(found[name].value - true) / found[name].std for name, true in truth.items()])
    assert np.all(np.sqrt(np.mean(np.square(away), axis=0)) < 1.5)


def test_an_event_at_the_last_frame_does_not_hide_the_slide():
    x = noisy(slide(T))
    x[-1] += 2e-4  # too small to be told from a blow
    run = measured(x)
    assert np.sum(free_section(run)[0]) > 0.9 * N


# ---- the study


def study(folder: Path, **tables: np.ndarray) -> Session:
    lines = ["[study]", "mass = 0.35", 'model = ["coulomb", "viscous"]']
    for name, x in tables.items():
        rows = [f"{t!r},{v!r}" for t, v in zip(T.tolist(), x.tolist(), strict=True)]
        (folder / f"{name}.csv").write_text("\n".join(["t_s,x_m", *rows]))
        lines += ["[[run]]", f'name = "{name}"', f'table = "{name}.csv"']
    (folder / "study.toml").write_text("\n".join(lines))
    return Session(open_study(folder / "study.toml"))


def test_a_study_names_bad_samples_and_copies(tmp_path):
    good, spiky = noisy(law(0.0, 2.0, 2.0, 0.4, T)), noisy(law(0.0, 1.5, 2.0, 0.4, T), 1)
    spiky[[50, 300]] += 1e-3
    session = study(tmp_path, good=good, spiky=spiky, again=good + 0.1)
    rows = {row["run"]: row["notes"] for row in session.measure("motion")["runs"]}
    assert rows["good"] == []
    assert "off their course (frames 50, 300): left out" in rows["spiky"][0]
    assert rows["again"] == ['the same recording as run "good": it is left out, because it tells nothing more']
    found = session.fit()
    assert any(remark.startswith('run "again" is the same recording as run "good"') for remark in found["remarks"])
    assert any(w["words"].startswith('run "again": it is the same recording as') for w in found["warnings"])
    assert abs(found["parameters"]["coulomb.F_c"]["value"] - 2.0) < 3 * found["parameters"]["coulomb.F_c"]["std"]


def test_a_stage_that_repeats_its_path_gives_runs_of_their_own(tmp_path):
    t = np.arange(0, 4, 0.01)
    x = 0.02 * np.sin(2 * np.pi * 0.125 * t)
    rng = np.random.default_rng(5)
    for name, friction in {"light": 3.0, "heavy": 6.0}.items():
        force = friction * np.sign(np.gradient(x, t)) + 0.02 * rng.standard_normal(len(t))
        np.savetxt(
            tmp_path / f"{name}.csv", np.c_[t, x, force], header="t_s,x_m,friction_N", delimiter=",", comments=""
        )
    shutil.copy(tmp_path / "light.csv", tmp_path / "again.csv")
    lines = [f'[[run]]\nname = "{name}"\ntable = "{name}.csv"' for name in ("light", "heavy", "again")]
    (tmp_path / "study.toml").write_text("\n".join(lines))
    rows = {row["run"]: row["notes"] for row in Session(open_study(tmp_path / "study.toml")).measure("motion")["runs"]}
    assert rows["light"] == rows["heavy"] == []
    assert rows["again"] == ['the same recording as run "light": it is left out, because it tells nothing more']
