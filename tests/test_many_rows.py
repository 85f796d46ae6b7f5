"""Records of very many rows: equations that are solved part by part, and the memory that a row takes."""

from __future__ import annotations

import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from frictrack.measure.motion import smoother as equations
from frictrack.measure.motion.banded_equations import LineParameters, NoiseColour, SmootherData
from frictrack.measure.motion.derivative import deviations
from frictrack.measure.motion.grid import stencils
from frictrack.measure.motion.smoother import FactoredSmoother

N, PART = 1300, 300
RNG = np.random.default_rng(0)
CASES = {
    "trend": (1e6, (), (), None, False),
    "soft trend": (1.0, (), (), None, False),
    "stiff trend": (1e13, (), (), None, False),
    "lines of constant amplitude": (1e8, (0.3, 1.2), (np.exp(40.0), np.exp(24.0)), None, False),
    "coloured noise": (1e6, (), (), NoiseColour(0.8, 0.6), False),
    "a sensor, and gaps": (1e6, (0.3,), (1e5,), NoiseColour(0.8, 0.6), True),
}


def smoother(name, n=N):
    lam, omega, mu, colour, sensed = CASES[name]
    w = RNG.uniform(0.5, 2.0, n)
    if sensed:
        w[RNG.random(n) < 0.2] = w[n // 3 : n // 2] = 0.0
    bent, weights = (RNG.normal(size=n - 2), RNG.uniform(0.1, 5.0, n - 2)) if sensed else (None, None)
    y = np.where(w > 0, RNG.normal(size=n) + 10 * np.sin(np.arange(n) / 50), 0.0)
    lines = LineParameters(np.array(omega), np.array(mu))
    return FactoredSmoother(SmootherData(y, w, bent, weights, colour), lam * np.exp(RNG.normal(size=n - 4)), lines)


def solved(made, part, monkeypatch):
    """Number of parts, and all that is computed of a smoother in parts of so many frames."""
    fresh = FactoredSmoother(made.data, made.lam, made.lines)
    monkeypatch.setattr(equations, "PART_UNKNOWNS", part * fresh._layout(equations.END_FRAMES).group)
    loss, variance, unknowns = fresh.restricted_likelihood()
    columns = np.stack([made.data.y, made.data.y[::-1]], axis=1)
    found = fresh.signal(unknowns), fresh.smooth(columns), fresh.posterior_covariance_times(columns)
    return len(fresh.cuts) - 1, loss, variance, found, fresh.posterior_and_noise_variance(*stencils(N, 1e-3))


@pytest.mark.parametrize("name", CASES)
def test_parts_are_solved_as_the_whole_record_is(name, monkeypatch):
    made = smoother(name)
    one, loss, variance, whole, spread = solved(made, 10 * N, monkeypatch)
    many, loss_of_parts, variance_of_parts, parts, spread_of_parts = solved(made, PART, monkeypatch)
    assert one == 1
    assert many >= 3
    assert loss_of_parts == pytest.approx(loss, abs=1e-5)
    assert variance_of_parts == pytest.approx(variance, rel=1e-9)
    posterior = np.sqrt(spread[0, 0])
    for q, of_parts in zip(whole[:2], parts[:2], strict=True):
        assert np.max(np.abs(q - of_parts).T / posterior) < 1e-6
    np.testing.assert_allclose(parts[2], whole[2], atol=1e-5 * np.max(np.abs(whole[2])))
    np.testing.assert_allclose(spread_of_parts[0], spread[0], rtol=1e-5)
    assert np.max(np.abs(spread_of_parts[1] - spread[1]) / spread[0]) < 1e-3  # of a difference of penalties by 1 %


def memory_of_a_row(first, second, work):
    """Bytes by which the largest memory of some work grows from one number of rows to the next, by row."""
    peaks = []
    for n in (first, first, second):  # the first time, what is kept for all lengths is computed
        made = smoother("trend", n)
        tracemalloc.start()
        work(made)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    return (peaks[2] - peaks[1]) / (second - first)


def test_a_row_takes_little_memory():
    def work(made):
        made.restricted_likelihood()
        made.smooth(made.data.y)

    assert memory_of_a_row(100_000, 130_000, work) < 120  # both of more parts than those whose factors are kept


@pytest.mark.slow
def test_the_deviations_of_a_row_take_little_memory():
    assert memory_of_a_row(150_000, 200_000, lambda made: deviations(made, made.data.y, 1.0, 1e-3)) < 250


MEASURED = """
import resource, sys
from frictrack.flow import Session, open_study
Session(open_study(sys.argv[1])).measure("friction")
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
"""


@pytest.mark.release
@pytest.mark.slow
def test_a_table_of_many_rows_is_measured_in_bounded_memory(tmp_path: Path):
    n = 300_000  # 1.1 GB before the equations were solved part by part
    t = np.arange(n) * 1e-4
    x = 0.05 * np.sin(3.1 * t) + 0.01 * np.sin(0.8 * t + 0.3) + 1e-5 * RNG.standard_normal(n)
    np.savetxt(tmp_path / "r.csv", np.stack([t, x], axis=1), "%.4f,%.9f", header="t_s,x_m", comments="")
    (tmp_path / "study.toml").write_text('[study]\nmass = 0.35\n[[run]]\ntable = "r.csv"\n')
    command = [sys.executable, "-c", MEASURED, str(tmp_path / "study.toml")]
    found = subprocess.run(command, capture_output=True, text=True, check=True)
    assert int(found.stdout.splitlines()[-1]) < 650e6
