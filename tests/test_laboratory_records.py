"""Records as laboratories make them: swings, clocks, counters, placeholders, wheels; truth is a closed form."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import frictrack as ft
from frictrack import sampling
from frictrack.effects import LIBRARY
from frictrack.fit.least_squares import fit_with_scatter
from frictrack.flow import propose_study
from frictrack.measure.friction import count_flights, drive_noise, free_section, impact
from frictrack.measure.table_clock import with_even_clock
from frictrack.records import Array
from frictrack.simulate.dynamics import Panels, directions, solve_motion
from frictrack.study import TableData, open_table, read_frame, read_table

MASS, STIFFNESS, COULOMB, VISCOUS = 0.35, 14.0, 0.03, 0.02
LAW = {"coulomb.F_c": COULOMB, "viscous.F_v": VISCOUS, "spring.k": STIFFNESS}
LOSS = VISCOUS / 2 / MASS  # 1/s
OMEGA = float(np.sqrt(STIFFNESS / MASS - LOSS**2))


def swing(t: Array) -> Array:
    """A mass that is let go 0.1 m from where its spring is slack: damped cosines, whose centre dry friction moves."""
    x, place, side, begin = np.empty_like(t), 0.1, 1.0, 0.0
    half = np.pi / OMEGA
    while begin <= t[-1]:
        rows = (t >= begin) & (t <= begin + half)
        since, centre = np.append(t[rows] - begin, half), side * COULOMB / STIFFNESS
        turn = np.exp(-LOSS * since) * (np.cos(OMEGA * since) + LOSS / OMEGA * np.sin(OMEGA * since))
        way = centre + (place - centre) * turn
        x[rows], place, side, begin = way[:-1], way[-1], -side, begin + half
        if STIFFNESS * abs(place) <= COULOMB:
            x[t > begin] = place
            break
    return x


def slide(t: Array) -> Array:
    """A mass that slides from 1.5 m/s under 0.9 N and 0.2 N s/m to its stop at 0.503 s."""
    tau = MASS / 0.2
    since = np.minimum(t, tau * np.log(1 + 1.5 / 4.5))
    return (1.5 + 4.5) * tau * (1 - np.exp(-since / tau)) - 4.5 * since


def noisy(x: Array, sigma: float = 3e-6) -> Array:
    return x + sigma * np.random.default_rng(3).normal(size=len(x))


@pytest.mark.slow
def test_the_law_of_a_swing_does_not_depend_on_how_seldom_it_is_sampled() -> None:
    t = np.arange(0, 8, 0.02)
    fit = ft.fit("coulomb + viscous + spring", [ft.Run.from_arrays(t, noisy(swing(t)), mass=MASS)])
    assert fit.reduced_chi2 < 1.3
    for name, true in LAW.items():
        found = fit.parameters[name]
        assert found.value == pytest.approx(true, abs=3 * (found.std or 0.0), rel=0)
        assert found.std < 2e-3 * true


@pytest.mark.parametrize("interval", [0.005, 0.02, 0.04])
def test_dry_friction_turns_within_a_panel_as_it_does(interval: float) -> None:
    t = np.arange(0.1, 8, interval)  # from within the first half swing to before the stop
    panels = Panels(t)

    def law(x: Array, v: Array, t: Array) -> Array:
        return -(STIFFNESS * x + VISCOUS * v + COULOMB * directions(panels, v)) / MASS

    lever = STIFFNESS * 0.1 - COULOMB  # of the first half swing, N
    speed = -lever / (MASS * OMEGA) * np.exp(-LOSS * t[0]) * np.sin(OMEGA * t[0])
    x = swing(np.append(0.0, t))[1:]
    motion, _ = solve_motion(law, panels, (x[0], speed), -STIFFNESS / MASS * np.interp(panels.t, t, x))
    assert np.sum(np.diff(np.sign(motion.v)) != 0) == 16
    np.testing.assert_allclose(motion.x_edge, x, atol=1e-6 * (interval / 0.02) ** 4)


@pytest.mark.slow
def test_a_swing_that_is_let_go_keeps_its_first_quarter_and_one_that_is_pushed_does_not() -> None:
    t = np.arange(0, 4, 2e-3)
    run = ft.Run.from_arrays(t, noisy(swing(t)), mass=MASS)
    assert run.motion.t[np.argmax(free_section(run)[0])] < 0.05

    def pull(t: float, state: Array) -> list[float]:
        x, v = state
        return [v, (-STIFFNESS * x - COULOMB * np.tanh(v / 1e-3) - VISCOUS * v - (t < 0.1)) / MASS]

    x = solve_ivp(pull, (0, 3), (0.1, 0.0), t_eval=t[t < 3], max_step=5e-3).y[0]
    pushed = ft.Run.from_arrays(t[t < 3], noisy(x), mass=MASS)
    assert pushed.motion.t[np.argmax(free_section(pushed)[0])] > 0.1


@pytest.mark.slow
def test_a_gap_and_another_rate_within_a_swing_are_neither_rounding_nor_an_impact() -> None:
    t = np.arange(0, 8, 2e-3)
    x = noisy(swing(t))
    there = (t < 4) | (t > 5)
    assert len(with_even_clock(TableData(t[there], x[there])).t) == np.sum(there)
    slower = (t < 4) | (np.arange(len(t)) % 5 == 0)
    run = ft.Run.from_arrays(t[slower], x[slower], mass=MASS)
    assert impact(run) == ""
    assert count_flights(run) == 1


def test_the_blow_that_starts_a_slide_is_no_impact() -> None:
    t = np.arange(0, 1.5, 1e-3)
    run = ft.Run.from_arrays(t, noisy(slide(np.maximum(t - 0.8, 0.0))), mass=MASS)
    assert impact(run) == ""


def test_the_noise_of_a_drive_is_its_own_however_smooth_it_is() -> None:
    t, rng = np.arange(0, 8, 0.01), np.random.default_rng(0)
    tones = np.arange(0.2, 10, 0.2)
    drive = np.sin(2 * np.pi * np.outer(t, tones) + rng.uniform(0, 6, len(tones))).sum(axis=1)
    for sigma in (0.0, 0.05):
        measured = drive + sigma * rng.normal(size=len(t))
        run = ft.Run.from_arrays(t, slide(0.05 * t), mass=MASS, drive=measured)
        assert drive_noise(run) == pytest.approx(sigma, rel=0.1, abs=1e-9)


@pytest.mark.parametrize("value", [-999.0, 0.0])
def test_a_value_that_stands_for_no_position_is_left_out(value: float) -> None:
    t = np.arange(0, 0.5, 1e-3)
    x = noisy(slide(t))
    x[100:130] = x[300:302] = value
    table = with_even_clock(TableData(t, x))
    assert table.numbers.tolist() == [*range(100), *range(130, 300), *range(302, 500)]
    assert table.notes == (f"32 rows hold {value:g} instead of a position: left out",)


def test_coarse_positions_at_rest_and_after_a_jump_stand_for_themselves() -> None:
    coarse = np.round(noisy(swing(np.arange(0, 8, 2e-3)), 1e-4), 3)
    stops = np.r_[np.zeros(50), np.linspace(0, 0.5, 50), np.full(90, 0.5), np.linspace(0.5, 0, 3), np.zeros(90)]
    assert not np.any(sampling.placeholders(coarse))
    assert not np.any(sampling.placeholders(np.round(stops, 3)))


def test_the_angle_of_a_wheel_is_its_way_by_the_radius() -> None:
    pd = pytest.importorskip("pandas")
    t = np.arange(0, 0.5, 1e-3)
    frame = pd.DataFrame({"Time (s)": t, "Angle (deg)": np.degrees(slide(t) / 0.025) % 360})
    data = read_frame(frame, {"t": "Time (s)", "x": "Angle (25 mm/rad)"})
    assert data.x == pytest.approx(slide(t), abs=1e-12)
    assert not data.notes
    with warnings.catch_warnings():  # a moment of inertia has no weight that friction could exceed
        warnings.simplefilter("error")
        angle = ft.Run.from_dataframe(frame, mass="0.2 g", columns={"t": "Time (s)", "x": "Angle (deg)"})
    assert "(25 mm/rad)" in angle.displacement.notes[0]


def test_times_of_numpy_and_pandas_know_their_unit() -> None:
    pd = pytest.importorskip("pandas")
    t = np.arange(0, 0.5, 1e-3)
    since = (1e6 * t).round().astype("timedelta64[us]")
    for times in (since, np.datetime64("2024-03-31T01:59:59") + since):
        assert ft.Run.from_arrays(times, noisy(slide(t)), mass=MASS).motion.t == pytest.approx(t, abs=1e-9)
    assert read_frame(pd.DataFrame({"t_s": since, "x_m": slide(t)})).t == pytest.approx(t, abs=1e-9)


def test_titles_between_records_below_one_another_begin_new_runs(tmp_path: Path) -> None:
    t = np.arange(0, 0.4, 1e-3)
    rows = "".join(f"{a:.3f}\t{1e3 * b:.3f}\n" for a, b in zip(t, slide(t), strict=True))
    (tmp_path / "all.txt").write_text("".join(f"Run {i}\nTime (s)\tPosition (mm)\n{rows}\n" for i in (1, 2)))
    assert [track.columns["x"] for track in open_table(tmp_path / "all.txt").tracks] == [
        "Run 1: Position (mm)",
        "Run 2: Position (mm)",
    ]


def test_arrays_of_numpy_and_decimal_commas_in_cells_are_read(tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    t = np.arange(0, 0.4, 1e-3)
    np.savez(tmp_path / "a.npz", t=t, x=slide(t))
    assert open_table(tmp_path / "a.npz").frame["x"].to_numpy() == pytest.approx(slide(t))
    book = openpyxl.Workbook()
    for row in (
        ["Zeit (s)", "Weg (m)"],
        *([f"{a:.3f}".replace(".", ",") for a in pair] for pair in zip(t, slide(t), strict=True)),
    ):
        book.active.append(row)
    book.save(tmp_path / "b.xlsx")
    data = read_table(tmp_path / "b.xlsx", {"t": "Zeit (s)", "x": "Weg (m)"})
    assert data.x == pytest.approx(slide(t), abs=6e-4)


def test_a_counter_that_rolls_over_is_no_swing(tmp_path: Path) -> None:
    t = np.arange(0, 0.5, 2e-4)
    counts = np.floor(slide(t) / 10e-6).astype(int) % 256
    table = "".join(f"{a:.4f},{b}\n" for a, b in zip(t, counts, strict=True))
    (tmp_path / "a.csv").write_text(f"Time (s),Encoder (10 um/count)\n{table}")
    propose_study(tmp_path, {"mass": "350 g"})
    assert "spring" not in (tmp_path / "study.toml").read_text()


def test_many_swings_with_levels_of_their_own_are_fitted_to_the_end() -> None:
    """More swings than the first fit takes: the law is then refined on all, with the scatter of the levels."""
    rng, runs, g = np.random.default_rng(3), [], 9.80665
    for mu, degrees in ((0.002, 2.0), (0.0022, 1.9), (0.012, 2.05), (0.004, 1.6)):
        pull, rub = g * np.sin(np.radians(degrees)), g * mu * np.cos(np.radians(degrees))
        t, begin, v, parts = np.arange(0, 40.0, 0.01), 0.0, 0.9, []
        while begin < 40.0 and v > 0.15:  # up the ramp, down to a bumper
            up, height = v / (pull + rub), v * v / 2 / (pull + rub)
            down, since = np.sqrt(2 * height / (pull - rub)), t - begin
            x = np.where(
                since < up, v * since - (pull + rub) / 2 * since**2, height - (pull - rub) / 2 * (since - up) ** 2
            )
            parts.append(x[(since >= 0) & (since < up + down)])
            begin, v = begin + up + down, 0.97 * (pull - rub) * down
        x = np.concatenate(parts)
        x = np.round(x + 3e-3 * rng.standard_normal(len(x)), 2)
        name = f"{degrees} deg"
        runs.append(ft.Run.from_arrays(t[: len(x)], x, mass=0.25, name=name, incline="2.0 +/- 0.3 deg"))
    own = LIBRARY["slope"].adjusted(F={"per_run": True})
    found = ft.fit(["coulomb", own], runs).solution
    assert len(found.problem.pieces) > 16
    again = fit_with_scatter(found.problem, found.p, found.starts, found.tau)
    assert abs(found.objective - again.objective) < 0.1
