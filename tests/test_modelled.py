"""The motion that a law tells is as near the truth, and its bands as wide, as the data allow; it says where not."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
from runs import Slider, integrate, plain_motion
from scipy.integrate import solve_ivp

from frictrack import effects
from frictrack.effects import models
from frictrack.fit import fit, restore
from frictrack.fit import state as state_of
from frictrack.flow import Session, open_study
from frictrack.measure.friction import friction
from frictrack.measure.motion import differentiate, low_pass
from frictrack.present import export, plots, report
from frictrack.records import Displacement, Run
from frictrack.results import ModelResults, RunResults

FPS, MASS = 4000.0, 0.35
LAW = {"F_c": 8.0, "rise": 6.0, "v_s": 0.4, "F_v": 1.2, "amplitude": 2.0, "frequency": 60.0, "phase": 4.0, "v0": 5.75}
PULSE = {"J": 0.02, "begin": 0.06, "length": 1.5e-3}  # half a sine
SLOWEST = 0.06  # m/s at which a slide is cut off
VIBRATION = "coulomb,stribeck,viscous,vibration"
COLLISION = "coulomb,stribeck,viscous,collision,vibration"
BOUNDS = {2e-6: 0.020, 10e-6: 0.098, 50e-6: 0.49}  # Cramer-Rao, rms of a over the record, m/s^2
QUANTITIES = ("x", "v", "a", "F")


def force(t, v, q, pulse=None):
    """Friction force in N, written anew."""
    total = q["F_c"] + q["rise"] * np.exp(-np.abs(v) / q["v_s"]) + q["F_v"] * v
    total = total + q["amplitude"] * np.sin(2 * np.pi * q["frequency"] * t + q["phase"])
    if pulse is None:
        return total
    z = (t - pulse["begin"]) / pulse["length"]
    return total + np.pi / 2 * pulse["J"] / pulse["length"] * np.sin(np.pi * np.clip(z, 0, 1))


def slide(t_end, q, pulse=None):
    """True t, x, v, a, F at 4 kHz from rest at x = 0 to the slowest speed, or to t_end s."""
    cuts = [0.0, *((pulse["begin"], pulse["begin"] + pulse["length"]) if pulse else ()), t_end or 0.5]

    def slow(t, z):
        return z[1] - SLOWEST

    slow.terminal = t_end is None
    z, parts, end = [q.get("x0", 0.0), q["v0"]], [], 0.5
    for begin, stop in pairwise(cuts):
        solved = solve_ivp(
            lambda t, z: [z[1], -force(t, z[1], q, pulse) / MASS], (begin, stop), z, method="DOP853",
            rtol=1e-12, atol=1e-14, max_step=2e-3, dense_output=True, events=slow,
        )  # fmt: skip
        parts.append((begin, solved.sol))
        z, end = solved.y[:, -1], solved.t[-1]
    t = np.arange(int(np.floor(end * FPS + 1e-9)) + (t_end is not None)) / FPS
    x, v = np.empty_like(t), np.empty_like(t)
    for begin, path in parts:
        x[t >= begin], v[t >= begin] = path(t[t >= begin])
    f = force(t, v, q, pulse)
    return {"t": t, "x": x, "v": v, "a": -f / MASS, "F": f}


@cache
def vib():
    return slide(None, LAW)


@cache
def coll():
    return slide(None, LAW, PULSE)


@cache
def five():
    """Five slides of different speeds and phases under one law."""
    pairs = zip((5.75, 5.0, 4.2, 3.5, 5.4), (4.0, 1.0, 2.5, 5.5, 0.3), strict=True)
    return [slide(None, LAW | {"v0": v0, "phase": phase}) for v0, phase in pairs]


def seen(truth, sigma=10e-6, seed=0, name="slide", shift=0.0, method="kalman"):
    """A run that a camera saw of a slide, all of it free; the smoother only gives a fit its first guess."""
    t, nan = truth["t"], np.full(len(truth["t"]), np.nan)
    y = truth["x"] + shift + sigma * np.random.default_rng(seed).standard_normal(len(t))
    film = Displacement(t, y, nan, nan, np.full(len(t), sigma), nan, np.ones(len(t), bool), pixel_pitch=5e-4)
    motion = differentiate(low_pass(film, method=method))
    return Run(film, motion, mass=MASS, name=name, free=(float(t[0]), float(t[-1])))


def errors(told, truth):
    """Error of every quantity at the frames that a law tells, away from blows that it does not resolve."""
    rows = np.searchsorted(truth["t"], told.t - 1e-9)[~told.blow]
    return {q: getattr(told, q)[~told.blow] - truth[q][rows] for q in QUANTITIES}


def scores(told, truth):
    """Mean squared z-score of every quantity, (4,)."""
    missed = errors(told, truth)
    return np.array([np.mean((missed[q] / getattr(told, f"sigma_{q}")[~told.blow]) ** 2) for q in QUANTITIES])


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@cache
def fitted(model=VIBRATION, sigma=10e-6, pulse=False):
    return fit(model, [seen(coll() if pulse else vib(), sigma)])


@pytest.mark.slow
def test_acceleration_is_nearer_than_smoothing_and_at_the_bound():
    runs = [seen(vib(), seed=seed, method="structural") for seed in range(5)]
    told = [fit(VIBRATION, [run]).motion[0] for run in runs]
    own = rms([rms(errors(m, vib())["a"]) for m in told])
    smooth = rms([rms(run.motion.a - vib()["a"]) for run in runs])
    assert own <= 0.12
    assert own < smooth / 1.5
    assert all(len(m) == len(vib()["t"]) for m in told)  # both ends included
    assert np.all(np.abs(np.mean([scores(m, vib()) for m in told], axis=0) - 1) < 0.5)


@pytest.mark.few(1)
@pytest.mark.parametrize("sigma", BOUNDS)
def test_band_is_the_cramer_rao_bound(sigma):
    told = fitted(sigma=sigma).motion[0]
    assert rms(told.sigma_a) == pytest.approx(BOUNDS[sigma], rel=0.08)
    assert np.allclose(told.sigma_F, MASS * told.sigma_a)
    assert told.notes == ()


def test_bands_are_those_of_an_independent_linearisation():
    """Every unknown and both starts moved in scipy's integration; frame by frame."""
    told, end = fitted().motion[0], float(vib()["t"][-1])
    estimates = {k: e.value for k, e in fitted().parameters.items()}
    q = {
        "F_c": estimates["coulomb.F_c"], "rise": estimates["stribeck.F_s"] - estimates["coulomb.F_c"],
        "v_s": estimates["stribeck.v_s"], "F_v": estimates["viscous.F_v"],
        "amplitude": estimates["vibration.amplitude"], "frequency": estimates["vibration.frequency"],
        "phase": estimates["vibration.phase[slide]"], "x0": told.x[0], "v0": told.v[0],
    }  # fmt: skip
    assert np.allclose(slide(end, q)["x"], told.x, atol=1e-9)
    moved = {}
    for name, value in q.items():
        h = 1e-4 * max(abs(value), 0.1)
        after, before = (slide(end, q | {name: value + s * h}) for s in (1, -1))
        moved[name] = {k: (after[k] - before[k]) / (2 * h) for k in QUANTITIES}
    sigma = float(fitted().curves[0].sigma_x[0])
    jac = np.stack([m["x"] for m in moved.values()], axis=1) / sigma
    covariance = np.linalg.inv(jac.T @ jac)
    for quantity in QUANTITIES:
        by = np.stack([m[quantity] for m in moved.values()], axis=1)
        band = np.sqrt(np.einsum("ni,ij,nj->n", by, covariance, by))
        assert np.allclose(getattr(told, f"sigma_{quantity}"), band, rtol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("sigma", BOUNDS)
def test_z_scores_over_a_hundred_fits(sigma):
    told = [fit(VIBRATION, [seen(vib(), sigma, seed)]).motion[0] for seed in range(100)]
    z = np.sqrt(np.mean([scores(m, vib()) for m in told], axis=0))
    assert np.all((z > 0.9) & (z < 1.1))
    assert rms([rms(errors(m, vib())["a"]) for m in told]) <= 1.22 * BOUNDS[sigma]
    assert sum(bool(m.notes) for m in told) <= 1  # white noise is hardly ever taken for something missed


@pytest.mark.slow
def test_z_scores_of_five_runs_of_one_law():
    """Levels are free from four runs on, and none scatters here."""
    z, own = [], []
    for seed in range(25):
        runs = [seen(s, seed=100 * seed + i, name=f"r{i}") for i, s in enumerate(five())]
        for told, truth in zip(fit(VIBRATION, runs).motion, five(), strict=True):
            z.append(scores(told, truth))
            own.append(rms(errors(told, truth)["a"]))
    z = np.sqrt(np.mean(z, axis=0))
    assert np.all((z > 0.9) & (z < 1.1))
    assert rms(own) <= 0.12


def test_collision_is_told_by_its_impulse():
    result = fitted(COLLISION, pulse=True)
    told = result.motion[0]
    (blow,) = result.collisions
    assert abs(blow["impulse_N_s"] - PULSE["J"]) < 3 * blow["std"]
    assert 0.003 < blow["relative_std"] < 0.005
    assert blow["resolved"] is False
    assert blow["width_at_most_s"] > 0.2176 * PULSE["length"]  # deviation of half a sine about its middle
    assert blow["words"].endswith("these frames determine the impulse, but not the peak force")
    inside = np.abs(told.t - PULSE["begin"] - PULSE["length"] / 2) < PULSE["length"] / 2
    assert np.all(told.blow[inside])
    assert np.sum(told.blow) < 30
    assert rms(errors(told, coll())["a"]) <= 0.13
    assert json.loads(json.dumps(result.summary()["collisions"]))


@pytest.mark.slow
def test_a_blow_that_was_none_is_said():
    (blow,) = fitted(COLLISION).collisions
    assert blow["words"] == "no significant collision in this run"


@pytest.mark.slow
def test_impulses_scatter_as_they_say():
    blows = [fit(COLLISION, [seen(coll(), seed=seed)]).collisions[0] for seed in range(60)]
    z = [(b["impulse_N_s"] - PULSE["J"]) / b["std"] for b in blows]
    assert 0.8 < rms(z) < 1.2
    assert np.mean([b["relative_std"] for b in blows]) == pytest.approx(0.0036, rel=0.1)


@pytest.mark.few(1)
@pytest.mark.parametrize(("sigma", "least"), [(2e-6, 0.93), (10e-6, 0.93), (50e-6, 0.85)])
def test_a_law_that_misses_the_vibration_says_so_and_widens_its_band(sigma, least):
    told = fitted("tustin", sigma).motion[0]
    (note,) = told.notes
    assert note.startswith("the model misses something: its residual shows ")
    assert "the bands hold only if nothing faster is missing" in note
    assert "frictrack diagnose" in note
    missed = errors(told, vib())
    for quantity in QUANTITIES:
        sigma_q = getattr(told, f"sigma_{quantity}")
        assert np.mean(np.abs(missed[quantity]) < 2 * sigma_q) > least
        assert 0.75 < rms(missed[quantity] / sigma_q) < 1.35


@pytest.mark.slow
def test_a_law_that_misses_a_blow_says_so():
    told = fitted(pulse=True).motion[0]
    assert told.notes
    assert rms(told.sigma_a) > 2.0


@pytest.mark.slow
def test_motion_is_the_sliders_not_the_cameras():
    shake = 40e-6 * np.sin(2 * np.pi * 83.0 * vib()["t"] + 0.9)
    known = effects.get("camera_shake").adjusted(frequency={"fixed": 83.0})  # one run does not tell which is which
    told = fit(models.parse(VIBRATION) + known, [seen(vib(), shift=shake)]).motion[0]
    assert rms(errors(told, vib())["x"]) < 5e-6
    assert rms(errors(told, vib())["a"]) < 0.2
    assert told.notes == ()


@pytest.mark.slow
def test_five_runs_and_a_predicted_one():
    runs = [seen(s, seed=i, name=f"r{i}") for i, s in enumerate(five())]
    runs[3] = replace(runs[3], role="validation")
    result = fit(VIBRATION, runs)
    assert [(m.run, m.role) for m in result.motion] == [
        ("r0", "fit"), ("r1", "fit"), ("r2", "fit"), ("r4", "fit"), ("r3", "validation"),
    ]  # fmt: skip
    for told in result.motion:
        truth = five()[int(told.run[1])]
        assert rms(errors(told, truth)["a"]) < 0.15
        assert np.all(scores(told, truth) < 4.0)
    again = restore(runs, state_of(result))
    assert np.allclose(again.motion[0].sigma_a, result.motion[0].sigma_a, rtol=1e-3)


@pytest.mark.few(1)
@pytest.mark.parametrize("mass", [MASS, None])
def test_a_driven_slider_that_turns_round(mass):
    """Stretches of either direction, the mass given or fitted."""

    def push(t):
        return 14 * np.sin(4 * np.pi * t + 0.3) + 3 * np.sin(10.6 * np.pi * t)

    law, t = {"coulomb": {"F_c": 5.0}, "viscous": {"F_v": 1.2}}, np.arange(1200) / 1000
    x = integrate(law, Slider(push=push), t, (0.0, 0.5), max_step=1e-3)
    z = []
    for seed in range(2):
        told = fit("coulomb,viscous", [driven(t, x, push(t), mass, seed)]).motion[0]
        assert len(np.unique(told.segment)) == 5
        assert np.any(told.v < 0)
        assert told.notes == ()
        resisting = 5.0 * np.sign(told.v) + 1.2 * told.v
        missed = (told.F - resisting) / told.sigma_F, (told.a - (push(told.t) - resisting) / MASS) / told.sigma_a
        z.append([np.mean(m**2) for m in missed])
    assert np.all(np.mean(z, axis=0) < 2.0)


def driven(t, x, drive, mass, seed):
    """A run with a measured drive, 10 um of noise."""
    nan, sigma = np.full(len(t), np.nan), np.full(len(t), 10e-6)
    y = x + 10e-6 * np.random.default_rng(seed).standard_normal(len(t))
    film = Displacement(t, y, nan, nan, sigma, nan, np.ones(len(t), bool))
    return Run(film, plain_motion(film), mass=mass, drive=drive)


def test_json_holds_both_bands():
    (row,) = fitted().summary()["per_run"]
    told = row["motion"]
    assert told["sigma_a"] == pytest.approx(rms(fitted().motion[0].sigma_a))
    assert told["sigma_a_smoothed"] > told["sigma_a"]
    assert told["sigma_F_N"] == pytest.approx(MASS * told["sigma_a"])
    assert told["notes"] == []


@pytest.fixture(scope="module")
def study(tmp_path_factory) -> Path:
    """A study of one table, fitted."""
    folder = tmp_path_factory.mktemp("own")
    run = seen(coll())
    with (folder / "slide.csv").open("w", newline="") as f:
        writer = csv.writer(f)
        writer.writerow(["t_s", "x_m"])
        writer.writerows(zip(run.displacement.t, run.displacement.x, strict=True))
    (folder / "study.toml").write_text(
        f'[study]\nname = "own"\nmass = {MASS}\nmodel = {json.dumps(COLLISION.split(","))}\n'
        f'[[run]]\nname = "slide"\ntable = "slide.csv"\nfree = [0.0, {run.displacement.t[-1]}]\n'
    )
    return folder / "study.toml"


def test_store_and_export_offer_it_beside_the_smoothed_motion(study, monkeypatch):
    monkeypatch.setattr(Session, "diagnose", lambda session, seed: {"verdict": "complete"})
    monkeypatch.setattr(Session, "_update_papers_route", lambda session: ())
    session = Session(open_study(study))
    session.fit()
    with h5py.File(session.path) as file:
        (group,) = file["models"]
        told = file[f"models/{group}/motion/slide"]
        units = {name: told[name].attrs["unit"] for name in ("x", "v", "a", "F", "sigma_a", "sigma_F")}
        assert units == {"x": "m", "v": "m/s", "a": "m/s^2", "F": "N", "sigma_a": "m/s^2", "sigma_F": "N"}
        stored = told["a"][()]
    results = session.results()
    (own,) = results.current.motion
    assert np.array_equal(own.a, stored)
    assert own.notes == ()
    paths = {p.stem: p for p in export.write(results, "csv")}
    table = pd.read_csv(paths["slide"])
    assert {"x_model_m", "v_model_ms", "a_model_ms2", "F_model_N", "sigma_a_model_ms2"} <= set(table)
    assert np.allclose(table["a_model_ms2"].dropna(), stored)
    (book,) = export.write(results, "xlsx")
    assert "sigma_F_model_N" in pd.read_excel(book, sheet_name="slide")


def results_of(result):
    """What plots and report are given."""
    (run,) = result.runs
    slides = RunResults(run.name, "slide.csv", run.displacement, low_pass(run.displacement), run.motion, friction(run))
    model = ModelResults("1_law", str(result.model), result.summary(), result.curves, True, motion=result.motion)
    return model, (slides,)


def test_figure_shows_both_bands_and_opens_at_a_blow():
    model, runs = results_of(fitted(COLLISION, pulse=True))
    figure = plots.modelled(model, runs)
    labels = [ax.get_ylabel() for ax in figure.axes]
    assert labels == ["a / (m/s²)", "a − model / (m/s²)", "friction F / N"]
    assert len(figure.axes[0].collections) == 2  # bands
    assert "J = " in figure.axes[0].texts[0].get_text()
    own = figure.axes[0].lines[-1].get_ydata()
    assert np.array_equal(np.isnan(own), model.motion[0].blow)
    assert "std of a 0.1" in figure.get_suptitle()
    assert np.all(np.isfinite(plots.fit(model, runs).axes[0].lines[-1].get_ydata()))  # filtered, a blow has a peak


@pytest.mark.slow
def test_figure_of_a_law_that_fails_says_so():
    model, runs = results_of(fitted("tustin"))
    assert plots.modelled(model, runs).get_suptitle().endswith("; the model misses something")


def test_a_model_stored_without_motion_is_said():
    model, runs = results_of(fitted())
    with pytest.raises(ValueError, match=r'expected a model with its own motion but "1_law" has none; fit it again'):
        plots.modelled(replace(model, motion=()), runs)


def test_report_tells_the_impulse_and_no_peak_force():
    model, _ = results_of(fitted(COLLISION, pulse=True))
    told = " ".join(report.texts.model_motion_sentences(model))
    assert "acceleration of the model 0.1" in told
    assert re.search(r"impulse \((19\.[89]|20\.[01])\d* ± 0\.07\) mN s, relative error 0\.3\d %", told)
    assert "but not the peak force" in told
    rows = {str(row[0]): row for row in report.tables.parameter_table(model).rows}
    assert rows["<code>collision.width</code>"][-1] == "not resolved: the impulse is known, the peak force is not"
