"""Low-pass, noise level and derivatives against closed forms, dense algebra, scipy.signal and solve_ivp."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import butter, sosfiltfilt

from frictrack.errors import FrictrackError
from frictrack.motion import differentiate, lag1, low_pass, noise_level
from frictrack.motion.smoother import MISSING, best_cutoff, deviations, penalty, smooth
from frictrack.records import Displacement

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


@pytest.mark.parametrize("lam", [1e-2, 1e3, 1e7])
def test_smoother_and_covariance_agree_with_dense_algebra(rng, lam):
    n = 61
    w = rng.uniform(0.5, 2.0, n)
    w[[0, 20, 21, 22]] = 0.0
    y = rng.normal(size=n)
    d = np.diff(np.eye(n), 3, axis=0)
    normal = np.diag(w) + lam * d.T @ d
    assert smooth(y, w, lam) == pytest.approx(np.linalg.solve(normal, w * y), abs=1e-6)

    start = np.minimum(np.arange(n), n - 4)
    stencils = rng.normal(size=(2, n, 4))
    covariance = np.linalg.inv(np.diag(np.maximum(w, 1e-10)) + lam * d.T @ d)
    noise = covariance @ np.diag(np.maximum(w, 1e-10)) @ covariance
    for share in (0.0, 1.0, 0.3):
        total = noise + share * (covariance - noise)
        near = [total[s : s + 4, s : s + 4] for s in start]
        expected = np.sqrt(np.einsum("kij,ijl,kil->ki", stencils, near, stencils))
        assert deviations(w, lam, share, start, stencils) == pytest.approx(expected, rel=2e-3)


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
    h = 1.0 / (1.0 + (np.sin(np.pi * f / FPS) / np.sin(np.pi * cutoff / FPS)) ** 6)
    middle = slice(600, -600)
    assert filtered.x[middle] == pytest.approx(h * np.sin(2 * np.pi * f * t + 0.4)[middle], abs=1e-4)


def test_interior_is_the_forward_backward_butterworth_filter(rng):
    t = np.arange(3000) / FPS
    x = np.cumsum(rng.normal(size=3000)) * 1e-4
    sos = butter(3, 40.0, fs=FPS, output="sos")
    middle = slice(800, -800)
    ours = low_pass(displacement(t, x), 40.0).x[middle]
    assert rms(ours - sosfiltfilt(sos, x)[middle]) < 2e-3 * rms(x[middle] - np.mean(x[middle]))


def test_cutoff_is_that_of_the_process_that_made_the_signal(rng):
    n, truth = 4000, penalty(50.0, 1 / FPS)
    found = []
    for _ in range(8):
        signal = np.cumsum(np.cumsum(np.cumsum(rng.normal(size=n)))) / np.sqrt(truth)
        found.append(best_cutoff(signal + rng.normal(size=n), np.ones(n), 1 / FPS))
    assert np.median(found) == pytest.approx(50.0, rel=0.05)


def test_reason_says_how_the_cutoff_was_chosen(rng):
    t = np.arange(500) / FPS
    x = 0.02 * np.sin(2 * np.pi * 15 * t) + rng.normal(size=500) * NOISE
    by_itself = low_pass(displacement(t, x))
    assert by_itself.reason == f"cut-off {by_itself.cutoff:.3g} Hz by maximum likelihood"
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
    assert np.all(low_pass(displacement(t, x, valid=valid)).sigma_x[~valid] == MISSING)


def test_lost_target_at_the_ends_widens_the_deviation(rng):
    t = np.arange(600) / FPS
    valid = (np.arange(600) > 40) & (np.arange(600) < 500)
    x = 3 * t - 10 * t**2 + rng.normal(size=600) * NOISE
    motion = differentiate(low_pass(displacement(t, x, valid=valid)))
    assert motion.sigma_x[-1] > 2 * motion.sigma_x[450]
    assert motion.sigma_x[0] > 1.1 * motion.sigma_x[45]


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
    assert filtered.cutoff_y > 100.0 > filtered.cutoff
    a_y = -2e-3 * (2 * np.pi * 100) ** 2 * np.sin(2 * np.pi * 100 * t)
    motion = differentiate(filtered)
    assert rms(motion.a_y - a_y) < 0.15 * rms(a_y)
    assert 0.5 < rms((motion.a_y - a_y) / motion.sigma_a_y) < 1.2
    without = differentiate(low_pass(displacement(t, x)))
    assert np.all(np.isnan(without.a_y))
    assert np.all(np.isnan(without.sigma_a_y))


# -- accuracy and honest deviations -----------------------------------------------------------------------


@pytest.mark.parametrize(("vibration", "limit_a", "limit_v"), [(0.0, 0.55, 1.0e-3), (2.0, 1.05, 1.5e-3)])
def test_error_and_deviation_on_a_slide(vibration, limit_a, limit_v):
    t, x, v, a = tustin_slide(vibration)
    error_a, error_v, z = [], [], []
    for seed in range(15):
        noise = NOISE * np.random.default_rng(seed).normal(size=len(t))
        m = differentiate(low_pass(displacement(t, x + noise)))
        error_a.append(m.a - a)
        error_v.append(m.v - v)
        z.append([(m.x - x) / m.sigma_x, (m.v - v) / m.sigma_v, (m.a - a) / m.sigma_a])
    assert rms(error_a) < limit_a
    assert rms(error_v) < limit_v
    z_x, z_v, z_a = (rms(part) for part in np.swapaxes(z, 0, 1))
    assert 0.9 < z_x < 1.2
    assert 0.85 < z_v < 1.2
    assert 0.7 < z_a < 1.2


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
    assert reason.startswith("cut-off 45 Hz as given, maximum likelihood would take 13")
    assert reason.endswith("Hz: the deviations do not cover the signal lost")


def test_stiff_smoother_is_the_parabola_of_least_squares():
    n = 400
    q = np.linalg.qr(np.vander(np.linspace(-1, 1, n), 3))[0]
    start = np.arange(n - 1)
    found = deviations(np.ones(n), penalty(0.3, 1 / FPS), 1.0, start, np.tile([1.0, 0.0], (n - 1, 1)))
    assert found == pytest.approx(np.sqrt(np.sum(q**2, axis=1))[:-1], rel=1e-6)


def test_guard_of_a_long_record_is_half_a_period(rng):
    t = np.arange(24_800) / 1000.0
    x = 0.1 * np.sin(2 * np.pi * 0.5 * t) + 0.02 * np.sin(2 * np.pi * 3.1 * t) + rng.normal(size=len(t)) * NOISE
    motion = differentiate(low_pass(displacement(t, x)))
    assert motion.guard == np.ceil(500.0 / motion.cutoff)


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


def test_a_push_is_filtered_apart_and_does_not_smear_into_the_slide(rng):
    t, x, a = pushed()
    motion = differentiate(low_pass(displacement(t, x + rng.normal(size=len(t)) * 1e-6)))
    assert len(motion.breaks) == 2
    assert 16 <= motion.breaks[1] <= 26  # the push ends at frame 16
    assert motion.cutoff < 200.0
    slide = slice(motion.breaks[1] + 5, -5)
    assert rms(motion.a[slide] - a[slide]) < 1.5
    assert rms((motion.a[slide] - a[slide]) / motion.sigma_a[slide]) < 1.5


@pytest.mark.parametrize("vibration", [0.0, 2.0])
def test_a_slide_without_push_or_impact_is_one_stretch(rng, vibration):
    t, x, _, _ = tustin_slide(vibration)
    assert low_pass(displacement(t, x + rng.normal(size=len(t)) * NOISE)).breaks == (0,)


# -- noise level ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("vibration", [0.0, 2.0])
def test_noise_level_is_unbiased_under_a_slide_and_vectorises(rng, vibration):
    t, x, _, _ = tustin_slide(vibration, v0=8.0)
    valid = rng.random(len(t)) > 0.007
    draws = x[:, None] + NOISE * rng.normal(size=(len(t), 999))
    sigma, relative = noise_level(draws, valid)
    assert sigma.shape == relative.shape == (999,)
    assert rms(sigma) == pytest.approx(NOISE, rel=0.01)
    assert np.std(sigma) == pytest.approx(np.mean(relative) * NOISE, rel=0.12)
    assert noise_level(draws[:, 3], valid)[0] == pytest.approx(sigma[3], rel=1e-12)


def test_noise_level_ignores_an_impact(rng):
    t = np.arange(700) / FPS
    x = np.where(t < 0.1, 4.0 * t, 0.4 - 1.5 * (t - 0.1)) + NOISE * rng.normal(size=700)
    sigma, relative = noise_level(x, np.ones(700, bool))
    assert abs(sigma / NOISE - 1.0) < 4.0 * relative


def test_noise_level_needs_four_neighbours():
    assert np.isnan(noise_level(np.arange(9.0), np.arange(9) % 2 == 0)[0])


def test_lag1_sees_correlated_noise_and_passes_white_noise(rng):
    valid = np.ones(4000, bool)
    z = []
    for _ in range(60):
        r, spread = lag1(rng.normal(size=4000), valid)
        z.append(r / spread)
    assert rms(z) == pytest.approx(1.0, abs=0.3)
    white = rng.normal(size=20_001)
    r, spread = lag1(white[1:] + 0.5 * white[:-1], np.ones(20_000, bool))
    assert r == pytest.approx(0.4, abs=5 * spread)


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
