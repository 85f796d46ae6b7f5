"""What happens in a run and what a plain cut-off would cost, against closed forms."""

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

from frictrack.measure.friction import find_events
from frictrack.measure.motion import cutoff_tradeoff, differentiate, low_pass
from frictrack.records import Displacement, Run

FPS = 4000.0
NOISE = 10e-6


def filmed(t, x, *, seed=0, cutoff=None, **run):
    nan = np.full(len(t), np.nan)
    x = x + NOISE * np.random.default_rng(seed).normal(size=len(t))
    seen = Displacement(t, x, nan, nan, np.full(len(t), NOISE), nan, np.ones(len(t), bool))
    return Run(seen, differentiate(low_pass(seen, cutoff)), **{"mass": 0.5, **run})


def kinds(run):
    return [kind for kind, _, _ in find_events(run).events]


def pieces(*parts, x=0.0, v=0.0):
    """t, x of a motion of constant accelerations: (seconds, m/s^2) one after the other; a stop is 0 at v = 0."""
    t, out, start = [], [], 0.0
    for lasts, a in parts:
        n = round(lasts * FPS)
        u = np.arange(n) / FPS
        t.append(start + u)
        out.append(x + v * u + 0.5 * a * u**2)
        x, v, start = x + v * lasts + 0.5 * a * lasts**2, v + a * lasts, start + lasts
    return np.concatenate(t), np.concatenate(out)


def test_a_push_a_slide_a_stop_and_the_rests_round_them():
    t, x = pieces((0.03, 0.0), (0.02, 150.0), (0.15, -20.0), (0.05, 0.0))
    found = find_events(filmed(t, x))
    assert [kind for kind, _, _ in found.events] == ["start", "release", "stop"]
    starts, released, stops = (begins for _, begins, _ in found.events)
    assert starts == pytest.approx(0.03, abs=1.5e-3)
    assert released == pytest.approx(0.05, abs=1.5e-3)
    assert stops == pytest.approx(0.20, abs=3e-3)
    assert len(found.rests) == 2
    assert found.rests[0][1] < 0.0305
    assert found.rests[1][0] > 0.197
    assert found.noise_at_rest == pytest.approx(NOISE, rel=0.2)


def test_a_reversal_is_no_stop():
    t, x = pieces((0.1, -30.0), (0.1, -10.0), v=3.0)
    found = find_events(filmed(t, x, has_incline=True, incline=0.5))
    assert [kind for kind, _, _ in found.events] == ["reversal"]
    assert found.events[0][1] == pytest.approx(0.1, abs=2e-3)
    assert found.rests == ()
    assert np.isnan(found.noise_at_rest)


def test_a_rest_between_two_motions_is_a_stop_and_a_start():
    t, x = pieces((0.1, -20.0), (0.05, 0.0), (0.1, 20.0), v=2.0)
    assert kinds(filmed(t, x, drive=np.zeros(len(t)))) == ["stop", "start"]


def test_an_impact_takes_speed_at_once():
    t, x = pieces((0.08, -5.0), (0.001, -4000.0), (0.08, 5.0), v=3.0)
    found = find_events(filmed(t, x, drive=np.zeros(len(t))))
    assert "impact" in [kind for kind, _, _ in found.events]
    at = next(begins for kind, begins, _ in found.events if kind == "impact")
    assert at == pytest.approx(0.08, abs=2e-3)


def test_bounces_are_impacts_also_where_a_cutoff_smears_them():
    t, wall = np.arange(0, 11, 0.01), 2.0
    x, v, at, touches = 0.0, 0.0, 0.503, []
    places = np.zeros(len(t))
    for _ in range(3):  # falls toward the wall at 0.5 m/s^2, and leaves it with 0.7 of its speed
        touch = at + (-v + np.sqrt(v**2 + (wall - x))) / 0.5
        inside = (t >= at) & (t < touch)
        places[inside] = x + v * (t[inside] - at) + 0.25 * (t[inside] - at) ** 2
        x, v, at = wall, -0.7 * (v + 0.5 * (touch - at)), touch
        touches.append(touch)
    seen = t < touches[-1]
    t, rounded, nan = t[seen], np.round(places[seen], 2), np.full(np.sum(seen), np.nan)
    found = Displacement(t, rounded, nan, nan, 0.003 + 0 * t, nan, seen[seen], resolution=0.01)
    run = Run(found, differentiate(low_pass(found, 5.0)), mass=0.5, has_incline=True, incline=-0.05)
    impacts = [(begins, ends) for kind, begins, ends in find_events(run).events if kind == "impact"]
    assert [0.5 * (begins + ends) for begins, ends in impacts] == pytest.approx(touches[:-1], abs=0.05)


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_a_plain_slide_has_no_story(direction):
    t, x = pieces((0.15, -20.0), v=5.0)
    assert kinds(filmed(t, direction * x)) == []


# -- the cut-off --------------------------------------------------------------------------------------------------


def vibrating(f=60.0, size=40e-6):
    t, x = pieces((0.17, -20.0), v=5.0)
    return t, x + size * np.sin(2 * np.pi * f * t + 0.4)


def test_residual_follows_the_floor_where_only_noise_is_taken_and_leaves_it_where_signal_is():
    t, x = vibrating()
    run = filmed(t, x)
    found = cutoff_tradeoff(run.displacement, low_pass(run.displacement), run.motion)
    high = found.frequency > 150
    assert found.residual[high] == pytest.approx(found.floor[high], rel=0.1)
    low = found.frequency < 30
    assert np.all(found.residual[low] > 25e-6)  # 40 um of vibration, rms 28 um
    assert np.all(np.diff(found.noise) > 0)
    assert found.lost[0] > 10 * found.lost[-1]
    assert 60 < found.least < 250
    assert found.structural < 0.7 * found.total.min()


def test_the_error_of_a_cutoff_is_the_same_whichever_filter_is_asked_for():
    t, x = vibrating()
    lost = 40e-6 / np.sqrt(2) * (2 * np.pi * 60.0) ** 2 / 2  # a low-pass at 60 Hz takes half of the vibration
    for asked in (None, 60.0):
        run = filmed(t, x, cutoff=asked)
        found = cutoff_tradeoff(run.displacement, low_pass(run.displacement, asked), run.motion)
        assert found.at(60.0)[1] == pytest.approx(lost, rel=0.15)
        assert found.lost.min() < 0.1 * lost
    assert found.structural == pytest.approx(np.hypot(*found.at(60.0)), rel=0.15)


@pytest.mark.slow
def test_noise_let_through_is_that_of_the_butterworth_filter_and_two_differences():
    rng = np.random.default_rng(0)
    t, x = vibrating()
    run = filmed(t, x)
    found = cutoff_tradeoff(run.displacement, low_pass(run.displacement), run.motion)
    noise = NOISE * rng.normal(size=40_000)
    for f in (50.0, 150.0):
        smooth = sosfiltfilt(butter(4, f, fs=FPS, output="sos"), noise)
        a = np.gradient(np.gradient(smooth, 1 / FPS), 1 / FPS)[1000:-1000]
        assert found.at(f)[0] == pytest.approx(np.std(a), rel=0.15)


@pytest.mark.slow
def test_what_may_hide_is_what_is_not_found():
    """A vibration half as large as the limit is not seen, one twice as large always is."""
    t, x = pieces((0.17, -20.0), v=5.0)
    for times, seen in ((0.5, 0), (2.0, 2)):
        found = 0
        for seed in range(2):
            plain = filmed(t, x, seed=seed)
            limit = cutoff_tradeoff(plain.displacement, low_pass(plain.displacement), plain.motion)
            hidden = np.exp(np.interp(np.log(300.0), np.log(limit.frequency), np.log(limit.hidden)))
            size = times * hidden * np.sqrt(2.0) / (2 * np.pi * 300.0) ** 2
            found += bool(filmed(t, x + size * np.sin(2 * np.pi * 300.0 * t + seed), seed=seed).motion.lines)
        assert found == seen


@pytest.mark.slow
def test_what_lies_above_a_cutoff_is_said():
    t, x = vibrating(134.0, 8e-6)
    run = filmed(t, x, cutoff=60.0)
    found = cutoff_tradeoff(run.displacement, low_pass(run.displacement, 60.0), run.motion)
    assert found.chosen == 60.0
    assert any(w.startswith("a vibration at 13") and "lies above the cut-off of 60 Hz" in w for w in found.warnings)
    t, x = pieces((0.08, -5.0), (0.001, -4000.0), (0.08, 5.0), v=3.0)
    run = filmed(t, x, cutoff=60.0, drive=np.zeros(len(t)))
    found = cutoff_tradeoff(run.displacement, low_pass(run.displacement, 60.0), run.motion)
    assert any("shorter than half a period of the cut-off of 60 Hz" in w for w in found.warnings)
    t, x = pieces((0.15, -20.0), v=5.0)
    run = filmed(t, x)
    assert cutoff_tradeoff(run.displacement, low_pass(run.displacement), run.motion).warnings == ()


def test_a_push_does_not_rule_what_a_low_pass_costs():
    """A half sine of 4 ms and 6000 m/s^2, then friction of 15 m/s^2: a low-pass at 100 Hz smears the push over 5 ms."""
    t, lasts = np.arange(270) / FPS, 0.004
    u, late = np.pi / lasts * np.minimum(t, lasts), np.maximum(t - lasts, 0.0)
    x = 6000.0 * ((lasts / np.pi) ** 2 * (u - np.sin(u)) + 2 * lasts / np.pi * late) - 7.5 * late**2
    run = filmed(t, x, drive=np.zeros(len(t)))
    found = cutoff_tradeoff(run.displacement, low_pass(run.displacement), run.motion)
    assert max(found.at(100.0)) < 1.0
    assert max(found.at(found.chosen)) < 15.0
