"""What a newcomer types wrong: every mistake is refused early, with what was read and what to type instead."""

from __future__ import annotations

import io
import json
import re
import shutil
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from film import block_film
from rich import progress as bars
from rich.console import Console

from frictrack.cli import main, study_commands, utility_commands  # noqa: F401 - registers the commands
from frictrack.cli.common import BatchPrinter, ProgressBars, ProgressDisplay, app
from frictrack.flow import stages
from frictrack.flow.batch import BatchState
from frictrack.study import read_table

T = np.arange(300) / 4000
X = 1.6 * T - 1.5 * T**2
TABLE_STUDY = '[study]\nmass = "0.35 kg"\n[[run]]\nname = "v3"\ntable = "v3.csv"\n'
FILM_RUN = '[camera]\nfps = 4000\nscale = "0.5 mm/px"\n[[run]]\nname = "film"\nvideo = "film.tif"\n'


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, in which nothing may be tracked or fitted: mistakes are found before."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    untracked = replace(stages.FILM["track"], make=lambda *inputs: pytest.fail("the film was tracked"))
    monkeypatch.setitem(stages.FILM, "track", untracked)
    return tmp_path


def table(name: str = "v3.csv", head: str = "t_s,x_m", time: float = 1.0, length: float = 1.0) -> None:
    rows = "\n".join(f"{t:.9g},{x:.9g}" for t, x in zip(time * T, length * X, strict=True))
    Path(name).write_text(f"{head}\n{rows}\n", encoding="utf-8")


def film(name: str = "film.tif") -> None:
    pictures = block_film(60 + 100 * np.linspace(0, 1, 20), size=(40, 60), shape=(96, 256))
    tifffile.imwrite(name, np.stack([pictures.frame(i) for i in range(20)]), photometric="minisblack")


def study(text: str) -> None:
    Path("study.toml").write_text(text, encoding="utf-8")


def typed(capsys: pytest.CaptureFixture[str], command: str) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command."""
    with pytest.raises(SystemExit) as ended:
        main(command.split())
    out, err = capsys.readouterr()
    assert "Traceback" not in err
    return int(ended.value.code or 0), out, err


def refused(capsys: pytest.CaptureFixture[str], command: str) -> tuple[int, str]:
    """Exit code, and the last line on stderr."""
    code, _, err = typed(capsys, command)
    assert code in (1, 2), err
    return code, err.splitlines()[-1]


# ---- numbers without a unit


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--mass 350 --scale 0.5mm/px", '--mass 350 has no unit and was read as 350 kg; if grams were meant'),
        ("--mass 350g --scale 0.5", '--scale 0.5 has no unit and was read as 0.5 m/px; if mm were meant give'),
        ("--mass 350g --scale 0.5mm/px --fps 4", "--fps 4 lies outside 5 to 1e+07 frames per second; if kHz"),
        ("--mass abc --scale 0.5mm/px", 'expected mass as a quantity in kg but got "abc"'),
        ("--mass 0 --scale 0.5mm/px", "expected mass above 0 kg but got '0'"),
        ("--mass 350g --scale 0", "expected the scale above 0 m/px but got '0'"),
        ("--scale 0.5mm/px", "expected --mass together with recordings"),
        ("--mass 350g", "expected --scale together with recordings"),
    ],
)  # fmt: skip
def test_a_wrong_number_of_the_command_line(capsys: pytest.CaptureFixture[str], options: str, said: str) -> None:
    film()
    code, err = refused(capsys, f"run film.tif {options}")
    assert code == 2
    assert said in err
    assert not Path("study.toml").exists()


def test_both_wrong_numbers_are_told_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    film()
    _, err = refused(capsys, "run film.tif --mass 350 --scale 0.5 --fps 4000")
    assert "--mass 350 " in err
    assert "--scale 0.5 " in err


def test_numbers_are_echoed_as_read(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    table()
    monkeypatch.setattr("frictrack.flow.Session.run", lambda session, seed, **how: pytest.skip("read"))
    with pytest.raises(pytest.skip.Exception):
        main(["run", "v3.csv", "--mass", "0.350", "--fps", "4000"])
    err = capsys.readouterr().err
    assert "read as: mass 0.350 kg, 4000 fps\nv3.csv: 300 rows, 0.0747 s\n" in err


def test_a_mass_of_grams_in_the_study_file_is_remarked(
    capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    table()
    study(TABLE_STUDY.replace('"0.35 kg"', "500"))
    assert typed(capsys, "motion study.toml")[0] == 0
    assert "mass = 500 has no unit and was read as 500 kg; if grams were meant" in caplog.text


def test_ms_and_mm_are_noticed(capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture) -> None:
    """The speed is the same as in s and m; the friction is a thousand times too small."""
    table(time=1e3, length=1e3)
    study(TABLE_STUDY)
    assert typed(capsys, "motion study.toml")[0] == 0
    assert "less than in a ball bearing, over" in caplog.text
    assert 'probably t_s holds ms and x_m mm: give columns = {t = "t_s (ms)", x = "x_m (mm)"}' in caplog.text
    study(TABLE_STUDY + 'columns = {t = "t_s (ms)", x = "x_m (mm)"}\n')
    caplog.clear()
    assert typed(capsys, "motion study.toml")[0] == 0
    assert not caplog.text


def test_wrong_units_of_a_table_are_noticed_before_films_are_tracked(capsys: pytest.CaptureFixture[str]) -> None:
    table(time=1e3, length=2e3)
    film()
    study(TABLE_STUDY + FILM_RUN)
    code, err = refused(capsys, "motion study.toml")
    assert code == 1
    assert 'probably t_s holds ms and x_m mm: give columns = {t = "t_s (ms)", x = "x_m (mm)"}' in err


# ---- study files


def test_a_film_without_a_mass(capsys: pytest.CaptureFixture[str]) -> None:
    film()
    study(FILM_RUN)
    code, err = refused(capsys, "run study.toml")
    assert (code, "expected a mass but got none; give mass" in err) == (2, True)


def test_a_table_without_a_mass_is_refused_before_anything_is_read(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    table()
    film()
    study(TABLE_STUDY.replace('mass = "0.35 kg"\n', "") + FILM_RUN + 'mass = "1 kg"\n')
    code, err = refused(capsys, "run study.toml")
    assert code == 2
    assert 'run "v3": expected a mass but got none; give mass = "0.35 kg" in [study] or in its [[run]]' in err


def test_measured_friction_needs_no_mass(capsys: pytest.CaptureFixture[str]) -> None:
    rows = "\n".join(f"{t:.9g},{x:.9g},1.5" for t, x in zip(T, X, strict=True))
    Path("v3.csv").write_text(f"t_s,x_m,friction_N\n{rows}\n")
    study(TABLE_STUDY.replace('mass = "0.35 kg"\n', ""))
    assert typed(capsys, "motion study.toml")[0] == 0


def test_faults_of_all_inputs_come_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    film()
    table("v4.csv", head="Time (ms),Position (mm)")
    Path("broken.avi").write_bytes(b"RIFFxxxx")
    table("force.csv", head="t_s,push")
    study(
        f'[study]\nmass = 1\n{FILM_RUN}drive = "force.csv"\n[[run]]\ntable = "v4.csv"\n[[run]]\nvideo = "broken.avi"\n'
    )
    _, err = refused(capsys, "run study.toml")
    assert 'v4.csv: expected columns "t_s" and "x_m" but got Time (ms), Position (mm)' in err
    assert 'columns = {t = "Time (ms)", x = "Position (mm)"} in its [[run]]' in err
    assert 'run "broken", recording: broken.avi: expected a film but' in err
    assert 'run "film", drive: force.csv: expected a column drive_N in addition to t_s' in err


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("mass =", "masss =", 'unknown key "masss"; did you mean "mass"?'),
        ("v3.csv", "v33.csv", 'expected a file "v33.csv" but there is none; did you mean "v3.csv"?'),
        ("[[run]]", "[[runs]]", 'unknown table "runs"'),
        ('[[run]]\nname = "v3"\ntable = "v3.csv"\n', "", "expected at least one [[run]] but got none"),
        ('name = "v3"', 'model = "tustin"', 'unknown key "model"; it belongs in [study]'),
        ('"v3.csv"', '"C:\\data\\v3.csv"', "(at line 5, column 14); write paths with / instead of"),
        ('"0.35 kg"', "0,35", "write a decimal point instead of the comma"),
        ('"0.35 kg"', "0.35 kg", 'a number with a unit is a text in quotes: mass = "0.35 kg"'),
        ('"0.35 kg"', '"0,35 kg"', 'but got "0,35 kg"; write a decimal point: "0.35 kg"'),
        ('"v3.csv"', "v3.csv", 'texts stand in quotes: video = "a.avi"'),
        (
            'table = "v3.csv"',
            'table = "v3.csv"\nrole = "test"',
            'expected role as "fit" or "validation" but got "test"',
        ),
        ('table = "v3.csv"', 'table = "v3.csv"\ntemplate = 2.5', "expected template as a whole number but got 2.5"),
        (
            'table = "v3.csv"',
            'table = "v3.csv"\norigin_px = [1]',
            "expected origin_px as a list of 2 or more values but",
        ),
        ("[[run]]", "[search]\nseed = 1\n[[run]]", "expected the key method but it is missing"),
        (
            "[[run]]",
            '[[effect]]\neffect = "drag"\nfix = 5\n[[run]]',
            "expected fix as a table {name = value} but got 5",
        ),
    ],
)
def test_a_wrong_study_file(capsys: pytest.CaptureFixture[str], old: str, new: str, said: str) -> None:
    table()
    study(TABLE_STUDY.replace(old, new))
    code, err = refused(capsys, "run study.toml")
    assert code == 2
    assert said in err


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("fit study.toml --model tustin,foo", 'got "foo" (name 2 of 2); known are tustin, stribeck-model'),
        ("fit study.toml --model tustin,texure", 'got "texure" (name 2 of 2); did you mean "texture"?'),
        ("add study.toml textur", 'got "textur"; did you mean "texture"?'),
        ("run nowhere.csv --mass 1kg", "expected a recording nowhere.csv but there is no such file"),
        ("run v3.csv v3.csv --mass 1kg", "expected each recording once but got v3.csv twice"),
        ("run v3.csv --mass 1kg", "study.toml is already there"),
        ("fit v3.csv", "expected a study file (.toml) but got v3.csv"),
    ],
)
def test_a_wrong_word(capsys: pytest.CaptureFixture[str], command: str, said: str) -> None:
    table()
    study(TABLE_STUDY)
    code, err = refused(capsys, command)
    assert code == 2
    assert said in err


# ---- recordings without a study file


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "the file is empty"),
        ("name,colour\na,red\nb,blue\n", "no column of times and no column of positions in it, but name, colour"),
        ("t,x\n0,1\n1,2\n", 'the headers t, x state no units; `frictrack init .` writes a study file'),
        ("0,1\n1,2\n2,3\n", "the headers column 1, column 2 state no units"),
    ],
)  # fmt: skip
def test_a_table_that_cannot_be_used(capsys: pytest.CaptureFixture[str], text: str, said: str) -> None:
    Path("v3.csv").write_text(text)
    code, err = refused(capsys, "run v3.csv --mass 350g")
    assert code == 1
    assert said in err
    assert not Path("study.toml").exists()


def test_a_folder_stands_for_its_recordings(capsys: pytest.CaptureFixture[str]) -> None:
    Path("tables").mkdir()
    table("tables/a.csv", head="Time (ms);Position (mm)".replace(";", ","), time=1e3, length=1e3)
    Path("tables/b.avi").write_bytes(b"RIFFxxxx")
    _, err = refused(capsys, "run tables --mass 350g --scale 0.5mm/px")
    assert "b.avi: expected a film but the file cannot be read as one" in err
    Path("tables/b.avi").unlink()
    _, err = refused(capsys, "run tables --mass 350g --scale 0")
    assert "expected the scale above 0" in err


def test_init_lists_what_it_found_and_what_it_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    film("slow_4000fps.tif")
    table("a.csv", head="Time (ms),Position (mm)", time=1e3, length=1e3)
    table("b.csv")
    table("c.csv", head="t,pos")
    Path("broken.avi").write_bytes(b"RIFFxxxx")
    Path("odd.csv").write_text("name,colour\na,red\nb,blue\n")
    Path("notes.txt").write_text("hello\n")
    code, out, _ = typed(capsys, "init .")
    assert code == 0
    said = " ".join(out.split())
    for words in (
        "slow_4000fps.tif 20 frames of 256 x 96 px, 4000 fps (from its name)",
        'a.csv 300 rows, 0.0747 s; t is "Time (ms)", x is "Position (mm)"',
        "b.csv 300 rows, 0.0747 s",
        "broken.avi expected a film but the file cannot be read as one",
        "odd.csv no column of times and no column of positions in it, but name, colour",
        "notes.txt no column of times",
        "fill in mass, scale, columns of c.csv (marked FILL IN), then `frictrack run study.toml`",
    ):
        assert words in said
    text = Path("study.toml").read_text()
    assert "# FILL IN: the sliding mass; weigh it" in text
    assert "# FILL IN: size of a pixel on the course" in text
    assert "# a ruler        scale = {points" in text
    assert "# from its name: frame rate while filming (not the playback rate)" in text
    assert '# FILL IN the units: columns = {t = "t (s)", x = "pos (m)"}' in text
    raw = tomllib.loads(text)
    assert raw["camera"] == {"fps": 4000.0}
    assert [run.get("columns") for run in raw["run"]] == [{"t": "Time (ms)", "x": "Position (mm)"}, None, None, None]


def test_what_init_writes_runs_without_being_edited(capsys: pytest.CaptureFixture[str]) -> None:
    table("a.csv", head="Time (ms),Position (mm)", time=1e3, length=1e3)
    result = json.loads(typed(capsys, "init . --mass 350g --json")[1])
    assert result["fill_in"] == result["skipped"] == []
    assert result["runs"] == ["a.csv"]
    code, out, err = typed(capsys, "motion study.toml")
    assert code == 0, err
    assert "v max: it must be a speed that you expect" in " ".join(out.split())


def test_init_refuses_an_implausible_mass_and_a_folder_without_recordings(capsys: pytest.CaptureFixture[str]) -> None:
    Path("odd.csv").write_text("name,colour\na,red\nb,blue\n")
    code, err = refused(capsys, "init .")
    assert code == 1
    assert "expected films or tables in . but found none; odd.csv: no column of times" in err
    assert refused(capsys, "init . --mass 350")[0] == 2


def test_a_playback_rate_is_to_be_filled_in(capsys: pytest.CaptureFixture[str]) -> None:
    """Neither the file nor its name tells the rate of the camera."""
    film("slow.tif")
    assert "frame rate of the camera not stated" in " ".join(typed(capsys, "init .")[1].split())
    assert (
        "# FILL IN: (not stated by slow.tif; an .avi or .mp4 often states the speed" in Path("study.toml").read_text()
    )


# ---- the program itself


def test_no_line_of_progress_is_missing_where_stderr_is_a_file(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter([0.0, 1.0, 2.0, 6.5, 6.5, 7.0])
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    progress = ProgressDisplay()
    progress(0, 0, "tracking")
    progress(10, 200, "frames")
    progress(11, 200, "frames")
    progress(99, 200, "frames")
    assert capsys.readouterr().err == "tracking\nframes: 11 of 200\n"


def test_a_bar_of_unknown_length_has_not_that_of_the_step_before() -> None:
    drawn = bars.Progress(console=Console(file=io.StringIO()))
    progress = ProgressBars(drawn)
    progress(150, 200, "fast: follow")
    progress(0, 0, "fitting tustin")
    progress.clear()
    assert [(task.description, task.total) for task in drawn.tasks] == [("fitting tustin", None)]


def test_a_batch_tells_what_it_works_on_where_stderr_is_a_file(
    capsys: pytest.CaptureFixture[str], here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, tell = BatchState(3, kept=1, began=0.0), BatchPrinter(ProgressDisplay())
    for now, event in ((0.0, "begin"), (1.0, ""), (20.0, ""), (21.0, ""), (30.0, "end")):
        monkeypatch.setattr("time.monotonic", lambda now=now: now)
        if event == "begin":
            state.under_way = {f"{here}/a.toml": 0.0, f"{here}/b.toml": 0.0}
        elif event == "end":
            state.done.append(f"{here}/a.toml")
        tell(state)
    said = ["3 studies, 1 of them finished before", "working on a.toml, 0:20 and 1 more", "2 of 3: a.toml"]
    assert capsys.readouterr().err.splitlines() == said


COMMANDS = [info.name or info.callback.__name__ for info in app.registered_commands if info.callback]


@pytest.mark.parametrize("command", [*COMMANDS, "blind make", "blind score"])
def test_every_help_ends_with_two_examples_that_fit(capsys: pytest.CaptureFixture[str], command: str) -> None:
    code, out, _ = typed(capsys, f"{command} --help")
    assert code == 0
    lines = out.rstrip().splitlines()
    assert lines[-3] == "  Examples:"
    assert all(line.startswith(f"    frictrack {command}") for line in lines[-2:])
    assert all(len(line) <= 80 for line in lines)


def test_the_shell_can_complete_commands() -> None:
    how: dict[str, Any] = {"COMP_WORDS": "frictrack dia", "COMP_CWORD": "1", "_FRICTRACK_COMPLETE": "complete_bash"}
    command = [sys.executable, "-m", "frictrack"]
    import os  # noqa: PLC0415

    done = subprocess.run(command, env=os.environ | how, capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout.split() == ["diagnose"]


def test_the_documentation_is_found_or_how_to_build_it_is_said(
    capsys: pytest.CaptureFixture[str], here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = here / "site" / "frictrack"
    (package / "cli").mkdir(parents=True)
    monkeypatch.setattr(utility_commands, "__file__", str(package / "cli" / "utility_commands.py"))
    code, err = refused(capsys, "docs")
    assert code == 1
    assert "`sphinx-build docs docs/_build/html` builds it" in err
    built = here / "site" / "docs" / "_build" / "html" / "index.html"
    for page in (built, package / "pages" / "index.html"):  # the installed pages win
        page.parent.mkdir(parents=True)
        page.touch()
        assert typed(capsys, "docs --path")[1] == f"{page}\n"
        assert json.loads(typed(capsys, "docs --json")[1]) == {"output": str(page)}
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda address: not opened.append(address))
    assert typed(capsys, "docs")[1] == ""
    assert opened == [page.as_uri()]
    shutil.rmtree(package)


@pytest.mark.parametrize(
    ("headers", "columns"),
    [
        ("Zeit/s;Weg / mm", {"t": "Zeit/s", "x": "Weg / mm"}),
        ("time_s;position_mm", {"t": "time_s", "x": "position_mm"}),
        ("t_s;x_mm", {"x": "x_mm"}),
        ("Zeit in s;Weg in mm", {"t": "Zeit in s", "x": "Weg in mm"}),
    ],
)
def test_units_without_brackets_are_read(
    capsys: pytest.CaptureFixture[str], headers: str, columns: dict[str, str]
) -> None:
    Path("v.csv").write_text(f"{headers}\n0;0\n0,1;150\n0,2;310\n")
    assert typed(capsys, "init")[0] == 0
    run = tomllib.loads(Path("study.toml").read_text())["run"][0]
    assert run["columns"] == columns
    assert read_table(Path("v.csv"), run["columns"]).x.tolist() == pytest.approx([0.0, 0.15, 0.31])


def test_a_force_that_may_be_the_friction_is_asked_about(capsys: pytest.CaptureFixture[str]) -> None:
    Path("cell.csv").write_text("t [s],x [mm],F [N]\n0,0,1\n0.1,150,1.1\n0.2,310,1\n")
    printed = " ".join(typed(capsys, "init .")[1].split())
    assert 'is "F [N]" the friction? Then name it in columns: friction = "F [N]"' in printed
    assert "fill in mass" in printed
    Path("study.toml").unlink()
    Path("cell.csv").write_text("t [s],x [mm],Reibkraft [N]\n0,0,1\n0.1,150,1.1\n0.2,310,1\n")
    printed = " ".join(typed(capsys, "init .")[1].split())
    assert 'normal_load = "5 N" gives its coefficient' in printed
    assert "fill in" not in printed


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("fit", "expected a study file study.toml but there is none; `frictrack init .` writes one"),
        ("add patch", "expected a study file study.toml but there is none"),
        ("fast.avi", "expected a command but got the file fast.avi; `frictrack run fast.avi` analyses it"),
        ("run Fast.avi --mass 350g --scale 0.5mm/px", 'there is no such file; did you mean "fast.avi"?'),
    ],
)
def test_what_comes_to_mind_first(capsys: pytest.CaptureFixture[str], command: str, said: str) -> None:
    Path("fast.avi").write_bytes(b"")
    assert said in refused(capsys, command)[1]


def test_a_study_file_with_typographic_quotes(capsys: pytest.CaptureFixture[str]) -> None:
    Path("study.toml").write_text("[study]\nmass = “350 g”\n")
    assert 'texts stand in plain quotes: "0.35 kg"' in refused(capsys, "run")[1]


def test_a_command_to_type_next_has_quotes_where_a_folder_has_a_blank(capsys: pytest.CaptureFixture[str]) -> None:
    Path("my runs").mkdir()
    Path("my runs/a.csv").write_text("t_s,x_m\n0,0\n0.1,0.15\n0.2,0.31\n")
    with pytest.raises(SystemExit):
        main(["init", "my runs"])
    assert "frictrack run 'my runs/study.toml'" in " ".join(capsys.readouterr().out.split())


@pytest.mark.few(1)
@pytest.mark.parametrize(("head", "column"), [("Weg [m]", "Weg [m]"), ("Weg", "Weg (m)"), ("x_m", None)])
def test_the_remedy_for_a_unit_works_whatever_the_header_is(
    capsys: pytest.CaptureFixture[str], head: str, column: str | None
) -> None:
    table(length=1e4, head=f"t_s,{head}")
    named = "" if column is None else f'columns = {{t = "t_s", x = "{column}"}}\n'
    study(TABLE_STUDY + named)
    _, err = refused(capsys, "motion study.toml")
    remedy = re.search(r'x = "([^"]*)"', err)
    assert remedy is not None
    study(TABLE_STUDY + f'columns = {{t = "t_s", x = "{remedy[1]}"}}\n')
    assert typed(capsys, "motion study.toml")[0] == 0
