"""Files that mean harm: nothing runs, nothing is written outside the study's folder, memory and time stay bounded."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
from campaigns import campaign
from cost import within
from test_recording import H, W, write_video

from frictrack.base import __version__
from frictrack.base.errors import MAX_MESSAGE_LENGTH, FrictrackError
from frictrack.base.files import is_file_name, lock_folder, make_subfolder
from frictrack.base.units import parse_quantity
from frictrack.flow import CommandHistory, Session, open_study, store
from frictrack.flow.store import HEADER_BYTES, GroupContent
from frictrack.flow.store.integrity import header_of, sign
from frictrack.measure.calibration.lens import read_lens
from frictrack.present import export
from frictrack.recording import open_recording
from frictrack.results import Results
from frictrack.simulate.scene import read_scene, render_scene
from frictrack.study import load, parse, read_table, table_files, write_study

RUN = '[[run]]\nname = {name}\ntable = "t.csv"\n'
GOOD = RUN.format(name='"one"')


def sealed(hdf5, *how):
    """A whole file of an HDF5 part that anybody may have written."""
    return header_of(hdf5, *how) + hdf5


def refused(path: Path, text: str) -> str:
    """What is said of a study file, in about a second at most."""
    with within(75), pytest.raises(FrictrackError) as caught:  # quadratic in its lines: minutes
        parse(path, text)
    assert caught.value.usage
    assert str(caught.value).isprintable()
    return str(caught.value)


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """Where a study file could be, a table beside it; above it a folder that is none of its business."""
    (tmp_path / "outside").mkdir()
    home = tmp_path / "home"
    home.mkdir()
    (home / "t.csv").write_text("t_s,x_m\n0,0\n1,1\n")
    return home / "study.toml"


# ---- where results go


@pytest.mark.parametrize(
    "output", ["/etc/x", "../outside", "a/../../outside", "link", "link/deeper", "circle", r"a\u0000b"]
)
def test_results_cannot_leave_the_studys_folder(study: Path, output: str) -> None:
    (study.parent / "link").symlink_to(study.parent.parent / "outside")
    (study.parent / "circle").symlink_to(study.parent / "circle")
    said = refused(study, f'[study]\noutput = "{output}"\n{GOOD}')
    assert "[study], line 2: expected an output inside the study's folder but got" in said
    assert "FRICTRACK_OUTPUTS=FOLDER" in said


def test_nor_by_a_link_in_the_place_of_the_usual_folder(study: Path) -> None:
    (study.parent / "study_results").symlink_to(study.parent.parent / "outside")
    assert 'but got "study_results", which is outside' in refused(study, GOOD)


def test_unless_the_user_says_so(study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = f'[study]\noutput = "../outside/results"\n{GOOD}'
    refused(study, text)
    monkeypatch.setenv("FRICTRACK_OUTPUTS", os.pathsep.join(["/nowhere", str(study.parent.parent / "outside")]))
    assert parse(study, text).output.resolve() == study.parent.parent.resolve() / "outside" / "results"
    refused(study, text.replace("../outside", "/etc"))


@pytest.mark.parametrize(
    "name",
    [
        *(
            "'../up'",
            "'/etc/x'",
            r"'a\b'",
            "'a/b'",
            "'..'",
            "'.hidden'",
            r'"a\u0000b"',
            r'"a\u001b[2Jb"',
            "'CON'",
            "'nul'",
        ),
        *("'com1.x'", "'study'", "'end.'", "'end '", "'" + "x" * 101 + "'", "'" + "µ" * 90 + "é" * 20 + "'"),
    ],
)
def test_names_that_are_no_file_names_everywhere(study: Path, name: str) -> None:
    assert "expected a name that can be a file name on every system" in refused(study, RUN.format(name=name))


def test_names_that_differ_only_in_case_are_one_file_on_many_systems(study: Path) -> None:
    assert 'to have its own name but got "ONE" twice' in refused(study, GOOD + RUN.format(name='"ONE"'))


@pytest.mark.parametrize("name", ["v3", "run 12 (oiled)", "Lauf_µ.2", "a=1,b=2"])
def test_usual_names_stay(name: str) -> None:
    assert is_file_name(name)


def test_links_among_the_results_are_not_followed(tmp_path: Path) -> None:
    outside, output = tmp_path / "outside", tmp_path / "results"
    outside.mkdir()
    output.mkdir()
    victim = outside / "victim"
    victim.write_text("mine")
    (output / ".frictrack").mkdir()
    for name in (".frictrack/log.jsonl", ".frictrack/lock", "parameters.csv", "study.xlsx"):
        (output / name).symlink_to(victim)
    (output / "csv").symlink_to(outside)
    results = Results("a", tmp_path / "study.toml", output, "0", runs=(), models=())
    with pytest.raises(FrictrackError, match="csv but it is a link to another place; remove the link"):
        export.write(results, "csv")
    with pytest.raises(FrictrackError, match=r"cannot write results into .*results"), lock_folder(output):
        pass
    (output / ".frictrack" / "lock").unlink()
    with pytest.raises(FrictrackError, match="it is a link to another place"), CommandHistory(output).record("fit"):
        pass
    export.write(results, "xlsx")  # takes the link's place
    (output / "csv").unlink()
    (make_subfolder(output, "csv") / "errors.csv").symlink_to(victim)
    export.write(results, "csv")
    (tmp_path / "new.toml").symlink_to(outside / "made")
    write_study(tmp_path / "new.toml", [tmp_path / "t.csv"])
    assert victim.read_text() == "mine"
    assert [p.name for p in outside.iterdir()] == ["victim"]


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_a_lock_that_is_none(tmp_path: Path, make: object) -> None:
    (tmp_path / ".frictrack").mkdir()
    make(tmp_path / ".frictrack" / "lock")
    if make is os.mkdir:
        with pytest.raises(FrictrackError, match="cannot write results into"), lock_folder(tmp_path):
            pass
    else:
        with lock_folder(tmp_path):  # it is never read
            pass


def test_a_log_that_cannot_be(tmp_path: Path) -> None:
    line = '{"rev": 1, "at": "", "who": "", "do": "undo"%s}\n'
    for text in (line % "", line % ', "before": 3', "[" * 100_000 + "\n", "3\n"):
        (tmp_path / ".frictrack").mkdir(exist_ok=True)
        (tmp_path / ".frictrack" / "log.jsonl").write_text(text)
        with pytest.raises(FrictrackError, match="is damaged; move it away"):
            CommandHistory(tmp_path).undo_stacks()


# ---- what a study file says


@pytest.mark.parametrize(
    "line",
    [
        *("x = " + "[" * 20_000, "x = " + "{a=" * 5000, "x." + "a." * 250_000 + "a = 1", "x = " + "9" * 5000),
        *("x = 1\n" * 2, "\x00", '"', 'x = {"."' + ' . "."' * 70_000 + " = 1}", "[" + "1.2." * 100_000 + "3]"),
    ],
    ids=lambda line: line[:8],
)
def test_text_that_is_hardly_toml(study: Path, line: str) -> None:
    assert refused(study, f"[study]\n{line}\n{GOOD}").startswith("study.toml")


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ("mass = 1" + "0" * 400, "expected mass as a quantity in kg but got inf"),
        ('mass = "1 +/- 1e999 kg"', "expected an uncertainty of mass above 0"),
        ('mass = "1 kg**9**9**9**9"', 'but got "kg**9**9**9**9" as its unit'),
        ('mass = "1 kg*9^9^9^9^9"', 'but got "kg*9^9^9^9^9" as its unit'),
        ('mass = "1 kg*((9^99)^99)^99^99"', "as its unit"),
        ('mass = "1 (kg)⁹⁹⁹⁹⁹"', "as its unit"),
        ('mass = "1 ' + "kg*" * 9000 + 'kg"', "as its unit"),
        ("mass = \"1 __import__('os').system('touch owned')\"", "as its unit"),
        ("target = [nan, 1]", "expected a rectangle"),
        ("target = [1e300, 1]", "expected a rectangle"),
        ("template = 1" + "0" * 4200, "template"),
        ('table = "/dev/zero"', 'expected a file "/dev/zero" but there is none'),
        ('table = "pipe"', 'expected a file "pipe" but there is none'),
        ('table = "' + "x" * 5000 + '"', "expected a file"),
        (r'table = "a\u0000b"', "expected a file"),
        (r'note = "a"' + "\n" + r'"\u001b[2J" = 1', r"\x1b[2J"),
    ],
    ids=lambda text: text[:30],
)
def test_values_without_bounds(study: Path, monkeypatch: pytest.MonkeyPatch, key: str, said: str) -> None:
    monkeypatch.chdir(study.parent)
    os.mkfifo("pipe")
    text = key if "table" in key else f'table = "t.csv"\n{key}'
    assert said in refused(study, f'[[run]]\nname = "one"\n{text}\n')
    assert not Path("owned").exists()


def test_units_that_are_arithmetic_but_finite_stay() -> None:
    assert parse_quantity("1 kg*m^2/s**2", "J", "energy")[0] == 1
    assert parse_quantity("1 kg m² s⁻²", "J", "energy")[0] == pytest.approx(1)
    assert parse_quantity("3 N/(m/s)", "N*s/m", "F_v")[0] == 3
    assert parse_quantity("2 cm^2", "m^2", "area")[0] == pytest.approx(2e-4)


def test_a_study_file_without_end(tmp_path: Path) -> None:
    path = tmp_path / "study.toml"
    path.write_text("# " + "x" * (1 << 19) + "\n" + GOOD)
    with pytest.raises(FrictrackError, match="expected a study file of at most 512 kB but got 524 kB"):
        load(path)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(FrictrackError, match=r"expected a study file but .*study\.toml is none"):
        load(path)


def test_many_runs_are_read_in_linear_time(study: Path) -> None:
    def cost(runs: int) -> float:
        text = '[study]\nmass = "1 kg"\n' + "".join(RUN.format(name=f'"run {i}"') for i in range(runs))
        each = []
        for _ in range(3):
            start = time.thread_time()
            assert len(parse(study, text).runs) == runs
            each.append(time.thread_time() - start)
        return min(each)

    assert cost(3000) < 40 * cost(300)  # quadratic in the runs: a hundred times


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("[table{}]\n", 'unknown table "table0" (line 1); known are study, camera'),
        ('[[run]]\nname = "a"\nodd{} = 1\n', '[[run]] "a", line 3: unknown key "odd0"; known are'),
        ("[[run]]\nmass = 1{}.0\n", "[[run]] number 1, line 1, and 11999 more runs: expected either video"),
        ("key{} = 1\n", 'unknown table "key0" (line 1)'),
    ],
)
def test_many_faults_are_found_in_linear_time_and_the_first_of_them_listed(study: Path, line: str, said: str) -> None:
    assert said in refused(study, "".join(map(line.format, range(12_000))))


def test_an_error_is_one_line_that_no_terminal_obeys() -> None:
    said = str(FrictrackError("a\x1b[2J\nb\u202ec\ud800" + "x" * 10**6 + "the end"))
    assert said.startswith(r"a\x1b[2J\nb\u202ec\ud800xxx")
    assert said.endswith("the end")
    assert len(said) < MAX_MESSAGE_LENGTH


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ('name = "../../up"', "expected every run with a name that can be a file name"),
        ("frames = 1000000000", "expected frames of number 1 of run as a number of at most 1e+06 but got 1000000000"),
        ("width = 100000", "expected width of number 1 of run as a number of at most 16384 but got 100000"),
        ('v = "fast"', 'expected v of number 1 of run as a number but got "fast"'),
        ("v = nan", "expected v of number 1 of run as a finite number but got NaN"),
    ],
)
def test_a_scene_without_bounds(tmp_path: Path, key: str, said: str) -> None:
    values = {"name": '"a"', "frames": "60", "v": "1.0"}
    run = "".join(f"{k} = {v}\n" for k, v in values.items() if not key.startswith(k))
    (tmp_path / "scene.toml").write_text(f"[law.coulomb]\nF_c = 8.0\n[[run]]\n{run}{key}\n")
    with pytest.raises(FrictrackError) as caught:
        render_scene(tmp_path / "scene.toml", tmp_path / "out")
    assert said in str(caught.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "text",
    ["law = 3\nrun = 4", "[law]\ncoulomb = 3\n[[run]]\n", "run = [[1]]", "x = [", "[law.coulomb]\nF_c = []\n[[run]]\n"],
)
def test_a_scene_of_other_kinds(text: str) -> None:
    with pytest.raises(FrictrackError, match="scene"):
        read_scene(text)


# ---- films


def test_a_film_is_no_list_of_other_films(tmp_path: Path) -> None:
    """FFmpeg goes by the content, and knows scripts that name other files."""
    write_video(tmp_path / "secret.avi", np.zeros((6, H, W), np.uint8), 100, "MJPG")
    (tmp_path / "list.avi").write_bytes(b"ffconcat version 1.0\nfile 'secret.avi'\n")
    with pytest.raises(FrictrackError, match=r"list\.avi: expected a film but the file cannot be read as one"):
        open_recording(tmp_path / "list.avi", fps=4000)


def test_the_name_of_a_film_is_no_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_video(tmp_path / "secret.avi", np.zeros((6, H, W), np.uint8), 100, "MJPG")
    Path("concat:secret.avi|.avi").write_bytes(b"nothing of a film")
    with pytest.raises(FrictrackError, match="expected a film but the file cannot be read as one"):
        open_recording("concat:secret.avi|.avi", fps=4000)


# ---- tables


def workbook(path: Path, sheet: str, extra: bytes = b"") -> Path:
    """A workbook with this XML as its only sheet."""
    import pandas as pd  # noqa: PLC0415

    plain = io.BytesIO()
    pd.DataFrame({"t_s": [0, 1], "x_m": [0, 1]}).to_excel(plain, index=False)
    with zipfile.ZipFile(plain) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name, sheet if name.endswith("sheet1.xml") else old.read(name))
        if extra:
            new.writestr("xl/extra.xml", extra)
    return path


MAIN = '<worksheet xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main">{}<sheetData>{}</sheetData></worksheet>'
CELLS = (
    '<row r="1"><c r="A1" t="inlineStr"><is><t>t_s</t></is></c><c r="B1" t="inlineStr"><is><t>x_m</t></is></c></row>'
)


def numbers(row: int, first: float, second: float, column: str = "B") -> str:
    return f'<row r="{row}"><c r="A{row}"><v>{first}</v></c><c r="{column}{row}"><v>{second}</v></c></row>'


@pytest.mark.parametrize(
    ("sheet", "said"),
    [
        (MAIN.format("", CELLS + numbers(2, 0, 0) + numbers(10**12, 1, 1)), "more than 5000 rows"),
        (MAIN.format("", CELLS + numbers(2, 0, 0, "XFD") + numbers(3, 1, 1)), "at least two rows"),
        (MAIN.format('<dimension ref="A1:XFD1048576"/>', CELLS + numbers(2, 0, 0)), "at least two rows"),
        (MAIN.format("", ""), "no rows"),
        ("", "expected a table"),
        ("<" * 1000, "expected a table"),
        ('<!DOCTYPE a [<!ENTITY b "' + "x" * 1000 + '">]>' + MAIN.format("", "&b;" * 1000), "expected a table"),
    ],
)
def test_a_sheet_that_claims_more_than_it_holds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sheet: str, said: str
) -> None:
    monkeypatch.setattr(table_files, "MAX_ROWS", 5000)  # a million empty ones take six seconds
    with within(500), pytest.raises(FrictrackError, match=said):
        read_table(workbook(tmp_path / "t.xlsx", sheet))


def test_a_workbook_that_unfolds_without_end(tmp_path: Path) -> None:
    path = workbook(tmp_path / "t.xlsx", MAIN.format("", CELLS), extra=bytes(257 << 20))
    assert path.stat().st_size < 1 << 20
    with pytest.raises(FrictrackError, match="MB when unpacked"):
        read_table(path)


def test_a_sheet_with_empty_rows_and_far_ones_is_read(tmp_path: Path) -> None:
    rows = CELLS + numbers(2, 0, 5) + numbers(40, 1, 6) + numbers(1000, 2, 7)
    found = read_table(workbook(tmp_path / "t.xlsx", MAIN.format('<dimension ref="A1"/>', rows)))
    np.testing.assert_array_equal(found.x, [5, 6, 7])


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "cannot read it"),
        (b"t_s,x_m\n", "at least two rows"),
        ("t_s,x_m\n0,0\n1,a\n".encode("utf-16"), 'expected numbers in "x_m" but got a'),
        ("t_s,x_m\n0,0\n1,1\n".encode("utf-16")[:-1], "expected"),
        (b"t_s,x_m,x_m \n0,0,0\n1,1,1\n", 'expected one column "x_m" but got 2'),
        (b"t_s,x_m\n0,0\n0,1\n", "expected rising time"),
        (b"t_s,x_m\n0,0\n1,inf\n", "expected numbers"),
        (b"t_s,x_m\n0,0\n1," + b"9" * 400 + b"\n", "but got 9{40} in row"),
        (b"t_s,x_m\n0,0\n1,1e999\n", "expected numbers"),
        (b"t_s,x_m\nnan,0\n1,1\n", "expected numbers"),
        (b"t_s,x_m\n0,0\n" + b"3" * 90 + b",1\n", r"expected numbers below 1e\+12"),
        (b"t_s|x_m\n0|0\n1|1\n", 'expected columns "t_s" and "x_m" but got t_s|x_m'),
        (b"t_s,x_m\n0,0,0,0\n1,1\n", "expected"),
        (b"\0" * 5000, "expected"),
        (b'"' * 5001, "expected"),
    ],
)
def test_tables_that_are_none(tmp_path: Path, data: bytes, said: str) -> None:
    path = tmp_path / "t.csv"
    path.write_bytes(data)
    with pytest.raises(FrictrackError, match=said):
        read_table(path)


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        (20_000, "20000 columns, at most 10000 are read; keep time and position"),
        (300_000, "a line of more than 1048576 characters; keep time and position"),
    ],
)
def test_a_table_of_very_many_columns_is_refused_in_short_time(tmp_path: Path, columns: int, said: str) -> None:
    names = ("t_s", "x_m", *(f"column{i}" for i in range(columns - 2)))
    (tmp_path / "t.csv").write_text("\n".join([",".join(names), *[",".join(["0.5"] * columns)] * 2]))
    with within(50), pytest.raises(FrictrackError, match=said):
        read_table(tmp_path / "t.csv")


def test_a_factor_cannot_make_a_number_infinite(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_bytes(b"t_s,x (km)\n0,0\n1,1e308\n")
    with pytest.raises(FrictrackError, match="expected numbers"):
        read_table(path, {"x": "x (km)"})


def test_a_byte_order_mark_is_no_part_of_the_header(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_bytes(b"\xef\xbb\xbft_s,x_m\n0,0\n1,1\n")
    assert len(read_table(path).t) == 2


# ---- a lens


@pytest.mark.parametrize(
    "text",
    [
        " - ws: 4\n\n   data: [  0., 1]\ndfs - ]\na: 48",  # OpenCV's own parser does not come back from this
        "a: &a [1]\nb: *a\n",
        "K: " + "[" * 100_000,
        '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "' + "x" * 1000 + '">]><a>' + "&b;" * 100_000 + "</a>",
        "K: !!python/object/apply:os.system ['touch owned']\n",
        '{"K": ' + "[" * 100_000,
    ],
)
def test_a_lens_file_that_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.chdir(tmp_path)
    Path("lens.yml").write_text(text)
    with within(100), pytest.raises(FrictrackError, match=r"lens\.yml: expected OpenCV's .* it cannot be read"):
        read_lens(Path("lens.yml"))
    assert not Path("owned").exists()


# ---- the store


def results(path: Path) -> Path:
    store.write(path, {"track": GroupContent({"x": np.arange(4.0)}), "models/1_a": GroupContent({"n": 1})})
    return path


def bomb(file: h5py.File) -> None:
    file.create_dataset("track/y", (10**12,), "f8", chunks=(1024,), compression="gzip")


def plain_bomb(file: h5py.File) -> None:
    file.create_dataset("track/y", (10**9,), "u1", chunks=(1024,))


def dense(file: h5py.File) -> None:
    """Zeros that deflate well: a claim of 40 GB out of 40 kB."""
    how = {"chunks": (1, 40 << 20), "maxshape": (None, 40 << 20), "compression": "gzip"}
    file.create_dataset("track/y", data=np.zeros((1, 40 << 20), "u1"), **how)
    file["track/y"].id.set_extent((1000, 40 << 20))


def circle(file: h5py.File) -> None:
    file["track/again"] = file["track"]


def many_ways(file: h5py.File) -> None:
    """Forty groups, two links from each to the next: 2^40 ways."""
    group = file["track"]
    for _ in range(40):
        inside = group.create_group("a")
        group["b"] = inside
        group = inside


def elsewhere(file: h5py.File) -> None:
    secret = Path(file.filename).parent / "secret"
    secret.write_bytes(b"secret" * 100)
    file.create_dataset("track/y", (10,), "u1", external=[(str(secret), 0, 10)])


def virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((4,), "f8")
    layout[:] = h5py.VirtualSource(Path(file.filename).parent / "other.h5", "x", (4,))
    file["track"].create_virtual_dataset("y", layout)


def reference(file: h5py.File) -> None:
    file["track"].create_dataset("y", data=[file["models"].ref], dtype=h5py.ref_dtype)


def lists(file: h5py.File) -> None:
    file["track"].create_dataset("y", (3,), dtype=h5py.vlen_dtype(float))


def fields(file: h5py.File) -> None:
    file["track"]["y"] = np.zeros(3, [("a", "f8")])


def one_string_for_all(file: h5py.File) -> None:
    """Ten thousand strings of a million letters: all of them the one that is in the file."""
    text = file["track"].create_dataset("y", (2,), h5py.string_dtype())
    text[0] = "x" * 900_000
    place = text.id.get_offset()
    wide = file["track"].create_dataset("z", (10_000,), h5py.string_dtype())
    wide[...] = "a"
    at = wide.id.get_offset()
    file.flush()
    with open(file.filename, "r+b") as raw:
        raw.seek(place)
        one = raw.read(16)
        raw.seek(at)
        raw.write(one * 10_000)


HARM = (
    bomb, plain_bomb, dense, circle, many_ways, elsewhere, virtual, reference, lists, fields,
    one_string_for_all,
)  # fmt: skip


@pytest.mark.parametrize("harm", HARM, ids=lambda harm: harm.__name__)
def test_results_that_mean_harm(tmp_path: Path, harm: object) -> None:
    path = results(tmp_path / "v3.h5")
    with h5py.File(path, "r+") as file:
        harm(file)
    path.write_bytes(sealed(path.read_bytes()[HEADER_BYTES:], __version__))  # who means harm seals it too
    assert path.stat().st_size < 2 << 20
    with within(500), pytest.raises(FrictrackError, match="damaged or is not HDF5; delete it and run again"):
        store.read(path, "track")


def test_links_out_of_the_results_are_not_followed(tmp_path: Path) -> None:
    other, path = results(tmp_path / "other.h5"), results(tmp_path / "v3.h5")
    before = other.read_bytes()
    with h5py.File(path, "r+") as file:
        del file["models"]
        file["models"] = h5py.ExternalLink("other.h5", "/models")
        file["soft"] = h5py.SoftLink("/models/1_a")
        file["track/inside"] = h5py.ExternalLink("other.h5", "/track")
        file["turning"] = h5py.SoftLink("/turning")
    held = path.read_bytes()
    path.write_bytes(sealed(held[HEADER_BYTES:], __version__, sign))  # not even where it is ours
    assert set(store.read(path, "track")) == {"x"}
    for look in (store.read, store.attributes, store.names):
        for group in ("models", "models/1_a", "soft"):
            with pytest.raises(FrictrackError, match="it is another thing"):
                look(path, group)
    for group in ("models/2_b", "soft/b"):
        with pytest.raises(FrictrackError, match="but it is a link"):
            store.write(path, {group: GroupContent({"n": 2})})
        with pytest.raises(FrictrackError, match="but it is a link"):
            store.write(path, {}, attribute_updates={group.split("/")[0]: {"current": False}})
        with pytest.raises(FrictrackError, match="but it is a link"):
            store.write(path, {}, remove=(group,))
    with pytest.raises(FrictrackError):
        store.read(path, "turning")
    assert other.read_bytes() == before


@pytest.mark.few(1)
@pytest.mark.parametrize("words", [("verify", "."), ("batch", ".", "--workers", "2"), ("fit", "study.toml")])
def test_python_files_beside_a_study_are_not_run(tmp_path: Path, words: tuple[str, ...]) -> None:
    """A folder that somebody sent: also the processes that a command begins look for nothing in it."""
    campaign(tmp_path, 1)
    folder = tmp_path / "day_1"
    Session(open_study(folder / "study.toml")).bring_up_to("displacement")
    for path in (folder / "study_results").glob("*.h5"):
        path.write_bytes(sealed(path.read_bytes()[HEADER_BYTES:], __version__))  # of somebody else
    for name in ("json", "struct", "h5py", "numpy", "frictrack", "multiprocessing", "sitecustomize"):
        (folder / f"{name}.py").write_text("open('owned', 'w')")
    command = Path(sys.executable).with_name("frictrack")
    done = subprocess.run([command, *words], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not (folder / "owned").exists()
