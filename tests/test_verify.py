"""`frictrack verify`: damage is found and named, and told apart from a changed recording or a result out of date."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from conftest import STUDY, slide
from filelock import FileLock

from frictrack.base import __version__
from frictrack.base.errors import FrictrackError
from frictrack.base.files import _HOST
from frictrack.cli import main
from frictrack.flow import Session, open_study, store, verify
from frictrack.flow.stages import FILM, TABLE
from frictrack.flow.store import GroupContent

DATA = Path(__file__).parent / "data" / "schema_1"


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of two short tables with a drive, fitted and compared."""
    folder = tmp_path_factory.mktemp("done")
    rng = np.random.default_rng(1)
    t = np.arange(200) / 2000
    text = STUDY
    for name, v0 in {"slow": 1.0, "fast": 3.0}.items():
        x = slide(t, v0) + 1e-5 * rng.normal(size=len(t))
        np.savetxt(folder / f"{name}.csv", np.c_[t, x], delimiter=",", header="t_s,x_m", comments="")
        text += f'\n[[run]]\nname = "{name}"\ntable = "{name}.csv"\n'
    (folder / "study.toml").write_text(text)
    session = Session(open_study(folder / "study.toml"))
    session.fit()
    session.compare()
    for work in session.runs:
        for stage in work.stages:
            work.get(stage)
    return folder


@pytest.fixture
def study(done: Path, tmp_path: Path) -> Path:
    shutil.copytree(done, tmp_path / "lab")
    return tmp_path / "lab" / "study.toml"


def faults(*paths: Path) -> list[tuple[str, str, str]]:
    """(kind, file, group) of each."""
    found = verify(paths)
    assert found["sound"] == (not found["faults"])
    return [(f["kind"], Path(f["file"]).name, f["group"]) for f in found["faults"]]


def flip(path: Path, at: int) -> None:
    content = bytearray(path.read_bytes())
    content[at] ^= 0x10
    path.write_bytes(content)


def chunk(path: Path, name: str) -> int:
    """Where in the file the numbers of a dataset lie."""
    with h5py.File(path) as file:
        return int(file[name].id.get_chunk_info(0).byte_offset)


def test_a_sound_study_is_sound_however_it_is_named(study: Path, tmp_path: Path) -> None:
    results = study.parent / "study_results"
    for paths in ([study], [study.parent], [tmp_path], [results], [results / "slow.h5"], [results, study, tmp_path]):
        found = verify(paths)
        assert found["faults"] == []
        assert found["files"] == (1 if paths[0].suffix == ".h5" else 3)
        assert found["studies"] == (0 if paths[0].suffix == ".h5" else 1)


def test_a_flipped_byte_is_found(study: Path) -> None:
    path = study.parent / "study_results" / "slow.h5"
    flip(path, chunk(path, "motion/v") + 20)
    assert faults(study) == [("damage", "slow.h5", "")]
    (fault,) = verify([study])["faults"]
    assert "delete it and run again, the recordings are untouched" in fault["words"]
    with pytest.raises(FrictrackError, match=r"slow\.h5 is damaged"):
        Session(open_study(study)).bring_up_to("motion")


def test_what_somebody_else_wrote_into_a_file_is_found(study: Path) -> None:
    path = study.parent / "study_results" / "slow.h5"
    with h5py.File(path, "r+") as file:
        file["motion"].attrs["cutoff"] = 12.0
        file["motion"]["note"] = 1.0
    assert faults(path) == [("damage", "slow.h5", "")]


def test_looking_at_a_file_for_writing_leaves_it_sound(study: Path) -> None:
    """A viewer that opens a file to edit it, and edits nothing."""
    path = study.parent / "study_results" / "slow.h5"
    with h5py.File(path, "r+") as file:
        assert file["motion/v"][0] > 0
    assert faults(path) == []


@pytest.mark.parametrize("content", [b"", b"no HDF5", b"\x89HDF\r\n\x1a\n" + bytes(500)])
def test_what_is_no_result_is_said(study: Path, content: bytes) -> None:
    path = study.parent / "study_results" / "slow.h5"
    path.write_bytes(content)
    assert faults(study.parent) == [("damage", "slow.h5", "")]


def test_a_truncated_file_is_said(study: Path) -> None:
    path = study.parent / "study_results" / "slow.h5"
    path.write_bytes(path.read_bytes()[:-700])
    assert all(fault[:2] == ("damage", "slow.h5") for fault in faults(study))
    assert faults(study)


def test_a_changed_table_is_no_damage(study: Path) -> None:
    table = study.parent / "slow.csv"
    table.write_text(table.read_text()[:-3] + "9\n")
    assert faults(study) == [("changed", "slow.h5", "/displacement")]
    assert "slow.csv as it was then, which has changed since; the results are sound" in str(verify([study])["faults"])
    table.unlink()
    assert faults(study) == [("changed", "study.toml", "")]
    assert "slow.csv" in verify([study])["faults"][0]["what"]
    assert verify([study])["files"] == 3


def test_a_touched_table_is_the_same(study: Path) -> None:
    for path in study.parent.glob("*.csv"):
        os.utime(path, (1.0, 1.0))
    assert faults(study) == []


def test_a_changed_setting_is_said(study: Path) -> None:
    study.write_text(study.read_text().replace("0.350", "0.360"))
    kinds = faults(study)
    assert ("changed", "slow.h5", "/friction") in kinds
    assert ("changed", "fast.h5", "/events") in kinds
    assert {kind for kind, *_ in kinds} <= {"changed", "outdated"}


def test_a_result_made_again_leaves_others_out_of_date(study: Path) -> None:
    path = study.parent / "study_results" / "slow.h5"
    other = store.Provenance(**(vars(store.provenance(path, "filtered")) | {"key": "another"}))
    store.write(path, {"filtered": GroupContent(store.read(path, "filtered"), other)})
    assert ("outdated", "slow.h5", "/motion") in faults(path)


def test_a_missing_run_is_said(study: Path) -> None:
    (study.parent / "study_results" / "fast.h5").unlink()
    found = faults(study)
    assert ("missing", "fast.h5", "") in found
    assert ("missing", "study.h5", "/models/1_coulomb+viscous") in found


def test_a_lost_file_of_models_is_said(study: Path) -> None:
    lost = study.parent / "study_results" / "study.h5"
    lost.unlink()
    assert faults(study) == [("missing", "study.h5", "")]
    session = Session(open_study(study))
    session.fit()
    session.restart()
    lost.unlink()
    assert faults(study) == []


def test_other_programs_files_are_left_alone_unless_named(study: Path) -> None:
    path = study.parent / "film.h5"
    with h5py.File(path, "w") as file:
        file["frames"] = np.zeros(3)
    assert faults(study.parent) == []
    assert faults(path) == [("foreign", "film.h5", "")]


def test_what_a_killed_writer_left_is_said_and_swept(study: Path) -> None:
    results = study.parent / "study_results"
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    left = results / f".slow_{_HOST}-{gone.pid}_abc.part.h5"
    left.write_bytes(b"half")
    assert faults(study) == [("leftover", left.name, "")]
    store.write(results / "slow.h5", {})
    assert faults(study) == []


def test_a_writer_at_work_is_told_and_its_files_left(study: Path) -> None:
    results = study.parent / "study_results"
    (results / ".slow_abc.part.h5").write_bytes(b"half")
    with FileLock(results / ".frictrack" / "lock"):
        found = verify([study])
    assert found["faults"] == []
    assert found["at_work"] == [str(results)]


def test_an_attempt_of_the_page_is_sound_whatever_came_after(study: Path) -> None:
    results = study.parent / "study_results"
    Session(open_study(study)).attempt("drag")
    assert faults(study.parent) == []
    assert verify([results])["files"] == 4


def test_a_damaged_log_is_said(study: Path) -> None:
    log = study.parent / "study_results" / ".frictrack" / "log.jsonl"
    log.write_bytes(log.read_bytes() + b'{"rev": 2')
    assert faults(study) == [("leftover", "log.jsonl", "")]
    log.write_bytes(b"{nothing}\n")
    assert faults(study) == [("damage", "log.jsonl", "")]


def test_a_diagnosis_without_its_report_is_said(study: Path) -> None:
    path = study.parent / "study_results" / "study.h5"
    store.write(path, {}, links={"diagnosis": "/comparison"})
    assert faults(study) == [("missing", "report.html", "")]


def test_every_stage_says_where_it_comes_from(study: Path) -> None:
    results = study.parent / "study_results"
    for path in results.glob("*.h5"):
        for group, provenance in store.provenances(path).items():
            assert min(len(provenance.key), len(provenance.input_hash)) == 64, group
            assert json.loads(provenance.inputs), group
            assert provenance.version == __version__
            json.loads(provenance.settings)
    assert set(TABLE) == set(store.provenances(results / "slow.h5"))
    assert {"models/1_coulomb+viscous", "comparison"} == set(store.provenances(results / "study.h5"))
    assert set(TABLE) < set(FILM)


def test_the_command_says_each_fault_in_one_line(study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(["verify", str(study)])
    assert left.value.code == 0
    assert capsys.readouterr().out == "3 result files are sound\n"
    path = study.parent / "study_results" / "slow.h5"
    flip(path, chunk(path, "motion/v") + 20)
    (study.parent / "fast.csv").write_text("t_s,x_m\n0,0\n1,1\n")
    with pytest.raises(SystemExit) as left:
        main(["verify", str(study)])
    assert left.value.code == 1
    out, err = capsys.readouterr()
    assert [line.split(":")[0] for line in out.splitlines()] == ["damage", "changed"]
    assert err.endswith("frictrack: 2 fault(s) in 3 file(s); each line above says what to do\n")
    with pytest.raises(SystemExit) as left:
        main(["verify", str(study), "--json"])
    assert left.value.code == 1
    told: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert [fault["kind"] for fault in told["faults"]] == ["damage", "changed"]


def test_nothing_to_verify_is_wrong_usage(tmp_path: Path) -> None:
    (tmp_path / "never_run.toml").write_text('[study]\nname = "never run"\n')
    for path in (tmp_path / "nowhere", tmp_path / "x.h5", tmp_path / "never_run.toml"):
        with pytest.raises(FrictrackError, match=r"expected results of frictrack in .* but found none") as e:
            verify([path])
        assert e.value.usage


def test_a_broken_study_file_is_said(study: Path) -> None:
    study.write_text(study.read_text() + "\nnonsense = 3\n")
    assert ("changed", "study.toml", "") in faults(study.parent)


def test_a_study_of_an_earlier_schema_is_sound_and_migrated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files that frictrack wrote before there were checksums (commit 5c0aea8)."""
    shutil.copytree(DATA, tmp_path / "old")
    study, results = tmp_path / "old" / "study.toml", tmp_path / "old" / "results"
    before = {path.name: path.read_bytes() for path in results.glob("*.h5")}
    found = verify([study])
    assert found["faults"] == []
    assert sorted(Path(p).name for p in found["without_checksums"]) == ["study.h5", "v3.h5"]
    with h5py.File(results / "v3.h5") as file:
        assert file.attrs["schema"] == 1
        velocity = file["motion/v"][()]
    np.testing.assert_array_equal(store.read(results / "v3.h5", "motion")["v"], velocity)
    assert {path.name: path.read_bytes() for path in results.glob("*.h5")} == before  # reading leaves them
    monkeypatch.setattr("frictrack.flow.store.integrity.header_of", lambda hdf5, version, mark: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        store.write(results / "v3.h5", {})
    assert (results / "v3.h5").read_bytes() == before["v3.h5"]
    monkeypatch.undo()
    store.write(results / "v3.h5", {})
    with h5py.File(results / "v3.h5") as file:
        assert file.attrs["schema"] == store.SCHEMA
        np.testing.assert_array_equal(file["motion/v"][()], velocity)
    assert [Path(p).name for p in verify([study])["without_checksums"]] == ["study.h5"]
    (study.parent / "v3.csv").write_text("t_s,x_m\n0,0\n1,1\n")
    assert faults(study) == [("changed", "v3.h5", "/displacement")]


def test_a_file_with_checksums_in_its_groups_is_read_and_loses_them_when_written(tmp_path: Path) -> None:
    """Files of schema 2."""
    shutil.copytree(DATA.with_name("schema_2"), tmp_path, dirs_exist_ok=True)
    path = tmp_path / "v3.h5"
    with h5py.File(path) as file:
        velocity = file["motion/v"][()]
        assert {len(item.attrs["sha256"]) for item in (file, file["motion"], file["motion/v"])} == {64}
    assert faults(tmp_path) == []
    np.testing.assert_array_equal(store.read(path, "motion")["v"], velocity)
    store.write(path, {})
    with h5py.File(path) as file:
        assert file.attrs["schema"] == store.SCHEMA
        assert not any("sha256" in item.attrs for item in (file, file["motion"], file["motion/v"]))
    assert faults(tmp_path) == []
