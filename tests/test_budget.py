"""The error budget of a friction force against closed forms, brute force and slides of known truth."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from film import Film as Pictures
from runs import BASE, Slider, integrate

from frictrack.base.errors import FrictrackError
from frictrack.cli import main
from frictrack.flow import Session, open_study
from frictrack.measure.calibration import calibrate
from frictrack.measure.error_budget import budget
from frictrack.measure.friction import friction
from frictrack.measure.motion import Smoother, covariance, differentiate, low_pass
from frictrack.present import plots, report
from frictrack.records import Displacement, Run
from frictrack.results import RecordingInfo
from frictrack.simulate import scene
from frictrack.simulate.scene import read_scene
from frictrack.tracking import track

FPS, MASS, PITCH, NOISE = 4000.0, 0.35, 5e-4, 10e-6
T = np.arange(240) / FPS
LAW = {"coulomb": BASE["coulomb"], "viscous": BASE["viscous"]}
X = integrate(LAW, Slider(), T, (0.0, 4.0))  # m, of the true slide


def force(x):
    """True friction force (n,) of the slide, by the law and the velocity that go with its place."""
    v = np.gradient(x, T, edge_order=2)
    return LAW["coulomb"]["F_c"] + LAW["viscous"]["F_v"] * v


def seen(x=X, *, noise=NOISE, seed=0, scale_error=0.0, valid=None, t=T):
    nan = np.full(len(t), np.nan)
    valid = np.ones(len(t), bool) if valid is None else valid
    at = x + noise * np.random.default_rng(seed).standard_normal(len(t))
    return Displacement(
        t, np.where(valid, at, np.nan), nan, nan, np.full(len(t), noise), nan, valid, PITCH, scale_error
    )


def smoothed(displacement, method="kalman", cutoff=None, **known):
    """A run and what its motion was derived from."""
    filtered = low_pass(displacement, cutoff, **({} if cutoff else {"method": method}))
    return Run(displacement, differentiate(filtered), **{"mass": MASS, "free": (0.0, 1.0), **known}), filtered


def film(*rates, fps=FPS, clocked=True):
    """A film whose frame rates were found to be so."""
    return RecordingInfo(
        T,
        fps=fps,
        clocked=clocked,
        audit=tuple((f"frame rate, {name}", f"{r:.6g} fps", verdict) for name, r, verdict in rates),
    )


# -- agreement with what else is stated ---------------------------------------------------------------------


@pytest.mark.parametrize("method", ["structural", "kalman"])
def test_total_is_sigma_F_and_the_mean_follows_the_covariance(method):
    run, filtered = smoothed(seen(scale_error=0.002), method, sigma_mass=0.001)
    found, told = budget(run, filtered), friction(run)
    rel = 1e-6 if method == "structural" else 1e-3  # the noise that passes may exceed the distance from the best motion
    assert found.frame_N == pytest.approx(np.sqrt(np.mean(told.sigma_F[told.free] ** 2)), rel=rel)
    w = told.free / np.sum(told.free)
    smooth = MASS * np.sqrt(w @ covariance(filtered, "a") @ w)
    assert np.hypot(found.row("pixel noise").mean_N, found.row("filter").mean_N) == pytest.approx(smooth)
    assert found.force_N == pytest.approx(np.mean(told.F[told.free]))


def test_gaps_in_the_record_are_no_obstacle():
    valid = np.ones(len(T), bool)
    valid[100:110] = False
    run, filtered = smoothed(seen(valid=valid))
    w = valid / np.sum(valid)
    smooth = MASS * np.sqrt(w @ covariance(filtered, "a") @ w)
    found = budget(run, filtered)
    assert np.hypot(found.row("pixel noise").mean_N, found.row("filter").mean_N) == pytest.approx(smooth, rel=1e-6)


@pytest.mark.few(1)
@pytest.mark.parametrize("cutoff", [None, 120.0])
def test_pixel_noise_is_what_the_smoother_lets_through(cutoff):
    """Brute force: the same smoother on nothing but noise."""
    run, filtered = smoothed(seen(), "savitzky-golay", cutoff)
    row = budget(run, filtered).row("pixel noise")
    level = np.mean(filtered.sigma_x**-2.0) ** -0.5
    a = again(filtered)(level * np.random.default_rng(1).standard_normal((len(T), 80)))
    assert row.frame_N == pytest.approx(MASS * np.sqrt(np.mean(a**2)), rel=0.1)
    assert row.mean_N == pytest.approx(MASS * np.std(np.mean(a, axis=0)), rel=0.25)


def again(filtered):
    """The same low-pass or window once more, as a map of columns: what was smoothed with a column less without."""
    if method := Smoother.read(filtered.smoother).method:
        return lambda columns: method.derived(columns, 2) * FPS**2

    def through(x):
        return differentiate(low_pass(seen(x, noise=0.0), filtered.cutoff)).a

    base = through(X)
    return lambda columns: np.stack([through(X + column) - base for column in columns.T], axis=1)


# -- scale, mass, time base ---------------------------------------------------------------------------------


def test_common_errors_do_not_average_out():
    run, filtered = smoothed(seen(scale_error=0.003), sigma_mass=0.002)
    rows = {
        row.source: row
        for row in budget(run, filtered, film=film(("given", 4000, "used"), ("stamps", 4004, "disagrees"))).rows
    }
    pull = np.mean(MASS * np.abs(run.motion.a))
    assert rows["scale"].mean_N == pytest.approx(0.003 * pull)
    assert rows["mass"].mean_N == pytest.approx(0.002 / MASS * pull)
    assert rows["time base"].mean_N == pytest.approx(2 * 0.001 * pull)
    assert {rows[k].common for k in ("scale", "mass", "time base")} == {"all runs"}


def test_the_error_of_a_clock_read_from_rounded_stamps_counts_twice():
    run, filtered = smoothed(replace(seen(), clock_error=0.003))
    still, (found, told) = smoothed(seen())[0], (budget(run, filtered), friction(run))
    common = 2 * 0.003 * MASS * run.motion.a
    np.testing.assert_allclose(told.sigma_F**2 - friction(still).sigma_F ** 2, common**2, rtol=1e-6)
    assert found.row("time base").size == pytest.approx(0.3)
    assert found.row("time base").mean_N == pytest.approx(abs(np.mean(common[told.free])))


def test_gravity_counts_for_the_mass_but_not_for_scale_and_clock():
    run, filtered = smoothed(seen(scale_error=0.003), sigma_mass=0.002, incline=0.4, has_incline=True)
    found = budget(run, filtered)
    pull = np.mean(run.motion.a + 9.80665 * np.sin(0.4))
    assert found.row("mass").mean_N == pytest.approx(0.002 * abs(pull))
    assert found.row("scale").mean_N == pytest.approx(0.003 * MASS * abs(np.mean(run.motion.a)))


@pytest.mark.parametrize(
    ("rates", "size", "told"),
    [
        ((("header", 4000, "used"),), None, "not known: that of the header is used"),
        ((("given", 4000, "used"), ("header", 4000, "agrees")), None, "there are no camera time stamps"),
        ((("given", 4000, "used"), ("header", 30, "speed of showing")), None, "not known: the rate given"),
        ((("header", 4000, "used"), ("stamps", 4000, "agrees")), 5e-5, "header and stamps"),
        ((("given", 4000, "used"), ("header", 3990, "disagrees")), 0.25, "given and header"),
    ],
)  # fmt: skip
def test_the_time_base_is_known_as_well_as_independent_rates_agree(rates, size, told):
    run, filtered = smoothed(seen())
    row = budget(run, filtered, film=film(*rates)).row("time base")
    assert row.size == pytest.approx(size) if size else (row.size is None and row.mean_N is None)
    assert told in row.known_from


def test_the_stamps_of_a_container_check_nothing():
    run, filtered = smoothed(seen())
    rates = (("header", 4000, "used"), ("stamps", 4000, "agrees"))
    assert budget(run, filtered, film=film(*rates, clocked=False)).row("time base").size is None


def test_what_is_not_known_stands_without_a_number():
    run, filtered = smoothed(seen())
    found = budget(run, filtered)
    for source in ("scale", "mass", "time base"):
        assert found.row(source).frame_N is None
        assert "each 0.1 % would add" in found.row(source).known_from
    assert found.summary()["says"][-1].endswith("because unknown: scale, mass, time base")


# -- faults of the picture ----------------------------------------------------------------------------------


def creeping(speed):
    """A slide at constant speed, without noise, through a plain low-pass at 100 Hz."""
    run, filtered = smoothed(seen(speed * T, noise=1e-9), cutoff=100.0, free=(0.0175, 0.0425))
    return run, filtered


@pytest.mark.parametrize("cycles", [40.0, 80.0, 400.0])
def test_peak_locking_goes_through_the_smoother(cycles):
    run, filtered = creeping(cycles * PITCH)
    row = budget(run, filtered, {"peak_locking_px": 0.05, "peak_locking_std_px": 0.003}).row("peak locking")
    size = np.sqrt(0.05**2 - 0.003**2)
    passes = 1.0 / (1.0 + (np.sin(np.pi * cycles / FPS) / np.sin(np.pi * 100.0 / FPS)) ** 8)
    expected = MASS * size * PITCH * (2 * np.pi * cycles) ** 2 * passes / np.sqrt(2.0)
    assert row.size == pytest.approx(size)
    assert row.frame_N == pytest.approx(expected, rel=0.15, abs=5e-3)


def test_peak_locking_within_its_error_counts_nothing_but_says_how_much_it_may_be():
    run, filtered = creeping(40.0 * PITCH)
    row = budget(run, filtered, {"peak_locking_px": 0.004, "peak_locking_std_px": 0.003}).row("peak locking")
    assert (row.size, row.frame_N, row.mean_N) == (0.0, 0.0, 0.0)
    assert row.known_from.startswith("none found; at most 0.010 px, which would add ")


def test_what_is_left_of_camera_shake_counts():
    run, filtered = creeping(1.0)
    shaken = {"peak_locking_px": None, "peak_locking_std_px": None, "shake_left_px": 0.004, "shake_Hz": 60.0}
    found = budget(run, filtered, shaken)
    passes = 1.0 / (1.0 + (np.sin(np.pi * 60.0 / FPS) / np.sin(np.pi * 100.0 / FPS)) ** 8)
    assert found.row("camera shake").frame_N == pytest.approx(
        MASS * 0.004 * PITCH * (2 * np.pi * 60.0) ** 2 * passes, rel=0.15
    )
    assert found.row("peak locking").frame_N is None


# -- drives and load cells ----------------------------------------------------------------------------------


def test_a_measured_drive_brings_its_noise_and_its_clock():
    drive = 20.0 + 100.0 * T + 0.3 * np.random.default_rng(3).standard_normal(len(T))
    run, filtered = smoothed(seen(), drive=drive)
    found = budget(run, filtered, clocks={"drive": {"sigma_offset_s": 2e-4}})
    assert found.row("drive sensor").frame_N == pytest.approx(0.3, rel=0.15)
    assert found.row("drive sensor").mean_N == pytest.approx(0.3 / np.sqrt(len(T)), rel=0.15)
    assert found.row("drive clock").mean_N == pytest.approx(100.0 * 2e-4, rel=0.4)


def test_where_friction_was_measured_nothing_else_counts():
    cell = 8.0 + 0.2 * np.random.default_rng(4).standard_normal(len(T))
    run, filtered = smoothed(seen(scale_error=0.1), mass=None, friction_N=cell)
    found = budget(run, filtered)
    assert [row.source for row in found.rows] == ["load cell"]
    assert found.mean_N == pytest.approx(0.2 / np.sqrt(len(T)), rel=0.2)
    assert found.summary()["rows"][-1]["source"] == "total"


def test_a_run_nobody_weighed_has_no_budget():
    run, filtered = smoothed(seen(), mass=None, drive=np.ones(len(T)))
    with pytest.raises(FrictrackError, match='run "run": expected a mass for an error budget but got none; weigh'):
        budget(run, filtered)


# -- statistics ---------------------------------------------------------------------------------------------


def wandering(rng):
    """Place (n,), m, and friction force (n,), N, of a slide whose friction wanders: its slope is a random walk."""
    fine = 16
    step = 1.0 / FPS / fine
    n = fine * (len(T) - 1) + 1
    slope = rng.normal(0.0, 100.0) + np.cumsum(rng.normal(0.0, 400.0, n)) * np.sqrt(step / T[-1])
    a = -23.0 + np.cumsum(slope) * step
    v = 4.0 + np.concatenate(([0.0], np.cumsum(0.5 * (a[1:] + a[:-1]) * step)))
    x = np.concatenate(([0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * step)))
    return x[::fine], -MASS * a[::fine]


def z_of_mean(seed, method):
    """Error of the mean force of a noisy slide over what the budget says: scale and mass wrong, and both right."""
    rng = np.random.default_rng([seed, 1])
    x, F = wandering(rng)
    scale_error, sigma_mass = 0.004, 0.001
    wrong, weighed = 1.0 + scale_error * rng.standard_normal(), MASS + sigma_mass * rng.standard_normal()
    off = []
    for factor, error, known in ((wrong, scale_error, {"mass": weighed, "sigma_mass": sigma_mass}), (1.0, 0.0, {})):
        found = budget(*smoothed(seen(factor * x, seed=seed, scale_error=error), method, **known))
        off.append((found.force_N - np.mean(F)) / found.mean_N)
    return off


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "seeds", "margin"),
    [
        ("kalman", 60, 0.22),  # 3 deviations or less
        ("structural", 100, 0.22),
    ],
)
def test_the_mean_force_scatters_as_the_budget_says(method, seeds, margin):
    rms = np.sqrt(np.mean(np.square([z_of_mean(seed, method) for seed in range(seeds)]), axis=0))
    assert np.all(np.abs(rms - 1) < margin), rms


SCENE = """
mass = 0.35
[camera]
fps = 4000
width = 440
height = 72
scale = 0.0005
[law.coulomb]
F_c = 8.0
[law.stribeck]
F_s = 14.0
v_s = 0.4
[law.viscous]
F_v = 1.2
[[run]]
name = "r"
v = {v}
frames = {n}
push = 0.004
"""


def filmed(seed):
    """Mean squares of the z-scores of x, v, a, F (4,) in a slide that was filmed and tracked, z of its mean force."""
    rng = np.random.default_rng([seed, 7])
    v = rng.uniform(3.0, 5.5)
    made = read_scene(SCENE.format(v=v, n=min(200, int(670 / v))))
    camera = scene._camera(made, made.runs[0])
    true = scene.true_trajectory(made, made.runs[0], camera, 1.0)
    pictures = list(scene._render_frames(made, camera, true, rng))
    k = int(np.sum(true.x / camera.scale < camera.width - 50))
    corner = np.rint([true.x[0] / camera.scale - 44.5, camera.height / 2 - 4 - 27.5])
    displacement = calibrate(
        track(Pictures(lambda i: pictures[i], k, pictures[0].shape), [*corner.tolist(), 90, 56]), "0.5 mm/px"
    )
    run, filtered = smoothed(displacement, "structural", free=None)
    told, m = friction(run), run.motion
    at = told.free
    usual = displacement.sigma_x**-2.0 / np.sum(displacement.sigma_x**-2.0)
    zero = usual @ (displacement.x - true.x[:k])  # where on the body x is counted from
    noise = np.mean(filtered.sigma_x**-2.0) ** -1 / k  # of that zero
    z = [
        (m.x - true.x[:k] - zero) / np.sqrt(m.sigma_x**2 - noise),
        (m.v - true.v[:k]) / m.sigma_v,
        (m.a - true.a[:k]) / m.sigma_a,
        (told.F - true.F[:k]) / told.sigma_F,
    ]
    found = budget(run, filtered)
    return np.mean(np.array(z)[:, at] ** 2, axis=1), (found.force_N - np.mean(true.F[:k][at])) / found.mean_N


@pytest.mark.slow
def test_deviations_on_rendered_film_are_what_they_say():
    """Issue 4: the rms of the z-scores is 0.9 to 1.1 for x, v, a, F; 30 films leave it a scatter of 0.07."""
    squares, means = zip(*(filmed(seed) for seed in range(30)), strict=True)
    rms = np.sqrt(np.mean(squares, axis=0))
    assert np.all((rms > 0.85) & (rms < 1.15)), rms
    assert 0.8 < np.sqrt(np.mean(np.square(means))) < 1.25


# -- the way out --------------------------------------------------------------------------------------------


@pytest.fixture
def study(tmp_path):
    x = X + NOISE * np.random.default_rng(0).standard_normal(len(T))
    np.savetxt(tmp_path / "v4.csv", np.stack([T, x], axis=1), delimiter=",", header="t_s,x_m", comments="")
    (tmp_path / "study.toml").write_text(
        '[study]\nmass = "0.350 +/- 0.002 kg"\n[camera]\nscale = "0.500 +/- 0.002 mm/px"\n'
        '[[run]]\nname = "v4"\ntable = "v4.csv"\n'
    )
    return tmp_path / "study.toml"


def ran(capsys, *argv):
    """Stdout of a command that does its work."""
    with pytest.raises(SystemExit) as ended:
        main(argv)
    assert not ended.value.code
    return capsys.readouterr().out


def test_friction_tells_the_budget_in_json_and_in_words(study, capsys):
    (row,) = json.loads(ran(capsys, "friction", str(study), "--json"))["runs"]
    found = {part["source"]: part for part in row["budget"]}
    assert list(found)[-1] == "total"
    assert found["scale"]["share_mean"] + found["mass"]["share_mean"] > 0.5
    total = found.pop("total")
    assert sum(part["share_mean"] or 0.0 for part in found.values()) == pytest.approx(1.0)
    assert total["mean_N"] == pytest.approx(np.sqrt(sum((p["mean_N"] or 0.0) ** 2 for p in found.values())))
    out = ran(capsys, "friction", str(study))
    assert "v4: error from" in out
    assert "mean friction force: " in out


def test_the_figure_and_the_table_tell_the_same(study, monkeypatch):
    monkeypatch.setattr(Session, "diagnose", lambda session, seed=0: None)
    session = Session(open_study(study))
    (row,) = session.measure("friction")["runs"]
    found = {"rows": row["budget"], "says": row["budget_says"]}
    figure = plots.budget("v4", found)
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == [
        part["source"] for part in row["budget"]
    ]
    assert figure.axes[0].get_xlabel() == "error of the mean force / N"
    assert "not known" in [text.get_text() for text in figure.axes[0].texts]
    results = session.results()
    page = report.render(results).partition('id="budget"')[2]
    assert "<b>v4</b>: " in page
    assert all(f">{part['source']}</td>" in page for part in row["budget"][:-1])
    without = replace(results, runs=tuple(replace(run, budget={}) for run in results.runs))
    assert 'id="budget"' not in report.render(without)
