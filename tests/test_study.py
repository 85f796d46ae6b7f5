"""The study file: what is written comes out in SI, and every fault is one sentence that says what to do."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tifffile

from frictrack.base.errors import FrictrackError
from frictrack.settings.filters import FilterChoice
from frictrack.study import find_recordings, load, parse, read_sensor_table, read_table, write_study

CAMERA = '[camera]\nfps = 4000\nscale = "0.5 mm/px"\n'
RUN = '[[run]]\nname = "v3"\nvideo = "v3.avi"\n'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("v3.avi", "heavy.avi", "drive.csv"):
        (tmp_path / name).touch()
    return tmp_path


def written(folder: Path, text: str) -> Path:
    path = folder / "study.toml"
    path.write_text(text)
    return path


def sentence(folder: Path, text: str) -> str:
    with pytest.raises(FrictrackError) as caught:
        load(written(folder, text))
    assert caught.value.usage
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_every_key_of_the_design_is_read(folder: Path) -> None:
    study = load(
        written(
            folder,
            """
[study]
name = "course A"
mass = "350 +/- 2 g"
model = ["coulomb", "vibration:2"]
output = "out"

[camera]
fps = 4000
scale = {points = [[0, 0], [200, 0]], length = "100 mm"}

[[run]]
video = "v3.avi"

[[run]]
name = "heavy"
video = "heavy.avi"
mass = 0.7
fps = "8 kHz"
scale = 5e-4
target = [410, 232, 96, 64]
template = 30
reference = [0, 0, 50, 50]
targets = {beam = [1, 2, 3, 4]}
clamp_x = "20 mm"
beam_length = "0.3 m"
axis = [1, 0.1]
origin_px = [3, 4]
x_offset = "-5 mm"
free = ["10 ms", 0.2]
cutoff = "0.2 kHz"
incline = "-22 deg"
normal_load = "7 N"
drive = "drive.csv"
impact_energy = "2 J"
group = "high speed"
role = "validation"
note = "oiled"

[[effect]]
effect = "vibration:2"
fix = {frequency = 60}
bounds = {amplitude = [0, 1]}
prior = {frequency = [60, 1]}
tie = {frequency = "vibration.frequency"}
per_run = ["phase"]
""",
        )
    )
    first, heavy = study.runs
    assert (study.name, study.model, study.output) == ("course A", ("coulomb", "vibration:2"), folder / "out")
    assert first.name == "v3"
    assert first.mass == pytest.approx((0.35, 0.002))
    assert first.fps == 4000
    assert first.scale == {"points": [[0, 0], [200, 0]], "length": "100 mm"}
    assert (first.role, first.x_offset, first.targets) == ("fit", 0.0, {})
    assert heavy.mass == (0.7, 0.0)
    assert (heavy.fps, heavy.scale, heavy.cutoff) == (8000, 5e-4, 200)
    assert heavy.incline == pytest.approx((-22 * math.pi / 180, 0.0))
    assert heavy.free == pytest.approx((0.01, 0.2))
    assert (heavy.clamp_x, heavy.x_offset, heavy.normal_load, heavy.impact_energy) == (0.02, -0.005, 7, 2)
    assert heavy.targets == {"beam": (1, 2, 3, 4)}
    assert heavy.drive == folder / "drive.csv"
    assert study.effects[0].fix == {"frequency": 60}


def test_targets_are_rectangles_clicks_and_pictures(folder: Path) -> None:
    (folder / "slider.png").touch()
    for text, value in {
        "target = [1, 2, 30, 40]": (1, 2, 30, 40),
        "target = [10.5, 20]": (10.5, 20),
        'target = "slider.png"': folder / "slider.png",
    }.items():
        run = load(written(folder, f"[study]\nmass = 1\n{CAMERA}{RUN}{text}\n")).runs[0]
        assert run.target == value
        assert run.reference == "auto"
    keys = 'reference = "none"\ntargets = {beam = [3, 4], rod = "slider.png"}\n'
    run = load(written(folder, f"[study]\nmass = 1\n{CAMERA}{RUN}{keys}")).runs[0]
    assert run.reference == "none"
    assert run.targets == {"beam": (3, 4), "rod": folder / "slider.png"}


def test_a_study_of_tables_says_nothing_of_a_camera(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t_s,x_m\n" + "".join(f"{k / 100},{k / 50}\n" for k in range(20)))
    assert "camera]" not in write_study(tmp_path / "study.toml", [tmp_path / "a.csv"], commented=True).read_text(
        "utf-8"
    )


def test_init_lists_every_recording_once(tmp_path: Path) -> None:
    """Headers, single pictures and results are no recordings."""
    for name in ("a.mraw", "a.cih", "b.mraw", "b.cihx", "c.cine", "d.avi", "e.m4v", "notes.txt", ".hidden.avi"):
        (tmp_path / name).touch()
    tifffile.imwrite(tmp_path / "f.tif", np.zeros((3, 16, 16), np.uint8), photometric="minisblack")
    tifffile.imwrite(tmp_path / "g.tif", np.zeros((3, 16, 16), np.uint8), imagej=True)
    tifffile.imwrite(tmp_path / "board.tif", np.zeros((16, 16), np.uint8))
    for folder, count in (("h", 3), ("alone", 1), ("study_results", 3)):
        (tmp_path / folder).mkdir()
        for i in range(count):
            (tmp_path / folder / f"{i}.png").touch()
    found = find_recordings(tmp_path)
    assert [p.name for p in found] == ["a.mraw", "b.mraw", "c.cine", "d.avi", "e.m4v", "f.tif", "g.tif", "h"]


def test_a_folder_means_its_study_file_and_output_stands_beside_it(folder: Path) -> None:
    written(folder, f"[study]\nmass = 1\n{CAMERA}{RUN}")
    study = load(folder)
    assert study.output == folder / "study_results"
    assert study.name == folder.name
    assert study.model == "tustin"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (f"[study]\nmas = 1\n{CAMERA}{RUN}", '[study], line 2: unknown key "mas"; did you mean "mass"?'),
        (f"[study]\nmass = 1\nfps = 4000\n{RUN}", '[study], line 3: unknown key "fps"; it belongs in [camera]'),
        (f"[studdy]\nmass = 1\n{CAMERA}{RUN}", 'unknown table "studdy" (line 1); did you mean "study"?'),
        (
            f'[study]\nmass = 1\n{CAMERA}{RUN}vidoe = "a"\n',
            '[[run]] "v3", line 9: unknown key "vidoe"; did you mean "video"?',
        ),
        (f"[study]\nmass = 0\n{CAMERA}{RUN}", "line 2: expected mass above 0 kg but got 0"),
        (f'[study]\nmass = "1 stone weight"\n{CAMERA}{RUN}', 'the unknown unit "stone weight"'),
        (f'[study]\nmass = "3 s"\n{CAMERA}{RUN}', 'expected mass as a quantity in kg but got "s"'),
        (f"[study]\nmass = nan\n{CAMERA}{RUN}", "expected mass as a quantity in kg but got nan"),
        (f"[study]\nmass = 1\n{RUN}", 'expected a scale but got none; give scale = "0.5 mm/px"'),
        (f"{CAMERA}{RUN}", 'expected a mass but got none; give mass = "0.35 kg"'),
        (f"[study]\nmass = 1\n{CAMERA}", "expected at least one [[run]] but got none"),
        (f"[study]\nmass = 1\n{CAMERA}[run]\nvideo = 'v3.avi'\n", 'expected "run" as a table [[run]]'),
        (
            f"[study]\nmass = 1\n{CAMERA}{RUN}{RUN}",
            'line 10: expected every run to have its own name but got "v3" twice',
        ),
        (
            f"[study]\nmass = 1\n{CAMERA}[[run]]\nname = 'a'\n",
            'expected either video = "..." or table = "..." but got neither',
        ),
        (f"[study]\nmass = 1\n{CAMERA}{RUN}table = 'drive.csv'\n", "but got both"),
        (
            f"[study]\nmass = 1\n{CAMERA}[[run]]\nvideo = 'v33.avi'\n",
            '[[run]] number 1, line 7: video: expected a file "v33.avi" but there is none; did you mean "v3.avi"?',
        ),
        (
            f"[study]\nmass = 1\n{CAMERA}{RUN}target = [1, 2, 3]\n",
            "target: expected a rectangle [x, y, width, height] in px, an outline [[x, y], ...], a click [x, y] or a "
            "picture's path but got [1, 2, 3]",
        ),
        (f"[study]\nmass = 1\n{CAMERA}{RUN}target = [1, 2, 0, 4]\n", "a click [x, y] or a picture's path"),
        (f"[study]\nmass = 1\n{CAMERA}{RUN}target = 'v33.avi'\n", 'did you mean "v3.avi"?'),
        (f"[study]\nmass = 1\n{CAMERA}{RUN}reference = 'atuo'\n", 'expected "auto", "none" or a rectangle'),
        (f"[study]\nmass = 1\n{CAMERA}{RUN}reference = [1, 2]\n", 'expected "auto", "none" or a rectangle'),
        (f"[study]\nmass = 1\n{CAMERA}{RUN}targets = {{beam = 3}}\n", "a click [x, y] or a picture's path"),
        (f"[study]\nmass = 1\n{CAMERA}{RUN}targets = 3\n", "expected further targets as {name = [x, y, width"),
        (
            f"[study]\nmass = 1\n{CAMERA}{RUN}targets = {{reference = [1, 2, 3, 4]}}\n",
            'other than target, reference, backward but got "reference"',
        ),
        (
            f"[study]\nmass = 1\n{CAMERA}{RUN}target = 'v3.avi'\ntemplate = 3\n",
            "expected no template with a picture of the target",
        ),
        (f"[study]\nmass = 1\n{CAMERA}{RUN}template = 3\n", "expected a target with template"),
        (f"[study]\nmass = 1\n{CAMERA}{RUN}free = [0.2, 0.1]\n", "expected an end after the start but got [0.2, 0.1]"),
        (f"[study]\nmass = 1\n{CAMERA}{RUN}incline = 22\n", "expected incline between -1.57 and 1.57 rad but got 22"),
        (f"[study]\nmass = 1\n{CAMERA}{RUN}role = 'val'\n", 'expected role as "fit" or "validation" but got "val"'),
        (f"[study]\nmass = 1\n{CAMERA}{RUN}columns = {{x = 'x'}}\n", "expected columns only with a table"),
        (f"[study]\nmass = 'fit'\n{CAMERA}{RUN}", 'expected a measured drive with mass = "fit" but got none'),
        (f"[study]\nmass = 1\nmodel = 3\n{CAMERA}{RUN}", "expected model as a text in quotes but got 3"),
        (f"[study]\nmass = 1\n[camera]\nscale = true\n{RUN}", '"0.5 mm/px" or {points'),
        (
            f"[study]\nmass = 1\n{CAMERA}[[run]]\nname = '../up'\nvideo = 'v3.avi'\n",
            "expected a name that can be a file name",
        ),
        ("[study]\nmass = \n", "is not valid TOML: Invalid value (at line 2, column 8)"),
    ],
)
def test_every_fault_is_one_sentence(folder: Path, text: str, expected: str) -> None:
    assert expected in sentence(folder, text)


@pytest.mark.parametrize("value", ["0", "-0.5"])
@pytest.mark.parametrize("key", ["fps", "cutoff", "mass", "normal_load", "pause", "beam_length", "impact_energy"])
def test_a_quantity_that_is_positive_by_nature_is_refused_at_zero_and_below(folder: Path, key: str, value: str) -> None:
    message = sentence(folder, f"[study]\nmass = 1\n{CAMERA}{RUN}{key} = {value}\n")
    assert f"line 9: expected {key} above 0 " in message
    assert message.endswith(f"but got {value}")


def test_all_faults_come_at_once(folder: Path) -> None:
    said = sentence(folder, f"[study]\nmas = 1\n[camera]\nfsp = 3\n{RUN}roll = 'a'\n")
    assert all(word in said for word in ('"mas"', '"fsp"', '"roll"'))


def test_the_line_is_that_of_the_right_table(folder: Path) -> None:
    second = '[[run]]\nname = "b"\nvideo = "heavy.avi"\nmass = -1\n'
    assert '[[run]] "b", line 13: expected mass above 0 kg' in sentence(
        folder, f"[study]\nmass = 1\n{CAMERA}{RUN}mass = 2\n{second}"
    )
    part = "table = 't.csv'\n[run.columns]\nt = 't_s'\n"
    assert '[[run]] "b", line 14: expected mass above 0 kg' in sentence(
        folder, f"[study]\nmass = 1\n{CAMERA}[[run]]\nname = 'a'\n{part}{second}"
    )


def test_what_is_no_study_file_is_said(folder: Path) -> None:
    with pytest.raises(
        FrictrackError, match=r"expected a study file \(\.toml\) but got v3\.avi; `frictrack run v3\.avi"
    ):
        load(folder / "v3.avi")
    with pytest.raises(
        FrictrackError, match=r"expected a study file .*absent\.toml but there is none; `frictrack init"
    ):
        load(folder / "absent.toml")
    (folder / "latin.toml").write_bytes(b'name = "\xe9"')
    with pytest.raises(FrictrackError, match="is not a text in UTF-8"):
        load(folder / "latin.toml")


def test_a_written_study_is_read_again(folder: Path) -> None:
    path = folder / "study.toml"
    films = [folder / "v3.avi", folder / "heavy.avi"]
    write_study(path, films, {"mass": "0.35kg", "scale": "0.5mm/px", "fps": 4000.0})
    study = load(path)
    assert [run.name for run in study.runs] == ["v3", "heavy"]
    assert [run.video for run in study.runs] == films
    assert study.runs[0].mass == (0.35, 0.0)
    with pytest.raises(FrictrackError, match="is already there"):
        write_study(path, films)


def test_an_initial_study_explains_itself_and_works_once_filled_in(folder: Path) -> None:
    (folder / "drive.csv").unlink()
    (folder / "pictures").mkdir()
    for i in range(3):
        (folder / "pictures" / f"{i}.png").touch()
    path = write_study(folder / "study.toml", find_recordings(folder), commented=True)
    text = path.read_text()
    assert "frictrack run study.toml" in text
    assert "the friction force scales with its square" in text
    for key in ("mass", "fps", "scale", "model"):
        text = text.replace(f"# {key} = ", f"{key} = ", 1)
    study = load(written(folder, text))
    assert [run.name for run in study.runs] == ["heavy", "pictures", "v3"]


def test_a_folder_without_recordings_is_said(tmp_path: Path) -> None:
    with pytest.raises(FrictrackError, match=r"expected recordings in .* but found none"):
        find_recordings(tmp_path)
    with pytest.raises(FrictrackError, match="expected a folder with recordings"):
        find_recordings(tmp_path / "absent")


def table(folder: Path, text: str) -> Path:
    path = folder / "run.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_plain_table_is_read(folder: Path) -> None:
    data = read_table(table(folder, "# made by hand\nt_s,x_m,drive_N,other\n0,1,5,a\n0.1,2,6,b\n"))
    np.testing.assert_array_equal(data.t, [0, 0.1])
    np.testing.assert_array_equal(data.x, [1, 2])
    np.testing.assert_array_equal(data.drive, [5, 6])
    assert data.friction is None


def test_columns_name_units_and_signs(folder: Path) -> None:
    path = table(folder, "Time (ms)\tpos [mm]\tF (uN)\n0\t1\t5\n100\t2\t6\n")
    data = read_table(path, {"t": "Time (ms)", "x": "pos [mm]", "friction": "-F (uN)"})
    np.testing.assert_allclose(data.t, [0, 0.1])
    np.testing.assert_allclose(data.x, [1e-3, 2e-3])
    np.testing.assert_allclose(data.friction, [-5e-6, -6e-6])


@pytest.mark.parametrize(
    "text",
    [
        "t_s;x_m\n0;0\n0,5;2,25\n",
        "t_s\tx_m\n0\t0\n0,5\t2,25\n",
        "t_s;x_m;note, any\n0;0;a, b\n0,5;2,25;1.5 V, perhaps\n",
        't_s;x_m\n0;0\n"0,5";"2,25"\n',
        "t_s;x_m\n0;0\n0.5;2.25\n",
        "t_s;x_m\n0;0\n5e-1;,225e1\n",
        "t_s,x_m,\n0,0,\n0.5,2.25,\n",
        "t_s,x_m\n0,0,\n0.5,2.25,\n",
        "t_s,x_m\n0,0,,\n0.5,2.25,,\n",
    ],
)
def test_separator_and_decimal_sign_of_a_table(folder: Path, text: str) -> None:
    data = read_table(table(folder, text))
    np.testing.assert_array_equal(data.t, [0.0, 0.5])
    assert data.x is not None
    np.testing.assert_array_equal(data.x, [0.0, 2.25])


def test_a_decimal_comma_that_comes_late_is_seen(folder: Path) -> None:
    rows = "".join(f"{i};0\n" for i in range(5000))
    data = read_table(table(folder, f"t_s;x_m\n{rows}5000,5;0,25\n"))
    assert (data.t[-1], None if data.x is None else data.x[-1]) == (5000.5, 0.25)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("t_s,x_m\n0,0,7\n0.1,1,7\n", "2 names in the header but 3 fields in row 1; name every column"),
        ("t_s,x_m\n0,0,\n0.1,1,7\n", "2 names in the header but 3 fields in row 2; name every column"),
        ("t_s,x_m\n0,0,1,5\n0,1,2,5\n", "2 names in the header but 4 fields in row 1"),
        ("t_s,x_m\n0,0\n0.1,1,7\n", "expected 2 cells in line 3 but got 3"),
    ],
)
def test_a_table_with_more_fields_than_names_is_refused(folder: Path, text: str, said: str) -> None:
    with pytest.raises(FrictrackError, match=re.escape(said)):
        read_table(table(folder, text))


def test_a_table_with_decimal_commas_is_read(folder: Path) -> None:
    data = read_table(table(folder, "t_s;x_m\n0,0;1,5\n0,1;2,5\n"))
    np.testing.assert_allclose(data.x, [1.5, 2.5])


def test_an_excel_table_is_read(folder: Path) -> None:
    pd.DataFrame({"t_s": [0.0, 0.1], "x_m": [1.0, 2.0]}).to_excel(folder / "run.xlsx", index=False)
    np.testing.assert_allclose(read_table(folder / "run.xlsx").x, [1, 2])


@pytest.mark.parametrize(
    ("text", "columns", "expected"),
    [
        ("t_s,pos\n0,1\n1,2\n", {}, 'run.csv: expected a column "x_m" but got t_s, pos'),
        ("t_s,x_m\n0,1\n1,2\n", {"friction": "F (N)"}, 'expected a column "F (N)" but got t_s, x_m'),
        ("t_s,x_m\n0,1\n,2\n2,3\n", {}, 'expected numbers in "t_s" but got nan in row 2'),
        ("t_s,x_m\n0,1\n1,oops\n2,x\n", {}, 'expected numbers in "x_m" but got oops in row 2 and 1 more'),
        ("t_s,x_m\n0,1\n1,2\n1,3\n", {}, "expected rising time but got 1 s after 1 s in row 3"),
        ("t_s,x_m,sigma_m\n0,1,1\n1,2,0\n", {}, "expected standard deviations above 0 but got 0 m"),
        ("t_s,x_m\n0,1\n", {}, "expected at least two rows but got 1"),
        ("t_s,x_m\n", {}, "expected at least two rows but got 0"),
        ("", {}, "expected a table with a header line but cannot read it"),
        ("Time (hours of work),x_m\n0,1\n1,2\n", {"t": "Time (hours of work)"}, "unknown unit"),
    ],
)
def test_every_fault_of_a_table_is_said(folder: Path, text: str, columns: dict[str, str], expected: str) -> None:
    with pytest.raises(FrictrackError) as caught:
        read_table(table(folder, text), columns)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_film_is_no_table(folder: Path) -> None:
    (folder / "film.csv").write_bytes(bytes(range(256)) * 4)
    with pytest.raises(FrictrackError, match=r"film\.csv: expected a table with a header line but cannot read it"):
        read_table(folder / "film.csv")


def test_a_sensor_with_its_own_clock_is_read(folder: Path) -> None:
    data = read_sensor_table(table(folder, "t_s,drive_N\n0,0\n1,\n2,20\n"), ("drive",))
    np.testing.assert_array_equal(data.drive, [0, np.nan, 20])  # an empty cell is a sample that was not taken
    with pytest.raises(FrictrackError, match="expected a column a_m_s2 or friction_N in addition to t_s but got none"):
        read_sensor_table(folder / "run.csv", ("a", "friction"))
    with pytest.raises(FrictrackError, match='expected numbers in "drive_N" but got off in row 2'):
        read_sensor_table(table(folder, "t_s,drive_N\n0,0\n1,off\n2,20\n"), ("drive",))


def test_a_sensors_headers_carry_units(folder: Path) -> None:
    path = table(folder, "Time (ms),acc (g),p (bar)\n0,1,2\n1,2,3\n")
    data = read_sensor_table(path, ("a",), {"t": "Time (ms)", "a": "-acc (g)"})
    np.testing.assert_allclose(data.t, [0, 1e-3])
    np.testing.assert_allclose(data.a, [-9.80665, -2 * 9.80665])
    data = read_sensor_table(path, ("pressure",), {"t": "Time (ms)", "pressure": "p (bar)"})
    np.testing.assert_allclose(data.pressure, [2e5, 3e5])


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ('drive = "2.5 N"', 2.5),
        ("drive = 3", 3.0),
        ('drive = "-1 kN"', -1000.0),
        ('drive = "none"', None),
        ('drive = {force = "2 N", until = "release"}', {"force": 2.0, "until": "release"}),
        ('drive = {force = "2 N", until = "80 ms"}', {"force": 2.0, "until": 0.08}),
    ],
)
def test_a_drive_is_a_constant_or_none(folder: Path, text: str, value: object) -> None:
    assert load(written(folder, f"[study]\nmass = 1\n{CAMERA}{RUN}{text}\n")).runs[0].drive == value


def test_a_drive_is_a_pressure_times_an_area(folder: Path) -> None:
    text = 'drive = {table = "drive.csv", area = "3.14 cm^2", columns = {t = "Time (ms)", pressure = "p (bar)"},'
    text += ' until = "release", offset = "1.2 ms"}\nsensor = {table = "drive.csv", columns = {a = "a (g)"}}\n'
    run = load(written(folder, f"[study]\nmass = 1\n{CAMERA}{RUN}{text}")).runs[0]
    assert run.drive["table"] == folder / "drive.csv"
    assert run.drive["area"] == pytest.approx(3.14e-4)
    assert (run.drive["until"], run.drive["offset"]) == ("release", pytest.approx(1.2e-3))
    assert run.drive["columns"] == {"t": "Time (ms)", "pressure": "p (bar)"}
    assert run.sensor == {"table": folder / "drive.csv", "columns": {"a": "a (g)"}}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('drive = "drvie.csv"', 'expected a file "drvie.csv" but there is none; did you mean "drive.csv"?'),
        ('drive = "2.5 m"', 'expected drive as a quantity in N but got "m"'),
        ("drive = true", 'expected a drive as "drive.csv" (t_s, drive_N), a constant "2.5 N", "none"'),
        ("drive = {area = 3}", 'expected table = "drive.csv" or force = "2.5 N" but got neither'),
        ('drive = {table = "drive.csv", force = 1}', "but got both"),
        ('drive = {force = 1, offset = "auto"}', "expected no offset with a constant force: it belongs to a table"),
        ('drive = {tabel = "drive.csv"}', 'but got "tabel"; did you mean "table"?'),
        ('drive = {table = "drive.csv", area = "-1 cm^2"}', "expected area above 0 m^2 but got '-1 cm^2'"),
        (
            'drive = {table = "drive.csv", until = "relaese"}',
            'expected until as "release", a place like "30 cm" or a time like "1.2 ms"',
        ),
        ('drive = {table = "drive.csv", offset = "2 mm"}', 'expected offset as "auto" or a time like "1.2 ms"'),
        (
            'drive = {table = "drive.csv", area = 1, columns = {drive = "F"}}',
            'expected one of t, pressure in columns but got "drive"',
        ),
        ('drive = {table = "drive.csv", columns = "F"}', 'expected columns = {t = "Time (ms)", drive = "..."}'),
        ("sensor = 3", 'expected a sensor as "acc.csv" (t_s, a_m_s2) or {table = "acc.csv"'),
        ("sensor = {}", 'expected table = "acc.csv" but got none'),
        ('sensor = {table = "drive.csv", area = 1}', 'expected one of table, columns, offset but got "area"'),
        ("sensor = 'v33.avi'", 'did you mean "v3.avi"?'),
    ],
)
def test_every_fault_of_a_drive_or_a_sensor_is_said(folder: Path, text: str, expected: str) -> None:
    assert expected in sentence(folder, f"[study]\nmass = 1\n{CAMERA}{RUN}{text}\n")


def test_a_key_that_all_runs_lack_is_asked_for_once(tmp_path):
    for name in "abc":
        (tmp_path / f"{name}.avi").touch()
    runs = "".join(f'[[run]]\nvideo = "{name}.avi"\n' for name in "abc")
    (tmp_path / "study.toml").write_text(f'[camera]\nfps = 4000\nscale = "0.5 mm/px"\n{runs}')
    with pytest.raises(FrictrackError) as caught:
        load(tmp_path / "study.toml")
    assert str(caught.value).count("expected a mass but got none") == 1
    assert "[[run]] number 1, line 4, and 2 more runs: expected a mass" in str(caught.value)


def test_a_filter_of_all_runs_and_of_one(tmp_path):
    runs = "".join(
        f'[[run]]\nname = "{name}"\ntable = "a.csv"\n{keys}\n'
        for name, keys in (
            ("as all", ""),
            ("lower", 'cutoff = "60 Hz"'),
            ("own", 'filter = "savitzky-golay"\nwindow = 31'),
        )
    )
    head = '[study]\nmass = 0.35\n[motion]\nfilter = "butterworth"\ncutoff = "120 Hz"\norder = 2\ncausal = true\n'
    (tmp_path / "a.csv").write_text("t_s,x_m\n0,0\n")
    study = parse(tmp_path / "study.toml", head + runs)
    assert [run.filter_choice for run in study.runs] == [
        FilterChoice("butterworth", 120.0, 2, causal=True),
        FilterChoice("butterworth", 60.0, 2, causal=True),
        FilterChoice("savitzky-golay", window=31),
    ]


@pytest.mark.parametrize(
    ("where", "keys", "says"),
    [
        ("motion", 'filter = "butterworh"', 'papers but got "butterworh"; did you mean "butterworth"?'),
        (
            "motion",
            'filter = "kalman"\ncutoff = 60',
            'no cutoff with filter = "kalman", which finds its settings itself',
        ),
        ("motion", 'filter = "papers"\nwindow = 9', "which takes cutoff, order, causal; leave window out"),
        ("motion", 'filter = "butterworth"\norder = 40', 'order from 1 to 10 with filter = "butterworth" but got 40'),
        ("motion", 'filter = "savitzky-golay"\nwindow = 10', "window as an odd number of at least 5 frames but got 10"),
        ("motion", "order = 4", 'expected no order with filter = "structural", which takes cutoff; leave order out'),
        ("camera", 'fps = 200\n[motion]\nfilter = "papers"\ncutoff = 100', "cutoff below half the frame rate, 100 Hz"),
    ],
)
def test_wrong_filters_are_refused(tmp_path, where, keys, says):
    (tmp_path / "a.csv").write_text("t_s,x_m\n0,0\n")
    text = f'[study]\nmass = 0.35\n[{where}]\n{keys}\n[[run]]\ntable = "a.csv"\n'
    with pytest.raises(FrictrackError, match=re.escape(says)) as refused:
        parse(tmp_path / "study.toml", text)
    assert (f"[{where}], line" in str(refused.value)) or where == "camera"
