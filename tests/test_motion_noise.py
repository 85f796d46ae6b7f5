"""Correlated noise in the smoothing of the motion, against dense algebra and slides by scipy's integrator."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import toeplitz
from scipy.signal import lfilter

from frictrack.measure.motion import CorrelatedNoise, Smoother, cutoff_tradeoff, differentiate, low_pass
from frictrack.measure.motion.banded_equations import LineParameters, NoiseColour, SmootherData
from frictrack.measure.motion.smoother import FactoredSmoother, variances_of
from frictrack.records import Displacement

FPS, MASS, NOISE = 4000.0, 0.35, 2e-5
COLOURS = [NoiseColour(0.6, 0.999), NoiseColour(0.9, 0.7)]


def slid(n=690, texture=0.0):
    """Time, place, velocity and acceleration (n,) of a slide over a rough course."""

    def acceleration(x, v):
        return -(6.0 + 6.0 * np.exp(-v / 0.4) + 1.2 * v + texture * np.sin(2 * np.pi * x / 0.03)) / MASS

    t = np.arange(n) / FPS
    options = {"t_eval": t, "rtol": 1e-11, "atol": 1e-13, "max_step": 1e-3}
    x, v = solve_ivp(lambda t, y: [y[1], acceleration(*y)], (0.0, t[-1]), [0.0, 5.5], **options).y
    return t, x, v, acceleration(x, v)


def noise(seed, n, correlation, share):
    """Of rms one: an autoregressive series, stationary from its first frame on, beside a white one."""
    rng = np.random.default_rng([seed, 3])
    shocks = np.sqrt(1 - correlation**2) * rng.standard_normal(n + 2000)
    return np.sqrt(share) * lfilter([1.0], [1.0, -correlation], shocks)[2000:] + np.sqrt(1 - share) * rng.normal(size=n)


def seen(t, y):
    nan = np.full(len(t), np.nan)
    return Displacement(t, y, nan, nan, np.full(len(t), NOISE), nan, np.ones(len(t), bool))


def covariance(colour, n):
    return (1 - colour.share) * np.eye(n) + colour.share * toeplitz(colour.correlation ** np.arange(n))


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("lines", [0, 1])
@pytest.mark.parametrize("colour", COLOURS)
def test_smoother_and_variances_agree_with_dense_algebra(colour, lines):
    n, rng = 60, np.random.default_rng(4)
    lam, omega, mu = 1e3 * np.exp(rng.normal(size=n - 4)), np.array([0.5])[:lines], np.array([1e3])[:lines]
    made = FactoredSmoother(SmootherData(rng.normal(size=n), np.ones(n), colour=colour), lam, LineParameters(omega, mu))
    every, known = np.hstack([np.eye(n)] * (1 + lines)), np.linalg.inv(covariance(colour, n))
    normal = every.T @ known @ every
    fourth = np.diff(np.eye(n), 4, axis=0)
    normal[:n, :n] += fourth.T @ np.diag(lam) @ fourth
    if lines:
        obeyed = np.diff(np.eye(n), 2, axis=0) + 2 * (1 - np.cos(0.5)) * np.eye(n)[1:-1]
        normal[n:, n:] += 1e3 * obeyed.T @ obeyed
    inverse = every @ np.linalg.inv(normal) @ every.T
    assert made.signal(made.unknowns()) == pytest.approx(inverse @ known @ made.data.y, abs=1e-7)
    assert made.data.apply_inverse_covariance(made.data.y) == pytest.approx(known @ made.data.y, rel=1e-6, abs=1e-6)
    assert made.posterior_covariance_times(np.eye(n)) == pytest.approx(inverse, rel=1e-6, abs=1e-8)
    start, ones = np.arange(n - 1), np.tile([1.0, 0.0], (1, n - 1, 1))
    assert made.variances(start, ones)[0] == pytest.approx(np.diag(inverse)[:-1], rel=1e-6)
    passed = np.diag(inverse @ known @ inverse)[:-1]
    assert made.noise_variances(start, ones)[0] == pytest.approx(passed, rel=2e-3)
    stiffer = FactoredSmoother(made.data, 9 * lam, LineParameters(omega, mu))
    both = variances_of([made, stiffer], start, ones)
    assert both == pytest.approx(np.array([f.variances(start, ones) for f in (made, stiffer)]), rel=1e-9)


def test_the_likelihood_of_noise_is_that_of_the_dense_covariance():
    n, rng = 50, np.random.default_rng(6)
    y = rng.normal(size=n) + np.linspace(0, 3, n) ** 2
    free, fourth = np.vander(np.arange(n) / n, 4), np.diff(np.eye(n), 4, axis=0)
    shaken = np.linalg.lstsq(fourth, np.eye(len(fourth)))[0]

    def dense(colour):
        v = (covariance(colour, n) if colour else np.eye(n)) + shaken @ shaken.T / 1e3
        inverse = np.linalg.inv(v)
        inside = free.T @ inverse @ free
        p = inverse - inverse @ free @ np.linalg.solve(inside, free.T @ inverse)
        return (n - 4) * np.log(y @ p @ y / (n - 4)) + np.linalg.slogdet(v)[1] + np.linalg.slogdet(inside)[1]

    def ours(colour):
        return FactoredSmoother(
            SmootherData(y, np.ones(n), colour=colour), np.full(n - 4, 1e3)
        ).restricted_likelihood()[0]

    for colour in COLOURS:
        assert ours(colour) - ours(None) == pytest.approx(dense(colour) - dense(None), abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("correlation", "share"), [(0.5, 1.0), (0.9, 1.0), (0.9, 0.8)])
def test_deviations_hold_in_correlated_noise(correlation, share):
    t, x, v, a = slid()
    z, off = [], []
    for seed in range(2):
        m = differentiate(low_pass(seen(t, x + NOISE * noise(seed, len(t), correlation, share))))
        z.append([(m.x - x) / m.sigma_x, (m.v - v) / m.sigma_v, (m.a - a) / m.sigma_a])
        off.append(m.a - a)
    assert all(0.5 < rms(part) < 1.4 for part in np.swapaxes(z, 0, 1))
    assert rms(off) < 1.5  # of 20 to 35 m/s^2; a smoother that takes the noise for white follows it: above 10


@pytest.mark.slow
@pytest.mark.parametrize("share", [1.0, 0.8])
@pytest.mark.parametrize("correlation", [0.5, 0.8, 0.9, 0.95])
def test_deviations_hold_in_correlated_noise_of_any_kind(correlation, share):
    t, x, v, a = slid()
    z = []
    for seed in range(12):
        m = differentiate(low_pass(seen(t, x + NOISE * noise(seed, len(t), correlation, share))))
        z.append([(m.x - x) / m.sigma_x, (m.v - v) / m.sigma_v, (m.a - a) / m.sigma_a])
    assert all(0.65 < rms(part) < 1.4 for part in np.swapaxes(z, 0, 1))


def test_noise_that_other_runs_have_shown_is_taken_into_a_short_one():
    """Two hundred frames alone show a correlation only roughly."""
    t, x, v, _ = slid(200)
    record = seen(t, x + NOISE * noise(1, len(t), 0.9, 1.0))
    given, alone = (low_pass(record, noise=n) for n in (CorrelatedNoise(0.9, 1.0, np.array([NOISE])), None))
    assert Smoother.read(given.smoother).colour == NoiseColour(0.9, 0.999)
    assert "correlated (0.9 from frame to frame)" in given.reason
    assert Smoother.read(alone.smoother).colour.correlation == pytest.approx(0.9, abs=0.2)
    assert given.x != pytest.approx(alone.x, abs=1e-9)
    assert rms((differentiate(given).v - v) / differentiate(given).sigma_v) < 2.0


@pytest.mark.few(1)
@pytest.mark.parametrize("texture", [0.0, 2.0])
def test_white_noise_and_a_rough_course_are_not_called_correlated(texture):
    t, x, _, _ = slid(texture=texture)
    for seed in range(3):
        filtered = low_pass(seen(t, x + NOISE * noise(seed, len(t), 0.0, 0.0)))
        assert Smoother.read(filtered.smoother).colour is None
        assert "correlated" not in filtered.reason


def test_a_plain_low_pass_is_judged_by_the_noise_that_there_is():
    """Above the cut-off, correlated noise has less than white noise of the same size, below it more."""
    t, x, _, _ = slid()
    curves = []
    for correlation in (0.0, 0.9):
        seen_x = seen(t, x + NOISE * noise(2, len(t), correlation, 1.0))
        filtered = low_pass(seen_x)
        curves.append(cutoff_tradeoff(seen_x, filtered, differentiate(filtered)))
    assert curves[1].noise[0] > 2.0 * curves[0].noise[0]
    assert curves[1].noise[-1] < curves[0].noise[-1]
