"""Files as instruments write them: LabVIEW, MATLAB, UTF-16, Excel days, dates, commented headers, several runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io

from frictrack import FrictrackError
from frictrack.flow import survey_recording
from frictrack.flow.new_study import propose_study
from frictrack.study import load, read_run_table, read_table

T = np.arange(40) * 1e-3
X = 2.0 * T - 1.5 * T**2  # m, of a slide that slows down
END = "***End_of_Header***"


def labview(sign: str = "\t", decimal: str = ".", columns: str = "One", segments: int = 1) -> str:
    """Return a LabVIEW measurement file with a laser in mm and a voltage; every segment has one row less."""
    lines = [["LabVIEW Measurement", ""], ["Separator", ""], ["Decimal_Separator", decimal], ["X_Columns", columns]]
    lines += [[END, ""], ["", ""]]
    for i in range(segments):
        lines += [
            ["Notes", "valid"],
            ["Channels", "2"],
            ["Y_Unit_Label", "mm", "Volts"],
            ["X_Dimension", "Time", "Time"],
        ]
        lines += [[key, *[f"{value:.6f}".replace(".", decimal)] * 2] for key, value in (("X0", 0), ("Delta_X", 1e-3))]
        clock = ["X_Value"] * (columns == "Multi")
        lines += [[END, "", ""], ["X_Value", "Laser", *clock, "Untitled", "Comment"]]
        for t, x in zip(T[i:], X[i:], strict=True):
            at = [f"{t:.6f}"] if columns != "No" else [""]
            row = [*at, f"{1e3 * x:.6f}", *at * (columns == "Multi"), "0.1"]
            lines.append([cell.replace(".", decimal) for cell in row])
        lines.append([""])
    return "\n".join(sign.join(line) for line in lines) + "\n"


def matlab_73(path: Path) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in (("run/t", T), ("run/x", X)):
            dataset = file.create_dataset(name, data=values[None])
            dataset.attrs["MATLAB_class"] = np.bytes_("double")
        file["run"].attrs["MATLAB_class"] = np.bytes_("struct")


def tdms(path: Path) -> None:
    nptdms = pytest.importorskip("nptdms")
    said = {"wf_increment": 1e-3, "unit_string": "mm"}
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment([nptdms.ChannelObject("g", "Laser", 1e3 * X, properties=said)])


def rows(line: str, *, scale: float = 1.0, t: np.ndarray = T, header: str = "", comma: bool = False) -> str:
    """Return a text with a row of every sample."""
    texts = (line.format(t=one, x=scale * x) for one, x in zip(t, X, strict=True))
    return header + "".join(f"{text.replace('.', ',') if comma else text}\n" for text in texts)


def text(content: str, encoding: str = "utf-8") -> Callable[[Path], object]:
    return lambda path: path.write_bytes(content.encode(encoding))


FILES: dict[str, tuple[Callable[[Path], object], dict[str, str]]] = {
    "one.lvm": (text(labview()), {"t": "t (s)", "x": "Laser (mm)"}),
    "none.lvm": (text(labview(decimal=",", columns="No")), {"t": "t (s)", "x": "Laser (mm)"}),
    "multi.lvm": (text(labview(columns="Multi")), {"t": "t (s)", "x": "Laser (mm)"}),
    "comma.txt": (text(labview(",")), {"t": "t (s)", "x": "Laser (mm)"}),
    "laser.tdms": (tdms, {"t": "t (s)", "x": "Laser (mm)"}),
    "old.mat": (lambda path: scipy.io.savemat(path, {"t": T, "x": X, "fs": 1e3}), {"t": "t (s)", "x": "x (m)"}),
    "rate.mat": (lambda path: scipy.io.savemat(path, {"s": {"fs": 1e3, "x": X}}), {"t": "t (s)", "x": "x (m)"}),
    "new.mat": (matlab_73, {"t": "t (s)", "x": "x (m)"}),
    "bare16.txt": (
        text(rows("{t:.4f}\t{x:.4f}", scale=1e3, header="Zeit (s)\tWeg (mm)\n", comma=True), "utf-16-le"),
        {"t": "Zeit (s)", "x": "Weg (mm)"},
    ),
    "days.txt": (
        text(rows("{t:.12f}\t{x:.7f}", t=42513.5 + T / 86400, header="Zeit\tWeg\n", comma=True), "utf-16"),
        {"t": "Zeit (d)", "x": "Weg (m)"},
    ),
    "hash.csv": (
        text(rows('"{t:.4f}", "{x:.7f}"', header="# x, Curve1\n", comma=True)),
        {"t": "x (s)", "x": "Curve1 (m)"},
    ),
    "semi.csv": (text(rows("{t:.4f};{x:.7f}", header="# x;Curve1\n", comma=True)), {"t": "x (s)", "x": "Curve1 (m)"}),
    "dates.csv": (
        text(rows("2016-05-23 21:46:{t:.4f},{x:.7f}", t=T + 10, header="time,pos\n")),
        {"t": "time (s)", "x": "pos (m)"},
    ),
    "german.csv": (
        text(rows("23.05.2016 21:46:{t:.4f};{x:.7f}", t=T + 10, header="Zeit;Weg (m)\n")),
        {"t": "Zeit (s)", "x": "Weg (m)"},
    ),
    "capstone.csv": (
        text(rows("{t:.4f},{x:.7f}", header="Time (s) Run #1,Position (m) Run #1\n")),
        {"t": "Time (s) Run #1", "x": "Position (m) Run #1"},
    ),
}


@pytest.mark.parametrize("name", FILES)
def test_a_file_of_an_instrument_is_read_and_its_columns_are_proposed(tmp_path: Path, name: str) -> None:
    make, columns = FILES[name]
    make(tmp_path / name)
    seen = survey_recording(tmp_path / name)
    assert seen.problem == ""
    said = [*seen.columns_to_confirm, *(str(dict(run)) for run in seen.runs)]
    assert any(all(header.partition(" (")[0] in line for header in columns.values()) for line in said), said
    data = read_table(tmp_path / name, columns)
    assert data.t - data.t[0] == pytest.approx(T, abs=2e-6)
    assert data.x == pytest.approx(X, abs=6e-7)


def test_every_run_of_a_file_becomes_a_run_of_the_study(tmp_path: Path) -> None:
    (tmp_path / "two.lvm").write_text(labview(segments=2))
    head = ",".join(f"Data Set {i}:Time(s),Data Set {i}:Position(m),Data Set {i}:Force(N)" for i in (1, 2))
    tail = [
        f"{t:.4f},{x:.7f},,{t:.4f},{x:.7f},1\n" if i < 30 else f"{t:.4f},{x:.7f},,,,\n"
        for i, (t, x) in enumerate(zip(T, X, strict=True))
    ]
    (tmp_path / "all.csv").write_text(f"{head}\n{''.join(tail)}")
    found = propose_study(tmp_path, {"mass": "0.35 kg"})
    assert found["fill_in"] == []
    study = load(Path(found["study"]))
    assert [run.name for run in study.runs] == ["all_1", "all_2", "two_1", "two_2"]
    read = [read_run_table(run) for run in study.runs]
    assert [len(data.t) for data in read] == [40, 30, 40, 39]
    assert read[1].x == pytest.approx(X[:30])
    assert read[3].x == pytest.approx(X[1:], abs=1e-8)
    with pytest.raises(FrictrackError, match=r"expected the name of a run, as the table has 2; choose one"):
        read_table(tmp_path / "all.csv")


def test_a_position_that_is_no_number_is_a_missing_frame(tmp_path: Path) -> None:
    lines = rows("{t:.4f};{x:.7f};", header="Time;Position;\n[s];[m];\n", comma=True).splitlines()
    lines[12] = lines[12].partition(";")[0] + ";NaN;"
    (tmp_path / "gap.csv").write_text("\n".join(lines))
    data = read_table(tmp_path / "gap.csv", survey_recording(tmp_path / "gap.csv").runs[0])
    assert len(data.t) == len(T) - 1
    assert data.notes == ("1 of 40 rows have no position; they count as missing",)


@pytest.mark.parametrize(
    ("name", "content"), [("a.lvm", b"LabVIEW Measurement\n"), ("b.mat", b"MATLAB 5.0"), ("c.tdms", b"TDSm\0\0")]
)
def test_a_damaged_file_is_refused_in_one_sentence(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FrictrackError, match=f"{name}: expected tracks of (LabVIEW|MATLAB) but cannot read it"):
        read_table(tmp_path / name)
