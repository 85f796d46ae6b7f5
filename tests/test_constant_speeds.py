"""Points (v, F) of a bench that measures friction at constant speeds: from arrays, from a table, by `init`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import curve_fit

import frictrack as ft
from frictrack import effects
from frictrack.cli import main
from frictrack.fit.observations.load_cell import SpeedPoints
from frictrack.study import guess_points

SPEEDS = np.array([0.01, 0.02, 0.04, 0.06, 0.08, 0.1, 0.13, 0.17, 0.22, 0.3, 0.4, 0.6, 0.8, 1.0])
BOTH = np.r_[-SPEEDS[::-1], SPEEDS]


def stribeck(v: np.ndarray, F_c: float, F_s: float, v_s: float, F_v: float, delta: float = 2.0) -> np.ndarray:
    """Stribeck law with viscous friction."""
    return np.sign(v) * (F_c + (F_s - F_c) * np.exp(-((np.abs(v) / v_s) ** delta))) + F_v * v


def stribeck_of_two(v: np.ndarray, F_c: float, F_s: float, v_s: float, F_v: float) -> np.ndarray:
    """The same law with the exponent 2."""
    return stribeck(v, F_c, F_s, v_s, F_v)


TRUTH = (0.634, 2.235, 0.087, 0.607)
FORCE = stribeck(BOTH, *TRUTH) + 0.02 * np.random.default_rng(0).normal(size=len(BOTH))


def test_the_exponent_of_a_bench_is_named_first_and_nothing_else_is_invented() -> None:
    run = ft.Run.from_curve(BOTH, FORCE, name="bench")
    found = ft.diagnose(ft.fit("tustin", [run]))
    assert (found.verdict, found.missing) == ("missing", ["stribeck.delta"])
    again = ft.fit("stribeck-model", [run])
    assert again.parameters["stribeck.delta"].value == 2.0  # its upper bound
    best, covariance = curve_fit(stribeck_of_two, BOTH, FORCE, p0=TRUTH)
    names = ("coulomb.F_c", "stribeck.F_s", "stribeck.v_s", "viscous.F_v")
    for name, value, std in zip(names, best, np.sqrt(np.diag(covariance)), strict=True):
        estimate = again.parameters[name]
        assert estimate.value == pytest.approx(value, abs=0.02 * std)
        assert estimate.std is not None
        assert 0.7 * std < estimate.std < 2.5 * std  # delta is uncertain as well
    assert ft.diagnose(again).missing == []
    assert "only the law over the speed is tested" in found.remarks[0]
    assert all(span["t"] is None and span["v"] for span in found.fails_at)


def test_repeated_speeds_give_the_noise_and_the_test_of_the_law() -> None:
    rng = np.random.default_rng(4)
    v = np.repeat(np.geomspace(0.01, 1.0, 10), 4)
    force = stribeck(v, 1.0, 1.6, 0.08, 0.5, 1.0) + 0.03 * rng.normal(size=len(v))
    groups = force.reshape(10, 4)
    pure = np.sqrt(np.sum((groups - groups.mean(axis=1, keepdims=True)) ** 2) / 30)  # Draper & Smith, section 2.1
    points = SpeedPoints(v, np.ones(len(v)), np.ones(len(v)))
    assert points.noise(force[:, None])[0] == pytest.approx(pure, rel=1e-12)
    found = ft.diagnose(ft.fit(["coulomb", "viscous"], [ft.Run.from_curve(v, force)]))
    assert found.missing == ["stribeck"]
    assert found.p_lack_of_fit < 0.01
    right = ft.diagnose(ft.fit("tustin", [ft.Run.from_curve(v, force)]))
    assert right.verdict in ("complete", "undetermined")
    assert "scatter of repeated speeds, 30 degrees of freedom" in " ".join(right.remarks)


def test_few_points_without_repeats_name_nothing_that_is_not_there() -> None:
    rng, named = np.random.default_rng(8), 0
    for n in (6, 8, 10, 12, 16):
        v = np.geomspace(0.005, 1.0, n)
        for _ in range(2):
            force = stribeck(v, 1.0, 1.8, 0.08, 0.5, 1.0) + 0.02 * rng.normal(size=n)
            named += bool(ft.diagnose(ft.fit("tustin", [ft.Run.from_curve(v, force)])).missing)
    assert named == 0


def test_units_signs_coefficients_and_loads() -> None:
    v = SPEEDS
    mu = stribeck(v, 0.1, 0.2, 0.06, 0.08, 1.0)
    law = ["coulomb", "stribeck", "viscous"]
    per_newton = ft.fit(law, [ft.Run.from_curve(v, mu=mu, sigma=1e-3)])
    assert per_newton.parameters["coulomb.F_c"].value == pytest.approx(0.1, rel=1e-3)
    loaded = ft.Run.from_curve(v, mu=mu, sigma=1e-3, load="50 N")
    assert (loaded.load, loaded.friction_N[0]) == (50.0, pytest.approx(50 * mu[0]))
    assert loaded.sigma_friction[0] == pytest.approx(0.05)
    assert ft.fit(law, [loaded]).parameters["stribeck.F_s"].value == pytest.approx(10.0, rel=1e-3)
    assert ft.Run.from_curve(v, mu=mu, mass="2 kg").friction_N[0] == pytest.approx(2 * 9.80665 * mu[0])
    against = ft.Run.from_curve(BOTH, np.abs(stribeck(BOTH, *TRUTH)))
    assert np.array_equal(np.sign(against.friction_N), np.sign(BOTH))
    assert "one sign for both directions" in against.displacement.notes[0]
    on_mass = ft.Run.from_curve(BOTH, -stribeck(BOTH, *TRUTH))
    assert np.array_equal(np.sign(on_mass.friction_N), np.sign(BOTH))
    shuffled = np.random.default_rng(0).permutation(len(v))
    assert np.array_equal(ft.Run.from_curve(v[shuffled], mu=mu[shuffled]).friction_N, mu)


def test_several_loads_in_one_table_separate_what_the_load_carries() -> None:
    v, load = np.tile(SPEEDS, 3), np.repeat([10.0, 20.0, 40.0], len(SPEEDS))
    rng = np.random.default_rng(1)
    force = 0.2 * load + 3.0 * v + 0.01 * rng.normal(size=len(v))
    found = ft.fit(["coulomb", "viscous"], [ft.Run.from_curve(v, force, load=load, sigma=0.01)])
    assert found.parameters["coulomb.F_c"].value == pytest.approx(0.2 * load.mean(), abs=0.02)
    assert found.parameters["viscous.F_v"].value == pytest.approx(3.0, abs=0.03)
    more = force + 0.5
    missing = ft.diagnose(ft.fit(["coulomb", "viscous"], [ft.Run.from_curve(v, more, load=load, sigma=0.01)])).best
    assert missing is not None
    assert missing.effect in ("adhesion", "slope", "asymmetry")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (dict(v=SPEEDS), "expected a force (friction) or a coefficient (mu) for every speed but got none"),
        (dict(v=SPEEDS, friction=SPEEDS, mu=SPEEDS), "for every speed but got both"),
        (dict(v=SPEEDS[:4], friction=SPEEDS[:4]), "expected at least 5 points at speeds other than 0 but got 4"),
        (dict(v=1e3 * SPEEDS, friction=SPEEDS), "expected speeds in m/s but got 1000 m/s"),
        (dict(v=SPEEDS, friction=SPEEDS[1:]), "expected friction of shape (14,), as v has 14 values, but got (13,)"),
        (dict(v=SPEEDS, friction=SPEEDS, sigma=0.0), "expected sigma_friction above 0 but got 0"),
        (dict(v=SPEEDS, friction=SPEEDS, load=-1.0), "expected normal loads above 0"),
    ],
)
def test_faults_are_one_sentence(given: dict[str, object], message: str) -> None:
    with pytest.raises(ft.FrictrackError) as fault:
        ft.Run.from_curve(**given)  # type: ignore[arg-type]
    assert message in str(fault.value)


def test_what_needs_time_or_place_is_refused() -> None:
    run = ft.Run.from_curve(BOTH, FORCE)
    with pytest.raises(ft.FrictrackError, match=r"expected effects of the speed alone.*but got texture; remove it"):
        ft.fit(["coulomb", "texture"], [run])
    with pytest.raises(ft.FrictrackError, match=r"but got the domain of displacements"):
        ft.fit("tustin", [run], domain="displacement")
    with pytest.raises(ft.FrictrackError, match=r"expected only points \(v, F\).*but got 1 records over time"):
        ft.fit("tustin", [run, ft.samples.runs()[0]])
    with pytest.raises(ft.FrictrackError, match=r'draw its law with fit.plot\("law"\)'):
        run.plot()
    assert ft.fit("tustin", [run]).plot("law").axes
    of_velocity = {name for name, effect in effects.known([]).items() if effect.is_of_velocity}
    assert {"coulomb", "stribeck", "viscous", "drag", "asymmetry", "slope", "load_exponent"} <= of_velocity
    assert not of_velocity & {"drift", "thermal", "texture", "presliding", "vibration", "heating", "friction_lag"}


@pytest.mark.parametrize(
    ("headers", "found"),
    [
        ("velocity (m/s),friction (N)", {"v": "velocity (m/s)", "friction": "friction (N)"}),
        ("v (mm/s),COF,Normal force (N),T (degC)", {"v": "v (mm/s)", "mu": "COF", "load": "Normal force (N)"}),
        ("v (mm/s),Fx (N),Fz (N)", {"v": "v (mm/s)", "friction": "Fx (N)", "load": "Fz (N)"}),
        ("No,speed (m/s),F (N),std", {"v": "speed (m/s)", "friction": "F (N)", "sigma_friction": "std (N)"}),
        ("v,mu,std", {"v": "v", "mu": "mu", "sigma_mu": "std"}),
        ("t (s),speed (mm/s),force (N)", {}),
        ("t_s,x_m,friction_N", {}),
    ],
)
def test_headers_of_points_are_known(headers: str, found: dict[str, str]) -> None:
    assert guess_points(headers.split(",")) == found


def table(folder: Path, header: str, *columns: np.ndarray) -> Path:
    """Write a table."""
    rows = "\n".join(",".join(f"{value:.6g}" for value in row) for row in zip(*columns, strict=True))
    (folder / "bench.csv").write_text(f"{header}\n{rows}\n")
    return folder / "study.toml"


def test_init_and_run_understand_a_table_of_points(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study = table(tmp_path, "Speed [mm/s],Friction (N)", 1e3 * BOTH, FORCE)
    with pytest.raises(SystemExit):
        main(["init", str(tmp_path), "--json"])
    made = json.loads(capsys.readouterr().out)
    assert made["fill_in"] == []
    assert "28 points (v, F) at constant speeds, -1 to 1 m/s" in made["found"][0]["words"]
    with pytest.raises(SystemExit):
        main(["run", str(study), "--json"])
    result = json.loads(capsys.readouterr().out)
    assert result["diagnose"]["missing"] == ["stribeck.delta"]
    assert "velocity v" in (tmp_path / "study_results" / "report.html").read_text()


def test_a_turning_speed_is_refused_with_what_to_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table(tmp_path, "speed (rpm),F (N)", SPEEDS, SPEEDS)
    with pytest.raises(SystemExit):
        main(["init", str(tmp_path)])
    assert "add a column of v = 2 pi r n / 60" in " ".join(capsys.readouterr().err.split())
