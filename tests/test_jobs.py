"""Long work in processes of its own: done, cancelled, broken off, found again, never two at once."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path

import pytest
from filelock import FileLock

from frictrack.errors import FrictrackError
from frictrack.flow import Session, open_study
from frictrack.study import Study
from frictrack.workbench import jobs
from frictrack.workbench.jobs import Job


def ended(job: Job, within: float = 120.0) -> str:
    """The state of a job once it has one that lasts."""
    until = time.monotonic() + within
    while (state := job.state) == jobs.RUNNING and time.monotonic() < until:
        time.sleep(0.02)
    return state


def at_work(job: Job) -> Job:
    """A job once it has said something."""
    until = time.monotonic() + 60
    while not job.progress and time.monotonic() < until:
        time.sleep(0.01)
    assert job.progress
    return job


def slow(study: Study) -> Job:
    """A search that takes long."""
    return jobs.start(study, "fit", search="sga", model="tustin")


@pytest.fixture
def study(study_file: Path) -> Study:
    return open_study(study_file)


def test_work_is_done_and_stands_in_the_log(study: Study) -> None:
    job = jobs.start(study, "fit", expected_revision=0)
    assert ended(job) == jobs.DONE
    assert job.result["done"]["model"] == ["coulomb", "viscous"]
    assert [c.author for c in Session(study).commands.changes] == ["page"]
    assert [j.folder.name for j in jobs.list_jobs(study)] == ["0001"]


def test_a_failure_is_told_in_its_own_words(study: Study) -> None:
    job = jobs.start(study, "add", effect="textur")
    assert ended(job) == jobs.FAILED
    assert 'did you mean "texture"' in job.result["error"]


def test_work_on_a_study_that_has_changed_is_refused(study: Study) -> None:
    Session(study).apply("edit", table="study", key="mass", value="0.4 kg")
    job = jobs.start(study, "fit", expected_revision=0)
    assert ended(job) == jobs.FAILED
    assert "changed meanwhile" in job.result["error"]


def test_one_piece_of_work_at_a_time_and_cancelled_at_once(study: Study) -> None:
    job = at_work(slow(study))
    with pytest.raises(FrictrackError, match="fit is still running"):
        jobs.start(study, "diagnose")
    began = time.monotonic()
    job.cancel()
    assert ended(job, within=5.0) == jobs.CANCELLED
    assert time.monotonic() - began < 2.0  # half a second when nothing else keeps the machine busy
    assert ended(jobs.start(study, "fit")) == jobs.DONE  # and the study is as it was


def test_a_process_that_dies_is_seen_and_nothing_half_written_stays(study: Study) -> None:
    job = at_work(slow(study))
    pid = next(int(p.name) for p in Path("/proc").iterdir() if p.name.isdigit() and str(job.folder) in _command(p))
    os.kill(pid, signal.SIGKILL)
    assert ended(job) == jobs.INTERRUPTED
    assert Session(study).fit()["model"] == ["coulomb", "viscous"]


def _command(process: Path) -> str:
    try:
        return (process / "cmdline").read_bytes().decode().replace("\0", " ")
    except OSError:
        return ""


def test_a_line_of_progress_that_is_half_written_is_left_out(tmp_path: Path) -> None:
    (tmp_path / "progress.jsonl").write_text(json.dumps({"done": 1, "total": 2, "what": "a"}) + '\n{"done": 2, "to')
    assert Job(tmp_path).progress == [{"done": 1, "total": 2, "what": "a"}]


def test_a_process_that_never_began_is_not_running_whatever_the_clock(tmp_path: Path) -> None:
    for jump in (-3600.0, 3600.0):
        (tmp_path / "spec.json").write_text(json.dumps({"do": "fit", "study": "a.toml", "at": time.time() - jump}))
        assert Job(tmp_path).state == jobs.INTERRUPTED
    (tmp_path / "spec.json").write_text(json.dumps({"do": "fit", "study": "a.toml", "at": time.time()}))
    assert Job(tmp_path).state == jobs.RUNNING


def test_a_process_that_is_just_taking_its_lock_is_running(tmp_path: Path) -> None:
    (tmp_path / "spec.json").write_text(json.dumps({"do": "fit", "study": "a.toml", "at": time.time()}))
    (tmp_path / "alive").touch()  # the file is created an instant before it is locked
    assert Job(tmp_path).state == jobs.RUNNING
    with FileLock(tmp_path / "alive"):
        (tmp_path / "began").touch()
        assert Job(tmp_path).state == jobs.RUNNING
    assert Job(tmp_path).state == jobs.INTERRUPTED


def test_an_attempt_changes_nothing_of_the_study(study: Study) -> None:
    session = Session(study)
    session.fit()
    before, rev = session.models.groups, session.commands.revision
    job = jobs.start(study, "attempt", effect="drag")
    assert ended(job) == jobs.DONE
    assert job.result["done"]["model"] == ["coulomb", "viscous", "drag"]
    assert (Session(study).models.groups, Session(study).commands.revision) == (before, rev)
