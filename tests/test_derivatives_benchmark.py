"""The differentiation benchmark: its signals are what they claim, its bounds are where they must be."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "pipelines" / "benchmarks"))

from derivatives import SIGNALS, classics, others, ours, run, signal
from derivatives.bayes import gaussian_process, kalman
from derivatives.bounds import cramer_rao, wiener
from derivatives.estimate import Estimate
from derivatives.measures import judge, parts
from derivatives.plan import Plan
from derivatives.signals import LINE, MASS, PULSE, SLIDE, Signal, slide

BENCHMARKS = Path(__file__).parents[1] / "pipelines" / "benchmarks"


@pytest.fixture(scope="module")
def signals():
    return {name: signal(name) for name in SIGNALS}


def away(truth: Signal, frames: int = 4) -> np.ndarray:
    """Frames whose stencil holds no event."""
    h = truth.t[1] - truth.t[0]
    near = [np.abs(truth.t - event) < frames * h for event in truth.events]
    mask = ~np.any(near, axis=0) if near else np.ones(len(truth.t), dtype=bool)
    mask[:frames], mask[-frames:] = False, False
    return mask


def difference(y: np.ndarray, h: float) -> np.ndarray:
    """Central difference of sixth order."""
    return sum(c * (np.roll(y, -k) - np.roll(y, k)) for k, c in ((1, 45), (2, -9), (3, 1))) / (60 * h)


@pytest.mark.parametrize("name", SIGNALS)
def test_velocity_and_acceleration_are_the_derivatives_of_position(signals, name):
    truth = signals[name]
    h, mask = truth.t[1] - truth.t[0], away(truth)
    assert np.max(np.abs(difference(truth.x, h) - truth.v)[mask]) < 1e-6 * np.max(np.abs(truth.v))
    assert np.max(np.abs(difference(truth.v, h) - truth.a)[mask]) < 1e-3 * np.max(np.abs(truth.a))
    assert np.allclose(np.diff(truth.t), 1 / 4000)


def test_the_slide_is_the_one_of_the_anchor(signals):
    vib, coll, plain = (signals[name] for name in ("vib", "coll", "plain"))
    assert (len(vib.t), len(coll.t)) == (684, 678)
    assert vib.v[0] == 5.75
    assert vib.v[-1] < 0.06 <= vib.v[-2]
    # Newton's law, written anew.
    drag = 8 + 6 * np.exp(-vib.v / 0.4) + 1.2 * vib.v
    assert np.allclose(0.35 * vib.a, 2 * np.sin(2 * np.pi * 60 * vib.t + 4.0) - drag, atol=1e-9)
    drag = 8 + 6 * np.exp(-coll.v / 0.4) + 1.2 * coll.v
    hit = 0.35 * coll.a - 2 * np.sin(2 * np.pi * 60 * coll.t + 4.0) + drag
    assert hit.min() == pytest.approx(-np.pi / 2 * 0.02 / 1.5e-3, rel=1e-6)  # N; 60 m/s^2
    assert np.flatnonzero(np.abs(hit) > 1e-6).tolist() == list(range(241, 246))  # 1.5 ms from 60 ms on
    assert hit.sum() / 4000 == pytest.approx(-0.02, rel=0.03)  # its impulse, N s
    assert 0.05 < plain.v[-1] < 0.06


def test_the_viscous_slide_has_its_closed_form():
    t = np.arange(400) / 4000
    law = SLIDE | {"fs": SLIDE["fc"]}  # no Stribeck part: v = (v0 + fc/fv) exp(-fv t/m) - fc/fv
    x, v, a = slide(law, t)
    rate, level = law["fv"] / MASS, law["fc"] / law["fv"]
    decay = (law["v"] + level) * np.exp(-rate * t)
    assert np.allclose(v, decay - level, rtol=0, atol=1e-10)
    assert np.allclose(x, (law["v"] + level - decay) / rate - level * t, rtol=0, atol=1e-12)
    assert np.allclose(a, -rate * decay, rtol=0, atol=1e-9)


def test_jumps_are_where_they_are_said_to_be(signals):
    for name, jump in {"stop": 14 / MASS, "incline": 2.31, "reversal": 6.0}.items():
        truth = signals[name]
        for event in truth.events:
            k = int(np.searchsorted(truth.t, event))
            step = truth.a[k + 1] - truth.a[k - 2]
            assert abs(step) == pytest.approx(jump, rel=0.06), name
    assert np.all(signals["stop"].v[signals["stop"].t > signals["stop"].events[0]] == 0)
    push = signals["push"]
    assert np.ptp(push.x[:40]) == 0
    assert push.v.max() == pytest.approx(5.0, abs=0.03)
    swing = signals["reversal"]
    assert np.diff(np.sign(swing.v[1:])).astype(bool).sum() == len(swing.events) == 2


@pytest.mark.parametrize(("name", "um", "a"), [("vib", 2, 0.139), ("vib", 10, 0.315), ("vib", 50, 0.856)])
def test_the_oracle_lands_where_the_anchor_has_it(signals, name, um, a):
    assert run.row(wiener(signals[name], um * 1e-6), signals[name], um * 1e-6, 20)["a"] == pytest.approx(a, rel=0.05)


def test_the_oracle_on_a_collision(signals):
    truth = signals["coll"]
    assert run.row(wiener(truth, 1e-5), truth, 1e-5, 20)["a"] == pytest.approx(3.18, rel=0.03)


@pytest.mark.slow
def test_the_bounds_land_where_the_anchor_has_them(signals):
    assert run.bounds(signals["vib"], 1e-5)["Cramer-Rao"]["a"] == pytest.approx(0.098, rel=0.02)
    rows = run.bounds(signals["coll"], 1e-5)
    assert rows["Cramer-Rao"]["a"] == pytest.approx(3.6, rel=0.05)
    assert rows["Cramer-Rao, duration known"]["a"] == pytest.approx(0.34, rel=0.1)
    known = rows["Cramer-Rao"]["parameters"]
    assert known["J"] / PULSE["J"] == pytest.approx(0.0036, rel=0.15)
    assert known["width"] / PULSE["width"] == pytest.approx(0.87, rel=0.15)


@pytest.mark.slow
def test_the_bound_is_what_a_fit_of_the_true_model_reaches(signals):
    truth = signals["vib"]
    deviations, sizes = cramer_rao(truth, 1e-5)
    # One Gauss-Newton step from the truth: the columns anew, by one-sided differences of single parameters.
    names, rng = list(sizes), np.random.default_rng(1)
    columns = []
    for name in names:
        moved = truth.model(dict(truth.parameters) | {name: truth.parameters[name] + 0.01 * sizes[name]}, truth.t)
        columns.append((np.array(moved) - truth[2:5]) / 0.01)
    design = np.stack(columns, axis=-1)
    noise = 1e-5 * rng.standard_normal((len(truth.t), 300))
    steps = np.linalg.lstsq(design[0], noise, rcond=None)[0]
    assert np.allclose(steps.std(axis=1), 1, atol=0.15)
    found = np.sqrt(np.mean((design[2] @ steps) ** 2))
    assert found == pytest.approx(np.sqrt(np.mean(deviations[2] ** 2)), rel=0.05)


@pytest.mark.slow
def test_the_practice_of_laboratories_is_as_bad_as_the_anchor_says(signals):
    truth = signals["vib"]
    rows = {name: run.row(method, truth, 1e-5, 2) for name, method in classics.methods(truth).items()}
    assert rows["Butterworth 100 Hz + differences"]["a"] == pytest.approx(25, rel=0.15)
    assert rows["Butterworth oracle"]["a"] == pytest.approx(9.9, rel=0.15)
    assert rows["Savitzky-Golay oracle"]["a"] == pytest.approx(0.845, rel=0.2)
    assert rows["SciPy smoothing spline GCV"]["a"] == pytest.approx(5.5, rel=0.1)
    for family in ("Butterworth", "Savitzky-Golay"):
        assert rows[f"{family} oracle"]["a"] <= rows[f"{family} GCV"]["a"]


def bumps(rng: np.random.Generator, t: np.ndarray) -> np.ndarray:
    """A smooth random course: what the Gaussian process takes for granted."""
    return sum(
        w * np.exp(-0.5 * ((t - at) / 0.01) ** 2) for at, w in zip(t[::10], rng.normal(0, 1e-3, 70), strict=False)
    )


@pytest.mark.parametrize(("method", "order"), [(kalman(3), 3), (kalman(4), 4), (gaussian_process, None)])
def test_the_references_state_their_errors_where_their_assumptions_hold(method, order):
    rng, t = np.random.default_rng(3), np.arange(600) / 4000
    x = 1e-8 * rng.standard_normal(600) if order else bumps(rng, t)
    for _ in range(order or 0):  # white jerk or snap, summed up
        x = np.cumsum(x) * (0.02 if order == 4 and _ == 3 else 1)
    y = x + 1e-5 * rng.standard_normal(600)
    found = method(t, y)
    assert 0.7 < np.sqrt(np.mean(((found.x - x) / found.sigma_x) ** 2)) < 1.4
    middle = slice(20, -20)
    a = np.gradient(np.gradient(x, t), t)
    assert 0.6 < np.sqrt(np.mean(((found.a - a) / found.sigma_a)[middle] ** 2)) < 1.5


def test_figures_are_called_what_they_are(signals):
    truth = signals["stop"]
    off = np.zeros((3, len(truth.t)))
    off[2, :32] = 2.0  # the first 5 %
    made = Estimate(*(np.array(truth[2:5]) + off), None, None, np.ones(len(truth.t)))
    figures = judge(truth, [made, made], [1.0, 3.0])
    assert figures["a_first"] == pytest.approx(2)
    assert figures["a"] == figures["z_a"] == pytest.approx(2 * np.sqrt(0.05))
    assert figures["a_worst"] == figures["a"]
    assert figures["a_mid"] == figures["a_last"] == figures["a_near"] == figures["v"] == 0
    assert np.isnan(figures["z_x"])
    assert figures["ms"] == 2000
    assert np.ptp(truth.t[parts(truth)["near"]]) == pytest.approx(4e-3, abs=3e-4)


def test_noise_is_the_same_for_every_method_and_of_the_stated_size(signals):
    truth = signals["vib"]
    y = run.measured(truth, 1e-5, 4)
    assert np.array_equal(y, run.measured(truth, 1e-5, 4))
    assert np.std(y - truth.x) == pytest.approx(1e-5, rel=0.1)
    assert not np.allclose(y, run.measured(truth, 1e-5, 5), atol=1e-7)


def test_a_method_that_refuses_leaves_its_reason(signals, monkeypatch):
    def refuse(t, y):
        raise run.FrictrackError("expected more but got less")

    rows = {run.WIENER: {"a": 1.0}, "mine": run.row(refuse, signals["vib"], 1e-5, 2)}
    assert "expected more but got less" in run.table("vib", 1e-5, rows)


def test_the_command_prints_a_table_and_writes_all_figures(tmp_path):
    file = tmp_path / "figures.json"
    command = [sys.executable, str(BENCHMARKS / "derivatives"), "--signals", "vib", "--noises", "10", "--seeds", "1"]
    command += ["--methods", "jerk,100 Hz", "--no-peers", "--json", str(file)]
    text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "vib, 10 um" in text
    assert "RMS error of a" in text
    rows = json.loads(file.read_text())["accuracy"]["vib"]["10 um"]
    jerk, practice = "Kalman, white jerk, ML", "Butterworth 100 Hz + differences"
    assert set(rows) == {"Cramer-Rao", run.WIENER, jerk, practice}
    assert rows["Cramer-Rao"]["a"] < rows[run.WIENER]["a"] < rows[jerk]["a"] < rows[practice]["a"]
    for title in rows:
        assert sum(line.startswith(title) for line in text.splitlines()) == 2  # table and overview


def test_frictrack_is_asked_through_its_public_stages(signals):
    truth = signals["vib"]
    assert "frictrack" in ours.methods(1e-5)
    found = ours.frictrack(1e-5)(truth.t, run.measured(truth, 1e-5, 0))
    figures = judge(truth, [found], [0.0])
    assert 0.1 < figures["a"] < 1.0
    assert 0.7 < figures["z_x"] < 1.3


@pytest.mark.parametrize(
    ("does", "said"),
    [("kill -XCPU $$", "more than 7 s"), ("echo no such method >&2; exit 1", "no such method"), ("exit 1", "ended")],
)
def test_a_peer_that_breaks_off_leaves_its_reason(signals, tmp_path, does, said):
    python = tmp_path / "python"
    python.write_text(f"#!/bin/sh\n{does}\n")
    python.chmod(0o755)
    truth = signals["vib"]
    found = others.peer(Plan(["vib"], [1e-5], python=str(python), peer_seconds=7), truth, truth.x, "rtsdiff", "own")
    assert isinstance(found, str)
    assert said in found
    assert said in run.table("vib", 1e-5, {run.WIENER: {"a": 1.0}, "peer": run._judge_peer(truth, [found])})


@pytest.mark.slow
def test_an_unknown_signal_is_answered_with_the_known_ones():
    command = [sys.executable, str(BENCHMARKS / "derivatives"), "--signals", "vib,wobble", "--no-peers"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "incline but got wobble" in done.stderr


def test_words_choose_methods():
    plan = Plan(["vib"], [1e-5], words=["golay", "ML"])
    assert plan.wants("Savitzky-Golay GCV")
    assert plan.wants("Kalman, white jerk, ML")
    assert not plan.wants("frictrack")
    assert Plan(["vib"], [1e-5]).wants("anything")
    assert LINE["F0"] / MASS == pytest.approx(5.7, abs=0.02)
    assert LINE["F0"] / MASS / (2 * np.pi * 60) ** 2 == pytest.approx(40e-6, rel=0.01)
