"""Faults of a Dask cluster in the middle of a batch: nothing is lost, nothing is made twice."""

from __future__ import annotations

import json
import operator
import os
import signal
import socket
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, wait
from contextlib import suppress
from pathlib import Path

import pytest
from campaigns import campaign, results

from frictrack.base.errors import FrictrackError
from frictrack.flow.batch import BatchState, batch, tasks

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="signals")]
POISON = """
import os, signal
from pathlib import Path
from typing import Any
from frictrack.flow.batch import tasks

def die(session, seed=0, real=tasks.Session.run):
    if "day_2" in str(session.study.path):
        with Path(os.environ["DEATHS"]).open("a") as file:
            file.write("x")
        os.kill(os.getpid(), signal.SIGKILL)
    return real(session, seed)

tasks.Session.run = die
"""


class Cluster:
    """A scheduler and workers as the command line of Dask starts them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self.port}"
        self.processes: list[subprocess.Popen[bytes]] = []

    def scheduler(self) -> subprocess.Popen[bytes]:
        return self._start("dask_scheduler", "--host", "127.0.0.1", "--port", str(self.port), "--no-show")

    def worker(self, preload: str = "", threads: int = 1) -> subprocess.Popen[bytes]:
        number = len(self.processes)
        more: list[str] = []
        if preload:
            path = self.folder / f"preload_{number}.py"
            path.write_text(preload)
            more = ["--preload", str(path)]
        place = str(self.folder / f"worker_{number}")
        return self._start("dask_worker", self.address, "--nthreads", str(threads), "--local-directory", place, *more)

    def wait_for(self, count: int) -> None:
        from distributed import Client  # noqa: PLC0415

        with Client(self.address, timeout=60) as client:
            client.wait_for_workers(count, timeout=60)

    def _start(self, program: str, *arguments: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.{program}", *arguments, "--no-dashboard"]
        log = (self.folder / f"log_{len(self.processes)}.txt").open("wb")
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "DEATHS": str(self.folder / "deaths")}
        with log:
            one = subprocess.Popen(command, stdout=log, stderr=log, env=environment, start_new_session=True)
        self.processes.append(one)
        return one

    def stop(self) -> None:
        for one in self.processes:
            kill(one)


def kill(one: subprocess.Popen[bytes]) -> None:
    """Kill a process and its children, as a power cut does."""
    with suppress(ProcessLookupError):
        os.killpg(one.pid, signal.SIGKILL)
    one.wait()


@pytest.fixture
def dask(tmp_path: Path) -> Iterator[Cluster]:
    folder = tmp_path / "cluster"
    folder.mkdir()
    one = Cluster(folder)
    yield one
    one.stop()


def studies_in_journal(folder: Path) -> Counter[str]:
    """How often each study is in the journal of a batch."""
    lines = (folder / ".frictrack" / "all.jsonl").read_text().splitlines()
    return Counter(Path(json.loads(line)["study"]).parent.name for line in lines)


def test_a_scheduler_that_is_killed_and_started_again(tmp_path: Path, dask: Cluster) -> None:
    there, ours = campaign(tmp_path / "there", 4), campaign(tmp_path / "here", 4)
    first = [dask.scheduler(), dask.worker(), dask.worker()]
    dask.wait_for(2)
    killed: list[float] = []

    def watch(state: BatchState) -> None:
        if not killed and state.done and state.under_way:
            killed.append(state.seconds)
            kill(first[0])  # its workers end by themselves
            dask.scheduler()
            dask.worker()
            dask.worker()

    found = batch([str(there)], there / "all", scheduler=dask.address, watch=watch)
    assert killed
    assert not found["failed"], found["failed"]
    expected = batch([str(ours)], ours / "all", workers=2)
    assert not expected["failed"]
    assert results(there) == results(ours)
    assert studies_in_journal(there) == {f"day_{k}": 1 for k in range(1, 5)}
    for worker in first[1:]:
        worker.wait(60)  # raises if it goes on
    assert not list(there.rglob("*.part*"))


def test_no_task_is_lost_at_any_moment(dask: Cluster) -> None:
    """Tasks of no length: when the scheduler is killed, some have ended whose results are on the way."""
    count, kill_at, running, found = 1500, [100, 400, 800], {}, {}
    todo = list(range(count))
    started = [dask.scheduler(), dask.worker(), dask.worker()]
    dask.wait_for(2)
    with tasks.cluster_workers(dask.address) as pool:
        while len(found) < count:
            for i in [todo.pop() for _ in range(min(len(todo), 5 * pool.capacity() - len(running)))]:
                running[pool.submit(operator.mul, i, i)] = i
            done, _ = wait(running, timeout=0.5, return_when=FIRST_COMPLETED)
            for future in done:
                i = running.pop(future)
                todo += [i] if future.cancelled() else []
                found |= {} if future.cancelled() else {i: future.result()}
            if kill_at and len(found) > kill_at[0]:
                kill_at.pop(0)
                kill(started[0])
                started = [dask.scheduler(), dask.worker(), dask.worker()]
    assert not kill_at
    assert found == {i: i * i for i in range(count)}


def test_a_scheduler_that_does_not_come_back(tmp_path: Path, dask: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tasks, "RESTART_TIMEOUT_S", 2.0)
    there = campaign(tmp_path / "there", 3)
    scheduler = dask.scheduler()
    dask.worker()
    dask.wait_for(1)

    def watch(state: BatchState) -> None:
        if state.done:
            kill(scheduler)

    with pytest.raises(FrictrackError, match="was lost and none answered there for 2 s; start it and run the batch"):
        batch([str(there)], there / "all", scheduler=dask.address, watch=watch)
    kept = studies_in_journal(there)
    assert set(kept.values()) == {1}
    assert batch([str(there)], there / "all", workers=2)["kept"] == len(kept) > 0


def test_a_study_that_kills_its_workers(tmp_path: Path, dask: Cluster) -> None:
    there = campaign(tmp_path / "there", 6)
    dask.scheduler()
    dask.worker(POISON)
    dask.worker(POISON)
    dask.wait_for(2)
    found = batch([str(there)], there / "all", scheduler=dask.address)
    deaths = len((dask.folder / "deaths").read_text())
    assert [(Path(one["study"]).parent.name, one["run"]) for one in found["failed"]] == [("day_2", "")]
    assert deaths == 4
    assert "all those workers died while running it" in found["failed"][0]["reason"]
    assert studies_in_journal(there) == {f"day_{k}": 1 for k in range(1, 7)}
