"""Friction force and free section against closed forms and a Coulomb slider integrated by solve_ivp."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from repeats import few_or_many
from runs import measured
from scipy.integrate import solve_ivp

from frictrack.base.errors import FrictrackError
from frictrack.fit import fit
from frictrack.measure.friction import free_section, friction, impact, moving_sections, release_time
from frictrack.measure.motion import differentiate, low_pass
from frictrack.records import GRAVITY, Displacement, Motion, Run

FPS = 4000.0
NOISE = 10e-6
MASS = 0.35
COULOMB = 8.0
DECELERATION = COULOMB / MASS


def filmed(t, x, *, valid=None, seed=0, **run):
    """A run as a camera with 10 um noise would give it."""
    n = len(t)
    valid = np.ones(n, bool) if valid is None else valid
    noisy = np.where(valid, x + NOISE * np.random.default_rng(seed).normal(size=n), np.nan)
    nan = np.full(n, np.nan)
    displacement = Displacement(t, noisy, nan, nan, nan, nan, valid)
    return Run(displacement, differentiate(low_pass(displacement)), **{"mass": MASS, **run})


def given(t, v, a, *, valid=None, guard=0, **run):
    """A run whose motion is known exactly, with deviations of 1 mm/s and 0.1 m/s^2."""
    n = len(t)
    nan, valid = np.full(n, np.nan), np.ones(n, bool) if valid is None else valid
    x = np.concatenate(([0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t))))
    displacement = Displacement(t, x, nan, nan, nan, nan, valid)
    one = np.ones(n)
    motion = Motion(t, x, v, a, nan, 1e-6 * one, 1e-3 * one, 0.1 * one, nan, guard)
    return Run(displacement, motion, **{"mass": MASS, **run})


def coasting(v0, duration):
    """A slide under Coulomb friction that stops and rests; returns t, x, the time of the stop."""
    t = np.arange(0, duration, 1 / FPS)
    stop = v0 / DECELERATION
    u = np.minimum(t, stop)
    return t, v0 * u - 0.5 * DECELERATION * u**2, stop


def driven(force, t_end, v0=0.0, breaks=()):
    """t, x of a slider under `force(t, x, v)`, by solve_ivp between the times of its kinks."""
    t = np.arange(0, t_end, 1 / FPS)
    x, state, ends = np.empty(len(t)), [0.0, v0], [0.0, *breaks, t_end]
    for a, b in pairwise(ends):
        part = solve_ivp(
            lambda s, y: [y[1], force(s, *y) / MASS],
            (a, b),
            state,
            rtol=1e-9,
            atol=1e-11,
            max_step=2e-4,
            dense_output=True,
        )
        inside = (t >= a) & (t < b)
        x[inside] = part.sol(t[inside])[0]
        state = part.y[:, -1]
    return t, x


# -- force ------------------------------------------------------------------------------------------------


def test_force_is_drive_less_mass_times_acceleration_and_gravity():
    t = np.arange(200) / FPS
    drive = 3.0 + np.sin(40 * t)
    run = given(t, 2.0 - 5.0 * t, np.full(200, -5.0), drive=drive, incline=0.3, sigma_mass=0.002)
    result = friction(run)
    expected = drive - MASS * GRAVITY * np.sin(0.3) + MASS * 5.0
    np.testing.assert_allclose(result.F, expected, atol=1e-12)
    pull = -5.0 + GRAVITY * np.sin(0.3)
    assert result.sigma_F == pytest.approx(np.full(200, np.hypot(MASS * 0.1, 0.002 * pull)), rel=1e-3)


def test_drive_noise_enters_the_deviation():
    t = np.arange(4000) / FPS
    drive = 3.0 + np.random.default_rng(1).normal(size=4000) * 0.2
    run = given(t, np.full(4000, 1.0), np.zeros(4000), drive=drive)
    assert friction(run).sigma_F[0] == pytest.approx(np.hypot(MASS * 0.1, 0.2), rel=0.1)


def test_measured_friction_is_passed_on_without_a_mass():
    t = np.arange(3000) / FPS
    series = 8.0 + np.random.default_rng(1).normal(size=3000) * 0.3
    series[100] = np.nan
    run = given(t, np.full(3000, 1.0), np.zeros(3000), friction_N=series, mass=None)
    result = friction(run)
    assert np.delete(result.F, 100) == pytest.approx(np.delete(series, 100))
    assert result.F[100] == pytest.approx(0.5 * (series[99] + series[101]))
    assert not result.free[100]
    assert result.sigma_F[0] == pytest.approx(0.3, rel=0.1)
    assert result.reason.startswith("whole record (friction is measured)")


@pytest.mark.few(1)
@pytest.mark.parametrize("repeats", few_or_many(3, 20))
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_coulomb_slide_gives_its_force_within_its_deviation(direction, repeats):
    z = []
    for seed in range(repeats):
        t, x, _ = coasting(5.0, 0.15)
        result = friction(filmed(t, direction * x, seed=seed))
        z.append((result.F - direction * COULOMB) / result.sigma_F)
        assert np.all(result.free)
    assert np.sqrt(np.mean(np.square(z))) < 1.3


# -- free section -----------------------------------------------------------------------------------------


def test_slide_that_starts_at_speed_is_free_from_the_first_frame():
    t, x, _ = coasting(5.0, 0.15)
    mask, reason = free_section(filmed(t, x))
    assert np.all(mask)
    assert reason == ("from the first frame at 0 s, which moves freely already to the last valid frame at 0.1497 s")


def test_vibration_and_texture_do_not_pass_for_a_push():
    def force(t, x, v):
        return -6.0 + 14.0 * np.cos(2 * np.pi * 60 * t) - 3.0 * np.sin(2 * np.pi * x / 0.03)

    t, x = driven(force, 0.05, v0=2.0)
    run = filmed(t, x)
    assert np.argmax(run.motion.v) > 3
    assert np.all(free_section(run)[0])
    assert release_time(run) == 0.0


@pytest.mark.few(2)
@pytest.mark.parametrize("seed", range(4))
def test_stop_and_rest_end_the_section(seed):
    t, x, stop = coasting(1.5, 0.115)
    run = filmed(t, x, seed=seed)
    mask, reason = free_section(run)
    assert -1 < np.flatnonzero(mask)[-1] - stop * FPS < 6  # the stop is found to a few frames
    assert "to the last moving frame at 0.06" in reason
    assert moving_sections(run) == [slice(0, int(np.sum(mask)))]


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_push_is_left_out(direction):
    def force(t, x, v):
        push = 90.0 * np.sin(np.pi * (t - 0.01) / 0.02) if 0.01 < t < 0.03 else 0.0
        return (push - COULOMB) if push > COULOMB or v > 0 else 0.0

    t, x = driven(force, 0.12, breaks=(0.01, 0.03))
    run = filmed(t, direction * x)
    first = np.flatnonzero(free_section(run)[0])[0]
    assert 0.030 <= t[first] < 0.036
    assert release_time(run) == pytest.approx(0.0294, abs=1e-3)
    assert free_section(run)[1].startswith("from the highest speed at 0.02")


def test_impact_at_an_end_stop_ends_the_section():
    def force(t, x, v):
        return -COULOMB * np.sign(v) - 3e5 * max(x - 0.3, 0.0)

    t, x = driven(force, 0.12, v0=4.0)
    touch = np.flatnonzero(x > 0.3)[0]
    mask, reason = free_section(filmed(t, x))
    last = np.flatnonzero(mask)[-1]
    assert touch - 30 < last < touch
    assert "an impact at 0.10" in reason


FURTHER = [pytest.param(*row, marks=pytest.mark.slow) for row in ((-3.0, 1), (-2.0, 2))]


@pytest.mark.few(1)
@pytest.mark.parametrize(("degrees", "seed"), [(-3.0, 0), (-5.0, 3), *FURTHER])
def test_places_rounded_to_1_cm_show_the_flights_between_bounces_on_a_buffer(degrees, seed):
    pull = -MASS * GRAVITY * np.sin(np.radians(degrees))

    def force(t, x, v):
        return pull - 0.05 * np.tanh(1e3 * v) - (900.0 * (x - 0.25) if x > 0.25 else 0.0)

    wait = 0.5 + np.random.default_rng(seed).uniform(0, 0.01)
    t = np.arange(0, 6, 0.01)
    slide = solve_ivp(lambda s, y: [y[1], force(s, *y) / MASS], (0, 6), [0, 0], dense_output=True, max_step=2e-3)
    x = slide.sol(np.maximum(t - wait, 0))[0]
    rounded = np.round(x, 2)
    nan = np.full(len(t), np.nan)
    displacement = Displacement(t, rounded, nan, nan, nan, nan, np.ones(len(t), bool), resolution=0.01)
    motion = differentiate(low_pass(displacement))
    run = Run(displacement, motion, mass=MASS, has_incline=True, incline=np.radians(degrees))
    free, touch = free_section(run)[0], np.flatnonzero(x > 0.25)[0]
    assert 0.8 * touch < moving_sections(run)[0].stop <= touch + 1
    assert np.sum(free & (x > 0.25)) <= np.sum(np.diff(x > 0.25))  # where the mass touches and leaves, a frame each
    assert np.sum(free) > 1.5 * np.sum(free[:touch])
    law = fit("coulomb", [run])
    assert law.parameters["coulomb.F_c"].value == pytest.approx(0.05, abs=3 * law.parameters["coulomb.F_c"].std)
    assert law.solution.problem.n_frames > 1.5 * np.sum(free[:touch])
    assert "restitution coefficient of" in impact(run)
    summary = law.summary()
    assert summary["errors"]["free_run_rms_um"] is None
    assert not any("no noise" in remark for remark in summary["remarks"])


def test_small_collision_does_not_end_the_section():
    def force(t, x, v):
        hit = 0.1 * np.pi / 2 / 1.5e-3 * np.sin(np.pi * (t - 0.05) / 1.5e-3) if 0.05 < t < 0.0515 else 0.0
        return -COULOMB - hit  # 0.1 N s of about 1 N s

    t, x = driven(force, 0.12, v0=4.0, breaks=(0.05, 0.0515))
    assert np.all(free_section(filmed(t, x))[0])


def test_incline_starts_where_motion_starts_whatever_the_later_maximum():
    t = np.arange(1200) / FPS
    u = np.maximum(t - 0.03, 0.0)
    run = filmed(t, 0.5 * 3.0 * u**2, has_incline=True, incline=-0.5)
    mask, reason = free_section(run)
    first = np.flatnonzero(mask)[0]
    assert release_time(run) == pytest.approx(0.03, abs=0.003)
    assert 0 < first - 120 < 0.125 * len(t)  # some frames for the filter
    assert np.all(mask[first:])
    assert "the beginning of motion" in reason


@pytest.mark.slow
def test_incline_keeps_the_way_up_and_the_way_down():
    t = np.arange(3200) / FPS
    turn = 2.0 / 7.0
    x = np.where(t < turn, 2.0 * t - 3.5 * t**2, 2.0**2 / 14.0 - 0.5 * 3.3 * (t - turn) ** 2)
    up, down = moving_sections(filmed(t, x, has_incline=True, incline=0.5))
    assert up.start == 0
    assert down.stop == 3200
    assert up.stop / FPS == pytest.approx(turn, abs=0.003)
    assert 0 < down.start - up.stop < 12


def test_measured_drive_frees_the_whole_record_but_stuck_frames():
    t = np.arange(1000) / FPS
    v = np.where((t > 0.1) & (t < 0.15), 0.0, np.sign(0.125 - t))
    run = given(t, v, np.zeros(1000), drive=np.zeros(1000))
    mask, reason = free_section(run)
    assert np.array_equal(mask, v != 0.0)
    assert reason == "whole record (drive is measured), 199 of 1000 frames left out as stuck"
    assert moving_sections(run) == [slice(0, 401), slice(600, 1000)]


def test_invalid_frames_are_never_free_but_do_not_cut_a_section():
    t = np.arange(400) / FPS
    valid = np.ones(400, bool)
    valid[[0, 100, 101, 395, 396, 397, 398, 399]] = False
    run = given(t, 5.0 - 20.0 * t, np.full(400, -20.0), valid=valid)
    mask, reason = free_section(run)
    assert np.array_equal(mask, valid)
    assert reason.endswith("to the last valid frame at 0.0985 s")
    assert moving_sections(run) == [slice(1, 395)]


def test_given_section_overrides():
    t = np.arange(400) / FPS
    run = replace(given(t, 5.0 - 20.0 * t, np.full(400, -20.0)), free=(0.02, 0.05))
    mask, reason = free_section(run)
    assert t[mask][[0, -1]] == pytest.approx([0.02, 0.05])
    assert reason == "0.02 s to 0.05 s as given"
    assert release_time(run) == pytest.approx(0.02)


# -- bad input --------------------------------------------------------------------------------------------


def test_target_at_rest_is_refused():
    t = np.arange(400) / FPS
    with pytest.raises(FrictrackError, match='run "run": expected a sliding target but its speed never exceeds 5'):
        free_section(given(t, np.zeros(400), np.zeros(400)))


def test_empty_section_is_refused():
    t = np.arange(400) / FPS
    run = given(t, 5.0 - 20.0 * t, np.full(400, -20.0), free=(3.0, 4.0))
    with pytest.raises(
        FrictrackError, match=r"at least 8 free frames but got 0 \(3 s to 4 s as given\); give the free"
    ):
        free_section(run)


def test_a_frame_that_was_lost_or_doubled_is_no_impact():
    whole, x, _ = coasting(6.0, 0.19)
    t = whole[:720]
    for way in (0, 2):  # the same frame once more, or one left out
        shown = np.interp(t + np.where(t > 0.1, (way - 1) / FPS, 0.0), whole, x)
        mask, reason = free_section(filmed(t, shown))
        assert "impact" not in reason
        assert mask[np.searchsorted(t, 0.15)]


def test_a_frame_that_was_lost_from_a_precise_record_is_no_rest():
    """A low-pass smears the jump: its velocity there is uncertain by more than a third of itself."""
    t = np.arange(0, 0.12, 1 / 4000)
    true = t + np.where(t > 0.04, 1 / 4000, 0.0)
    run = measured(t, 4.0 * true - 0.5 * 28.0 * true**2, sigma=1e-7)
    mask, _ = free_section(run)
    assert mask.all()
    assert moving_sections(run) == [slice(0, len(t))]


@pytest.mark.slow
def test_a_frame_that_was_lost_is_no_push():
    t = np.arange(0, 0.15, 1 / 6000)
    true = 2.0 * (t + np.where(t > 0.04, 1 / 6000, 0.0))
    x = true - 0.5 * 4.0 * (true / 2.0) ** 2
    rng = np.random.default_rng(3)
    displacement = Displacement(t, x + 2 * NOISE * rng.normal(size=len(t)), *[np.full(len(t), np.nan)] * 4, t >= 0)
    mask, reason = free_section(Run(displacement, differentiate(low_pass(displacement)), mass=MASS))
    assert mask.all()
    assert "moves freely already" in reason


def test_a_wrong_last_sample_after_a_stop_is_no_motion():
    t, x, stop = coasting(1.5, 0.115)
    x[-1] += 0.66e-3
    run = filmed(t, x)
    assert np.abs(run.motion.v[-1]) > 1.5  # the last frame seems to be the fastest of all
    mask, _ = free_section(run)
    assert np.flatnonzero(mask)[0] == 0
    assert -1 < np.flatnonzero(mask)[-1] - stop * FPS < 6
