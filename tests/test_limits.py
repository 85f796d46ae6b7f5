"""Detection limits of effects with several coefficients: that of the size, whatever the units of the others."""

from __future__ import annotations

import numpy as np
import pytest

from frictrack.diagnose import detection_limits


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
    gain, square = detection_limits._first_coefficient_gain(gram, np.einsum("gkk->gk", gram))
    assert gain[0] == pytest.approx(left_of(columns), rel=1e-8)
    assert square[0] == pytest.approx(columns[:, 0] @ columns[:, 0])


def test_an_amplitude_is_judged_at_the_phase_that_shows_least(rng):
    columns = rng.normal(size=(50, 2))
    gram = (columns.T @ columns)[None]
    gain, _ = detection_limits._wave_gain(gram, np.einsum("gkk->gk", gram))
    phases = np.linspace(0, np.pi, 20001)
    seen = np.sum((columns @ [np.cos(phases), np.sin(phases)]) ** 2, axis=0)
    assert gain[0] == pytest.approx(seen.min(), rel=1e-6)
