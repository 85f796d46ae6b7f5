"""Where a run is followed in one piece and where it starts afresh, on sliders of known truth and on the EMPS."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import butter, filtfilt
from test_mass import F_C, F_V, LAW, MASS, RATE, seen, slide

from frictrack.fit import fit, restore, state
from frictrack.records import Displacement, Motion, Run

EMPS = Path(__file__).parent / "data" / "emps_200Hz.csv"


def slow(size):
    """A force that no law of the library holds, N."""
    return lambda t: size * np.sin(2 * np.pi * 0.37 * t + 0.5)


def in_one_piece(monkeypatch, model, runs):
    with monkeypatch.context() as patch:
        patch.setattr(sys.modules["frictrack.fit"], "segment_frames", lambda *_: 0)
        return fit(model, runs)


@pytest.fixture(scope="module")
def pulled():
    return slide(unknown=slow(1.0))


def test_a_slow_force_that_nobody_modelled_is_forgotten(pulled, monkeypatch):
    runs = [seen(*pulled, 1e-5, 1)]
    whole, cut = in_one_piece(monkeypatch, LAW, runs), fit(LAW, runs)
    assert whole.lengths == (0,)
    assert cut.lengths[0] > 0
    error = [abs(f.parameters["mass.m"].value / MASS - 1) for f in (whole, cut)]
    assert error[1] < 0.02
    assert error[0] > 2 * error[1]


def test_deviations_hold_what_is_not_modelled(pulled):
    found = fit(LAW, [seen(*pulled, 1e-5, 2)]).parameters
    for address, true in {"mass.m": MASS, "coulomb.F_c": F_C, "viscous.F_v": F_V}.items():
        assert abs(found[address].value - true) < 3 * found[address].std


def test_the_noisier_the_film_the_longer_it_is_followed():
    pulled = slide(unknown=slow(0.2))
    lengths = [fit(LAW, [seen(*pulled, sigma, 3)]).lengths[0] for sigma in (2e-6, 2e-4)]
    assert 0 < lengths[0] < lengths[1]


def test_count_and_length_of_segments_are_reported(pulled):
    whole, cut = (fit(LAW, [seen(*course, 1e-5, 4)]) for course in (slide(), pulled))
    row = cut.summary()["per_run"][0]
    assert row["segments"] == len(cut.solution.problem.pieces) > 20
    assert row["segment_s"] == pytest.approx(cut.lengths[0] / RATE, rel=0.3)
    row = whole.summary()["per_run"][0]
    assert row["segments"] < 8  # of one direction each
    assert row["segment_s"] == pytest.approx(0.486, abs=0.05)


def test_frames_of_segments_neither_repeat_nor_get_lost(pulled):
    found = fit(LAW, [seen(*pulled, 1e-5, 5)])
    frames = np.concatenate([p.frames for p in found.solution.problem.pieces])
    assert np.all(np.diff(frames) > 0)
    whole = fit(LAW, [seen(*slide(), 1e-5, 5)])
    assert len(frames) >= 0.97 * whole.solution.problem.n_frames


def test_a_stored_fit_is_rebuilt_with_its_segments(pulled):
    runs = [seen(*pulled, 1e-5, 6)]
    found = fit(LAW, runs)
    again = restore(runs, state(found))
    assert again.lengths == found.lengths
    assert again.parameters["mass.m"].std == pytest.approx(found.parameters["mass.m"].std, rel=1e-3)


def test_a_run_without_drive_stays_whole():
    def nothing(t):
        return 0.0 * t

    t, x, v = slide(push=nothing, unknown=slow(2.0), duration=0.15)
    run = seen(t, x, v, 1e-6, 7, push=nothing, mass=MASS)
    free = Run(run.displacement, run.motion, mass=MASS)
    assert fit(LAW, [free]).lengths == (0,)


# ---------------------------------------------------------------- a machine


@pytest.fixture(scope="module")
def emps():
    q, push = np.loadtxt(EMPS, delimiter=",").T
    t = np.arange(len(q)) / 200.0
    x = filtfilt(*butter(4, 40.0, fs=200.0), q)
    v = np.gradient(x, t)
    nan, one = np.full(len(t), np.nan), np.ones(len(t))
    disp = Displacement(t, q, nan, nan, nan, nan, np.ones(len(t), bool))
    motion = Motion(t, x, v, np.gradient(v, t), nan, 1e-7 * one, 1e-5 * one, 1e-2 * one, nan, guard=5, cutoff=40.0)
    return Run(disp, motion, name="emps", drive=push)


def test_mass_and_friction_of_the_emps_are_those_published(emps):
    """Janot, Gautier & Brunot 2019: M 95.1089 kg, F_c 20.3935 N, F_v 203.5034 N s/m, offset -3.1648 N, from 1 kHz."""
    found = fit("coulomb,viscous,slope", [emps])
    published = {"mass.m": 95.1089, "coulomb.F_c": 20.3935, "viscous.F_v": 203.5034, "slope.F": -3.1648}
    for (address, value), within in zip(published.items(), (0.01, 0.05, 0.05, 0.1), strict=True):
        e = found.parameters[address]
        assert e.value == pytest.approx(value, rel=within), address
        assert abs(e.value - value) < 3.5 * e.std, address
    assert 0.05 < found.summary()["per_run"][0]["segment_s"] < 0.2
    assert found.errors["relative_force_error"] < 0.07  # published: 4.1 % after decimation


def test_the_screw_of_the_emps_is_worn_in_one_direction(emps):
    """The same: F_v 166.7061 forth and 240.4236 back."""
    found = fit("coulomb,viscous,slope,asymmetry", [emps])
    assert found.parameters["asymmetry.dF_v"].value == pytest.approx((166.7061 - 240.4236) / 2, rel=0.1)
    assert found.parameters["slope.F"].reason.startswith("these runs cannot tell it from asymmetry.dF")
