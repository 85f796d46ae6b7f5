"""Scans of a candidate: few nodes instead of many frequencies, runs one by one, columns of any size.

The truth is the long way: every grid point computed itself, and all runs in one least-squares problem written out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from runs import BASE, Spec, study

from frictrack import effects
from frictrack.diagnose import power
from frictrack.diagnose.examination import draw_null_ensemble
from frictrack.effects import models
from frictrack.fit import fit
from frictrack.fit.linearised import (
    candidate_grids,
    linearise,
    measured_series,
    scan_candidate,
    scan_candidates,
)
from frictrack.fit.linearised.waves import WaveFrame

LAW = ["coulomb", "viscous"]
SPECS = (Spec(3.0, 1, 0.06), Spec(5.0, 1, 0.08), Spec(4.0, 2, 0.05), Spec(-4.0, 1, 0.06), Spec(3.5, 1, 0.07))
DRAWS = 30


@pytest.fixture(scope="module")
def solution():
    law = {name: BASE[name] for name in LAW}
    runs, _ = study(models.of(law), law, specs=SPECS, sigma=1e-5, scatter=0.05, rng=np.random.default_rng(5))
    return fit(LAW, runs).solution


@pytest.fixture(scope="module")
def ensemble(solution):
    return draw_null_ensemble(solution, np.random.default_rng(1), DRAWS)


@pytest.mark.parametrize("name", ["vibration", "texture", "camera_shake", "load_modulation", "decaying_vibration"])
def test_interpolated_waves_gain_what_waves_computed_at_every_frequency_gain(ensemble, name):
    effect, every = effects.get(name), replace(effects.get(name), scan_wave=None)
    fast, slow = (_scan(ensemble, e) for e in (effect, every))
    np.testing.assert_allclose(fast.gains, slow.gains, rtol=2e-3, atol=2e-2)
    assert (0, effect.acts_on) in ensemble.series.kept or name == "texture"  # plain waves in time are shared by effects
    np.testing.assert_allclose(fast.max_gains, slow.max_gains, rtol=1e-3)
    left = ensemble.unbounded_projector
    np.testing.assert_allclose(fast.schur(left), slow.schur(left), rtol=0, atol=2e-3 * np.abs(slow.schur(left)).max())
    g = int(np.argmax(slow.gains))
    data = ensemble.series.coordinates[:, 0]
    np.testing.assert_allclose(fast.coefficients(g, left, data), slow.coefficients(g, left, data), rtol=0.02, atol=1e-5)


@pytest.mark.parametrize("name", ["vibration", "texture", "patch", "drag"])
def test_gains_of_draws_are_those_of_all_runs_in_one_least_squares_problem(ensemble, name):
    law, series = ensemble.law, ensemble.series
    (grid,) = candidate_grids(law, effects.get(name))
    g = len(grid.values) // 2
    grid = replace(grid, values=grid.values[g : g + 1], shape=(1,) * len(grid.shape))
    rows = np.zeros((len(series.measured), grid.size))
    for i, block in zip(grid.members, grid.block, strict=True):
        piece, mine = law.pieces[i], slice(block * grid.k, (block + 1) * grid.k)
        raw = grid.raw_columns(piece, grid.values)[0]
        rows[law.rows[i], mine] = piece.data_of(raw, grid.effect.acts_on == "measurement").T
    u, gains = law.basis.u, []
    draws = _series_written_out(ensemble)
    for tau, profile in zip(series.taus, series.profile, strict=True):
        metric = np.eye(len(u)) - u @ law.basis.shrink(tau) @ u.T
        products = rows.T @ metric @ draws
        if grid.size == 1 and grid.low[0] >= 0:
            products = np.maximum(products, 0)
        gain = np.einsum("kd,kl,ld->d", products, np.linalg.pinv(rows.T @ metric @ rows), products)
        gains.append(profile - gain)
    expected = series.profile.min(axis=0) - np.min(gains, axis=0)
    found = scan_candidate(law, grid, series)
    np.testing.assert_allclose(found.max_gains, expected, rtol=1e-3, atol=1e-3)


def _series_written_out(ensemble):
    """The whitened data and draws: residuals with what the model absorbs put back."""
    law, series = ensemble.law, ensemble.series
    out = np.array(series.residuals, dtype=float)
    for t, columns in enumerate(series.groups):
        out[:, columns] += (
            law.basis.u @ law.basis.shrink(series.taus[t]) @ (law.basis_coordinates.T @ series.coordinates[:, columns])
        )
    return out


def test_grids_scanned_together_gain_what_each_gains_alone(ensemble):
    names = ["drag", "spring", "patch", "vibration", "load_modulation", "clock_rate", "stribeck"]
    grids = [grid for name in names for grid in candidate_grids(ensemble.law, effects.get(name))]
    for grid, found in zip(grids, scan_candidates(ensemble.law, grids, ensemble.series), strict=True):
        alone = scan_candidate(ensemble.law, grid, ensemble.series)
        assert found.grid is grid
        np.testing.assert_allclose(found.gains, alone.gains, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(found.max_gains, alone.max_gains, rtol=1e-5, atol=1e-5)
        for own, other in zip(found.products, alone.products, strict=True):
            np.testing.assert_allclose(own.gram, other.gram, rtol=1e-6, atol=1e-9 * np.abs(other.gram).max())
        left, data, g = ensemble.unbounded_projector, ensemble.series.coordinates[:, 0], int(np.argmax(alone.gains))
        np.testing.assert_allclose(found.coefficients(g, left, data), alone.coefficients(g, left, data), rtol=1e-4)


@pytest.mark.parametrize("decades", [0.0, 100.0])
def test_gains_do_not_depend_on_the_size_of_the_columns(ensemble, decades):
    patch = effects.get("patch")
    (grid,) = candidate_grids(ensemble.law, patch)
    wide = grid.values[grid.values[:, 1] == grid.values[:, 1].max()][20:40]  # a run reaches every one of them
    grid = replace(grid, values=wide, shape=(len(wide), 1))

    def columns(path, nonlinear):  # squares leave the range of a float32, at all points or from point to point
        size = 10 ** (37 + decades * np.asarray(nonlinear["x_c"]))
        return patch.columns(path, nonlinear) * size.reshape(-1, 1)

    expected = scan_candidate(ensemble.law, grid, ensemble.series)
    found = scan_candidate(ensemble.law, replace(grid, effect=replace(patch, columns=columns)), ensemble.series)
    np.testing.assert_allclose(found.gains, expected.gains, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(found.max_gains, expected.max_gains, rtol=1e-4)


def _scan(ensemble, effect):
    return scan_candidate(ensemble.law, candidate_grids(ensemble.law, effect)[0], ensemble.series)


@pytest.mark.parametrize("decay", [0.0, 3.0, 12.0])
def test_sums_of_plain_waves_are_the_waves(decay):
    u = np.sort(np.random.default_rng(2).uniform(0.3, 0.8, 400))
    envelope, q = np.exp(-decay * (u - 0.3) / 0.5), np.linspace(5.0, 90.0, 130)
    frame = WaveFrame(u)
    sums = frame.sums(envelope)
    assert sums is not None
    used, weights = frame.weights(sums, q)
    plain = np.exp(2j * np.pi * frame.spacing * np.outer(np.arange(used.start, used.stop), u))
    found = weights @ np.stack([plain.imag, plain.real], axis=1).reshape(-1, len(u))
    phase = 2 * np.pi * np.outer(q, u)
    np.testing.assert_allclose(found[:, 0], envelope * np.sin(phase), atol=1e-4)
    np.testing.assert_allclose(found[:, 1], envelope * np.cos(phase), atol=1e-4)


def test_an_envelope_with_a_step_is_no_sum_of_plain_waves():
    u = np.linspace(0.0, 1.0, 300)
    assert WaveFrame(u).sums(np.sign(u - 0.4)) is None


@pytest.mark.parametrize("name", ["presliding", "friction_lag"])
def test_columns_that_the_model_absorbs_gain_nothing(ensemble, name):
    (grid,) = candidate_grids(ensemble.law, effects.get(name))
    assert scan_candidate(ensemble.law, grid, ensemble.series).max_gains.max() < 1e-3


def test_measured_data_alone_gain_what_they_gain_among_draws(solution, ensemble):
    law = linearise(solution)
    (grid,) = candidate_grids(law, effects.get("patch"))
    alone = scan_candidate(law, grid, measured_series(law))
    among = scan_candidate(ensemble.law, grid, ensemble.series)
    np.testing.assert_allclose(alone.gains, among.gains, rtol=0.05, atol=0.05)  # the scatter is read off a grid there


def test_a_column_that_no_run_reaches_leaves_the_limit_of_the_first_as_it_is():
    schur = np.array([[[4.0, 0.0], [0.0, 1e-312]]])
    gain, square = power._first_coefficient_gain(schur, np.array([[4.0, 1e-312]]))
    assert gain[0] == pytest.approx(4.0)
    assert square[0] == 4.0
