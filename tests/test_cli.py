"""The command line: what it prints, where it sends it, and how it ends."""

from __future__ import annotations

import csv
import io
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import tifffile
from film import block_film
from rich.console import Console

from frictrack import samples
from frictrack.base import __version__
from frictrack.base.errors import FrictrackError
from frictrack.base.number_format import format_plus_minus
from frictrack.cli import main, output
from frictrack.flow import Session
from frictrack.measure import calibration


@pytest.fixture(autouse=True)
def here(study_file: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(study_file.parent)
    monkeypatch.setenv("COLUMNS", "160")
    return study_file.parent


def run(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command."""
    with pytest.raises(SystemExit) as ended:
        main(argv)
    out, err = capsys.readouterr()
    return int(ended.value.code or 0), out, err


def answer(capsys: pytest.CaptureFixture[str], *argv: str) -> dict[str, Any]:
    """The JSON object that a command prints, and nothing else."""
    code, out, err = run(capsys, *argv, "--json")
    assert code == 0, err
    assert out.count("\n") == 1
    content: dict[str, Any] = json.loads(out)
    return content


def refused(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str]:
    """Exit code and the one line of the error on stderr; what was done before is one line per step."""
    code, out, err = run(capsys, *argv)
    assert out == ""
    *steps, error = err.splitlines()
    assert error.startswith("frictrack: ")
    assert not any(step.startswith("frictrack:") for step in steps)
    assert "Traceback" not in err
    return code, error


def test_fit_prints_the_contract(capsys: pytest.CaptureFixture[str]) -> None:
    result = answer(capsys, "fit", "study.toml")
    assert result["model"] == ["coulomb", "viscous"]
    plain = {"value", "std", "unit", "at_bound", "reason"}
    assert set(result["parameters"]["viscous.F_v"]) == plain
    assert set(result["parameters"]["coulomb.F_c"]) == plain | {"mu"}  # beside newtons that carry the load
    assert {"domain", "search", "correlations", "errors", "per_run", "friction_scatter"} <= set(result)


def test_a_person_reads_a_table_and_where_the_results_are(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "fit", "study.toml")
    assert code == 0
    assert "coulomb.F_c" in out
    assert "±" in out
    assert out.rstrip().endswith("results: study_results/study.h5")


def test_fit_says_once_how_well_the_scale_is_known(capsys: pytest.CaptureFixture[str], here: Path) -> None:
    assert answer(capsys, "fit", "study.toml")["scale_error"] == 0.0
    assert "scale" not in run(capsys, "fit", "study.toml")[1]
    text = (here / "study.toml").read_text()
    (here / "study.toml").write_text(text.replace("[[run]]", '[camera]\nscale = "0.500 +/- 0.002 mm/px"\n\n[[run]]', 1))
    assert answer(capsys, "fit", "study.toml")["scale_error"] == pytest.approx(0.004)
    out = " ".join(run(capsys, "fit", "study.toml")[1].split())
    assert (
        out.count("the scale has a standard deviation of 0.4 %, common to all runs of a camera and included in every ±")
        == 1
    )


@pytest.fixture
def film_study(here: Path) -> Path:
    """A study of one small film."""
    film = block_film(60 + 100 * np.linspace(0, 1, 60) ** 0.8, size=(40, 60), shape=(96, 256))
    tifffile.imwrite(here / "v3.tif", np.stack([film.frame(i) for i in range(60)]), photometric="minisblack")
    (here / "film.toml").write_text(
        '[study]\nmass = 0.35\n[camera]\nfps = 4000\nscale = "0.5 mm/px"\n[[run]]\nname = "v3"\nvideo = "v3.tif"\n'
    )
    return here / "film.toml"


def test_track_says_how_well_each_film_was_measured(capsys: pytest.CaptureFixture[str], film_study: Path) -> None:
    (row,) = answer(capsys, "track", "film.toml")["runs"]
    assert row["overlay"] is None
    assert not (film_study.parent / "film_results" / "v3_overlay.avi").exists()
    code, out, _ = run(capsys, "track", "film.toml", "--overlay")
    assert code == 0
    for words in (
        "60/60",
        "σ / µm",
        "locking / px",
        "time base: frame rate, given 4000 fps (used)",
        "target = [",
    ):
        assert words in out
    assert "no camera shake: the fixed reference" in out
    assert "film_results/v3_track.png, film_results/v3_overlay.avi" in out
    assert (film_study.parent / "film_results" / "v3_overlay.avi").stat().st_size > 10_000
    assert answer(capsys, "track", "film.toml")["runs"][0]["overlay"] == "film_results/v3_overlay.avi"


def test_a_track_that_cannot_be_calibrated_is_shown(capsys: pytest.CaptureFixture[str], film_study: Path) -> None:
    film_study.write_text(film_study.read_text().replace('scale = "0.5 mm/px"', 'scale = {target = "40 mm"}'))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("frictrack.measure.calibration.plane_map", refuse_targets(calibration.plane_map))
        (row,) = answer(capsys, "track", "film.toml")["runs"]
    assert row["sigma_um"] is None
    assert row["notes"][-1] == 'not calibrated: run "v3", displacement: no outline'


def refuse_targets(plane_map: Any) -> Any:
    def refuse(scale: Any, **given: Any) -> Any:
        if isinstance(scale, dict):
            raise FrictrackError("no outline")
        return plane_map(scale, **given)

    return refuse


@pytest.mark.parametrize("stage", ["motion", "friction"])
def test_stages_print_a_row_per_run(capsys: pytest.CaptureFixture[str], stage: str) -> None:
    result = answer(capsys, stage, "study.toml")
    assert [row["run"] for row in result["runs"]] == ["slow", "middle", "fast"]
    code, out, _ = run(capsys, stage, "study.toml")
    assert code == 0
    assert "middle" in out


def test_tables_need_no_tracking(capsys: pytest.CaptureFixture[str]) -> None:
    assert answer(capsys, "track", "study.toml")["runs"] == []
    assert "no films in this study" in run(capsys, "track", "study.toml")[1]


def test_add_and_remove_print_the_error_before_and_after(capsys: pytest.CaptureFixture[str]) -> None:
    added = answer(capsys, "add", "study.toml", "drag")
    assert set(added) == {"effect", "error_before", "error_after", "parameters", "misfit"}
    out = output.Terminal(width=80, file=io.StringIO())
    output.edit(out, added)
    assert len(out.file.getvalue().splitlines()) <= 12
    removed = answer(capsys, "remove", "study.toml", "drag")
    assert removed["error_before"] == added["error_after"]
    code, out, _ = run(capsys, "add", "study.toml", "drag")
    assert code == 0
    assert "before" in out
    assert "drag.c" in out


def test_the_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(capsys, "--version")[:2] == (0, f"frictrack {__version__}\n")


def test_effects_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    listed = {e["name"]: e for e in answer(capsys, "effects")["effects"]}
    assert {"coulomb", "texture", "lens"} <= set(listed)
    assert {"name", "acts_on", "equation", "parameters", "looks_like", "mistaken_for"} <= set(listed["texture"])
    code, out, _ = run(capsys, "effects")
    assert code == 0
    assert len(out.splitlines()) == len(listed) + 2  # one line each, a head, and what to do next
    for line, effect in zip(out.splitlines()[1:], listed.values(), strict=False):
        shown = line.removeprefix(effect["name"]).strip().removesuffix(" …")
        assert f"{effect['what']} ".startswith(f"{shown} ")  # no word is broken
    assert [e["name"] for e in answer(capsys, "effects", "texture", "study.toml")["effects"]] == ["texture"]
    code, out, _ = run(capsys, "effects", "texture")
    assert code == 0
    assert out.startswith(f"texture: {listed['texture']['what']}")
    assert f"  equation: {listed['texture']['equation']}" in out
    assert "symbols: L: dry friction of a run" in out
    assert "mistaken for: " in out
    assert [e["name"] for e in answer(capsys, "effects", "atm2:3", "vibration:2")["effects"]] == ["vibration", "atm2:2"]
    code, err = refused(capsys, "effects", "texure")
    assert code == 2
    assert 'did you mean "texture"?' in err


def test_init_writes_a_study_and_refuses_a_second(capsys: pytest.CaptureFixture[str], here: Path) -> None:
    assert refused(capsys, "init", ".")[0] == 2
    (here / "study.toml").unlink()
    assert answer(capsys, "init", ".")["runs"] == ["fast.csv", "middle.csv", "slow.csv"]
    assert (here / "study.toml").exists()


def test_the_swings_of_a_load_cell_need_no_spring(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    folder = tmp_path / "cell"
    folder.mkdir()
    shutil.copy(samples.DATA / "tribometer" / "strokes.txt", folder)
    answer(capsys, "init", str(folder))
    assert "spring" not in (folder / "study.toml").read_text().partition("[[run]]")[0]


def test_wrong_usage_ends_with_2(capsys: pytest.CaptureFixture[str], here: Path) -> None:
    (here / "empty").mkdir()
    for argv, sentence in {
        ("fit", "absent.toml"): "expected a study file absent.toml but there is none",
        ("add", "study.toml", "texure"): 'expected the name of an effect but got "texure"; did you mean "texture"?',
        ("fit", "slow.csv"): "expected a study file (.toml) but got slow.csv",
        ("run", "study.toml", "--mass", "1kg"): "expected no --mass together with a study file; set mass in the file",
        ("run", "study.toml", "study.toml"): "expected one study file; `frictrack batch` runs several",
        ("run", "a.avi"): "expected --mass and --scale together with recordings, as in --mass 0.35kg",
        ("run", "empty"): "expected a study.toml in empty; `frictrack init empty` writes one",
        (
            "run",
            "absent.avi",
            "--mass",
            "1kg",
            "--scale",
            "1mm/px",
        ): "expected a recording absent.avi but there is no such file",
        ("batch", "nowhere"): "expected study files in nowhere but found none",
    }.items():
        code, err = refused(capsys, *argv)
        assert code == 2
        assert err.startswith("frictrack: ")
        assert sentence in err
    code, _, err = run(capsys, "fit", "study.toml", "--search", "luck")
    assert code == 2
    assert "luck" in err
    text = (here / "study.toml").read_text()
    (here / "study.toml").write_text(text.replace("mass =", "mas ="))
    code, err = refused(capsys, "fit", "study.toml")
    assert code == 2
    assert 'unknown key "mas"; did you mean "mass"?' in err


def test_failed_work_ends_with_1(capsys: pytest.CaptureFixture[str], here: Path) -> None:
    (here / "slow.csv").write_text("t_s,x_m\n" + "".join(f"{i},1\n" for i in range(50)))
    code, err = refused(capsys, "motion", "study.toml", "--json")
    assert code == 1
    assert 'run "slow", filtered: displacement: expected a moving target' in err


def test_bare_recordings_get_a_study_file(capsys: pytest.CaptureFixture[str], here: Path) -> None:
    code, err = refused(capsys, "run", "slow.csv", "--mass", "0.35kg")
    assert code == 2
    assert "study.toml is already there" in err
    (here / "study.toml").unlink()
    code, err = refused(capsys, "run", "slow.csv", "--mass", "0.35kgg")
    assert code == 2
    assert 'unknown unit "kgg"' in err
    assert not (here / "study.toml").exists()


def test_a_recording_that_is_no_film_leaves_no_study_file(capsys: pytest.CaptureFixture[str], here: Path) -> None:
    (here / "study.toml").unlink()
    (here / "a.avi").write_text("this is no film")
    code, err = refused(capsys, "run", "a.avi", "--mass", "0.35kg", "--scale", "0.5mm/px", "--fps", "4000")
    assert code == 1
    assert "a.avi" in err
    assert not (here / "study.toml").exists()


def test_batch_lists_what_failed(capsys: pytest.CaptureFixture[str], here: Path) -> None:
    (here / "broken").mkdir()
    (here / "broken" / "study.toml").write_text("[study]\nmas = 1\n")
    code, out, err = run(capsys, "batch", "broken", "--json", "-o", "out/all", "--workers", "1")
    assert code == 1
    assert "1 of 1: broken/study.toml" in err
    assert 'failed: broken/study.toml: study.toml: [study], line 2: unknown key "mas"' in err
    assert "1 of 1 studies failed; see out/all.html" in err
    result = json.loads(out)
    assert [s["study"] for s in result["studies"]] == ["broken/study.toml"]
    rows = list(csv.DictReader((here / "out" / "all.csv").read_text().splitlines()))
    assert [(row["study"], row["run"]) for row in rows] == [("broken/study.toml", "")]


def test_the_values_that_a_person_reads() -> None:
    assert format_plus_minus(8.01234, 0.0214) == "8.012 ± 0.021"
    assert format_plus_minus(812.3, 12.3) == "812 ± 12"
    assert format_plus_minus(None, None) == "not determined"
    assert format_plus_minus(1.0, 0.0) == "1"
    assert format_plus_minus(1.2345e-9, 1e-11) == "1.2345e-09 ± 1e-11"


def test_help_comes_at_once() -> None:
    call = [sys.executable, "-c", "from frictrack.cli import main; main(['--help'])"]
    took = []
    for _ in range(3):  # the fastest of three, as other work may share the machine
        start = time.perf_counter()
        done = subprocess.run(call, capture_output=True, text=True, check=True)
        took.append(time.perf_counter() - start)
        assert "diagnose" in done.stdout
    assert min(took) < 1.0  # 0.2 s on an idle machine


def test_help_loads_no_science() -> None:
    heavy = ("cv2", "scipy", "h5py", "pandas", "matplotlib")
    call = f"import sys; from frictrack.cli import study_commands; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", call], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.few(1)
@pytest.mark.parametrize("to", ["csv", "xlsx"])
def test_export_writes_plain_tables(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, to: str
) -> None:
    monkeypatch.setattr(Session, "diagnose", lambda session, seed: {"verdict": "complete"})
    monkeypatch.setattr(Session, "_update_papers_route", lambda session: (None, ()))
    files = [Path(f) for f in answer(capsys, "export", "study.toml", "--to", to)["files"]]
    sheets = pd.read_excel(files[0], sheet_name=None) if to == "xlsx" else {f.stem: pd.read_csv(f) for f in files}
    assert list(sheets) == ["slow", "middle", "fast", "parameters", "errors", "budget"]
    assert {"t_s", "x_measured_m", "v_ms", "a_ms2", "F_N", "sigma_F_N", "free"} <= set(sheets["slow"])
    assert {"run", "source", "size", "unit", "frame_N", "mean_N", "share_mean", "common"} <= set(sheets["budget"])
    assert len(sheets["slow"]) == 500
    parameters = sheets["parameters"]
    assert set(parameters["parameter"]) == {"coulomb.F_c", "viscous.F_v"}
    assert {"mu", "mu_std"} <= set(parameters)
    assert parameters["mu"].dtype == parameters["mu_std"].dtype == float


def test_the_demo_tells_the_whole_story(
    capsys: pytest.CaptureFixture[str], here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The sample study and the diagnosis stand in; adding, history and the words are real."""

    def copy_films(folder: Path) -> None:
        shutil.copytree(here, folder, ignore=shutil.ignore_patterns("frictrack_demo"))

    def diagnose(session: Session, seed: int = 0) -> dict[str, Any]:
        missing = [] if "drag" in session.fit()["model"] else ["drag"]
        verdict = "missing" if missing else "complete"
        return {"verdict": verdict, "missing": missing, "candidates": [], "model": ["coulomb", "viscous"]}

    def report(session: Session, seed: int) -> Path:
        return session.study.output / "report.html"

    monkeypatch.setattr(samples, "copy_films", copy_films)
    monkeypatch.setattr(Session, "diagnose", diagnose)
    monkeypatch.setattr(Session, "report", report)
    result = answer(capsys, "demo")
    assert result["diagnose"]["missing"] == ["drag"]
    assert result["add"]["effect"] == "drag"
    assert [m["name"] for m in result["history"]["models"]] == ["1_coulomb+viscous", "2_coulomb+viscous+drag"]
    assert result["report"] == "frictrack_demo/study_results/report.html"
    code, out, _ = run(capsys, "demo")  # a second time tells the same story
    assert code == 0
    assert "Coulomb + viscous lacks drag" in out
    assert "With drag in the model, the held-out error " in " ".join(out.split())
    assert len(out.splitlines()) <= 15


PATCH = {
    "effect": "patch",
    "parameters": {"F": {"value": 0.408, "std": 0.008, "unit": "N"}, "x_c": {"value": 0.22, "std": 1e-4, "unit": "m"}},
    "p": 0.001,
    "delta_bic": 167256.9,
    "heldout_rms_before_um": 214.0,
    "heldout_rms_after_um": 9.85,
    "passes": True,
}


def test_run_prints_fifteen_lines_and_with_details_the_rest(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [*(f"effect.{name}" for name in "abcdefgh"), "vibration.phase[slow]"]
    friction = {"value": 3.012, "std": 0.049, "std_misfit": 0.053, "unit": "N"}
    fitted = {
        "model": ["coulomb", "stribeck"],
        "domain": "displacement",
        "search": "varpro",
        "parameters": dict.fromkeys(names, friction),
        "errors": {"rms_displacement_um": 54.2, "heldout_rms_um": 214.0, "reduced_chi2": 29.2},
        "misfit": {"words": "the model is rejected: it misses a force. A standard deviation means nothing then"},
    }
    found = {
        "headline": "Coulomb + stribeck lacks patch",
        "verdict": "missing",
        "missing": ["patch"],
        "candidates": [PATCH],
        "reduced_chi2": 29.2,
        "noise_um": 9.9,
        "warnings": [{"words": "a mass of 350 kg is implausible"}],
        "findings": [{"run": name, "words": "2 frames lost"} for name in ("slow", "fast")],
        "fails_at": [{"run": "slow", "t": [0.01, 0.02], "share_of_error": 0.8, "p": 1e-9}],
    }
    result = {"fit": fitted, "diagnose": found, "output": "study_results"}
    monkeypatch.setattr(Session, "run", lambda *_, **__: result)
    monkeypatch.setenv("COLUMNS", "80")
    code, brief, _ = run(capsys, "run", "study.toml")
    lines = brief.splitlines()
    assert code == 0
    assert len(lines) == 15  # as many parameters as fit
    assert lines[0] == "Check first: a mass of 350 kg is implausible (and 2 more in the report)"
    assert lines[1] == "Coulomb + stribeck lacks patch"
    text = " ".join(brief.split())
    assert "patch: F 0.408 ± 0.008 N, x_c 0.22000 ± 0.00010 m; p at most 1/1000" in text
    assert "held-out error 214 to 9.85 µm" in text
    assert "held out, rms 214 µm; reduced chi² 29.2" in lines
    assert "and 4 more in the report" in text
    assert "† the model is rejected: it misses a force" in lines
    assert "Check these numbers first" in text  # and not: add patch
    assert lines[-1] == "results: study_results/report.html"
    assert "fails in" not in text
    code, details, _ = run(capsys, "run", "study.toml", "--details")
    assert code == 0
    for shown in ("fails in", "slow: 2 frames lost", "effect.h", "vibration.phase[slow]", "displacement, rms"):
        assert shown in details
    assert answer(capsys, "run", "study.toml") == result  # JSON has everything, with and without --details


NUMBERS = {"rms_displacement_um": 12.58, "heldout_rms_um": 12.64, "free_run_rms_um": 0.6432, "rms_acceleration": 0.6112,
           "relative_force_error": 0.0571, "reduced_chi2": 483.7}  # fmt: skip


@pytest.mark.parametrize("name", ["2_tustin+texture", "4_tustin+texture+viscous_modulation+decaying_vibration"])
def test_a_table_of_models_fits_80_columns_and_breaks_no_name(name: str) -> None:
    out = Console(width=80, file=io.StringIO())
    output.history(out, {"models": [{"name": name, "errors": NUMBERS}]})
    lines = out.file.getvalue().splitlines()
    assert all(len(line.rstrip()) <= 80 for line in lines)
    words = [word for line in lines[1:] for word in line.split()]
    assert all(word in words for word in name.partition("_")[2].capitalize().split("+"))
    for number in ("12.58", "12.64", "0.6432", "0.6112", "5.71", "483.7"):
        assert number in out.file.getvalue()


def test_no_line_of_the_terminal_ends_within_a_number_or_before_its_unit() -> None:
    wholes = ("+77\u202f572", "0.701 µm", "8.48 %", "(0.0398 ± 0.0012) N s/m")
    for width in range(24, 60):
        out = output.Terminal(width=width, file=io.StringIO(), highlight=False)
        out.print(f"delta BIC {wholes[0]}; from 2.64 to {wholes[1]}; force error {wholes[2]}; F_v {wholes[3]}")
        printed = out.file.getvalue()
        assert all(whole in printed for whole in wholes), printed


def test_a_table_of_films_breaks_no_name_at_80_columns(capsys: pytest.CaptureFixture[str], film_study: Path) -> None:
    result = answer(capsys, "track", "film.toml")
    result["runs"][0]["run"] = "double_mass_2"
    out = Console(width=80, file=io.StringIO())
    output.track(out, result)
    (line,) = (line for line in out.file.getvalue().splitlines() if line.startswith("double_mass_2  60"))
    assert "60/60" in line
