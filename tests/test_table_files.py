"""Tables as other programs and laboratories write them: own names, units, separators, titles, exports of Tracker."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from frictrack.base.errors import FrictrackError
from frictrack.study import find_recordings, load, propose_columns, read_run_table, read_table

# What Tracker 6 writes: the name of the track, the names of the columns, numbers as Java prints them.
TRACKER = """mass_A\t\t
t\tx\ty
0.000000000E0\t1.245986911E-1\t-1.328191643E-3
3.200000000E-2\t1.164289057E-1\t-1.262051106E-3
6.400000000E-2\t1.082591203E-1\t-1.195910569E-3
"""
TRACKER_SEVERAL = """#multi:
\tmass A\t\tmass B\t\t
t\tx\ty\tx\ty\t
0.032\t0.100\t0.001\t0.500\t0.002\t
0.064\t0.110\t0.001\t0.510\t0.002\t
"""
TRACKER_COMMAS = """,mass A,,,,,
t,frame,x,y,pixelx,pixely,
0.0,0,0.10,0.00,300,200,
0.1,1,0.12,0.00,320,200,
0.2,2,,,,,
0.3,3,0.16,0.00,360,200,
"""
TRACKER_SEMICOLONS = "mass_A\nt;x;y\n0,0;1,5;0,0\n0,1;1,6;0,0\n"
# What Kinovea 0.8 writes for gnuplot; 0.9 writes the name of each trajectory and numbers as times.
KINOVEA_TEXT = """#Kinovea Trajectory data export
#T X Y
0:00:00:00 866.00 320.00
0:00:00:03 847.00 321.00
0:00:01:07 830.00 321.00
"""
KINOVEA_TEXT_NEW = """#Kinovea Trajectory data export
#T X Y

# Trajectory 1
0 8,5 0,1
0,04 9,5 0,1

"""
KINOVEA_CSV = '"Time";"Trajectory 1/0/X";"Trajectory 1/0/Y"\n"0";"1,5";"0"\n"0,04";"2,5";"0"\n'
KINOVEA_DIALOG = '"Time (ms)","X (cm)","Y (cm)"\n"0","1.5","0"\n"40","2.5","0"\n'
KINOVEA_XML = """<?xml version="1.0" encoding="utf-8"?>
<?mso-application progid="Excel.Sheet"?>
<Workbook xmlns="urn:schemas-microsoft-com:office:spreadsheet" xmlns:ss="urn:schemas-microsoft-com:office:spreadsheet">
 <Worksheet ss:Name="film.avi"><Table>
  <Row><Cell><Data ss:Type="String">Track</Data></Cell></Row>
  <Row><Cell><Data ss:Type="String">Label :</Data></Cell><Cell><Data ss:Type="String">slider</Data></Cell></Row>
  <Row><Cell ss:MergeAcross="2"><Data ss:Type="String">Coords (x,y:cm; t:time)</Data></Cell></Row>
  <Row><Cell><Data ss:Type="String">x</Data></Cell><Cell><Data ss:Type="String">y</Data></Cell>
       <Cell><Data ss:Type="String">t</Data></Cell></Row>
  <Row><Cell><Data ss:Type="Number">1.5</Data></Cell><Cell><Data ss:Type="Number">0</Data></Cell>
       <Cell><Data ss:Type="String">0:00:00:00</Data></Cell></Row>
  <Row><Cell><Data ss:Type="Number">2.5</Data></Cell><Cell><Data ss:Type="Number">0</Data></Cell>
       <Cell><Data ss:Type="String">0:00:00:04</Data></Cell></Row>
  <Row><Cell><Data ss:Type="String">Label :</Data></Cell><Cell><Data ss:Type="String">watch</Data></Cell></Row>
 </Table></Worksheet>
</Workbook>
"""


@pytest.fixture
def written(tmp_path: Path):
    """A function that writes a text and returns the path."""

    def write(text: str, name: str = "run.txt") -> Path:
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


def columns(path: Path, names: dict[str, str] | None = None, **how) -> tuple[list[float], list[float]]:
    data = read_table(path, names or {}, **how)
    assert data.x is not None
    return np.round(data.t, 9).tolist(), np.round(data.x, 9).tolist()


def refused(path: Path, names: dict[str, str] | None = None) -> str:
    with pytest.raises(FrictrackError) as caught:
        read_table(path, names or {})
    return str(caught.value)


@pytest.mark.parametrize(
    ("text", "t", "x"),
    [
        (TRACKER, [0, 0.032, 0.064], [0.124598691, 0.116428906, 0.10825912]),
        (TRACKER_COMMAS, [0, 0.1, 0.3], [0.1, 0.12, 0.16]),
        (TRACKER_SEMICOLONS, [0, 0.1], [1.5, 1.6]),
        (TRACKER.replace("\t\t\n", "\n").replace("\t", " "), [0, 0.032, 0.064], [0.124598691, 0.116428906, 0.10825912]),
    ],
)
def test_an_export_of_tracker_is_read_directly(written, text, t, x) -> None:
    assert columns(written(text)) == (t, x)


def test_another_unit_of_tracker_is_named_in_the_study_file(written) -> None:
    assert columns(written(TRACKER_SEMICOLONS), {"t": "t", "x": "x (mm)"}) == ([0, 0.1], [0.0015, 0.0016])


def test_positions_in_pixels_take_the_scale(written, tmp_path: Path) -> None:
    names = {"t": "t (s)", "x": "pixelx (px)"}
    path = written(TRACKER_COMMAS.replace("0.2,2,,,,,\n", ""), "tracker.csv")
    assert columns(path, names, pixel=0.5e-3) == ([0, 0.1, 0.3], [0.15, 0.16, 0.18])
    assert 'expected the scale of "pixelx" in px but got none; give scale' in refused(path, names)
    study = '[study]\nmass = 1\n[camera]\nscale = "0.5 mm/px"\n[[run]]\ntable = "tracker.csv"\n'
    (tmp_path / "study.toml").write_text(f'{study}columns = {{t = "t (s)", x = "pixelx (px)"}}\n')
    (run,) = load(tmp_path / "study.toml").runs
    assert np.asarray(read_run_table(run).x).tolist() == [0.15, 0.16, 0.18]


def test_one_of_several_tracks_is_named(written) -> None:
    said = refused(path := written(TRACKER_SEVERAL))
    assert "but got t, mass A x, mass A y, mass B x, mass B y" in said
    assert columns(path, {"t": "t", "x": "mass B x (m)"}) == ([0.032, 0.064], [0.5, 0.51])


@pytest.mark.parametrize(
    ("text", "name", "t", "x"),
    [
        (KINOVEA_TEXT, "k.txt", [0, 0.03, 1.07], [0.866, 0.847, 0.83]),
        (KINOVEA_TEXT_NEW, "k.txt", [0, 0.04], [0.0085, 0.0095]),
    ],
)
def test_a_text_export_of_kinovea_is_read_with_its_unit(written, text, name, t, x) -> None:
    path = written(text, name)
    said = refused(path)
    assert 'columns = {t = "T (s)", x = "X (m)", y = "Y (m)"} in its [[run]], with the units of the file' in said
    assert columns(path, {"t": "T (s)", "x": "X (mm)"}) == (t, x)


def test_several_trajectories_of_kinovea_are_refused(written) -> None:
    text = KINOVEA_TEXT_NEW + "# Trajectory 2\n0 1 1\n1 2 2\n"
    said = refused(written(text), {"t": "T (s)", "x": "X (mm)"})
    assert "put records that begin anew into files of their own" in said


def test_a_spreadsheet_of_kinovea_states_its_unit(written) -> None:
    assert columns(written(KINOVEA_XML, "k.xml")) == ([0, 0.04], [0.015, 0.025])
    assert "time stamps of the file" in refused(written(KINOVEA_XML.replace("t:time)", "t:timestamps)"), "k.xml"))
    assert "defines entities" in refused(written(f"<!DOCTYPE a>{KINOVEA_XML}", "k.xml"))
    assert "cannot read it" in refused(written(KINOVEA_XML[:-20], "k.xml"))


def test_csv_of_kinovea_proposes_its_columns(written) -> None:
    said = refused(path := written(KINOVEA_CSV, "k.csv"))
    assert 'columns = {t = "Time (s)", x = "Trajectory 1/0/X (m)", y = "Trajectory 1/0/Y (m)"}' in said
    assert columns(path, {"t": "Time (s)", "x": "Trajectory 1/0/X (cm)"}) == ([0, 0.04], [0.015, 0.025])
    said = refused(path := written(KINOVEA_DIALOG, "k.csv"))
    assert 'columns = {t = "Time (ms)", x = "X (cm)", y = "Y (cm)"} in its [[run]]' in said
    assert columns(path, {"t": "Time (ms)", "x": "X (cm)"}) == ([0, 0.04], [0.015, 0.025])


@pytest.mark.parametrize(
    "text",
    [
        "t;x\ns;m\n0,0;1,5\n0,5;2,25\n",
        "# rig 2, run 7\nt_s;x_m\n(s);(m)\n0,0;1,5\n# stopped\n0,5;2,25\n",
        "t,x\n[ms],[mm]\n0,1500\n500,2250\n",
        "Instrument;XY 300\nOperator;A\nt;x\nms;mm\n0;1500\n500;2250\n",
        "rig 2\n\nt x\n0.0 1.5\n0.5 2.25\n",
        "t (ms)\tx (mm)\n0\t1500\n500\t2250\n",
        "t;x\nms;mm\n\n0;1500,0\n500;2250,0\n",
    ],
)
def test_units_titles_comments_and_separators(written, text: str) -> None:
    assert columns(written(text), {"t": "t", "x": "x"} if "_s" not in text else {}) == ([0.0, 0.5], [1.5, 2.25])


def test_a_units_row_below_standard_names_wins(written) -> None:
    assert columns(written("t_s,x_m\nms,mm\n0,1500\n500,2250\n")) == ([0.0, 0.5], [1.5, 2.25])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "Time (ms),Position (mm)\n0,1\n1,2\n",
            'expected columns "t_s" and "x_m" but got Time (ms), Position (mm); to name them, write '
            'columns = {t = "Time (ms)", x = "Position (mm)"} in its [[run]]',
        ),
        ("a,b\n0,1\n1,2\n", 'columns = {t = "a (s)", x = "b (m)"} in its [[run]], with the units of the file'),
        ("Zeit [ms];Weg [mm]\n0;1\n1;2\n", 'columns = {t = "Zeit [ms]", x = "Weg [mm]"}'),
        ("name,colour\na,red\nb,blue\n", "a table needs a column of times and a column of positions"),
        ("0,1\n1,2\n2,3\n", 'columns = {t = "column 1 (s)", x = "column 2 (m)"} in its [[run]], with the units'),
    ],
)
def test_a_wrong_table_is_told_by_its_own_names(written, text: str, said: str) -> None:
    assert said in refused(path := written(text))
    if "columns = {" in said and "(m)" not in said:
        proposed = dict(re.findall(r'(\w) = "([^"]*)"', said))
        assert columns(path, proposed) == ([0, 0.001], [0.001, 0.002])  # what is proposed works


def test_a_unit_that_the_file_lacks_is_written_in_the_study_file(written) -> None:
    path = written("t_s,x_m\n0,1500\n500,2250\n")
    assert columns(path, {"t": "t_s (ms)", "x": "x_m (mm)"}) == ([0.0, 0.5], [1.5, 2.25])


def test_a_sheet_with_titles_ends_where_the_next_table_begins(tmp_path: Path) -> None:
    rows = [
        ["Trajectory 1", None, None],
        [None, "0", None],
        ["Time (ms)", "X (cm)", "Y (cm)"],
        [0, 1.5, 0],
        [40, 2.5, 0],
        ["Times", None, None],
        ["Name", "Duration (ms)", None],
    ]
    pd.DataFrame(rows).to_excel(tmp_path / "k.xlsx", index=False, header=False)
    assert columns(tmp_path / "k.xlsx", {"t": "Time (ms)", "x": "X (cm)"}) == ([0, 0.04], [0.015, 0.025])


def test_texts_that_hold_times_and_positions_are_recordings(written, tmp_path: Path) -> None:
    for name, text in {
        "tracker.txt": TRACKER,
        "kinovea.txt": KINOVEA_TEXT,
        "kinovea.xml": KINOVEA_XML,
        "plain.dat": "t_s x_m\n0 0\n1 1\n",
        "notes.txt": "film 3: t, x\nand more\n",
        "page.xml": "<a>t x</a>",
        "binary.dat": "\x00\x01",
    }.items():
        written(text, name)
    assert [p.name for p in find_recordings(tmp_path)] == ["kinovea.txt", "kinovea.xml", "plain.dat", "tracker.txt"]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_letters_of_other_encodings_are_read(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "run.csv").write_bytes("Zeit (ms);Weg (µm);Prüfer\n0;1500;Müller\n500;2250;\n".encode(encoding))
    expected = ([0, 0.5], [0.0015, 0.00225])
    assert columns(tmp_path / "run.csv", {"t": "Zeit (ms)", "x": "Weg (µm)"}) == expected


def test_a_header_that_is_there_twice_ends_no_proposal() -> None:
    table = pd.DataFrame([[0.0, 0.1, 1.0], [0.1, 0.2, 2.0]], columns=["a", "a", "b"])
    assert propose_columns(table) == {"t": "a", "x": "b"}


@pytest.mark.parametrize("unit", ["frame", "frames", "Frame"])
def test_a_frame_is_a_unit_of_time(tmp_path, unit):
    rows = "".join(f"{1000 + i},{0.01 * i * i:.4f}\n" for i in range(40))
    (tmp_path / "a.csv").write_text(f"stamp,pos\n{rows}")
    read = read_table(tmp_path / "a.csv", columns={"t": f"stamp ({unit})", "x": "pos (mm)"}, fps=100)
    assert np.allclose(np.diff(read.t), 0.01)
