"""What the page says about a study: values as read, what is missing, suspect frames, outdated results, history."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cost import within
from few_effects import use_few_effects
from runs import BASE, HIDDEN, Spec, study

from frictrack import samples
from frictrack.base.errors import FrictrackError
from frictrack.effects import models
from frictrack.flow import ResultsReader, Session, open_study, run_study, store, verify
from frictrack.records import Track
from frictrack.workbench.plot_data import comparison_plots
from frictrack.workbench.summaries import (
    SnapshotReader,
    candidate_curves,
    check_fields,
    new_study,
    refuse_implausible,
    state_of,
    suspect_frames,
)

LAW = ["coulomb", "viscous"]


def state(path: Path) -> dict[str, Any]:
    """The state as the browser gets it; NaN is refused."""
    found: dict[str, Any] = json.loads(json.dumps(state_of(SnapshotReader(path).read()), allow_nan=False))
    return found


def edit(path: Path, **arguments: Any) -> None:
    Session(open_study(path, allow_incomplete=True), author="page").apply("edit", **arguments)


# --- values as they are read


@pytest.mark.parametrize(
    ("key", "typed", "echo"),
    [
        ("mass", "350 g", "0.350 kg"),
        ("mass", "0.35", "0.350 kg"),
        ("mass", 0.35, "0.350 kg"),
        ("mass", "0.350 +/- 0.002 kg", "0.3500 ± 0.0020 kg"),
        ("fps", "4000", "4000 /s"),
        ("fps", "4 kHz", "4000 /s"),
        ("fps", "4000 fps", "4000 /s"),
        ("fps", "4000 /s", "4000 /s"),
        ("fps", "4000 1/s", "4000 /s"),
        ("scale", "0.5 mm/px", "0.5 mm/px"),
        ("scale", "500 um/px", "0.5 mm/px"),
        ("scale", {"points": [[0, 0], [200, 0]], "length": "100 mm"}, "0.5000 ± 0.0018 mm/px"),
    ],
)
def test_a_value_is_echoed_as_it_was_read(key: str, typed: Any, echo: str) -> None:
    field = check_fields({key: typed})[key]
    assert (field["echo"], field["warning"], field["error"]) == (echo, None, None)


@pytest.mark.parametrize(
    ("key", "typed", "words"),
    [
        ("mass", "350", 'if grams were meant give mass = "350 g"'),
        ("mass", "-1 kg", "expected mass above 0 kg"),
        ("mass", "heavy", "expected mass as a quantity in kg"),
        ("mass", "3 mm", "measures something else"),
        ("scale", "0.5", 'if mm were meant give scale = "0.5 mm/px"'),
        ("scale", "0 mm/px", "expected the scale above 0 m/px"),
        ("scale", "0.5 kg", "measures something else"),
        ("fps", "0", "expected fps above 0 Hz"),
        ("fps", "-4000", "expected fps above 0 Hz"),
        ("fps", "fast", "expected a frame rate"),
        ("fps", "3 mm", "expected a frame rate"),
    ],
)
def test_a_value_that_cannot_be_right_is_refused_with_a_reason(key: str, typed: str, words: str) -> None:
    field = check_fields({key: typed})[key]
    assert words in str(field["error"])
    table = "study" if key == "mass" else "camera"
    with pytest.raises(FrictrackError, match=r"expected|meant"):
        refuse_implausible(table, key, typed)


def test_a_frame_rate_that_is_odd_but_clear_is_warned_about_and_kept() -> None:
    field = check_fields({"fps": "4"})["fps"]
    assert "fps = 4 lies outside" in str(field["warning"])
    assert field["error"] is None
    refuse_implausible("camera", "fps", 4)


# --- a study of bare recordings


@pytest.fixture
def bare_film(tmp_path: Path) -> Path:
    shutil.copy(samples.films_folder() / "fast.avi", tmp_path / "fast.avi")
    return tmp_path / "study.toml"


def test_without_a_study_the_recordings_are_shown(bare_film: Path) -> None:
    found = state(bare_film)
    assert [(one["name"], one["frames"], one["in_study"]) for one in found["recordings"]] == [("fast.avi", 150, False)]
    assert (found["exists"], found["error"], found["ready"]["can_run"]) == (False, None, False)


def test_a_study_needs_no_value_before_it_is_shown(bare_film: Path) -> None:
    new_study(bare_film, ["fast.avi"], {})
    found = state(bare_film)
    assert found["ready"]["missing"] == ["Mass", "Scale"]
    assert found["ready"]["words"] == "Enter the mass and the scale to run."
    assert (found["fields"]["fps"]["echo"], found["fields"]["fps"]["source"]) == ("4000 /s", "film")
    assert found["runs"][0]["film"] | {"version": ""} == {
        "frames": 150, "width": 512, "height": 72, "fps": 4000.0, "version": "",
    }  # fmt: skip
    edit(bare_film, table="study", key="mass", value="350 g")
    assert state(bare_film)["ready"]["words"] == "Enter the scale to run."
    with pytest.raises(FrictrackError, match="expected a scale but got none"):
        Session(open_study(bare_film, allow_incomplete=True)).fit()
    edit(bare_film, table="camera", key="scale", value={"points": [[0, 10], [200, 10]], "length": "100 mm"})
    found = state(bare_film)
    assert found["ready"]["can_run"]
    assert (found["fields"]["scale"]["source"], found["runs"][0]["shapes"]["ruler"]) == ("drawn", [[0, 10], [200, 10]])


def test_a_repair_is_listed_as_it_stands_in_the_study_file(bare_film: Path) -> None:
    new_study(bare_film, ["fast.avi"], {"mass": "350 g", "scale": "0.5 mm/px"})
    repairs = [
        {"from": 40, "to": 60, "how": "interpolate"},
        {"from": 80, "to": 99, "how": "track", "frame": 80, "target": [20, 10, 60, 40]},
    ]
    edit(bare_film, table="run", which="fast", key="repair", value=repairs)
    assert state(bare_film)["runs"][0]["repairs"] == repairs
    assert state(bare_film)["history"]["undo_words"] == "Undo: repair the frames 40 to 60, 80 to 99 of fast"


def test_a_new_study_refuses_what_the_page_refuses(bare_film: Path) -> None:
    for fields in ({"mass": "350"}, {"scale": "0.5"}, {"fps": "0"}):
        with pytest.raises(FrictrackError, match=r"meant|expected"):
            new_study(bare_film, ["fast.avi"], fields)
    assert not bare_film.exists()


def test_a_run_may_have_a_mass_of_its_own(study_file: Path) -> None:
    edit(study_file, table="run", which="fast", key="mass", value="0.7 kg")
    found = state(study_file)
    by_run = {run["name"]: run["fields"]["mass"] for run in found["runs"]}
    assert (by_run["fast"]["echo"], by_run["fast"]["source"]) == ("0.700 kg", "run")
    assert (by_run["slow"]["echo"], by_run["slow"]["source"]) == ("0.3500 ± 0.0020 kg", "study")


def test_a_study_file_that_cannot_be_read_is_said_and_the_last_state_stays(study_file: Path) -> None:
    reader = SnapshotReader(study_file)
    before = state_of(reader.read())
    text = study_file.read_text()
    study_file.write_text(text.replace("[study]", "[study"))
    after = state_of(reader.read())
    assert "is not valid TOML" in str(after["error"])
    assert (after["runs"], after["ready"]["can_run"]) == (before["runs"], False)
    study_file.unlink()
    for _ in range(2):
        assert "it is gone" in str(state_of(reader.read())["error"])
    study_file.write_text(text)
    assert state_of(reader.read())["error"] is None


# --- suspect frames


def track_of(x: np.ndarray, lost: slice = slice(0), poor: slice = slice(0)) -> Track:
    n, ones = len(x), np.ones(len(x))
    x, score = x.copy(), np.full(n, 0.99)
    x[lost], score[poor] = np.nan, 0.6
    reason = np.where(np.isfinite(x), "", "match score 0.2 too low")
    return Track(np.arange(n) / 4000, x, 20 * ones, 0 * ones, 0.002 * ones, 0.002 * ones, score, reason)


class FilmRun:
    """A run of which only the track matters."""

    def __init__(self, track: Track) -> None:
        self.track, self.tracks = track, {}


def spans(track: Track) -> list[tuple[Any, Any]]:
    return [(span["from"], span["to"]) for span in suspect_frames(FilmRun(track))]  # type: ignore[arg-type]


def test_frames_to_look_at_are_found() -> None:
    frames = np.arange(200.0)
    pushed = np.where(frames > 30, 4.0 * (frames - 30), 0.0)  # a blow at frame 30: the speed jumps, the place does not
    assert spans(track_of(pushed)) == []
    assert spans(track_of(pushed, lost=slice(90, 100), poor=slice(120, 150))) == [(90, 99), (120, 149)]
    aside = pushed + np.where((frames >= 60) & (frames < 70), 12.0, 0.0)
    assert spans(track_of(aside)) == [(60, 69)]


def test_frames_before_the_target_comes_into_view_are_not_suspect() -> None:
    assert spans(track_of(np.arange(100.0), lost=slice(0, 10))) == []


# --- outdated results and history


@pytest.fixture(scope="module")
def textured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of tables whose model lacks texture, run up to the report as the page does it."""
    folder = tmp_path_factory.mktemp("textured")
    law = {name: BASE[name] for name in LAW} | {"texture": HIDDEN["texture"]}
    specs = (Spec(3.0, 1, 0.05), Spec(5.0, 1, 0.05), Spec(4.0, 2, 0.05))
    runs = study(models.of(law), law, specs=specs, sigma=1e-6, rng=np.random.default_rng(1))[0]
    lines = ["[study]", "mass = 0.35", f"model = {json.dumps(LAW)}"]
    for i, run in enumerate(runs):
        columns = np.column_stack([run.displacement.t, run.displacement.x])
        np.savetxt(folder / f"r{i}.csv", columns, delimiter=",", header="t_s,x_m", comments="", fmt="%.9f")
        lines += ["", "[[run]]", f'table = "r{i}.csv"', f"mass = {run.mass}"]
    (folder / "study.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    with pytest.MonkeyPatch.context() as patched:
        use_few_effects(patched)
        run_study(Session(open_study(folder / "study.toml"), author="page"), lambda found: None)
    return folder


@pytest.fixture
def diagnosed(textured: Path, tmp_path: Path) -> Path:
    shutil.copytree(textured, tmp_path, dirs_exist_ok=True)
    return tmp_path / "study.toml"


def test_a_run_that_is_replaced_while_it_is_read_is_read_again(
    study_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page reads while the next stage is being stored; it must not keep the force out of its plots."""
    session, reader, opened = Session(open_study(study_file)), ResultsReader(), store.snapshot
    session.measure("motion")

    @contextmanager
    def slow(*paths: Path) -> Iterator[None]:
        with opened(*paths):
            session.measure("friction")
            yield

    with monkeypatch.context() as patch:
        patch.setattr(store, "snapshot", slow)
        assert [run.friction for run in reader.read(session.study).runs] == [None] * len(session.study.runs)
    assert all(run.friction for run in reader.read(session.study).runs)


def test_the_verdict_is_told_as_in_the_report(diagnosed: Path) -> None:
    found = state(diagnosed)
    diagnosis = found["diagnosis"]
    assert diagnosis["title"] == "Coulomb + viscous lacks texture"
    assert diagnosis["title"] in (diagnosed.parent / "study_results" / "report.html").read_text()
    best = diagnosis["candidates"][0]
    assert (best["name"], best["passes"], best["fitted"]) == ("texture", True, True)
    assert sum(candidate["fitted"] for candidate in diagnosis["candidates"]) <= 6
    assert "<" not in "".join(diagnosis["sentences"])
    assert best["errors"]["with"] < 0.2 * best["errors"]["now"]
    assert diagnosis["plot"] == "Residual against place"
    assert (found["outdated"], found["report"]) == ([], {"exists": True, "outdated": None})


@pytest.mark.slow
def test_a_report_of_another_model_is_outdated(diagnosed: Path) -> None:
    Session(open_study(diagnosed), author="cli").add("texture")
    report = state(diagnosed)["report"]
    assert report["outdated"] == (
        "The report is outdated: it was written for Coulomb + viscous, but Coulomb + viscous + texture is the current "
        "model."
    )
    (entry,) = [one for one in state(diagnosed)["outdated"] if one["what"] == "report"]
    assert entry["update"] == {"do": "report", "arguments": {}}
    Session(open_study(diagnosed)).report()
    assert state(diagnosed)["report"] == {"exists": True, "outdated": None}


def test_a_changed_mass_makes_the_run_its_models_and_the_report_outdated(diagnosed: Path) -> None:
    edit(diagnosed, table="run", which="r1", key="mass", value="0.7 kg")
    found = state(diagnosed)
    told = {(one["what"], one["name"]): one["reason"] for one in found["outdated"]}
    assert set(told) == {("motion", "r1"), ("model", "1_coulomb+viscous"), ("diagnosis", "1_coulomb+viscous"),
                         ("report", "")}  # fmt: skip
    assert "mass was changed from" in told["motion", "r1"]
    assert "to 0.700 kg (r1)" in told["model", "1_coulomb+viscous"]
    assert found["models"][0]["outdated"] == told["model", "1_coulomb+viscous"]
    Session(open_study(diagnosed)).apply("undo")
    assert state(diagnosed)["outdated"] == []


def test_a_repair_makes_its_run_outdated_and_the_run_stays_visible(study_file: Path) -> None:
    Session(open_study(study_file)).fit()
    repair = [{"from": 100, "to": 120, "how": "interpolate"}]
    edit(study_file, table="run", which="slow", key="repair", value=repair)
    found = state(study_file)
    told = {(one["what"], one["name"]): one["reason"] for one in found["outdated"]}
    assert told["motion", "slow"] == "The motion of slow is outdated: a repair was added."
    assert {run["name"]: run["state"] for run in found["runs"]}["slow"] == "measured"
    Session(open_study(study_file)).fit()
    assert state(study_file)["outdated"] == []
    Session(open_study(study_file)).apply("undo")
    assert "a repair was removed" in state(study_file)["models"][0]["outdated"]


def test_a_run_that_was_left_out_makes_the_model_outdated(diagnosed: Path) -> None:
    Session(open_study(diagnosed), author="page").apply("leave_out", run="r2")
    reason = state(diagnosed)["models"][0]["outdated"]
    assert "it was fitted with r2, which the study no longer has" in reason


def test_the_history_says_who_changed_what(diagnosed: Path) -> None:
    edit(diagnosed, table="study", key="mass", value="0.4 kg")
    Session(open_study(diagnosed), author="cli").apply("undo")
    history = state(diagnosed)["history"]
    assert [(entry["author"], entry["words"]) for entry in history["entries"]] == [
        ("page", "Fit Coulomb + viscous"),
        ("page", "Set the mass of all runs to 0.4 kg"),
        ("command line", "Undo: set the mass of all runs to 0.4 kg"),
    ]
    assert (history["can_undo"], history["redo_words"]) == (False, "Redo: set the mass of all runs to 0.4 kg")


# --- candidates


def test_the_curves_of_a_candidate_have_the_rows_of_the_comparison(diagnosed: Path) -> None:
    snapshot = SnapshotReader(diagnosed).read()
    assert snapshot.results is not None
    assert snapshot.results.current is not None
    now = comparison_plots(snapshot.results, snapshot.results.current).columns
    curves = candidate_curves(snapshot, "texture")
    assert curves is not None
    left, better = now["left"], curves.columns["with"]
    assert np.array_equal(np.isfinite(left), np.isfinite(better))
    assert np.nanstd(better) < 0.2 * np.nanstd(left)
    # The measured force follows the texture, so that its small noise may make the force the larger change.
    assert curves.extra["errors"]["with"] < 0.2 * curves.extra["errors"]["now"]
    assert candidate_curves(snapshot, "drop") is None


def test_adding_a_candidate_takes_the_fit_that_was_tried(diagnosed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    snapshot = SnapshotReader(diagnosed).read()
    curves = candidate_curves(snapshot, "texture")
    monkeypatch.setattr(import_module("frictrack.fit"), "fit", lambda *_, **how: pytest.fail("it was fitted before"))
    change = Session(open_study(diagnosed)).add("texture")
    assert curves is not None
    assert change["error_after"]["heldout_rms_um"] == pytest.approx(curves.extra["errors"]["with"])


def test_a_fit_that_was_tried_on_other_runs_is_not_taken(diagnosed: Path) -> None:
    edit(diagnosed, table="run", which="r1", key="mass", value="0.7 kg")
    Session(open_study(diagnosed)).fit()
    assert candidate_curves(SnapshotReader(diagnosed).read(), "texture") is None


# --- verdict first


def test_the_verdict_is_stored_before_anything_else_is_done(study_file: Path) -> None:
    seen = []

    def end(found: dict[str, Any]) -> None:
        stored = state(study_file)
        seen.append((found["diagnose"]["verdict"], stored["diagnosis"]["verdict"], stored["report"]["exists"]))
        raise KeyboardInterrupt  # the process ends here

    with pytest.raises(KeyboardInterrupt):
        run_study(Session(open_study(study_file)), end)
    assert seen == [("complete", "complete", False)]
    assert (
        state(study_file)["diagnosis"]["title"]
        == "Coulomb + viscous is complete: no further effect is detectable in these runs"
    )


@pytest.mark.slow
def test_background_work_that_is_killed_loses_nothing(study_file: Path) -> None:
    """After the verdict the process may be killed at any moment: the files stay whole, and the work can go on."""
    script = (
        "from frictrack.flow import Session, open_study, run_study\n"
        f"run_study(Session(open_study({str(study_file)!r})), lambda found: print('verdict', flush=True))"
    )
    for pause in (0.0, 0.6):
        with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "verdict\n"
            time.sleep(pause)
            process.kill()
        assert [one for one in verify([study_file])["faults"] if one["kind"] == "damage"] == []
        assert state(study_file)["diagnosis"]["verdict"] == "complete"
    run_study(Session(open_study(study_file)), lambda found: None)
    assert state(study_file)["report"] == {"exists": True, "outdated": None}


# --- speed


def test_the_state_of_forty_runs_is_described_in_time(study_file: Path) -> None:
    """Runs without results of their own read those of one run, so that nothing has to be measured."""
    output = study_file.parent / "study_results"
    text = study_file.read_text()
    for i in range(37):
        shutil.copy(study_file.parent / "slow.csv", study_file.parent / f"more{i}.csv")
        shutil.copy(output / "slow.h5", output / f"more{i}.h5")
        text += f'\n[[run]]\ntable = "more{i}.csv"\n'
    study_file.write_text(text)
    reader = SnapshotReader(study_file)
    state_of(reader.read())
    with within(40):  # 15 measured
        found = state_of(reader.read())
    assert [run["state"] for run in found["runs"]] == ["measured"] * 40
