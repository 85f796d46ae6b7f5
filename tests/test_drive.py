"""Measured drives: their clock told from the motion they make, and the forms in which a study file gives them."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from frictrack.base.errors import FrictrackError
from frictrack.flow import Session, open_study
from frictrack.flow.stored_results import run_summaries
from frictrack.measure.motion import differentiate, low_pass
from frictrack.measure.sensors import Alignment, SensorRecord, align_drive
from frictrack.records import Array, Displacement

MASS, F_C, F_V = 0.35, 1.2, 0.4  # kg, N, N s/m
PARTS = ((0.03, 13.2, 0.3), (0.012, 33.3, 1.1), (0.004, 73.5, 2.0))  # m, rad/s, rad: a motion that reverses
DELAY = 3.37e-3  # s
HEADER = {"delimiter": ",", "comments": ""}


def x_true(t: Array) -> Array:
    return np.asarray(sum(a * np.sin(w * t + p) for a, w, p in PARTS))


def drive_true(t: Array) -> Array:
    """m a + F(v), in closed form: a kink wherever the motion turns."""
    v = sum(a * w * np.cos(w * t + p) for a, w, p in PARTS)
    a = sum(-a * w * w * np.sin(w * t + p) for a, w, p in PARTS)
    return np.asarray(MASS * a + F_C * np.sign(v) + F_V * v)


def film(rng: np.random.Generator, n: int = 2000, sigma: float = 1e-5) -> Displacement:
    t = np.arange(n) / 2000.0
    nan = np.full(n, np.nan)
    seen = x_true(t) + sigma * rng.standard_normal(n)
    return Displacement(t, seen, nan, nan, np.full(n, sigma), nan, np.ones(n, bool))


def alignment_of(seed: int, rate: float = 1e3, n: int = 2000) -> Alignment:
    rng = np.random.default_rng(seed)
    seen = film(rng, n)
    ts = np.arange(-0.2, n / 2000.0 + 0.2, 1 / rate) + rng.uniform(0, 1 / rate)
    felt = drive_true(ts - DELAY) + 0.05 * rng.standard_normal(len(ts))
    return align_drive(seen, differentiate(low_pass(seen)), SensorRecord(ts, felt, "drive.csv"))


@pytest.mark.few(1)
@pytest.mark.parametrize("rate", [1e3, 1e4])
def test_the_offset_of_a_drive_and_the_mass_are_found(rate: float) -> None:
    found = alignment_of(1, rate)
    assert found.gain is not None
    assert abs(found.offset + DELAY) < 4 * (found.sigma_offset or 0.0)
    assert found.sigma_offset is not None
    assert found.sigma_offset < 2e-5
    assert abs(1 / found.gain - MASS) < 4 * (found.sigma_gain or 0.0) * MASS**2


@pytest.mark.release
@pytest.mark.slow
def test_z_scores_of_the_drives_offset_are_standard() -> None:
    z = []
    for seed in range(120):
        found = alignment_of(seed)
        z.append((found.offset + DELAY) / float(found.sigma_offset or np.nan))
    assert 0.88 < np.sqrt(np.mean(np.square(z))) < 1.15


def test_a_constant_drive_keeps_zero_and_says_why() -> None:
    seen = film(np.random.default_rng(0), 400)
    motion = differentiate(low_pass(seen))
    ts = np.arange(-0.1, 0.4, 1e-3)
    for values in (0 * ts + 3, 2 + 3 * ts):  # a ramp shifts into itself and a constant
        found = align_drive(seen, motion, SensorRecord(ts, values, "drive.csv"))
        assert (found.offset, found.sigma_offset) == (0.0, None)
        assert "0 is kept" in found.reason


def force(t: Any) -> Any:
    """A push of 20 ms that ends at t = 30 ms, N."""
    return np.where((t > 0.01) & (t < 0.03), 60.0 * np.sin(np.pi * (t - 0.01) / 0.02) ** 2, 0.0)


FINE = np.arange(0, 0.16, 1e-5)  # s


@cache
def slid() -> tuple[Array, Array, Array]:
    """Displacement, velocity and acceleration at `FINE` of a slider under that push and friction, by midpoint steps."""
    h, x, v = 1e-5, 0.0, 0.0
    rows = []
    for push in force(FINE + h / 2):
        a = (push - F_C - F_V * v) / MASS if v > 0.0 or push > F_C else 0.0
        rows.append((x, v, a))
        x, v = x + h * (v + h * a / 2), v + h * a
    return tuple(np.array(rows).T)


@pytest.fixture
def study_file(tmp_path: Path) -> Path:
    """A slider pushed by a piston, as a table, and the piston's pressure on a clock that is 4 ms late."""
    rng = np.random.default_rng(3)
    t = np.arange(480) / 4000.0
    x = np.interp(t, FINE, slid()[0])
    np.savetxt(tmp_path / "push.csv", np.c_[t, x + 5e-6 * rng.standard_normal(len(t))], header="t_s,x_m", **HEADER)
    ts = np.arange(-0.05, 0.2, 1e-4)
    bar = force(ts) / 3.14e-4 / 1e5 + 0.002 * rng.standard_normal(len(ts))
    np.savetxt(tmp_path / "p.csv", np.c_[1e3 * (ts + 4e-3), bar], header="Time (ms),p (bar)", **HEADER)
    return tmp_path / "study.toml"


PRESSURE = 'drive = {table = "p.csv", area = "3.14 cm^2", columns = {t = "Time (ms)", pressure = "p (bar)"}%s}'


def opened(path: Path, keys: str, mass: str = '"0.35 kg"') -> Session:
    path.write_text(f'[study]\nmass = {mass}\n[[run]]\nname = "push"\ntable = "push.csv"\n{keys}\n')
    return Session(open_study(path))


def test_a_pressure_drives_and_its_clock_is_found(study_file: Path) -> None:
    work = opened(study_file, PRESSURE % "").runs[0]
    sensors = work.get("sensors")
    clock = sensors.clocks["drive"]
    assert abs(clock["offset_s"] + 4e-3) < 5 * clock["sigma_offset_s"]
    assert clock["sigma_offset_s"] < 2.5e-4
    assert np.max(sensors.drive) == pytest.approx(60.0, rel=0.02)
    assert abs(sensors.t[np.argmax(sensors.drive)] - 0.02) < 1.5e-3
    assert any(
        note.startswith("p.csv: its clock is 4.0") and "ahead of the camera" in note for note in sensors.notes
    ), sensors.notes
    with h5py.File(study_file.parent / "study_results" / "push.h5") as file:
        stored = file["sensors/clocks/drive"].attrs
        assert {"offset_s", "sigma_offset_s", "gain", "sigma_gain", "bias", "sigma_bias", "reason"} <= set(stored)
        assert file["sensors/drive"].attrs["unit"] == "N"


def test_a_given_offset_is_taken_and_the_drive_ends_at_release(study_file: Path) -> None:
    sensors = opened(study_file, PRESSURE % ', offset = "-4 ms", until = "release"').runs[0].get("sensors")
    assert sensors.clocks["drive"]["offset_s"] == -4e-3
    assert sensors.clocks["drive"]["sigma_offset_s"] is None
    released = next(note for note in sensors.notes if "none after the release" in note)
    at = float(released.split(" at ")[1].split()[0])
    assert 0.024 < at < 0.034
    assert np.all(sensors.drive[sensors.t > at] == 0.0)
    assert np.max(sensors.drive) == pytest.approx(60.0, rel=0.02)


def test_a_constant_drive_and_none(study_file: Path) -> None:
    t = np.arange(480) / 4000.0
    np.testing.assert_array_equal(opened(study_file, 'drive = "2.5 N"').runs[0].get("sensors").drive, np.full(480, 2.5))
    until = opened(study_file, 'drive = {force = 2, until = "50 ms"}').runs[0].get("sensors").drive
    ends = np.where(t < 0.0499, 2.0, 0.0)
    ends[200] = 1.0  # half of the interval around the frame at 50 ms
    np.testing.assert_allclose(until, ends, atol=1e-9)
    assert opened(study_file, 'drive = "none"').runs[0].get("sensors").drive is None


def test_a_drive_that_does_not_last_is_refused(study_file: Path) -> None:
    (study_file.parent / "short.csv").write_text("t_s,drive_N\n0,1\n0.03,2\n")
    with pytest.raises(FrictrackError) as caught:
        opened(study_file, 'drive = {table = "short.csv", offset = 0}').runs[0].get("sensors")
    assert "short.csv: expected values over 0 to 0.11975 s, as long as the run, but got 0 to 0.03 s" in str(
        caught.value
    )
    assert "correct its offset" in str(caught.value)
    opened(study_file, 'drive = {table = "short.csv", offset = 0, until = "25 ms"}').runs[0].get("sensors")


def test_short_gaps_of_a_drive_are_bridged_and_said(study_file: Path) -> None:
    ts = np.arange(-0.01, 0.13, 1e-3)
    rows = "\n".join(f"{t},{'' if 0.06 < t < 0.065 else 3 + t}" for t in ts)
    (study_file.parent / "gap.csv").write_text(f"t_s,drive_N\n{rows}\n")
    sensors = opened(study_file, 'drive = {table = "gap.csv", offset = 0}').runs[0].get("sensors")
    np.testing.assert_allclose(sensors.drive, 3 + sensors.t, atol=1e-6)
    assert any("bridged by straight lines" in note for note in sensors.notes)


def test_a_drive_that_moves_another_mass_is_said(study_file: Path) -> None:
    rows = run_summaries(opened(study_file, PRESSURE % "", mass='"0.7 kg"').runs, "motion")
    assert any("the drive moves a mass of 0.3" in note and "0.7 kg was weighed" in note for note in rows[0]["notes"])
    rows = run_summaries(opened(study_file, PRESSURE % "").runs, "motion")
    assert not any("was weighed" in note for note in rows[0]["notes"])
    assert rows[0]["sensors"]["drive"]["gain"] == pytest.approx(1 / MASS, rel=0.1)


def test_an_accelerometer_beside_the_camera_is_fused(study_file: Path) -> None:
    rng = np.random.default_rng(8)
    ts = np.arange(-0.05, 0.2, 1e-4)
    a = np.interp(ts, FINE, slid()[2]) + 0.5 * rng.standard_normal(len(ts))
    np.savetxt(study_file.parent / "acc.csv", np.c_[ts - 2e-3, a / 9.80665], header="t_s,acc (g)", **HEADER)
    keys = 'sensor = {table = "acc.csv", columns = {a = "acc (g)"}}\nimpact_energy = "2 J"'
    work = opened(study_file, keys).runs[0]
    sensors = work.get("sensors")
    clock = sensors.clocks["a"]
    assert clock["verdict"] == "consistent", clock
    assert abs(clock["offset_s"] - 2e-3) < 5 * clock["sigma_offset_s"]
    known = np.isfinite(sensors.known_a)
    assert np.mean(known) > 0.99
    free = (sensors.t > 0.035) & (sensors.t < 0.11)
    truth = np.interp(sensors.t, FINE, slid()[2])
    assert np.std((sensors.known_a - truth)[free]) == pytest.approx(sensors.sigma_known_a, rel=0.25)
    row = run_summaries([work], "friction")[0]
    energy = 0.5 * MASS * np.max(slid()[1]) ** 2
    assert row["impact"]["E_kin_J"] == pytest.approx(energy, rel=0.03)
    assert row["impact"]["verdict"] == "plausible"
    assert any("acc.csv agrees with the camera: they differ by" in note for note in row["notes"])


def test_an_impossible_energy_and_a_wrong_unit_are_said(study_file: Path) -> None:
    ts = np.arange(-0.05, 0.2, 1e-4)
    a = np.interp(ts, FINE, slid()[2]) + 0.1 * np.random.default_rng(0).normal(size=len(ts))
    np.savetxt(study_file.parent / "acc.csv", np.c_[ts, a / 9.80665], header="t_s,a_m_s2", **HEADER)
    work = opened(study_file, 'sensor = "acc.csv"\nimpact_energy = "0.1 J"').runs[0]
    row = run_summaries([work], "motion")[0]
    assert row["sensors"]["a"]["verdict"] == "disagrees"
    assert work.get("sensors").known_a is None
    assert any("disagrees with the camera and is not used; its gain is 9.8" in note for note in row["notes"])
    assert row["impact"]["verdict"] == "impossible"
    assert any("is more than the 0.1 J of the blow" in note for note in row["notes"])


def test_a_sensor_that_does_not_overlap_the_film_is_refused(study_file: Path) -> None:
    ts = np.arange(5.0, 5.3, 1e-3)
    noise = np.random.default_rng(0).normal(size=len(ts))
    np.savetxt(study_file.parent / "acc.csv", np.c_[ts, noise], header="t_s,a_m_s2", **HEADER)
    with pytest.raises(FrictrackError, match=r"acc\.csv: expected values over 0 to 0\.11975 s.* but got 5 to 5\.299 s"):
        opened(study_file, 'sensor = "acc.csv"').runs[0].get("sensors")


def test_friction_from_a_load_cell_finds_its_clock_beside_a_drive(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    t, ts = np.arange(1500) / 2000.0, np.arange(-0.1, 0.9, 5e-4)
    v = sum(a * w * np.cos(w * ts + p) for a, w, p in PARTS)
    felt = F_C * np.sign(v) + F_V * v + 0.05 * rng.standard_normal(len(ts))
    seen = x_true(t) + 1e-5 * rng.standard_normal(len(t))
    np.savetxt(tmp_path / "push.csv", np.c_[t, seen, drive_true(t)], header="t_s,x_m,drive_N", **HEADER)
    np.savetxt(tmp_path / "cell.csv", np.c_[ts + 5e-3, felt], header="t_s,friction_N", **HEADER)
    sensors = opened(tmp_path / "study.toml", 'sensor = "cell.csv"').runs[0].get("sensors")
    clock = sensors.clocks["friction_N"]
    assert abs(clock["offset_s"] + 5e-3) < 5 * clock["sigma_offset_s"]
    assert clock["sigma_offset_s"] < 3e-4
    assert clock["gain"] == pytest.approx(-1 / MASS, rel=0.1)


def test_an_acceleration_in_the_runs_own_table_is_on_its_clock(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    t = np.arange(800) / 2000.0
    a = sum(-a * w * w * np.sin(w * t + p) for a, w, p in PARTS) + 0.5 * rng.standard_normal(len(t))
    seen = x_true(t) + 1e-5 * rng.standard_normal(len(t))
    np.savetxt(tmp_path / "push.csv", np.c_[t, seen, a], header="t_s,x_m,a_m_s2", **HEADER)
    sensors = opened(tmp_path / "study.toml", "").runs[0].get("sensors")
    assert sensors.clocks["a"]["verdict"] == "consistent"
    assert (sensors.clocks["a"]["offset_s"], sensors.clocks["a"]["sigma_offset_s"]) == (0.0, None)
    assert np.mean(np.isfinite(sensors.known_a)) > 0.99
