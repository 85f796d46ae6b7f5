"""Long work in processes of its own: done, cancelled, broken off, found again, never two at once."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from pathlib import Path
from typing import Any

import pytest
from browser import LIMIT_S
from filelock import FileLock

from frictrack.base.errors import FrictrackError
from frictrack.flow import Session, open_study, read_results
from frictrack.study import Study
from frictrack.workbench import jobs
from frictrack.workbench.jobs import PREPARE_S, Job, JobSpec, WarmLauncher


def ended(job: Job) -> str:
    """The state of a job once it has one that lasts."""
    until = time.monotonic() + LIMIT_S
    while (state := job.state) == jobs.RUNNING and time.monotonic() < until:
        time.sleep(0.02)
    return state


def at_work(job: Job) -> Job:
    """A job once it has said something."""
    until = time.monotonic() + LIMIT_S
    while not job.progress and time.monotonic() < until:
        time.sleep(0.01)
    assert job.progress
    return job


def start(study: Study, do: str, expected_revision: int | None = None, **arguments: Any) -> Job:
    return jobs.start(study.path, study.output, JobSpec(do, arguments, expected_revision))


def slow(study: Study) -> Job:
    """A search that takes long."""
    return start(study, "fit", search="sga", model="tustin")


@pytest.fixture
def study(study_file: Path) -> Study:
    return open_study(study_file)


def test_work_is_done_and_stands_in_the_log(study: Study) -> None:
    job = start(study, "fit", expected_revision=0)
    assert ended(job) == jobs.DONE
    assert job.result["done"]["model"] == ["coulomb", "viscous"]
    assert [c.author for c in Session(study).commands.changes] == ["page"]
    assert [j.folder.name for j in jobs.list_jobs(study.output)] == ["0001"]


def test_a_failure_is_told_in_its_own_words(study: Study) -> None:
    job = start(study, "add", effect="textur")
    assert ended(job) == jobs.FAILED
    assert 'did you mean "texture"' in job.result["error"]


def test_work_on_a_study_that_has_changed_is_refused(study: Study) -> None:
    Session(study).apply("edit", table="study", key="mass", value="0.4 kg")
    job = start(study, "fit", expected_revision=0)
    assert ended(job) == jobs.FAILED
    assert "changed meanwhile" in job.result["error"]


def test_one_piece_of_work_at_a_time_and_cancelled_at_once(study: Study) -> None:
    job = at_work(slow(study))
    with pytest.raises(FrictrackError, match="Fit tustin is still running"):
        start(study, "diagnose")
    job.cancel()
    assert ended(job) == jobs.CANCELLED
    assert ended(start(study, "fit")) == jobs.DONE  # and the study is as it was


@pytest.mark.slow
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
    assert Job(tmp_path).progress == {"done": 1, "total": 2, "what": "a"}
    (tmp_path / "progress.jsonl").write_text('{"do')
    assert Job(tmp_path).progress == {}


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
    job = start(study, "attempt", effect="drag")
    assert ended(job) == jobs.DONE
    assert job.result["done"]["model"] == ["coulomb", "viscous", "drag"]
    assert (Session(study).models.groups, Session(study).commands.revision) == (before, rev)


def as_job(folder: Path, do: str, seen: int | None = 0, phase: str = "") -> Job:
    """A running job of some kind."""
    folder.mkdir()
    (folder / "spec.json").write_text(
        json.dumps({"do": do, "told": {}, "at": time.time(), "study": "a.toml", "seen": seen})
    )
    (folder / "progress.jsonl").write_text(json.dumps({"done": 0, "total": 0, "what": "", "phase": phase}) + "\n")
    return Job(folder)


@pytest.mark.parametrize(
    ("old", "phase", "new", "revision", "superseded"),
    [
        ("run", "background", "attempt", 0, True),
        ("run", "", "attempt", 0, False),
        ("run", "", "run", 0, True),
        ("run", "", "add_and_diagnose", 0, True),
        ("attempt", "", "attempt", 0, True),
        ("attempt", "", "report", 0, True),
        ("diagnose", "", "add_and_diagnose", 0, True),
        ("diagnose", "", "attempt", 0, False),
        ("report", "", "fit", 0, True),
        ("report", "", "diagnose", 0, False),
        ("add_and_diagnose", "", "add_and_diagnose", 0, False),  # the first effect is not added yet
        ("add_and_diagnose", "", "add_and_diagnose", 1, True),
        ("measure", "", "fit", 0, False),
        ("measure", "", "measure", 0, True),
    ],
)
def test_work_that_becomes_useless(
    old: str, phase: str, new: str, revision: int, superseded: bool, tmp_path: Path
) -> None:
    assert jobs.is_superseded(as_job(tmp_path / "1", old, phase=phase), new, revision) is superseded


@pytest.mark.slow
def test_a_superseded_job_is_cancelled_and_the_new_one_starts(study: Study) -> None:
    first = at_work(slow(study))
    second = start(study, "fit")
    assert first.state == jobs.CANCELLED
    assert ended(second) == jobs.DONE


@pytest.mark.slow
def test_an_effect_is_added_and_diagnosed_in_one_job(study: Study) -> None:
    Session(study).fit()
    job = start(study, "add_and_diagnose", 1, effect="drag")
    phases = []
    while job.state == jobs.RUNNING:
        phases.append(job.progress.get("phase", ""))
        time.sleep(0.02)
    assert job.state == jobs.DONE, job.result
    assert phases[0] == ""
    results = read_results(study)
    assert [model.summary["model"] for model in results.models if model.current] == [["coulomb", "viscous", "drag"]]
    assert results.diagnosis is not None


@pytest.mark.slow
def test_the_process_that_waits_runs_a_job_and_ends_with_its_input(study: Study) -> None:
    launcher = WarmLauncher()
    assert not launcher.is_needed  # the page that has just been opened needs the processor
    launcher._used -= PREPARE_S
    assert launcher.is_needed
    launcher.prepare()
    spare = launcher._spare
    launcher.prepare()
    assert launcher._spare is spare
    job = jobs.start(study.path, study.output, JobSpec("fit"), launcher.launch)
    assert not launcher.is_needed  # for a second
    assert ended(job) == jobs.DONE
    launcher.prepare()
    other = launcher._spare
    assert other is not None
    launcher.close()
    assert other.wait(30) == 0


@pytest.mark.slow
def test_a_job_starts_although_the_process_that_waits_was_killed(study: Study) -> None:
    launcher = WarmLauncher()
    launcher.prepare()
    assert launcher._spare is not None
    launcher._spare.kill()
    launcher._spare.wait()
    assert ended(jobs.start(study.path, study.output, JobSpec("fit"), launcher.launch)) == jobs.DONE


@pytest.mark.slow
def test_only_the_newest_jobs_are_kept(study: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jobs, "MAX_JOBS_KEPT", 2)
    for _ in range(4):
        start(study, "add", effect="textur").wait(60)
    assert [job.folder.name for job in jobs.list_jobs(study.output)] == ["0002", "0003", "0004"]


@pytest.mark.slow
def test_a_job_ends_when_the_results_are_removed(study: Study) -> None:
    job = at_work(slow(study))
    process = next(p for p in Path("/proc").iterdir() if p.name.isdigit() and str(job.folder) in _command(p))
    until = time.monotonic() + LIMIT_S
    while study.output.exists() and time.monotonic() < until:  # the job may write a file meanwhile
        shutil.rmtree(study.output, ignore_errors=True)
    while str(job.folder) in _command(process) and time.monotonic() < until:
        time.sleep(0.02)
    assert str(job.folder) not in _command(process)
    (study.output / ".frictrack/jobs/0001").mkdir(parents=True, exist_ok=True)  # what a process may leave
    assert ended(start(study, "fit")) == jobs.DONE
