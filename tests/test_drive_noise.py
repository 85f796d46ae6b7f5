"""Noise of a measured drive, and positions that are integrated from speeds; the truth is SciPy's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.signal import lfilter

import frictrack as ft
from frictrack.fit.least_squares.solution import covariance_of, white_noise_covariance
from frictrack.flow import Session, open_study, propose_study
from frictrack.measure.friction import drive_noise
from frictrack.workbench.plot_data import comparison_plots

MASS, F_C, F_V = 0.5, 1.0, 0.6
N, STEP = 500, 4e-3


def driven(scatter: float, seed: int, *, is_force: bool, **stated: float) -> ft.Run:
    """A mass under a drive that scatters: in the reading alone, or as a force that the mass follows."""
    rng, t = np.random.default_rng(seed), STEP * np.arange(N)
    even = 2.0 + 0.5 * np.sin(5 * t + seed)
    measured = even + scatter * rng.normal(size=N)
    force = measured if is_force else even
    matrix = np.zeros((4, 4))
    matrix[0, 1], matrix[1, 1], matrix[1, 2], matrix[2, 3] = 1.0, -F_V / MASS, 1 / MASS, 1.0
    step, state, x = expm(STEP * matrix), np.array([0.0, 1.5]), np.empty(N)
    for k in range(N):  # exact for a force that is linear from sample to sample
        x[k] = state[0]
        slope = (force[min(k + 1, N - 1)] - force[k]) / STEP
        state = (step @ [*state, force[k] - F_C, slope])[:2]
    return ft.Run.from_arrays(t, x + 1e-5 * rng.normal(size=N), drive=measured, mass=MASS, name=f"r{seed}", **stated)


def deviations(found: ft.Fit) -> list[float]:
    truth = {"coulomb.F_c": F_C, "viscous.F_v": F_V}
    return [(found.parameters[name].value - true) / found.parameters[name].std for name, true in truth.items()]


@pytest.mark.parametrize("scatter", [0.001, 0.1, 1.0])
def test_the_law_lies_within_its_interval_although_the_drive_is_noisy(scatter: float) -> None:
    for seed, stated in enumerate(({}, {"sigma_drive": scatter})):
        found = ft.fit(["coulomb", "viscous"], [driven(scatter, seed, is_force=False, **stated)])
        assert np.max(np.abs(deviations(found))) < 2.6
        assert 0.8 < found.reduced_chi2 < 1.25
        assert found.parameters["coulomb.F_c"].std > 0.05 * scatter
    assert "errors of the measured drive count as noise of the positions: r1" in " ".join(found.estimates.remarks)


def test_a_drive_whose_noise_moves_the_mass_as_little_as_the_positions_scatter_is_not_exact() -> None:
    found = [ft.fit(["coulomb", "viscous"], [driven(3e-4, seed, is_force=False)]) for seed in range(8)]
    assert 0.4 < float(np.sqrt(np.mean(np.square([deviations(one) for one in found])))) < 1.6


def test_a_scatter_that_the_mass_follows_is_a_force_and_is_used() -> None:
    found = ft.fit(["coulomb", "viscous"], [driven(0.1, 3, is_force=True)])
    assert np.max(np.abs(deviations(found))) < 2.6
    assert found.parameters["coulomb.F_c"].std < 1e-3
    assert not any("errors of the measured drive" in remark for remark in found.estimates.remarks)


def test_chi_squared_of_accelerations_counts_the_noise_of_the_drive() -> None:
    found = ft.fit(["coulomb", "viscous"], [driven(0.1, 5, is_force=False)], domain="force")
    assert np.max(np.abs(deviations(found))) < 2.6
    assert 0.3 < found.reduced_chi2 < 2.5


@pytest.mark.few(1)
@pytest.mark.parametrize(("header", "size"), [("Time (s),Velocity (mm/s)", 1e3), ("t (s),v", 1.0)])
def test_a_table_of_speeds_is_a_record(tmp_path: Path, header: str, size: float) -> None:
    for seed, speed in enumerate((2.4, 1.3, -1.8)):
        rng, s = np.random.default_rng(seed), np.sign(speed)
        t = np.arange(0, 0.96 * MASS / F_V * np.log(1 + F_V * abs(speed) / F_C), 5e-3)
        v = solve_ivp(lambda _, y, s=s: -(F_C * s + F_V * y) / MASS, (0, 9), [speed], t_eval=t, rtol=1e-10).y[0]
        rows = [f"{a:.3f},{size * b:.5f}" for a, b in zip(t, v + 0.005 * rng.normal(size=len(t)), strict=True)]
        (tmp_path / f"r{seed}.csv").write_text("\n".join([header, *rows]))
    path = Path(propose_study(tmp_path, {"mass": "0.5 kg", "scale": None, "fps": None})["study"])
    text = path.read_text(encoding="utf-8").replace("# FILL IN the units: ", "")
    path.write_text(text.replace("[study]\n", '[study]\nmodel = ["coulomb", "viscous"]\n', 1), encoding="utf-8")
    found = Session(open_study(path)).fit()
    for name, true in (("coulomb.F_c", F_C), ("viscous.F_v", F_V)):
        one = found["parameters"][name]
        assert abs(one["value"] - true) < 2.6 * one["std"]
        assert one["std"] < 0.02
    assert 0.7 < found["errors"]["reduced_chi2"] < 1.35


def test_a_drive_that_covers_part_of_the_run_is_used_there(tmp_path: Path) -> None:
    run = driven(0.02, 7, is_force=False)
    t, part = run.displacement.t, slice(60, 420)
    for name, first, rows, columns in (
        ("run", "t_s,x_m", slice(None), (t, run.displacement.x)),
        ("drive", "t_s,drive_N", part, (t, run.drive)),
    ):
        table = np.column_stack([column[rows] for column in columns])
        np.savetxt(tmp_path / f"{name}.csv", table, delimiter=",", header=first, comments="")
    (tmp_path / "study.toml").write_text(
        f'[study]\nmass = "{MASS} kg"\nmodel = ["coulomb", "viscous"]\n[[run]]\ntable = "run.csv"\n'
        'drive = {table = "drive.csv", offset = 0}\nsigma_drive = "0.02 N"\n'
    )
    session = Session(open_study(tmp_path / "study.toml"))
    found = session.fit()
    for name, true in (("coulomb.F_c", F_C), ("viscous.F_v", F_V)):
        assert abs(found["parameters"][name]["value"] - true) < 2.6 * found["parameters"][name]["std"]
    assert "drive.csv covers 0.24 to 1.676 s: only this part is fitted" in session.runs[0].get("sensors").notes
    assert session.runs[0].to_run().free == pytest.approx((0.24, 1.676))


@pytest.mark.parametrize("rate", [100.0, 250.0])
def test_a_noisy_drive_that_is_read_less_often_than_the_positions_pushes_for_longer(
    tmp_path: Path, rate: float
) -> None:
    lines, t, u = ["[study]", f"mass = {MASS}"], np.arange(0, 1, 2e-3), np.arange(0, 1 + 1 / rate, 1 / rate)
    rng = np.random.default_rng(4)
    for k in range(2):

        def force(at: np.ndarray | float, k: int = k) -> np.ndarray:
            return np.asarray(2.2 + 0.1 * k + 0.5 * np.sin(2 * np.pi * (3 + k) * at + k))

        def motion(at: float, y: np.ndarray) -> list[float]:
            return [y[1], (float(force(at)) - F_C - F_V * y[1]) / MASS]

        x = solve_ivp(motion, (0, 1), [0, 0.2], t_eval=t, rtol=1e-10, atol=1e-12).y[0] + 1e-5 * rng.normal(size=len(t))
        read = force(u) + 0.02 * rng.normal(size=len(u))
        np.savetxt(tmp_path / f"x{k}.csv", np.c_[t, x.round(8)], delimiter=",", header="t_s,x_m", comments="")
        np.savetxt(tmp_path / f"d{k}.csv", np.c_[u, read], delimiter=",", header="t_s,drive_N", comments="")
        lines += ["[[run]]", f'name = "r{k}"', f'table = "x{k}.csv"', f'drive = {{table = "d{k}.csv", offset = 0.0}}']
    (tmp_path / "study.toml").write_text("\n".join(lines) + "\n")
    runs = [pipeline.to_run() for pipeline in Session(open_study(tmp_path / "study.toml")).runs]
    found = ft.fit(["coulomb", "viscous"], runs)
    assert np.max(np.abs(deviations(found))) < 2.6
    assert 0.8 < found.reduced_chi2 < 1.25
    known = ft.friction(runs[1])
    error = known.F - F_C - F_V * runs[1].motion.v
    assert 0.7 < np.sqrt(np.mean((error / known.sigma_F)[known.free] ** 2)) < 1.3


def cell_study(
    tmp_path: Path, rate: float, amplifier: float = 0.0, scatter: float = 0.02, *, inner: bool = False
) -> Session:
    """A mass that is led to and fro for 2 s, filmed at 500 Hz; a load cell behind an amplifier of first order.

    Its noise passes the amplifier, too, if it is `inner`.
    """
    t, u, rng = np.arange(0, 2, 2e-3), np.arange(-0.5 / rate, 2 + 1 / rate, 1 / rate), np.random.default_rng(1)
    x = 0.2 * t + 0.015 * np.sin(8 * t) + 1e-5 * rng.normal(size=len(t))
    swing, fine = 0.12 * np.exp(8j * u), np.exp(-2 * np.pi * amplifier * np.clip(u, 0.0, None))
    lag = 8 / (2 * np.pi * amplifier) if amplifier else 0.0
    felt = (swing / (1 + 1j * lag)).real + (0.12 * (1 - 1 / (1 + 1j * lag))).real * fine * (lag > 0)
    noise, kept = scatter * rng.normal(size=len(u)), np.exp(-2 * np.pi * amplifier / rate)
    noise = lfilter([1 - kept], [1, -kept], noise) if inner else noise
    friction = F_C + F_V * (0.2 + np.where(u < 0, 0.12, felt)) + noise
    np.savetxt(tmp_path / "x.csv", np.c_[t, x.round(8)], delimiter=",", header="t_s,x_m", comments="")
    np.savetxt(tmp_path / "cell.csv", np.c_[u, friction], delimiter=",", header="t_s,friction_N", comments="")
    lines = [
        f"[study]\nmass = {MASS}\n[[run]]",
        'name = "r"\ntable = "x.csv"',
        'sensor = {table = "cell.csv", offset = 0.0}',
    ]
    (tmp_path / "study.toml").write_text("\n".join(lines) + "\n")
    return Session(open_study(tmp_path / "study.toml"))


@pytest.mark.parametrize("rate", [100.0, 300.0, 500.0, 700.0])
def test_a_load_cell_of_its_own_clock_is_no_better_than_its_samples(tmp_path: Path, rate: float) -> None:
    runs = [pipeline.to_run() for pipeline in cell_study(tmp_path, rate).runs]
    found = ft.fit(["coulomb", "viscous"], runs)
    assert np.max(np.abs(deviations(found))) < 2.6
    assert 0.75 < found.reduced_chi2 < 1.25
    known = ft.friction(runs[0])
    error = known.F - F_C - F_V * (0.2 + 0.12 * np.cos(8 * runs[0].motion.t))
    assert 0.7 < np.sqrt(np.mean((error / known.sigma_F)[known.free] ** 2)) < 1.3


@pytest.mark.parametrize("inner", [False, True])
def test_a_load_cell_behind_a_slow_amplifier_is_named_with_its_lag(tmp_path: Path, inner: bool) -> None:
    session = cell_study(tmp_path, 500.0, amplifier=20.0, scatter=0.006 if inner else 0.002, inner=inner)
    runs = [pipeline.to_run() for pipeline in session.runs]
    found = session.diagnose()
    named = found["candidates"][0]  # so slow a motion does not part a lag from a delay
    assert (found["verdict"], found["missing"]) == ("ambiguous", [named["effect"]])
    assert {named["effect"], *named["indistinguishable_from"]} == {"cell_lag", "cell_delay"}
    found = ft.fit(["coulomb", "viscous", "cell_lag"], runs)
    assert np.max(np.abs(deviations(found))) < 2.6
    assert 0.7 < found.reduced_chi2 < 1.3
    lag = found.parameters["cell_lag.tau"]
    assert abs(lag.value - 1 / (2 * np.pi * 20.0)) < 2.6 * lag.std
    known = ft.friction(runs[0])
    error = known.F - F_C - F_V * (0.2 + 0.12 * np.cos(8 * runs[0].motion.t))
    z = np.sqrt(np.mean((error / known.sigma_F)[known.free] ** 2))
    assert 0.6 < z < 1.4 or not inner  # noise that passed the amplifier shows its lag


def test_the_force_of_a_load_cell_that_is_read_seldom_is_drawn(tmp_path: Path) -> None:
    session = cell_study(tmp_path, 100.0)
    session.fit("coulomb,viscous")
    results = session.results()
    (run,) = results.runs
    read = np.isfinite(run.sensors.friction_N)
    assert 150 < np.sum(read) < 250
    inside = slice(10, -10)
    assert run.friction.free[inside].all()  # the free section goes on between two samples
    found = comparison_plots(results, results.current)
    forces = next(one for one in found.plots if one["id"] == "Force against time")
    assert {layer["kind"] for layer in forces["layers"]} == {"dots"}  # a line needs neighbours
    assert not np.any(np.isfinite(found.columns["F"]) & ~read)
    assert np.isfinite(found.columns["noise_low"][inside]).all()
    mean = ft.budget(session.runs[0].to_run(), ft.low_pass(run.displacement)).rows[0]
    assert mean.mean_N == pytest.approx(mean.frame_N / np.sqrt(np.sum(read)), rel=0.1)


def test_a_drive_without_scatter_is_exact() -> None:
    run = replace(driven(0.0, 1, is_force=True), drive_scatter=None)
    assert drive_noise(run) == 0.0


def test_the_deviation_of_friction_has_no_least_value() -> None:
    t, rng = np.arange(400) / 1000, np.random.default_rng(3)
    x = [(1 + 0.2 * k) * t - 0.5 * t**2 + 1e-8 * rng.normal(size=len(t)) for k in range(2)]
    found = ft.fit(["coulomb"], [ft.Run.from_arrays(t, one, mass=MASS, name=f"r{k}") for k, one in enumerate(x)])
    one = found.parameters["coulomb.F_c"]
    assert one.std < 1e-5
    assert abs(one.value - MASS) < 4 * one.std


@pytest.mark.slow
def test_rounded_positions_of_a_motion_with_nearly_whole_steps_per_frame_have_errors_that_are_alike() -> None:
    t, step, runs, truth = np.arange(1000) / 1000, 1e-4, [], []
    for k in range(2):

        def force(at: np.ndarray | float, k: int = k) -> np.ndarray:
            return np.asarray(2.2 + 0.1 * k + 0.5 * np.sin(2 * np.pi * (3 + k) * at + k))

        def motion(at: float, y: np.ndarray) -> list[float]:
            return [y[1], (float(force(at)) - F_C - F_V * y[1]) / MASS]

        truth.append(solve_ivp(motion, (0, 1), [0, 0.3], t_eval=t, rtol=1e-11, atol=1e-13, max_step=0.02).y[0])
        x = np.round(truth[-1] / step) * step
        runs.append(ft.Run.from_arrays(t, x, drive=force(t), sigma_drive=0.0, mass=MASS, name=f"r{k}"))
    solution, rng, estimates = ft.fit(["coulomb", "viscous"], runs).solution, np.random.default_rng(1), []
    for _ in range(200):  # the same motion at another place between two steps, in linear approximation
        gradients = []
        for r in solution.responses:
            x = truth[r.piece.run][r.piece.frames] + step * rng.random()
            gradients.append((np.round(x / step) * step - x)[None] @ r.piece.whitening.transposed(r.jac))
        estimates.append((solution.stacked(gradients) @ white_noise_covariance(solution)[0]).sum(axis=0))
    scatter = np.std(estimates, axis=0) / np.sqrt(np.diag(covariance_of(solution)[0]))
    assert np.min(scatter[:2]) > 0.8
    assert np.max(scatter[:2]) < 1.25


@pytest.mark.slow
@pytest.mark.parametrize(("late", "offset", "name"), [(0.004, 0.0, "drive_delay"), (0.0, 0.25, "drive_offset")])
def test_a_drive_that_is_late_or_has_lost_its_zero_is_named(late: float, offset: float, name: str) -> None:
    t = np.arange(400) / 1000.0
    runs = []
    for seed, mass in enumerate((0.5, 0.5, 0.8, 1.1)):

        def drive(at, mass=mass):
            return mass * (3.0 + 4.0 * np.exp(-(((at - 0.15) / 0.03) ** 2)))

        def law(at, y, mass=mass, drive=drive):
            return [y[1], (drive(at - late) + offset - 2.0 * mass - F_V * y[1]) / mass]

        x = solve_ivp(law, (0, t[-1]), [0.0, 0.5], t_eval=t, rtol=1e-10, atol=1e-12, max_step=1e-3).y[0]
        noisy = x + 3e-6 * np.random.default_rng(seed).standard_normal(len(t))
        runs.append(ft.Run.from_arrays(t, noisy, mass=mass, drive=drive(t), sigma_drive=0.0, name=f"r{seed}"))
    found = ft.diagnose(ft.fit(["coulomb", "viscous"], runs), quick=True)
    assert found.missing == [name]
    size = ft.fit(["coulomb", "viscous", name], runs).parameters[f"{name}.{'tau' if late else 'D_0'}"]
    assert abs(size.value - (late or offset)) < 2.6 * size.std
