"""Tables as laboratories write them: clocks, counts, angles, words for gaps, several runs; the truth is SciPy's."""

from __future__ import annotations

import datetime as dt
import json
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy
from scipy.integrate import solve_ivp

from frictrack.cli import main
from frictrack.flow import Session, open_study, propose_study
from frictrack.study import open_table, read_frame
from frictrack.study.column_names import runs_of_columns

MASS, F_C, F_V = 0.42, 1.1, 0.35
SPEEDS = {"a": 2.4, "b": 1.3, "c": -1.8}
START = dt.datetime(2023, 4, 5, 23, 59, 59, 700000, tzinfo=dt.UTC)
Rows = Iterable[tuple[str, ...]]


def slide(speed: float, t: np.ndarray, inertia: float = MASS, level: float = F_C, slope: float = F_V) -> np.ndarray:
    """Positions of a body that dry and viscous friction brake to rest."""
    sign = np.sign(speed)
    stops = lambda _, y: y[1]  # noqa: E731 - solve_ivp takes its attribute
    stops.terminal = True
    found = solve_ivp(
        lambda _, y: [y[1], -(level * sign + slope * y[1]) / inertia],
        (0, 60),
        [0, speed],
        rtol=1e-11,
        atol=1e-13,
        events=stops,
        dense_output=True,
    )
    return found.sol(np.clip(t, 0, found.t[-1]))[0]


def records(rate: float, noise: float = 5e-6) -> Iterable[tuple[str, np.ndarray, np.ndarray]]:
    """Names, times and positions of three slides."""
    for seed, (name, speed) in enumerate(SPEEDS.items()):
        t = np.arange(0, 0.96 * MASS / F_V * np.log(1 + F_V * abs(speed) / F_C), 1 / rate)
        yield name, t, slide(speed, t) + noise * np.random.default_rng(seed).normal(size=len(t))


def write(folder: Path, header: str, cells: Callable[[float, float, int], tuple[str, ...]], rate: float = 200, **how):
    """Write the slides as texts."""
    separator, noise = how.get("separator", ","), how.get("noise", 5e-6)
    for name, t, x in records(rate, noise):
        rows = [separator.join(cells(*row)) for row in zip(t, x, range(len(t)), strict=True)]
        lines = [*how.get("above", ()), *([header] if header else []), *rows, *how.get("below", ())]
        (folder / f"{name}.csv").write_text("\n".join(lines), encoding=how.get("encoding", "utf-8"))


def law(folder: Path, mass: str | None = "0.42 kg", fps: float | None = None, units: dict[str, str] | None = None):
    """Fit what `init` proposes, with units filled in where it asks for them."""
    path = Path(propose_study(folder, {"mass": mass, "scale": None, "fps": fps})["study"])
    text = path.read_text(encoding="utf-8").replace("# FILL IN the units: ", "")
    for proposed, right in (units or {}).items():
        assert proposed in text
        text = text.replace(proposed, right)
    path.write_text(text, encoding="utf-8")
    return Session(open_study(path)).fit()


def assert_law(found, level: float = F_C, slope: float = F_V) -> None:
    for name, right in (("coulomb.F_c", level), ("viscous.F_v", slope)):
        one = found["parameters"][name]
        assert abs(one["value"] - right) < 2.6 * one["std"]
        assert abs(one["value"] / right - 1) < 0.03
    assert found["errors"]["reduced_chi2"] < 1.3


def mm(x: float) -> str:
    return f"{1e3 * x:.4f}"


def german(value: float, digits: int) -> str:
    return f"{value:,.{digits}f}".translate(str.maketrans(",.", ".,"))


CLOCKS = {
    "zone": ("timestamp,x (mm)", lambda t: (START + dt.timedelta(seconds=t)).isoformat(timespec="milliseconds")),
    "half days": ("Time,x (mm)", lambda t: f"{START + dt.timedelta(seconds=t):%m/%d/%Y %I:%M:%S.%f %p}"),
    "time of day": ("Time,x (mm)", lambda t: f"{START + dt.timedelta(seconds=t):%H:%M:%S.%f}"),
    "since 1970": ("timestamp,x (mm)", lambda t: str(1700000000123 + round(1e3 * t))),
    "days": ("Date,x (mm)", lambda t: f"{45321.3 + t / 86400:.10f}"),
    "minutes": ("Time (min),x (mm)", lambda t: f"{3.2 + t / 60:.7f}"),
    "five digits": ("t (s),x (mm)", lambda t: f"{t:.5f}"),
}


@pytest.mark.few(2)
@pytest.mark.parametrize("name", CLOCKS)
def test_clocks_need_no_unit_where_their_values_tell(tmp_path: Path, name: str) -> None:
    header, clock = CLOCKS[name]
    rate = 300 if name == "five digits" else 200
    write(tmp_path, header, lambda t, x, i: (clock(t), mm(x)), rate)
    assert_law(law(tmp_path))


def test_frames_are_counted_with_a_rate_above_the_rows_or_given(tmp_path: Path) -> None:
    write(tmp_path, "Sample,x (mm)", lambda t, x, i: (str(i + 1), mm(x)), above=["# Sample rate: 200 Hz"])
    assert_law(law(tmp_path))


@pytest.mark.few(1)
@pytest.mark.parametrize("bits", [16, 32])
def test_counts_roll_over_and_have_a_size(tmp_path: Path, bits: int) -> None:
    def count(t: float, x: float, i: int) -> tuple[str, str]:
        value = (round(x / 2e-6) + 2 ** (bits - 1) - 9000) % 2**bits - 2 ** (bits - 1)
        return f"{t:.4f}", str((value + 2 ** (bits - 1)) % 2**bits - 2 ** (bits - 1))

    write(tmp_path, "t (s),encoder (counts)", count, 1000, noise=0.0)
    assert_law(law(tmp_path, units={'"encoder (counts) (m)"': '"encoder (counts) (2 um)"'}))


def test_the_size_of_a_count_and_the_mass_are_read_above_the_rows(tmp_path: Path) -> None:
    above = ["# Masse: 420 g", "# scale: 2 um/count"]
    write(tmp_path, "t (s),enc", lambda t, x, i: (f"{t:.4f}", str(round(x / 2e-6))), 1000, above=above, noise=0.0)
    assert_law(law(tmp_path, mass=None))


@pytest.mark.few(1)
@pytest.mark.parametrize(("unit", "turn"), [("°", 360.0), ("rad", 2 * np.pi)])
def test_wrapped_angles_are_positions_in_radians(tmp_path: Path, unit: str, turn: float) -> None:
    t = np.arange(900) / 400
    for seed, speed in enumerate((11.0, -9.0)):
        x = slide(speed, t, 0.02, 0.06, 0.004) + 1e-3 * np.random.default_rng(seed).normal(size=len(t))
        x = (x + 2.9) * turn / (2 * np.pi) % turn
        rows = [f"{a:.4f},{b:.6f}" for a, b in zip(t, x, strict=True)]
        (tmp_path / f"{'ab'[seed]}.csv").write_text("\n".join([f"t (s),angle ({unit})", *rows]), encoding="utf-8")
    assert_law(law(tmp_path, mass="0.02 kg"), 0.06, 0.004)


TEXTS = {
    "thousands": ("t (ms);x (um)", lambda t, x, i: (german(1e3 * t, 1), german(1e6 * x, 1)), {"separator": ";"}),
    "words": ("t (s),x (mm)", lambda t, x, i: (f"{t:.4f}", "OVERLOAD" if 40 <= i < 44 else mm(x)), {}),
    "number sign": ("t (s),x (mm)", lambda t, x, i: (f"{t:.4f}", "1.#QNAN" if i == 40 else mm(x)), {}),
    "summary": ("t (s),x (mm)", lambda t, x, i: (f"{t:.4f}", mm(x)), {"below": ["Mean,1.3", "End of data"]}),
    "no header": ("", lambda t, x, i: (f"{t:.4f}", mm(x)), {}),
    "full width": ("时间（s）,位移（mm）", lambda t, x, i: (f"{t:.4f}", mm(x)), {}),
    "japanese": ("時間 (s),変位 (mm)", lambda t, x, i: (f"{t:.4f}", mm(x)), {"encoding": "cp932"}),
    "units written out": ("Time (Seconds),X (Meters),Distance", lambda t, x, i: (f"{t:.4f}", f"{x:.7f}", "-1"), {}),
    "unnamed rows": (",Slice n° (frames),x (mm)", lambda t, x, i: (str(i + 1), str(i + 1), mm(x)), {}),
    "chinese": ("时间(s),位移(mm)", lambda t, x, i: (f"{t:.4f}", mm(x)), {"encoding": "gb18030"}),
}


@pytest.mark.few(2)
@pytest.mark.parametrize("name", TEXTS)
def test_texts_of_instruments(tmp_path: Path, name: str) -> None:
    header, cells, how = TEXTS[name]
    write(tmp_path, header, cells, **how)
    units = {'"column 1 (s)"': '"column 1 (s)"', '"column 2 (m)"': '"column 2 (mm)"'} if name == "no header" else {}
    assert_law(law(tmp_path, units=units, fps=200 if name == "unnamed rows" else None))


def test_a_log_of_an_arduino_is_a_table(tmp_path: Path) -> None:
    write(tmp_path, "micros,pos_mm", lambda t, x, i: (f"{1e6 * t + 4294000000:.0f}", mm(x)))
    for path in tmp_path.glob("*.csv"):
        path.rename(path.with_suffix(".log"))
    assert_law(law(tmp_path))


def test_a_letter_in_japanese_is_read_as_it_was_written(tmp_path: Path) -> None:
    write(tmp_path, *TEXTS["japanese"][:2], encoding="cp932")
    assert "変位 (mm)" in Path(
        propose_study(tmp_path, {"mass": "1 kg", "scale": None, "fps": None})["study"]
    ).read_text("utf-8")


def test_sheets_of_a_workbook_and_columns_beside_one_clock_are_runs(tmp_path: Path) -> None:
    slides = list(records(300))
    with pd.ExcelWriter(tmp_path / "book.xlsx") as book:
        pd.DataFrame({"Operator": ["A"], "Date": ["today"]}).to_excel(book, sheet_name="info", index=False)
        for name, t, x in slides:
            pd.DataFrame({"Time (s)": t, "x (mm)": 1e3 * x}).to_excel(book, sheet_name=name, index=False)
    found = law(tmp_path)
    assert len(found["per_run"]) == 3
    assert_law(found)
    (tmp_path / "beside").mkdir()
    longest = max((t for _, t, _ in slides), key=len)
    columns = {"Time (s)": longest} | {f"Run {i} (mm)": pd.Series(1e3 * x) for i, (_, _, x) in enumerate(slides)}
    pd.DataFrame(columns).to_csv(tmp_path / "beside" / "all.csv", index=False)
    found = law(tmp_path / "beside")
    assert len(found["per_run"]) == 3
    assert_law(found)


def test_a_label_of_the_run_may_stand_first() -> None:
    headers = [f"Run {k} {name}" for k in (1, 2, 3) for name in ("t (s)", "x (m)")]
    assert [run["x"] for run in runs_of_columns(headers)] == headers[1::2]


def test_records_below_one_another_are_runs(tmp_path: Path) -> None:
    rows = [f"{t:.4f},{mm(x)}" for _, times, places in records(300) for t, x in zip(times, places, strict=True)]
    (tmp_path / "all.csv").write_text("\n".join(["Time (s),x (mm)", *rows]))
    found = law(tmp_path)
    assert len(found["per_run"]) == 3
    assert_law(found)


def test_structures_of_matlab_are_runs(tmp_path: Path) -> None:
    cells = np.zeros(3, dtype=[("t", "O"), ("x", "O")])
    for i, (_, t, x) in enumerate(records(300)):
        cells[i] = (t, 1e3 * x)
    scipy.io.savemat(tmp_path / "runs.mat", {"data": cells})
    units = {f'"data({i}): x (m)"': f'"data({i}): x (mm)"' for i in (1, 2, 3)}
    assert_law(law(tmp_path, units=units))


@pytest.mark.few(1)
@pytest.mark.parametrize("spread", [0.3, None])
def test_uneven_and_repeated_times(tmp_path: Path, spread: float | None) -> None:
    for seed, (name, speed) in enumerate(SPEEDS.items()):
        rng, end = np.random.default_rng(seed), 0.38
        t = (
            np.arange(1, 115) / 300 + spread * rng.uniform(-1, 1, 114) / 300
            if spread
            else np.sort(rng.uniform(0, end, 300))
        )
        x = slide(speed, t) + 5e-6 * rng.normal(size=len(t))
        rows = [f"{a:.6f},{mm(b)}" for a, b in zip(t, x, strict=True)]
        (tmp_path / f"{name}.csv").write_text("\n".join(["t (s),x (mm)", rows[0], *rows]))
    found = law(tmp_path)
    for name, right in (("coulomb.F_c", F_C), ("viscous.F_v", F_V)):
        one = found["parameters"][name]
        assert abs(one["value"] - right) < 2.6 * one["std"]


def test_swings_about_two_origins_are_proposed_with_a_spring(tmp_path: Path) -> None:
    t = np.arange(600) / 50
    for seed, origin in enumerate((0.1, 0.1187)):
        motion = solve_ivp(
            lambda _, y: [y[1], -(2.6 * y[0] + 0.02 * y[1]) / 0.2], (0, 12), [0.15, 0], t_eval=t, rtol=1e-10
        )
        x = origin + motion.y[0] + 5e-4 * np.random.default_rng(seed).normal(size=len(t))
        rows = [f"{a:.4f},{b:.6f}" for a, b in zip(t, x, strict=True)]
        (tmp_path / f"p{seed}.csv").write_text("\n".join(["t_s,x_m", *rows]))
    found = law(tmp_path, mass="0.2 kg")["parameters"]
    for name, right in (("spring.k", 2.6), ("viscous.F_v", 0.02)):
        assert abs(found[name]["value"] - right) < 2.6 * found[name]["std"]


def test_a_drive_is_named_and_init_takes_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.csv").write_text("Time (s),Position (m),Drive (N)\n0,0,1\n0.1,0.1,1\n0.2,0.3,1\n")
    (tmp_path / "b.csv").write_text("t_s,x_m\n0,0\n0.1,0.1\n0.2,0.3\n")
    (tmp_path / "force.csv").write_text("t_s,drive_N\n0,1\n0.1,1\n")
    with pytest.raises(SystemExit) as ended:
        main(["init", str(tmp_path / "a.csv"), str(tmp_path / "force.csv"), "--json"])
    assert ended.value.code in (0, None)
    said = json.loads(capsys.readouterr().out)
    assert said["runs"] == ["a.csv"]
    assert 'drive is "Drive (N)"' in said["found"][0]["words"]


def test_a_voltage_beside_positions_is_named_with_the_line_that_makes_it_a_drive(tmp_path: Path) -> None:
    """A second encoder, a counter and a switch are no drive; the name of the column does not count."""
    t = np.arange(200) / 1000
    q, ref = np.sin(40 * t), np.cos(40 * t)
    columns = {"t": t, "q": q, "q2": 2 * q, "n": t + 5, "on": 1 + 0 * t, "ref": ref}
    pd.DataFrame(columns).to_csv(tmp_path / "a.csv", index=False)
    pd.DataFrame({"t (s)": t, "x (mm)": q, "U (V)": ref}).to_csv(tmp_path / "b.csv", index=False)
    words = {one["file"]: one["words"] for one in propose_study(tmp_path, {"mass": "1 kg"})["found"]}
    assert words["a.csv"].endswith('not read: ref; if one is a voltage, current or share of a drive, name it with its '
                                   'force per unit: drive = "ref (35 N)"')  # fmt: skip
    assert words["b.csv"].endswith('drive = "U (35 N)"')
    read = open_table(tmp_path / "b.csv").frame
    drive = read_frame(read, {"t": "t (s)", "x": "x (mm)", "drive": "U (35 N)"}).drive
    assert drive == pytest.approx(35 * ref)


def test_coefficients_without_a_mass_are_summarised(tmp_path: Path) -> None:
    v = np.array([0.005, 0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.2, 0.3, 0.5, 0.8])
    mu = 0.1 + 0.075 * np.exp(-v / 0.06) + 0.035 * v + 5e-4 * np.random.default_rng(3).normal(size=len(v))
    rows = [f"{a:.4f},{b:.5f}" for a, b in zip(v, mu, strict=True)]
    (tmp_path / "bench.csv").write_text("\n".join(["速度(m/s),摩擦系数", *rows]), encoding="utf-8")
    found = law(tmp_path, mass=None)["parameters"]["coulomb.F_c"]
    assert abs(found["value"] - 0.1) < 2.6 * found["std"]
