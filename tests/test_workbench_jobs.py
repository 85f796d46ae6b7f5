"""Jobs of the page over real HTTP: followed, superseded, found again after the server was killed."""

from __future__ import annotations

import json
import signal
import time
from pathlib import Path

import psutil
import pytest
from browser import Server
from conftest import Clients
from page_client import wait_for

from frictrack.workbench.jobs import JobFollower

# --- jobs and the end of the server


def test_a_job_is_followed_to_its_end(study_file: Path, page: Clients) -> None:
    client = page(study_file).listen()
    status, made = client.work("fit")
    assert (status, made["job"]["state"], made["job"]["words"]) == (200, "running", "Fit")
    ended = client.hear_end()
    assert (ended["state"], ended["error"]) == ("done", None)
    assert client.hear_state(lambda s: s["models"] and s["job"] is None)["last_job"]["id"] == ended["id"]


@pytest.mark.slow
def test_a_failed_job_says_why(study_file: Path, page: Clients) -> None:
    client = page(study_file).listen()
    client.work("add", effect="textur")
    ended = client.hear_end()
    assert ended["state"] == "failed"
    assert 'did you mean "texture"' in ended["error"]


@pytest.mark.slow
def test_useless_work_is_cancelled_by_a_change(fitted: Path, page: Clients) -> None:
    client = page(fitted).listen()
    client.work("diagnose")
    client.hear(lambda m: m["type"] == "job" and m["job"])
    status, _ = client.change("edit", table="study", key="mass", value="0.36 kg")
    assert status == 200
    assert client.hear_end()["state"] == "cancelled"


@pytest.mark.slow
def test_a_run_begins_again_when_its_input_changes(study_file: Path, page: Clients) -> None:
    client = page(study_file).listen()
    assert client.change("edit", table="study", key="mass", value="0.34 kg")[0] == 200  # the next change is quick
    client.work("run")
    client.hear(lambda m: m["type"] == "job" and m["job"])
    assert client.change("edit", table="study", key="mass", value="0.36 kg")[0] == 200
    second = client.hear(lambda m: m["type"] == "job" and m["job"] and m["job"]["id"] == "0002")
    assert second["job"]["do"] == "run"
    assert client.post("/api/cancel")[1] == {"cancelled": "0002"}
    assert client.hear(lambda m: m["type"] == "job" and not m["job"] and m["last_job"]["id"] == "0002")


@pytest.mark.slow
def test_a_killed_server_is_replaced_and_its_job_goes_on(study_file: Path, page: Clients) -> None:
    client = page(study_file).listen()
    before = client.hear(lambda m: m["type"] == "hello")["server"]
    long_work = {"search": "sga", "model": "tustin", "draws": 100_000}  # lasts until it is killed
    client.post("/api/job", do="fit", arguments=long_work, seen=0)
    client.hear(lambda m: m["type"] == "job" and m["job"])
    client.server.stop(signal.SIGKILL)
    assert spare_processes(client.server) == []
    client.server.start()
    again = page(study_file, client.server).listen()
    assert again.hear(lambda m: m["type"] == "hello")["server"] != before
    state = again.state
    assert (state["job"]["do"], state["job"]["state"]) == ("fit", "running")
    process = next(p for p in psutil.process_iter(["cmdline"]) if _works_for(p, study_file))
    process.kill()
    ended = again.hear_end()
    assert ended["state"] == "interrupted"
    again.server.stop()
    again.server.start()
    third = page(study_file, again.server)
    assert third.state["last_job"]["state"] == "interrupted"


def test_the_process_that_waits_starts_a_job_quickly_and_ends_with_the_server(study_file: Path, page: Clients) -> None:
    client = page(study_file).listen()
    assert client.state["exists"]
    spare = wait_for(lambda: spare_processes(client.server))[0]
    wait_for(lambda: is_idle(spare))  # its imports are done
    folder = study_file.parent / "study_results/.frictrack/jobs/0001"
    client.work("fit")
    wait_for((folder / "began").exists)
    assert str(folder) in " ".join(one.path for one in spare.open_files())
    assert client.hear_end()["state"] == "done"
    (other,) = wait_for(lambda: [p for p in spare_processes(client.server) if p != spare])
    client.server.stop(signal.SIGKILL)
    wait_for(lambda: not other.is_running() or other.status() == psutil.STATUS_ZOMBIE)


def is_idle(process: psutil.Process) -> bool:
    """Whether a process waits for its input; one that only waits for the processor is runnable."""
    before = process.cpu_times()
    seen = []
    for _ in range(20):
        time.sleep(0.02)
        seen.append(process.status())
    return set(seen) == {psutil.STATUS_SLEEPING} and process.cpu_times() == before


def spare_processes(server: Server) -> list[psutil.Process]:
    """Processes of a server that wait for a job."""
    assert server.process is not None
    try:
        children = psutil.Process(server.process.pid).children()
    except psutil.NoSuchProcess:
        return []
    return [p for p in children if _waits(p)]


def _waits(process: psutil.Process) -> bool:
    try:
        return "--wait" in process.cmdline()
    except psutil.NoSuchProcess:  # it has ended since
        return False


def _works_for(process: psutil.Process, study: Path) -> bool:
    try:
        files = [*process.cmdline(), *(one.path for one in process.open_files())]
    except psutil.Error:
        return False
    name = str(study.parent / "study_results/.frictrack/jobs")
    return any(name in one for one in files) and "job_process" in " ".join(process.cmdline())


def test_a_job_that_is_looked_at_in_the_moment_of_its_start_is_followed(tmp_path: Path) -> None:
    """Its folder is made before its file is written; another process may look between the two."""
    follower, folder = JobFollower(), tmp_path / ".frictrack" / "jobs" / "0001"
    folder.mkdir(parents=True)
    assert follower.look(tmp_path).running is None
    spec = {"do": "report", "told": {}, "study": "study.toml", "seen": 1, "who": "page", "at": time.time()}
    (folder / "spec.json").write_text(json.dumps(spec))
    running = follower.look(tmp_path).running
    assert running is not None
    assert (running["id"], running["do"]) == ("0001", "report")
    (folder / "result.json").write_text('{"done": {}}')
    ended = follower.look(tmp_path)
    assert ended.running is None
    assert ended.last is not None
    assert ended.last["state"] == "done"
