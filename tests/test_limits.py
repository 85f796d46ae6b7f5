"""Detection limits of effects with several coefficients: that of the size, whatever the units of the others."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import ncx2

from frictrack.diagnose import power
from frictrack.diagnose.examination import ScannedCandidate
from frictrack.effects import LIBRARY


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(6)


def left_of(columns: np.ndarray) -> float:
    """What of the first column no sum of the others explains, squared: by least squares."""
    rest = columns[:, 1:]
    away = columns[:, 0] - rest @ np.linalg.lstsq(rest, columns[:, 0], rcond=None)[0]
    return float(away @ away)


@pytest.mark.parametrize("unit", [1.0, 1e-4, 1e4])
def test_further_coefficients_hide_what_they_can_in_whatever_unit(rng, unit):
    columns = rng.normal(size=(50, 3)) @ rng.normal(size=(3, 3)) * [1.0, unit, 1.0 / unit]
    gram = (columns.T @ columns)[None]
    gain, square = power._first_coefficient_gain(gram, np.einsum("gkk->gk", gram))
    assert gain[0] == pytest.approx(left_of(columns), rel=1e-8)
    assert square[0] == pytest.approx(columns[:, 0] @ columns[:, 0])


def test_an_amplitude_is_judged_at_the_phase_that_shows_least(rng):
    columns = rng.normal(size=(50, 2))
    gram = (columns.T @ columns)[None]
    gain, _ = power._wave_gain(gram, np.einsum("gkk->gk", gram))
    phases = np.linspace(0, np.pi, 20001)
    seen = np.sum((columns @ [np.cos(phases), np.sin(phases)]) ** 2, axis=0)
    assert gain[0] == pytest.approx(seen.min(), rel=1e-6)


@pytest.mark.parametrize(("runs", "penalty"), [(1, 0.0), (3, 2 * np.log(700.0))])
def test_the_limit_is_found_in_95_of_100_repeats_and_an_event_pays_for_its_time_and_size(runs, penalty):
    """Columns of squared norm 25 and 4 at two times: the second shows least. BIC of two parameters is 2 ln N."""
    squares = np.array([25.0, 4.0])[:, None, None]
    values = np.array([[0.01, 1e-3], [0.02, 1e-3]])  # s
    names = ("time", "width")
    grid = SimpleNamespace(effect=LIBRARY["collision"], size=1, names=names, values=values)
    grid.point = lambda g: dict(zip(names, values[g], strict=True))
    scan = SimpleNamespace(grid=grid, schur=lambda projector: squares[..., None], squares=squares)
    draws = SimpleNamespace(unbounded_projector=None, series=SimpleNamespace(measured=np.zeros(700)))
    scanned = ScannedCandidate(LIBRARY["collision"], [scan] * runs, np.zeros(3), quantile=9.0)
    found, curve = power.detection_limit(scanned, draws, critical=6.0)
    np.testing.assert_allclose(ncx2.sf(15.0 + penalty, 1, curve["limit"] ** 2 * [25.0, 4.0]), 0.95, rtol=1e-6)
    assert (found["value"], found["unit"], found["at"]["time"]) == (curve["limit"][1], "N s", 0.02)
