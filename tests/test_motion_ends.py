"""Deviations of the acceleration at ends, round a stop and in a collision, against slides by scipy's integrator."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from frictrack.base.errors import FrictrackError
from frictrack.measure.motion import Smoother, compare_filters, differentiate, low_pass
from frictrack.measure.motion.smoother import Event, Structure
from frictrack.measure.motion.structure_search import ChangeGroup, StructureChange
from frictrack.records import Displacement, Run

FPS, MASS = 4000.0, 0.35
SLIDES = {  # start speed m/s, coulomb N, stribeck N, frames
    "viscous": (4.0, 8.0, 0.0, 500),
    "stribeck": (3.0, 6.0, 6.0, 479),
    "viscous to a stop": (3.0, 8.0, 0.0, 700),
    "stribeck to a stop": (3.0, 6.0, 6.0, 700),
}
STRUCK = (5.0, 6.0, 6.0, 500)
BLOW = (0.05, 0.06, 4e-4)  # N s, at s, of a width s


def slid(v0, coulomb, stribeck, n, blow=(0.0, 0.06, 4e-4)):
    """Time, place and acceleration (n,) of a slide, and the frame in which it stops."""
    impulse, when, width = blow

    def acceleration(t, v):
        push = impulse / width / np.sqrt(2 * np.pi) * np.exp(-0.5 * ((t - when) / width) ** 2)
        return -(coulomb + stribeck * np.exp(-v / 0.4) + 1.2 * v + push) / MASS

    def stops(t, y):
        return y[1]

    stops.terminal = True
    t = np.arange(n) / FPS
    options = {"rtol": 1e-11, "atol": 1e-13, "max_step": 5e-4, "dense_output": True, "events": stops}
    found = solve_ivp(lambda t, y: [y[1], acceleration(t, y[1])], (0.0, t[-1]), [0.0, v0], **options)
    x, v = found.sol(np.minimum(t, found.t[-1]))
    return t, x, np.where(t < found.t[-1], acceleration(t, v), 0.0), min(int(found.t[-1] * FPS), n)


def seen(t, x, noise, seed):
    nan = np.full(len(t), np.nan)
    y = x + noise * np.random.default_rng([seed, 7]).standard_normal(len(t))
    return Displacement(t, y, nan, nan, np.full(len(t), noise), nan, np.ones(len(t), bool))


def errors(slide, noise, seeds, **known):
    """Errors of the acceleration over their deviations (seeds, n), and the frame of the stop."""
    t, x, a, stop = slid(*slide, **known)
    motions = [differentiate(low_pass(seen(t, x, noise, seed))) for seed in range(seeds)]
    return np.array([(m.a - a) / m.sigma_a for m in motions]), stop


def rms(z):
    return float(np.sqrt(np.mean(z**2)))


def last(z, stop):
    """Of the last twentieth of a slide, without the frames of the stop itself."""
    return z[:, int(0.95 * stop) : stop - 3 * (stop < z.shape[1] - 2)]


@pytest.mark.slow
def test_the_last_frames_before_a_stop_are_as_well_known_as_they_are_said_to_be():
    z, stop = errors(SLIDES["stribeck to a stop"], 2e-5, 5)
    assert 0.5 < rms(last(z, stop)) < 2.0  # 2.5 with the best structure alone
    assert 0.6 < rms(z[:, stop // 10 : 9 * stop // 10]) < 1.15


@pytest.mark.slow
def test_a_collision_in_high_noise_is_as_well_known_as_it_is_said_to_be():
    z, _ = errors(STRUCK, 5e-5, 5, blow=BLOW)
    assert 0.5 < rms(z[:, 228:253]) < 2.4  # 4.7 with the best structure alone


@pytest.mark.slow
@pytest.mark.parametrize("noise", [2e-6, 2e-5])
@pytest.mark.parametrize("slide", SLIDES)
def test_deviations_hold_to_the_ends_of_every_slide(slide, noise):
    z, stop = errors(SLIDES[slide], noise, 12)
    assert 0.4 < rms(last(z, stop)) < 1.7
    assert 0.5 < rms(z[:, : stop // 20]) < 1.5
    assert 0.6 < rms(z[:, stop // 10 : 9 * stop // 10]) < 1.1


def test_a_stored_series_has_the_same_deviations_and_an_old_one_is_read():
    t, x, _, _ = slid(*SLIDES["stribeck"])
    filtered = low_pass(seen(t, x, 2e-5, 0))
    smoother = Smoother.read(filtered.smoother)
    assert smoother.alternatives
    assert str(smoother) == filtered.smoother
    settings = json.loads(filtered.smoother)
    del settings["alternatives"]
    for event in settings["events"]:
        del event["rises"]
    old = differentiate(replace(filtered, smoother=json.dumps(settings), x_measured=None))
    new = differentiate(filtered)
    assert np.array_equal(old.a, new.a)
    assert np.all(new.sigma_a[-5:] > old.sigma_a[-5:])
    assert new.sigma_a[200] == pytest.approx(old.sigma_a[200], rel=0.1)


def test_a_ramp_makes_the_trend_softer_towards_its_end():
    plain = Structure((9.0,))
    rising, falling = (replace(plain, events=(Event(10, 13, 4.0, rises),)) for rises in (1, -1))
    assert rising.log_lambda(30)[9:15] == pytest.approx([9, 8, 7, 6, 5, 9])
    assert falling.log_lambda(30)[9:15] == pytest.approx([9, 5, 6, 7, 8, 9])


def test_groups_survive_json():
    group = ChangeGroup(
        3, 400, (StructureChange(0.25, Event(5, 20, 4.0, -1)), StructureChange(0.1, Event(90, 95, 7.0), 1))
    )
    smoother = Smoother(Structure((9.0, 8.0), (), (Event(1, 2, 3.0), Event(91, 94, 5.0))), None, (group,))
    assert Smoother.read(str(smoother)).alternatives == (group,)


def textured(t, amplitude=1.0, period=0.031):
    """Place and acceleration of a slide on a course with a texture, by scipy's integrator."""

    def acceleration(x, v):
        return -(1.2 + 0.4 * v) / MASS + amplitude * np.sin(2 * np.pi * x / period)

    options = {"rtol": 1e-11, "atol": 1e-13, "max_step": 1e-4, "t_eval": t}
    found = solve_ivp(lambda t, y: [y[1], acceleration(*y)], (0.0, t[-1]), [0.0, 3.0], **options)
    return found.y[0], acceleration(*found.y)


def test_a_force_periodic_in_place_is_found_at_a_changing_speed():
    t = np.arange(400) / FPS
    x, a = textured(t)
    found = [low_pass(seen(t, x, 1e-6, seed)) for seed in range(3)]
    forces = [force for filtered in found for force in Smoother.read(filtered.smoother).forces]
    assert [force.period for force in forces] == pytest.approx([0.031] * 3, rel=0.01)
    assert [np.hypot(force.cosine, force.sine) for force in forces] == pytest.approx([1.0] * 3, rel=0.1)
    assert "periodic in place, every 3" in found[0].reason
    motions = [differentiate(filtered) for filtered in found]
    assert all(rms(m.a - a) < 0.05 for m in motions)  # 0.11 with a trend and a line, and a stated 0.4
    assert 0.6 < rms(np.concatenate([(m.a - a) / m.sigma_a for m in motions])) < 1.5
    blind = low_pass(seen(t, textured(t, 0.0)[0], 1e-6, 0))
    assert not Smoother.read(blind.smoother).forces


def test_a_figure_shows_what_a_filter_costs():
    t = np.arange(400) / FPS
    x, a = textured(t)
    displacement = seen(t, x, 1e-6, 0)
    run = Run(displacement, differentiate(low_pass(displacement, method="papers")), mass=MASS)
    measured, filtered, smoothed = compare_filters(displacement, low_pass(displacement, method="papers"), run.motion)
    assert filtered.name == "papers"
    assert np.array_equal(filtered.values[2], run.motion.a)
    inside = slice(60, -60)
    errors = [rms(one.values[2, inside] - a[inside]) for one in (measured, filtered, smoothed)]
    stated = [rms(one.sigma[2, inside]) for one in (measured, filtered, smoothed)]
    assert stated == pytest.approx(errors, rel=0.3)
    panels = run.plot("filters").axes
    assert [ax.get_ylabel().split()[0] for ax in panels] == ["x", "v", "a", "F"]
    assert [len(ax.lines) for ax in panels] == [3] * 4
    with pytest.raises(FrictrackError, match='expected "motion" or "filters" but got "phase"'):
        run.plot("phase")
