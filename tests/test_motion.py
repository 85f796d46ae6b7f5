"""Low-pass, noise level and derivatives against closed forms, dense algebra, scipy.signal and solve_ivp."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from repeats import few_or_many
from scipy.integrate import solve_ivp
from scipy.signal import butter, sosfiltfilt

import frictrack
from frictrack.base.errors import FrictrackError
from frictrack.measure.motion import (
    METHOD_NAMES,
    MISSING_SIGMA,
    KnownAcceleration,
    covariance,
    derivatives,
    differentiate,
    low_pass,
)
from frictrack.measure.motion.banded_equations import LineParameters, SmootherData, cutoff_of, penalty
from frictrack.measure.motion.derivative import deviations
from frictrack.measure.motion.smoother import FactoredSmoother, Structure
from frictrack.measure.motion.structure_search import StructureSearch
from frictrack.records import Displacement
from frictrack.sampling import noise_level
from frictrack.study.schema import MotionTable

FPS = 4000.0
NOISE = 10e-6


@pytest.fixture
def rng():
    return np.random.default_rng(20261121)


def displacement(t, x, *, y=None, sigma=None, valid=None):
    nan = np.full(len(t), np.nan)
    valid = np.ones(len(t), bool) if valid is None else valid
    x = np.where(valid, x, np.nan)
    return Displacement(t, x, nan if y is None else y, nan, nan if sigma is None else sigma, nan, valid)


def tustin_slide(vibration=0.0, mass=0.35, v0=5.75, v1=0.06):
    """t, x, v, a of a slide under Tustin friction and a 60 Hz force, by solve_ivp."""

    def acceleration(t, v):
        force = 8.0 + 6.0 * np.exp(-v / 0.4) + 1.2 * v + vibration * np.sin(2 * np.pi * 60.0 * t + 0.7)
        return -force / mass

    def slow(t, s):
        return s[1] - v1

    slow.terminal = True
    options = {"events": slow, "rtol": 1e-10, "atol": 1e-12, "max_step": 2e-3, "dense_output": True}
    solution = solve_ivp(lambda t, s: [s[1], acceleration(t, s[1])], (0, 5), [0, v0], **options)
    t = np.arange(0, solution.t[-1], 1 / FPS)
    x, v = solution.sol(t)
    return t, x, v, acceleration(t, v)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


# -- the smoother -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("sensed", [False, True])
@pytest.mark.parametrize("lines", [0, 1, 2])
def test_smoother_and_covariance_agree_with_dense_algebra(rng, lines, sensed):
    n = 61
    y, w = rng.normal(size=n), rng.uniform(0.5, 2.0, n)
    w[[0, 20, 21, 22]] = 0.0
    lam, omega, mu = 1e4 * np.exp(rng.normal(size=n - 4)), np.array([0.3, 0.9])[:lines], np.array([1e3, 1e5])[:lines]
    worth, bent = (rng.uniform(0, 50, n - 2), rng.normal(size=n - 2)) if sensed else (None, None)
    made = FactoredSmoother(SmootherData(y, w, bent, worth), lam, LineParameters(omega, mu))

    every = np.hstack([np.eye(n)] * (1 + lines))
    fourth, second = np.diff(np.eye(n), 4, axis=0), np.diff(np.eye(n), 2, axis=0)
    normal, right = every.T @ np.diag(w) @ every, every.T @ (w * y)
    normal[:n, :n] += fourth.T @ np.diag(lam) @ fourth
    for k in range(lines):
        obeyed = second + 2 * (1 - np.cos(omega[k])) * np.eye(n)[1:-1]
        here = slice(n * (k + 1), n * (k + 2))
        normal[here, here] += mu[k] * obeyed.T @ obeyed
    if sensed:
        normal += (second @ every).T @ np.diag(worth) @ (second @ every)
        right += (second @ every).T @ (worth * bent)
    solved, expected = np.linalg.solve(normal, right), every @ np.linalg.inv(normal) @ every.T

    assert made.signal(made.unknowns()) == pytest.approx(every @ solved, abs=1e-6)
    assert made.posterior_covariance_times(np.eye(n)) == pytest.approx(expected, rel=1e-5, abs=1e-6)
    start = np.minimum(np.arange(n), n - 4)
    stencils = rng.normal(size=(2, n, 4))
    near = [expected[s : s + 4, s : s + 4] for s in start]
    combined = np.einsum("kij,ijl,kil->ki", stencils, near, stencils)
    assert made.variances(start, stencils) == pytest.approx(combined, rel=1e-5)
    if not sensed:
        passed = expected @ np.diag(w) @ expected
        near = [passed[s : s + 4, s : s + 4] for s in start]
        noise = np.einsum("kij,ijl,kil->ki", stencils, near, stencils)
        assert made.noise_variances(start, stencils) == pytest.approx(noise, rel=2e-3, abs=1e-9)


def test_likelihood_is_that_of_the_dense_covariance(rng):
    """Of two penalties and two frequencies, the one that a Gaussian of that covariance favours by as much."""
    n = 40
    y = rng.normal(size=n) + np.linspace(0, 3, n) ** 2

    def dense(lam, omega, mu):
        trend, wave = np.vander(np.arange(n) / n, 4), np.arange(n)
        free = np.column_stack([trend, np.cos(omega * wave), np.sin(omega * wave)])
        fourth = np.diff(np.eye(n), 4, axis=0)
        second = np.diff(np.eye(n), 2, axis=0) + 2 * (1 - np.cos(omega)) * np.eye(n)[1:-1]
        shaken, turned = (np.linalg.lstsq(d, np.eye(len(d)))[0] for d in (fourth, second))
        v = np.eye(n) + shaken @ shaken.T / lam + turned @ turned.T / mu
        inverse = np.linalg.inv(v)
        inside = free.T @ inverse @ free
        p = inverse - inverse @ free @ np.linalg.solve(inside, free.T @ inverse)
        degrees = n - 6
        return (n - 4) * np.log(y @ p @ y / degrees) + np.linalg.slogdet(v)[1] + np.linalg.slogdet(inside)[1]

    def ours(lam, omega, mu):
        return FactoredSmoother(
            SmootherData(y, np.ones(n)), np.full(n - 4, lam), LineParameters(np.array([omega]), np.array([mu]))
        ).restricted_likelihood()[0]

    settings = [(1e2, 0.5, 1e2), (1e4, 0.5, 1e2), (1e4, 0.5, 1e5), (1e4, 1.1, 1e5)]
    theirs, found = np.array([dense(*s) for s in settings]), np.array([ours(*s) for s in settings])
    assert found - found[0] == pytest.approx(theirs - theirs[0], abs=1e-3)


@pytest.mark.few(1)
@pytest.mark.parametrize("cutoff", [1.0, 60.0, 1900.0])
def test_parabola_passes_whatever_the_cutoff(cutoff):
    t = 3.0 + np.arange(400) / FPS
    x = 0.2 + 5.0 * t - 12.0 * t**2
    motion = differentiate(low_pass(displacement(t, x), cutoff))
    assert motion.x == pytest.approx(x, abs=1e-9)
    assert motion.v == pytest.approx(5.0 - 24.0 * t, abs=1e-6)
    assert motion.a == pytest.approx(np.full(400, -24.0), abs=1e-2)


@pytest.mark.parametrize(("f", "cutoff"), [(30.0, 60.0), (60.0, 60.0), (90.0, 60.0), (400.0, 300.0)])
def test_sine_is_attenuated_by_the_stated_response_without_phase(f, cutoff):
    t = np.arange(3000) / FPS
    filtered = low_pass(displacement(t, np.sin(2 * np.pi * f * t + 0.4)), cutoff)
    h = 1.0 / (1.0 + (np.sin(np.pi * f / FPS) / np.sin(np.pi * cutoff / FPS)) ** 8)
    middle = slice(600, -600)
    assert filtered.x[middle] == pytest.approx(h * np.sin(2 * np.pi * f * t + 0.4)[middle], abs=1e-4)


def test_interior_is_the_forward_backward_butterworth_filter(rng):
    t = np.arange(3000) / FPS
    x = np.cumsum(rng.normal(size=3000)) * 1e-4
    sos = butter(4, 40.0, fs=FPS, output="sos")
    middle = slice(800, -800)
    ours = low_pass(displacement(t, x), 40.0).x[middle]
    assert rms(ours - sosfiltfilt(sos, x)[middle]) < 2e-3 * rms(x[middle] - np.mean(x[middle]))


def test_cutoff_is_that_of_the_process_that_made_the_signal(rng):
    n, truth = 4000, penalty(50.0, 1 / FPS)
    found = []
    for _ in range(6):
        signal = np.cumsum(np.cumsum(np.cumsum(np.cumsum(rng.normal(size=n))))) / np.sqrt(truth)
        u = np.linspace(-1, 1, n)
        y = signal + rng.normal(size=n)
        y -= np.polyval(np.polyfit(u, y, 3), u)
        found.append(cutoff_of(np.exp(StructureSearch(SmootherData(y, np.ones(n))).stiff.stiffness[0]), 1 / FPS))
    assert np.median(found) == pytest.approx(50.0, rel=0.05)


def test_reason_says_how_the_cutoff_was_chosen(rng):
    t = np.arange(500) / FPS
    x = 0.02 * np.sin(2 * np.pi * 15 * t) + rng.normal(size=500) * NOISE
    reason = low_pass(displacement(t, x)).reason
    assert reason.startswith("a trend cut off at")
    assert reason.endswith("by maximum likelihood")
    assert low_pass(displacement(t, x), 300.0).reason == "cut-off 300 Hz as given"


# -- missing frames, weights, the second coordinate -------------------------------------------------------


def test_missing_rows_and_invalid_rows_mean_the_same(rng):
    t = np.arange(600) / FPS
    x = 0.02 * np.sin(2 * np.pi * 12 * t) + rng.normal(size=600) * NOISE
    valid = np.ones(600, bool)
    valid[[50, 300, 301, 302, 303, 480]] = False
    marked = differentiate(low_pass(displacement(t, x, valid=valid)))
    dropped = differentiate(low_pass(displacement(t[valid], x[valid])))
    for name in ("x", "v", "a", "sigma_x", "sigma_v", "sigma_a"):
        expected = getattr(marked, name)[valid]
        assert getattr(dropped, name) == pytest.approx(expected, rel=1e-3, abs=1e-3 * rms(expected))
    assert marked.sigma_x[301] > 1.05 * marked.sigma_x[150]
    assert np.all(low_pass(displacement(t, x, valid=valid)).sigma_x[~valid] == MISSING_SIGMA)


def test_lost_target_at_the_ends_has_no_motion_there(rng):
    t = np.arange(600) / FPS
    valid = (np.arange(600) > 40) & (np.arange(600) < 500)
    x = 3 * t - 10 * t**2 + rng.normal(size=600) * NOISE
    motion = differentiate(low_pass(displacement(t, x, valid=valid)))
    np.testing.assert_array_equal(motion.t, t[valid])


def test_better_frames_count_more_and_the_level_comes_from_the_data(rng):
    t = np.arange(800) / FPS
    relative = np.where(np.arange(800) % 2, 5.0, 1.0)
    x = 3 * t - 10 * t**2 + rng.normal(size=800) * relative * NOISE
    stated = low_pass(displacement(t, x, sigma=1e-3 * relative))
    assert stated.sigma_x == pytest.approx(relative * NOISE, rel=0.1)
    blind = low_pass(displacement(t, x))
    assert differentiate(stated).sigma_x[400] < 0.6 * differentiate(blind).sigma_x[400]


def test_y_has_a_cutoff_of_its_own_and_may_be_missing(rng):
    t = np.arange(800) / FPS
    y = 2e-3 * np.sin(2 * np.pi * 100 * t) + rng.normal(size=800) * NOISE
    x = 3 * t - 10 * t**2 + rng.normal(size=800) * NOISE
    filtered = low_pass(displacement(t, x, y=y))
    a_y = -2e-3 * (2 * np.pi * 100) ** 2 * np.sin(2 * np.pi * 100 * t)
    motion = differentiate(filtered)
    assert rms(motion.a_y - a_y) < 0.15 * rms(a_y)
    assert 0.5 < rms((motion.a_y - a_y) / motion.sigma_a_y) < 1.2
    without = differentiate(low_pass(displacement(t, x)))
    assert np.all(np.isnan(without.a_y))
    assert np.all(np.isnan(without.sigma_a_y))


# -- accuracy and honest deviations -----------------------------------------------------------------------


# Smoothed errors of a slide count as some ten of white noise: their rms over 4 slides deviates by 11 %, over 15 by 6 %.
@pytest.mark.few(1)
@pytest.mark.parametrize(("repeats", "room"), few_or_many((4, 0.2), (15, 0.1)))
@pytest.mark.parametrize(("vibration", "limit_a", "limit_v"), [(0.0, 0.3, 0.6e-3), (2.0, 0.45, 0.8e-3)])
def test_error_and_deviation_on_a_slide(vibration, limit_a, limit_v, repeats, room):
    t, x, v, a = tustin_slide(vibration)
    error_a, error_v, z = [], [], []
    for seed in range(repeats):
        noise = NOISE * np.random.default_rng(seed).normal(size=len(t))
        m = differentiate(low_pass(displacement(t, x + noise)))
        error_a.append(m.a - a)
        error_v.append(m.v - v)
        z.append([(m.x - x) / m.sigma_x, (m.v - v) / m.sigma_v, (m.a - a) / m.sigma_a])
    assert rms(error_a) < limit_a
    assert rms(error_v) < limit_v
    z_x, z_v, z_a = (rms(part) for part in np.swapaxes(z, 0, 1))
    assert 1.0 - room < z_x < 1.0 + room
    assert 0.9 - room < z_v < 1.05 + room
    assert 0.85 - room < z_a < 1.05 + room


@pytest.mark.slow
@pytest.mark.parametrize("vibration", [0.0, 2.0])
def test_two_deviations_cover_the_truth(vibration):
    t, x, v, a = tustin_slide(vibration)
    inside = []
    for seed in range(100):
        noise = NOISE * np.random.default_rng(seed).normal(size=len(t))
        m = differentiate(low_pass(displacement(t, x + noise)))
        errors = ((m.x - x) / m.sigma_x, (m.v - v) / m.sigma_v, (m.a - a) / m.sigma_a)
        inside.append([np.mean(np.abs(z) < 1.96) for z in errors])
    assert np.all(np.mean(inside, axis=0) > 0.92)


def test_a_cutoff_that_takes_signal_away_says_so():
    t, x, _, _ = tustin_slide(2.0)
    noise = NOISE * np.random.default_rng(0).normal(size=len(t))
    reason = low_pass(displacement(t, x + noise), 45.0).reason
    assert reason.startswith("cut-off 45 Hz as given, maximum likelihood would take 1")
    assert reason.endswith("Hz: the deviations count the signal lost")


@pytest.mark.few(2)
@pytest.mark.parametrize("cutoff", [20.0, 45.0, 150.0, 400.0])
def test_deviations_of_a_given_cutoff_hold_the_signal_lost_too(cutoff):
    t, x, v, a = tustin_slide(2.0)
    z = []
    for seed in range(2):
        noise = NOISE * np.random.default_rng(seed).normal(size=len(t))
        m = differentiate(low_pass(displacement(t, x + noise), cutoff))
        z.append([rms(e) for e in ((m.x - x) / m.sigma_x, (m.v - v) / m.sigma_v, (m.a - a) / m.sigma_a)])
    mean = np.mean(z, axis=0)
    assert np.all((mean > 0.8) & (mean < 1.25)), mean


def test_stiff_smoother_is_the_cubic_of_least_squares():
    n = 400
    q = np.linalg.qr(np.vander(np.linspace(-1, 1, n), 4))[0]
    start = np.arange(n - 1)
    stiff = Structure.low_pass(0.3, 1 / FPS).factor_smoother(SmootherData(np.zeros(n), np.ones(n)))
    found = stiff.noise_variances(start, np.tile([1.0, 0.0], (n - 1, 1)))
    assert found == pytest.approx(np.sum(q**2, axis=1)[:-1], rel=0.03)


def test_guard_of_a_long_record_is_half_a_period(rng):
    t = np.arange(6_200) / 1000.0
    x = 0.1 * np.sin(2 * np.pi * 0.5 * t) + 0.02 * np.sin(2 * np.pi * 3.1 * t) + rng.normal(size=len(t)) * NOISE
    motion = differentiate(low_pass(displacement(t, x)))
    assert np.ceil(500.0 / motion.cutoff) <= motion.guard < 50


# -- push and impact ----------------------------------------------------------------------------------------


def pushed(push=0.004, v=4.0, slowing=30.0, n=300):
    """t, x, a of a mass brought to v by a smooth push, then slowed evenly: closed form."""
    t = np.arange(n) / FPS
    peak = 2 * (v + slowing * push) / push  # of sin^2, whose mean is one half
    u = np.minimum(t, push)
    w = 2 * np.pi / push
    place = peak * (u**2 / 4 + (np.cos(w * u) - 1) / (2 * w**2)) - slowing * t**2 / 2
    place += np.where(t > push, (t - push) * peak * push / 2, 0.0)
    return t, place, np.where(t < push, peak * np.sin(np.pi * t / push) ** 2, 0.0) - slowing


def test_a_push_does_not_smear_into_the_slide(rng):
    t, x, a = pushed()
    motion = differentiate(low_pass(displacement(t, x + rng.normal(size=len(t)) * 1e-6)))
    slide = slice(24, -5)  # the push ends at frame 16
    assert rms(motion.a[slide] - a[slide]) < 1.5
    assert rms((motion.a[slide] - a[slide]) / motion.sigma_a[slide]) < 1.5


@pytest.mark.parametrize("vibration", [0.0, 2.0])
def test_a_slide_without_push_or_impact_has_no_events_and_the_lines_that_it_has(rng, vibration):
    t, x, _, _ = tustin_slide(vibration)
    filtered = low_pass(displacement(t, x + rng.normal(size=len(t)) * NOISE))
    assert filtered.events == ()
    assert filtered.lines == (pytest.approx((60.0,), abs=0.1) if vibration else ())


def stopping(n=600, stop=400):
    """t, x, v, a of a mass slowed evenly to a stop in frame `stop`, where it stays."""
    t = np.arange(n) / FPS
    left = np.maximum(stop / FPS - t, 0.0)
    return t, -10.0 * left**2, 20.0 * left, np.where(left > 0, -20.0, 0.0)


def bouncing(n=600, hit=320):
    """The same of a mass that strikes something in frame `hit` and comes back at a third of its speed."""
    t = np.arange(n) / FPS
    u, fast = t - hit / FPS, 3.0 - 5.0 * hit / FPS
    v = np.where(u < 0, fast - 5.0 * u, -fast / 3 - 5.0 * u)
    return t, np.where(u < 0, fast * u, -fast / 3 * u) - 2.5 * u**2, v, np.full(n, -5.0)


@pytest.mark.parametrize(("made", "row"), [(stopping, 400), (bouncing, 320)])
def test_an_event_is_found_and_not_smeared(rng, made, row):
    t, x, v, a = made()
    motion = differentiate(low_pass(displacement(t, x + rng.normal(size=len(t)) * NOISE)))
    assert len(motion.events) >= 1
    assert min(abs(0.5 * (first + last) - row) for first, last in motion.events) <= 4
    away = np.abs(np.arange(len(t)) - row) > 12  # 3 ms
    assert rms((motion.a - a)[away]) < 0.3
    assert rms((motion.v - v)[away]) < 1e-3
    assert rms(((motion.a - a) / motion.sigma_a)[away]) < 2.0


def test_the_acceleration_at_an_event_lies_anywhere_between_both_sides():
    """A value anywhere between a and b has the standard deviation abs(b - a) / sqrt(12), besides that of the noise."""
    t = np.arange(60) / FPS
    quiet = low_pass(displacement(t, 2.0 * t - 900.0 * t**3, sigma=np.full(60, 1e-7)), 800.0)
    plain, jumped = (differentiate(replace(quiet, events=events)) for events in ((), ((30, 31),)))
    more = np.sqrt(np.maximum(jumped.sigma_a**2 - plain.sigma_a**2, 0.0))
    change = 4 / FPS * 6 * 900.0  # of the acceleration from two frames before to two after, m/s^2
    np.testing.assert_allclose(more[28:34], change / np.sqrt(12.0), rtol=1e-3)
    assert np.all(more[:28] == 0.0)
    assert np.all(more[34:] == 0.0)


@pytest.mark.slow
def test_lines_are_followed_as_far_as_they_wander(rng):
    """A ring-down and two tones, one of them beyond what any low-pass of a slide would let through."""
    t = np.arange(800) / FPS
    parts = [(80e-6, 60.0, 0.05), (10e-6, 134.0, np.inf), (5e-6, 390.0, np.inf)]
    x = 3 * t - 10 * t**2
    a = np.full(len(t), -20.0)
    for size, f, tau in parts:
        s = -1 / tau + 2j * np.pi * f
        x = x + np.real(size * np.exp(s * t))
        a = a + np.real(size * s**2 * np.exp(s * t))
    filtered = low_pass(displacement(t, x + rng.normal(size=len(t)) * 2e-6))
    assert sorted(filtered.lines) == pytest.approx([60.0, 134.0, 390.0], abs=1.5)
    motion = differentiate(filtered)
    assert rms(motion.a - a) < 0.06 * rms(a + 20.0)
    assert 0.5 < rms((motion.a - a) / motion.sigma_a) < 1.3


def test_two_lines_are_never_one_line_with_amplitudes_that_cancel(rng):
    n, peak = 283, 0.56
    swelling = np.linspace(-4.0, 4.0, n) * np.sin(peak * np.arange(n)) + rng.normal(size=n)
    search = StructureSearch(SmootherData(swelling, np.ones(n)))
    tied = Structure((search.highest,), ((peak, 30.0), (peak + 1e-4, 30.0)))
    refined = search.refine(search.scored(tied)).structure
    (first, _), (second, _) = refined.lines
    assert abs(second - first) * n / (2 * np.pi) > 0.1
    found = deviations(refined.factor_smoother(search.data), swelling, 1.0, 1 / FPS)
    assert np.max(found[0]) < 1.0


# -- what a mean is worth --------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHOD_NAMES)
def test_every_text_that_lists_the_filters_names_each(method):
    root = Path(frictrack.__file__).parent
    files = (root / "study" / "optional_keys.toml", root.parent / "docs" / "explanation" / "how_it_works.md")
    others = [path.read_text() for path in files if method != "structural"]  # the default, which they need not name
    assert all(f'"{method}"' in text for text in (MotionTable.__doc__, low_pass.__doc__, *others))


@pytest.mark.few(1)
@pytest.mark.parametrize("repeats", few_or_many(8, 30))
@pytest.mark.parametrize("method", METHOD_NAMES)
def test_covariance_covers_the_error_of_a_mean(method, repeats):
    """Smoothing colours the noise: the mean of many accelerations is far better known than each of them alone says."""
    t = np.arange(240) / FPS
    x, rows = 3 * t - 10 * t**2, np.arange(60, 180)
    means, singles = [], []
    for seed in range(repeats):
        noise = NOISE * np.random.default_rng(seed).normal(size=len(t))
        filtered = low_pass(displacement(t, x + noise), method=method)
        known = covariance(filtered, "a", rows)
        error = differentiate(filtered).a[rows] + 20.0
        means.append(np.mean(error) / np.sqrt(np.mean(known)))
        singles.append(error[60] / np.sqrt(known[60, 60]))
    assert 0.5 < rms(means) < 1.5
    assert 0.4 < rms(singles) < 1.5
    if method != "butterworth":
        motion = differentiate(filtered)
        assert np.sqrt(np.diag(known)) == pytest.approx(motion.sigma_a[rows], rel=0.6)


@pytest.mark.few(8)
@pytest.mark.parametrize("n", range(97, 130))
def test_deviations_of_any_length(n):
    """No length leaves a remainder that cannot be solved."""
    made = FactoredSmoother(
        SmootherData(np.zeros(n), np.ones(n)), np.full(n - 4, 1e9), LineParameters(np.array([0.1]), np.array([1e8]))
    )
    start = np.arange(n - 1)
    found = made.variances(start, np.tile([1.0, 0.0], (n - 1, 1)))
    assert found == pytest.approx(np.diag(made.posterior_covariance_times(np.eye(n)))[:-1], rel=1e-4)


def test_covariance_of_what():
    with pytest.raises(FrictrackError, match='expected x, v or a but got "F"'):
        covariance(low_pass(displacement(np.arange(50) / FPS, np.arange(50.0) ** 2)), "F")


# -- a sensor beside the camera ----------------------------------------------------------------------------------


def test_a_known_acceleration_is_taken_in(rng):
    """What the camera cannot resolve the sensor does; where the sensor is silent the camera goes on alone."""
    t = np.arange(600) / FPS
    x = 3 * t - 10 * t**2 + 2e-6 * np.sin(2 * np.pi * 250 * t)
    a = -20.0 - 2e-6 * (2 * np.pi * 250) ** 2 * np.sin(2 * np.pi * 250 * t)
    sensed = a + 0.5 * rng.normal(size=len(t))
    sensed[400:] = np.nan
    seen = displacement(t, x + NOISE * rng.normal(size=len(t)))
    both = differentiate(low_pass(seen, acceleration=KnownAcceleration(sensed, 0.5)))
    heard = slice(20, 380)
    assert rms((both.a - a)[heard]) < 0.5
    assert 0.8 < rms(((both.a - a) / both.sigma_a)[heard]) < 1.2
    assert rms((both.a - a)[heard]) < 0.5 * rms((differentiate(low_pass(seen)).a - a)[heard])
    assert rms((both.x - x)[heard]) < rms((differentiate(low_pass(seen)).x - x)[heard])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["structural", "savitzky-golay"])
def test_what_is_left_of_a_shake_widens_the_deviations(method):
    """A wave of unknown phase within the pass band: its own derivatives, at their mean square."""
    t = np.arange(800) / FPS
    x = 3 * t - 10 * t**2 + 30e-6 * np.sin(2 * np.pi * 40 * t) + NOISE * np.random.default_rng(4).normal(size=800)
    seen = displacement(t, x)
    plain = differentiate(low_pass(seen, method=method))
    shaken = differentiate(low_pass(replace(seen, shake=(40.0, 5e-6)), method=method))
    middle = slice(200, 600)
    more = np.sqrt(shaken.sigma_a**2 - plain.sigma_a**2)[middle]
    assert more == pytest.approx(np.full(400, 5e-6 * (2 * np.pi * 40) ** 2), rel=0.12)
    assert shaken.shake_a == pytest.approx(0.316, rel=0.12)
    assert shaken.a == pytest.approx(plain.a)


# -- the other methods -------------------------------------------------------------------------------------------


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("method", "limit"), [("kalman", 1.0), ("savitzky-golay", 1.5), ("butterworth", 12.0), ("gaussian-process", 1.0)]
)
def test_other_methods_do_what_they_did_elsewhere(method, limit):
    """Errors of the acceleration at 60 Hz and 10 um, ends included, as other programs of the same kind have them."""
    t, x, _, a = tustin_slide(2.0)
    filtered = low_pass(displacement(t, x + NOISE * np.random.default_rng(3).normal(size=len(t))), method=method)
    assert rms(differentiate(filtered).a - a) < limit
    if method != "kalman":
        assert filtered.reason.startswith(f"{method}, half passes at")


@pytest.mark.parametrize("method", METHOD_NAMES)
def test_every_method_bridges_what_is_missing(rng, method):
    t = np.arange(300) / FPS
    valid = np.ones(300, bool)
    valid[[40, 150, 151, 152]] = False
    x = 3 * t - 10 * t**2
    filtered = low_pass(displacement(t, x + NOISE * rng.normal(size=300), valid=valid), method=method)
    inside = slice(40, -40) if method == "papers" else slice(None)  # that chain distorts the ends
    assert filtered.x[inside] == pytest.approx(x[inside], abs=6 * NOISE)
    assert np.all(np.isfinite(differentiate(filtered).a))


# -- noise level ------------------------------------------------------------------------------------------


def noise_levels(draws, valid, relative=None):
    return np.array([noise_level(x, valid, relative) for x in draws.T]).T


@pytest.mark.parametrize("vibration", [0.0, 2.0])
def test_noise_level_is_unbiased_under_a_slide(rng, vibration):
    t, x, _, _ = tustin_slide(vibration, v0=8.0)
    valid = rng.random(len(t)) > 0.007
    draws = x[:, None] + NOISE * rng.normal(size=(len(t), 999))
    sigma, relative = noise_levels(draws, valid)
    assert rms(sigma) == pytest.approx(NOISE, rel=0.01)
    assert np.std(sigma) == pytest.approx(np.mean(relative) * NOISE, rel=0.12)


def test_noise_level_ignores_an_impact(rng):
    t = np.arange(700) / FPS
    x = np.where(t < 0.1, 4.0 * t, 0.4 - 1.5 * (t - 0.1)) + NOISE * rng.normal(size=700)
    sigma, relative = noise_level(x, np.ones(700, bool))
    assert abs(sigma / NOISE - 1.0) < 4.0 * relative


@pytest.mark.parametrize("n", [200, 700])
@pytest.mark.parametrize("missing", [0.0, 0.02, 0.25])
def test_noise_level_of_white_noise_is_unbiased_and_knows_its_spread(rng, n, missing):
    valid = rng.random(n) >= missing  # a quarter missing leaves too few fifth differences: third ones are taken
    sigma, relative = noise_levels(rng.normal(size=(n, 1000)), valid)
    assert np.mean(sigma**2) == pytest.approx(1.0, abs=4 * 2 * np.mean(relative) / np.sqrt(1000))
    assert (0.8 if missing else 0.9) < np.std(sigma) / np.mean(relative) < 1.1  # gaps part what is correlated


def test_noise_level_of_frames_of_unequal_deviations_is_that_of_a_typical_one(rng):
    size = np.where(np.arange(600) % 200 < 30, 8.0, 1.0)
    sigma, _ = noise_levels(size[:, None] * rng.normal(size=(600, 200)), np.ones(600, bool), size)
    assert np.mean(sigma) == pytest.approx(1.0, abs=0.01)


def test_noise_level_sees_neither_jerks_nor_a_ripple(rng):
    t = np.arange(700) / 2000
    pushed = 2e-3 * np.sin(2 * np.pi * 60 * t) + 3 * t
    ripple = NOISE * np.sin(2 * np.pi * 0.12 * np.arange(700))  # of peak locking, an eighth of a pixel a frame
    draws = (pushed + ripple)[:, None] + NOISE * rng.normal(size=(700, 300))
    sigma, _ = noise_levels(draws, np.ones(700, bool))
    assert rms(sigma) == pytest.approx(NOISE, rel=0.02)
    jerks = np.diff(pushed, 3)
    assert np.sqrt(1 + np.mean(jerks**2) / 20 / NOISE**2) > 1.02  # third differences would see them


def test_noise_level_needs_four_neighbours():
    assert np.isnan(noise_level(np.arange(9.0), np.arange(9) % 2 == 0)[0])


# -- bad input --------------------------------------------------------------------------------------------


def test_bad_positions_are_refused():
    t = np.arange(50) / FPS
    with pytest.raises(FrictrackError, match="at least 8 valid frames but got 0 of 50; check that the target"):
        low_pass(displacement(t, np.full(50, np.nan), valid=np.zeros(50, bool)))
    with pytest.raises(FrictrackError, match="at least 8 valid frames but got 2 of 2"):
        low_pass(displacement(t[:2], np.arange(2.0)))
    with pytest.raises(FrictrackError, match=r"expected a moving target but x is 0\.3 m in all 50 valid frames"):
        low_pass(displacement(t, np.full(50, 0.3)))


def test_bad_time_is_refused():
    t = np.arange(50) / FPS
    uneven = t.copy()
    uneven[20] += 0.05 / FPS
    with pytest.raises(FrictrackError, match=r"evenly spaced frames but the interval after t = 0\.00475 s is 1\.05 "):
        low_pass(displacement(uneven, t))
    glitch = t.copy()
    glitch[-1] = 3600.0
    with pytest.raises(FrictrackError, match=r"few missing frames but 1\.44e\+07 frame intervals pass"):
        low_pass(displacement(glitch, t))


@pytest.mark.parametrize("cutoff", [0.0, -3.0, 2000.0, np.nan])
def test_bad_cutoff_is_refused(cutoff):
    t = np.arange(50) / FPS
    with pytest.raises(FrictrackError, match="between 0 and half the frame rate, 2000 Hz, but got"):
        low_pass(displacement(t, t), cutoff)


def test_bad_methods_are_refused():
    t = np.arange(50) / FPS
    with pytest.raises(FrictrackError, match=r'expected filter as one of structural, kalman, .* but got "wavelet"'):
        low_pass(displacement(t, t), method="wavelet")
    with pytest.raises(FrictrackError, match='expected no cutoff with filter = "kalman"'):
        low_pass(displacement(t, t), 100.0, method="kalman")
    x = np.arange(3001.0) ** 2
    with pytest.raises(FrictrackError, match="at most 3000 frames for a Gaussian process but got 3001"):
        low_pass(displacement(np.arange(3001) / FPS, x), method="gaussian-process")


def test_derivatives_by_another_filter_need_no_second_smoothing(monkeypatch):
    t = np.arange(300) / 1000
    x = 2 * t - t**2 + 1e-5 * np.random.default_rng(0).standard_normal(300)
    nan = np.full(300, np.nan)
    filtered = low_pass(Displacement(t, x, nan, nan, np.full(300, 1e-5), nan, np.ones(300, bool)), method="kalman")
    expected = differentiate(filtered)
    monkeypatch.setattr("frictrack.measure.motion.derivative.best_smoothing", lambda asked: pytest.fail("smoothed"))
    assert np.array_equal(derivatives(filtered), [expected.x, expected.v, expected.a])
