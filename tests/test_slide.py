"""Simulated slides against closed forms and an independent Runge-Kutta that goes from event to event."""

from __future__ import annotations

import numpy as np
import pytest
from runs import BASE, FPS, HIDDEN, MASS, PITCH, SHIFTS, TOLD, Slider, integrate, picture

from frictrack.base.errors import FrictrackError
from frictrack.effects import models
from frictrack.records import GRAVITY
from frictrack.simulate import Conditions, simulate

NM = 1e-9
COULOMB = {"coulomb": {"F_c": 2.0}}
HOOKED = COULOMB | {"stribeck": {"F_s": 1.5, "v_s": 0.05, "delta": 1.0}}


def frames(duration, fps=FPS):
    return np.arange(round(duration * fps)) / fps


def slid(values, t, start, push=None, **known):
    """frictrack's slide under the values; `push` is a drive as a function of one time."""
    drive = None if push is None else lambda times: np.array([push(float(tau)) for tau in times])
    return simulate(models.of(values), values, Conditions(**{"mass": MASS, "drive": drive} | known), t, start)


@pytest.mark.parametrize("s", [1.0, -1.0])
def test_a_coulomb_slider_stops_where_and_when_energy_says(s):
    t, g = frames(0.2), 2.0 / MASS
    run = slid(COULOMB, t, (0.3, s * 0.6))
    stop = 0.6 / g
    moving = t < stop
    assert 0.3 < moving.mean() < 0.7
    np.testing.assert_allclose(run.x[moving], 0.3 + s * (0.6 * t - g * t**2 / 2)[moving], atol=1e-14)
    np.testing.assert_allclose(run.x[~moving], 0.3 + s * 0.6**2 / (2 * g), atol=1e-14)
    np.testing.assert_allclose(run.v, np.where(moving, s * (0.6 - g * t), 0.0), atol=1e-13)
    off = np.abs(t - stop) > 1e-9  # one frame is at the very stop, where acceleration and force jump
    np.testing.assert_allclose(run.a[off], np.where(moving, -s * g, 0.0)[off], atol=1e-11)
    np.testing.assert_allclose(run.F[off], np.where(moving, s * 2.0, 0.0)[off], atol=1e-12)


def test_a_slider_at_rest_stays_under_a_drive_below_its_static_friction():
    t = frames(0.2)
    run = slid(HOOKED, t, (0.1, 0.0), lambda tau: 3.4 * np.sin(2 * np.pi * 20 * tau))
    np.testing.assert_array_equal(run.x, 0.1)
    np.testing.assert_array_equal(run.v, 0.0)
    np.testing.assert_allclose(run.F, 3.4 * np.sin(2 * np.pi * 20 * t), atol=1e-12)  # friction answers the drive


def test_a_slider_sets_off_when_the_drive_passes_static_friction():
    t = frames(0.2)
    run = slid(HOOKED, t, (0.0, 0.0), lambda tau: 20.0 * tau)
    release = 3.5 / 20.0
    assert np.all(run.x[t < release] == 0)
    assert np.all(np.diff(run.x[t > release]) > 0)


@pytest.mark.parametrize(
    ("values", "push", "duration", "start"),
    [
        (COULOMB, lambda tau: 5 * np.sin(2 * np.pi * 20 * tau), 0.2, (0.0, 0.0)),
        (HOOKED, lambda tau: 5 * np.sin(2 * np.pi * 20 * tau + 1), 0.2, (0.0, 0.2)),
        (COULOMB | {"spring": {"k": 800.0, "x_0": 0.0}}, lambda tau: 0.0, 0.3, (0.0, 2.0)),
        (COULOMB | {"spring": {"k": 80.0, "x_0": 5.0}}, lambda tau: 0.0, 0.3, (0.0, 0.5)),
    ],
    ids=["stick-slip", "stick-slip with a hook", "spring to and fro", "spring comes to rest"],
)
def test_sticking_release_and_reversal_agree_with_runge_kutta(values, push, duration, start):
    t = frames(duration)
    run = slid(values, t, start, push)
    truth = integrate(values, Slider(push=push), t, start, max_step=1e-3)
    assert np.ptp(truth) > 5e-4
    assert len(np.unique(np.sign(run.v))) >= 2
    assert np.max(np.abs(run.x - truth)) < 0.1 * NM


def test_an_incline_is_gravity_along_the_course():
    t = frames(0.2)
    steep, flat = 1.2, 0.3  # rad; tan of the friction angle is 2/(0.35 g) = 0.58
    up = slid(COULOMB, t, (0.0, 0.5), incline=steep)
    climb, fall = GRAVITY * np.sin(steep) + 2.0 / MASS, GRAVITY * np.sin(steep) - 2.0 / MASS
    top = 0.5 / climb
    truth = np.where(t < top, 0.5 * t - climb * t**2 / 2, 0.5**2 / (2 * climb) - fall * (t - top) ** 2 / 2)
    np.testing.assert_allclose(up.x, truth, atol=1e-13)
    stays = slid(COULOMB, t, (0.0, 0.5), incline=flat)
    assert np.all(stays.v[t > 0.5 / (GRAVITY * np.sin(flat) + 2.0 / MASS)] == 0)
    np.testing.assert_allclose(stays.F[-1], -MASS * GRAVITY * np.sin(flat), rtol=1e-12)


def test_load_mass_ratio_and_mass_enter_as_the_design_says():
    t = frames(0.05)
    values = COULOMB | {"slope": {"F": 1.0}, "viscous": {"F_v": 0.0}}
    run = slid(values, t, (0.0, 4.0), mass=0.7, load=1.9, mass_ratio=2.0)
    np.testing.assert_allclose(run.a, -(2.0 * 1.9 + 1.0 * 2.0) / 0.7, rtol=1e-10)


@pytest.mark.few(6)
@pytest.mark.parametrize("speed", [4.0, -4.0, 2.2])
@pytest.mark.parametrize("name", ["", *(n for n in HIDDEN if n not in SHIFTS)])
def test_every_force_effect_is_followed_to_below_a_nanometre(name, speed):
    values = BASE | ({name: HIDDEN[name]} if name else {})
    t, start = frames(0.1), (0.0 if speed > 0 else 0.4, speed)
    step = 2e-4 if name == "collision" else np.inf
    assert np.max(np.abs(slid(values, t, start).x - integrate(values, Slider(), t, start, max_step=step))) < 0.01 * NM


@pytest.mark.few(1)
@pytest.mark.parametrize("width", [1e-4, 5e-5, 2e-5])
def test_a_blow_much_shorter_than_a_frame_is_followed_too(width):
    values = BASE | {"collision": {"J": 0.05, "time": 0.0601, "width": width}}
    t, start = frames(0.1), (0.0, 4.0)
    run = slid(values, t, start)
    assert np.max(np.abs(run.x - integrate(values, Slider(), t, start, max_step=width))) < 0.1 * NM


def test_a_blow_that_turns_the_mass_round_in_its_middle_is_followed():
    values = BASE | {"collision": {"J": 0.5, "time": 0.0601, "width": 2e-4}}
    t, start = frames(0.1), (0.0, 2.2)
    run = slid(values, t, start)
    assert run.v[t > 0.061][0] < 0 < run.v[t < 0.0598][-1]
    assert np.max(np.abs(run.x - integrate(values, Slider(), t, start, max_step=1e-4))) < 0.1 * NM


def test_a_motion_that_cannot_be_followed_is_refused():
    with pytest.raises(FrictrackError, match="expected a motion that can be followed to 1 nm but got one that still"):
        slid(COULOMB, frames(0.02), (0.0, 4.0), lambda tau: 5.0 * np.sin(3e7 * tau))


def test_measurement_effects_shift_the_picture_and_not_the_mass():
    t = frames(0.1)
    values = BASE | {name: (HIDDEN | TOLD)[name] for name in SHIFTS}
    plain, run = slid(BASE, t, (0.0, 4.0)), slid(values, t, (0.0, 4.0), pixel_pitch=PITCH)
    np.testing.assert_array_equal(plain.shift, 0.0)
    np.testing.assert_allclose(run.x, plain.x, atol=1e-13)
    np.testing.assert_allclose(run.shift, picture(values, run.x, t), atol=1e-15)
    assert np.ptp(run.shift) > 1e-5


def test_frames_of_uneven_times_are_met_exactly():
    t = np.cumsum(np.r_[0.0, np.random.default_rng(3).uniform(1e-4, 8e-4, 200)])
    run = slid(BASE, t, (0.0, 4.0))
    np.testing.assert_array_equal(run.t, t)
    assert np.max(np.abs(run.x - integrate(BASE, Slider(), t, (0.0, 4.0)))) < 0.1 * NM
