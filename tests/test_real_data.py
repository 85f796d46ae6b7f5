"""Measurements made by others: what a diagnosis names in them.

The strokes of a tribometer and the EMPS extract stand in frictrack/samples/data, with licence and citation.
"""

from __future__ import annotations

import numpy as np
import pytest

from frictrack import samples
from frictrack.diagnose import diagnose
from frictrack.diagnose.examination import list_candidates
from frictrack.fit import fit
from frictrack.fit.observations import weight_by_noise
from frictrack.measure.motion import differentiate, low_pass
from frictrack.records import Displacement, Run
from frictrack.study import read_table

COLUMNS = {"t": "Time [s]", "x": "Position [mm]", "friction": "-Friction [uN]"}
RATE = 200.0  # Hz, of the EMPS extract


@pytest.fixture(scope="module")
def strokes():
    table = read_table(samples.DATA / "tribometer" / "strokes.txt", COLUMNS)
    nan = np.full(len(table.t), np.nan)
    seen = Displacement(table.t, table.x, nan, nan, np.full(len(nan), 1e-7), nan, np.ones(len(nan), bool))
    motion = differentiate(low_pass(seen, method="kalman"))
    return Run(seen, motion, friction_N=table.friction, name="strokes", normal_load=5.0)


@pytest.mark.slow
def test_the_tribometer_names_memory_and_no_velocity_term(strokes):
    found = diagnose(fit("coulomb,viscous", [strokes]))
    assert found.missing[0] == "maxwell_slip"  # the knee is sharper than that of presliding
    assert "presliding" in {c.effect for c in found.candidates}
    assert not {"stribeck", "drag", "viscous_modulation"} & set(found.missing)
    best = found.best
    assert best.effect == "maxwell_slip"
    assert best.p == 0.001
    assert best.heldout_after < 0.3 * best.heldout_before
    assert any("that does not repeat between" in remark for remark in found.remarks)


def test_effects_of_reversals_are_tried_where_a_load_cell_sees_reversals(strokes):
    found, excluded = list_candidates(fit("coulomb,viscous", [strokes]).solution)
    assert "bouc_wen" not in excluded
    assert "bouc_wen" in {e.name for e in found}


def test_the_noise_of_the_tribometer_is_what_differs_from_stroke_to_stroke(strokes):
    solution = fit("coulomb,viscous", [strokes]).solution
    counted, noise = weight_by_noise(solution)
    left = np.concatenate([r.r * r.piece.sigma for r in solution.responses])
    assert noise.stroke_count >= 6
    assert noise.rms < 0.1 * float(np.std(left))  # the law's misfit is the same in every stroke, and no noise
    assert counted.chi2 > 10 * counted.problem.n_frames


def test_white_noise_of_a_cell_stays_what_its_differences_say():
    rng = np.random.default_rng(0)
    t = np.arange(2000) / 1000.0
    v = 0.3 * np.cos(2 * np.pi * 1.5 * t)
    nan = np.full(len(t), np.nan)
    seen = Displacement(t, np.cumsum(v) / 1000, nan, nan, np.full(len(t), 1e-6), nan, np.ones(len(t), bool))
    force = 8 * np.sign(v) + 2 * v + 0.05 * rng.standard_normal(len(t))
    run = Run(seen, differentiate(low_pass(seen, method="kalman")), friction_N=force)
    _, noise = weight_by_noise(fit("coulomb,viscous", [run]).solution)
    assert noise.rms == pytest.approx(0.05, rel=0.1)
    assert noise.correlation_frames == 1.0


@pytest.fixture(scope="module")
def carriage():
    """Six seconds of the EMPS at 200 Hz, driven to and fro."""
    q, drive = np.loadtxt(samples.DATA / "emps_200Hz.csv", delimiter=",").T
    n = int(6 * RATE)
    t, nan = np.arange(n) / RATE, np.full(n, np.nan)
    seen = Displacement(t, q[:n], nan, nan, nan, nan, np.ones(n, bool))
    return Run(seen, differentiate(low_pass(seen, method="kalman")), drive=drive[:n], name="carriage")


@pytest.mark.release
@pytest.mark.slow
def test_the_carriage_names_friction_that_depends_on_the_direction(carriage):
    found = diagnose(fit("coulomb,viscous", [carriage]))
    assert (found.missing or found.leads)[0] == "asymmetry"  # what is left beside it, no effect explains
    assert found.best.p == 0.001
