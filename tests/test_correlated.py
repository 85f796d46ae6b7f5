"""Noise that is alike in neighbouring frames: found in the spectrum, told from motion, and whitened exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from runs import MASS, measured
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from frictrack.diagnose import diagnose
from frictrack.fit import fit
from frictrack.fit.pieces import Whitening
from frictrack.measure.motion import NoiseStretch, correlated_noise
from frictrack.records import Run

FPS = 4000.0
RMS = 1e-5  # m


@pytest.fixture
def rng():
    """Random numbers."""
    return np.random.default_rng(5)


def autoregressive(rng, n, rho, rms=RMS):
    """Noise of order one, stationary from its first frame on."""
    return rms * lfilter([np.sqrt(1 - rho**2)], [1.0, -rho], rng.standard_normal(n + 400))[400:]


def slid(n, v0, *, texture=0.0, shaken=0.0):
    """Positions of a mass under dry and viscous friction, a rough course and a vibration, by another integrator, m."""

    def law(t, y):
        force = 8.0 + 1.2 * y[1] + texture * np.sin(2 * np.pi * y[0] / 0.03)
        return [y[1], -(force + shaken * np.exp(-t / 0.02) * np.sin(2 * np.pi * 61.0 * t)) / MASS]

    t = np.arange(n) / FPS
    return solve_ivp(law, (0.0, t[-1]), [0.0, v0], t_eval=t, rtol=1e-10, atol=1e-12).y[0]


@pytest.fixture(scope="module")
def slides():
    """Slides of some lengths without noise, m."""
    return [slid(n, v0) for n, v0 in ((400, 4.0), (480, 4.5), (350, 3.5), (450, 4.2))]


def found_in(stretches):
    """Correlated noise of some positions."""
    return correlated_noise([NoiseStretch(x) for x in stretches])


def spectral_level(noise):
    """Variance that a slow signal meets, over that of white noise of the same size: the density at frequency zero."""
    c, share = noise.correlation, noise.share
    return 1 - share + share * (1 + c) / (1 - c)


# ---------------------------------------------------------------- found in the spectrum


@pytest.mark.few(1)
@pytest.mark.parametrize(("rho", "white"), [(0.3, 0.0), (0.6, 0.0), (0.8, 0.5), (0.9, 0.0)])
def test_correlated_noise_is_found_with_its_size_and_its_level_at_low_frequencies(slides, rng, rho, white):
    levels, sizes = [], []
    for _ in range(8):
        noise = [autoregressive(rng, len(x), rho) + white * RMS * rng.standard_normal(len(x)) for x in slides]
        found = found_in([x + e for x, e in zip(slides, noise, strict=True)])
        assert found is not None
        levels.append(np.mean(found.rms**2) * spectral_level(found))
        sizes.append(np.mean(found.rms))
    assert np.mean(sizes) == pytest.approx(RMS * np.hypot(1.0, white), rel=0.1)
    truth = RMS**2 * ((1 + rho) / (1 - rho) + white**2)
    assert np.sqrt(np.median(levels) / truth) == pytest.approx(1.0, abs=0.25)


@pytest.mark.slow
def test_white_noise_is_not_called_correlated(slides, rng):
    alarms = [found_in([x + RMS * rng.standard_normal(len(x)) for x in slides]) for _ in range(40)]
    assert sum(a is not None for a in alarms) <= 1


@pytest.mark.parametrize("moved", [{"texture": 2.0}, {"shaken": 20.0}, {"texture": 2.0, "shaken": 10.0}])
def test_what_moves_the_mass_is_not_called_noise(rng, moved):
    moving = [slid(n, v0, **moved) for n, v0 in ((400, 4.0), (480, 4.5), (350, 3.5))]
    still = [slid(n, v0) for n, v0 in ((400, 4.0), (480, 4.5), (350, 3.5))]
    away = [x - y - np.polyval(np.polyfit(np.arange(len(x)), x - y, 2), np.arange(len(x)))
            for x, y in zip(moving, still, strict=True)]  # fmt: skip
    assert min(np.std(d) for d in away) > 3 * RMS  # it is there to be seen
    for _ in range(5):
        assert found_in([x + RMS * rng.standard_normal(len(x)) for x in moving]) is None


def test_a_lost_frame_and_a_blow_are_not_called_noise(rng):
    """A jump and a kink have wide spectra."""
    lengths = ((400, 4.0), (480, 4.5), (350, 3.5))
    jumps = [slid(n, v0) + 1e-3 * (np.arange(n) > n // 3) for n, v0 in lengths]
    kinks = [slid(n, v0) - 0.5 / FPS * np.maximum(np.arange(n) - n // 2, 0) for n, v0 in lengths]
    for moving in (jumps, kinks, jumps[:1], kinks[:1]):
        assert found_in([x + RMS * rng.standard_normal(len(x)) for x in moving]) is None


def test_short_stretches_have_no_spectrum():
    assert found_in([]) is None
    assert found_in([np.arange(30.0)]) is None


def test_stretches_of_all_lengths_are_searched_together_as_if_each_were_alone(slides, rng):
    noisy = [x + autoregressive(rng, len(x), 0.6) for x in slides]
    together = NoiseStretch.evidence([NoiseStretch(x) for x in noisy], 0.1)
    alone = [NoiseStretch.evidence([NoiseStretch(x)], 0.1)[0] for x in noisy]
    assert together == pytest.approx(np.array(alone), abs=1e-8)
    assert np.max(together) > 1.0


# ---------------------------------------------------------------- whitened


@pytest.fixture
def noisy(rng):
    """Times with missing frames, white noise that differs (one frame of unknown size), and the dense covariance."""
    t = np.delete(np.arange(40) * 0.1, [5, 6, 20])
    sigma = rng.uniform(0.5, 1.5, len(t))
    sigma[8] *= 1e4
    covariance = 4.0 * np.exp(-np.abs(t[:, None] - t) / 0.7) + np.diag(sigma**2)
    return Whitening.of(t, sigma, (2.0, 0.7)), covariance


def test_whitening_makes_the_dense_covariance_one(noisy):
    way, covariance = noisy
    matrix = way.whitened(np.eye(len(covariance)))
    assert matrix @ covariance @ matrix.T == pytest.approx(np.eye(len(covariance)), abs=1e-7)


def test_whitening_has_its_inverse_and_its_transposes(noisy):
    way, covariance = noisy
    one = np.eye(len(covariance))
    forth, back = way.whitened(one), way.coloured(one)
    assert forth @ back == pytest.approx(one, abs=1e-9)
    assert way.transposed(one) == pytest.approx(forth.T, abs=1e-12)
    assert way.coloured_transposed(one) == pytest.approx(back.T, rel=1e-9)
    rows = np.arange(float(len(one)))
    assert way.whitened(np.stack([rows, rows]).T[:, :, None]).shape == (len(one), 2, 1)
    assert way.whitened(rows) == pytest.approx(forth @ rows, abs=1e-9)


# ---------------------------------------------------------------- through the fit and the diagnosis


def runs_with(rho, rng, n=420):
    """Runs of a known law whose displacement has correlated noise."""
    made = []
    for i, v0 in enumerate((3.6, 4.0, 4.4, 4.8)):
        x = slid(n, v0) + autoregressive(rng, n, rho)
        run = measured(np.arange(n) / FPS, x, sigma=0.0, name=f"r{i}", rng=rng)
        made.append(replace(run, free=(0.0, float(run.displacement.t[-1]))))
    return made


@pytest.mark.slow
def test_chi_squared_is_one_and_nothing_is_named_where_only_the_noise_is_correlated(rng):
    fitted = fit("coulomb, viscous", runs_with(0.8, rng))
    assert fitted.reduced_chi2 == pytest.approx(1.0, abs=0.12)
    said = diagnose(fitted)
    assert said.missing == []
    assert said.verdict in ("complete", "undetermined")
    assert said.noise_um == pytest.approx(1e6 * RMS, rel=0.25)


def test_the_noise_of_a_run_is_searched_once_and_again_where_the_run_differs(rng, monkeypatch):
    runs = runs_with(0.8, rng)
    searched = []
    search = NoiseStretch.spectrum.func
    monkeypatch.setattr(NoiseStretch.spectrum, "func", lambda own: searched.append(own) or search(own))
    first = fit("coulomb", runs).solution.problem.pieces
    assert len(searched) == len(runs)
    again = fit("coulomb, viscous", runs).solution.problem.pieces
    assert len(searched) == len(runs)
    assert {p.correlated for p in again} == {p.correlated for p in first}
    assert all(p.correlated for p in again)
    shorter = replace(runs[0], free=(0.0, 0.8 * runs[0].free[1]))
    fit("coulomb", [shorter, *runs[1:]])
    assert len(searched) == len(runs) + 1


def test_a_stated_noise_is_taken_at_its_word(rng):
    runs = [replace(run, noise=RMS) for run in runs_with(0.8, rng)]
    assert all(not p.correlated for p in fit("coulomb, viscous", runs).solution.problem.pieces)


def test_uneven_rows_are_no_correlated_noise(rng):
    """Their differences hold the motion: a chi-squared of 1e-5 and deviations ten times too large came of it."""
    runs = []
    for k, speed in enumerate((4.0, 4.5, 3.5, 4.2)):
        kept = np.sort(rng.choice(500, 200, replace=False))
        t, x = kept / FPS, slid(500, speed)[kept]
        runs.append(Run.from_arrays(t, x + 1e-6 * rng.standard_normal(200), mass=MASS, name=f"r{k}"))
    made = fit("coulomb, viscous", runs)
    assert made.reduced_chi2 == pytest.approx(1.0, abs=0.2)
    assert not made.solution.problem.pieces[0].correlated
