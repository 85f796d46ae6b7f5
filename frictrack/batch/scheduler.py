"""Many studies at once: films measured side by side, studies concluded as their films are there."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from frictrack.batch.tasks import (
    StudyOutcome,
    StudyStarted,
    begin_study,
    describe_failure,
    failed_study,
    finish_study,
    measure_film,
)
from frictrack.errors import FrictrackError
from frictrack.workers import WorkerPool

POLL_INTERVAL_S = 0.5  # s between two looks at what is under way


@dataclass
class BatchState:
    """How far a campaign is, for who watches."""

    studies: int
    kept: int = 0  # studies that were finished before
    done: list[str] = field(default_factory=list)  # studies that came to an end, failed ones too
    runs: int = 0  # of the studies that were done now
    failures: list[dict[str, str]] = field(default_factory=list)  # study, run, reason
    under_way: dict[str, float] = field(default_factory=dict)  # what is worked on, and since when
    began: float = field(default_factory=time.monotonic)

    @property
    def seconds(self) -> float:
        """Time since the beginning."""
        return time.monotonic() - self.began

    @property
    def left(self) -> float | None:
        """Seconds until the end, as fast as it went so far; None before the first study is done."""
        todo = self.studies - self.kept - len(self.done)
        return self.seconds * todo / len(self.done) if self.done else None


Watch = Callable[[BatchState], None]


@dataclass
class _StudyProgress:
    """One study under way."""

    path: Path
    films: int = 0  # being measured
    failed: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Task:
    """A piece of work on a study; of one of its films, where there is a name."""

    case: _StudyProgress
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    run: str = ""


class Scheduler:
    """Studies, and who works on them."""

    def __init__(self, studies: Sequence[Path], seed: int, pool: WorkerPool, state: BatchState) -> None:
        self.seed = seed
        self.pool = pool
        self.state = state
        self._studies = deque(studies)
        self._tasks: deque[_Task] = deque()  # what goes on comes before what begins
        self._running: dict[Future[Any], _Task] = {}

    def run(self, watch: Watch) -> Iterator[StudyOutcome]:
        """Every study as it is done. `watch` is told a few times a second."""
        while self._fill() or self._running:
            watch(self.state)
            ended, _ = wait(self._running, timeout=POLL_INTERVAL_S, return_when=FIRST_COMPLETED)
            for future in ended:
                task = self._running.pop(future)
                self.state.under_way.pop(_title(task), None)
                done = self._on_task_end(task, future)
                if done is not None:
                    self._count(done)
                    yield done
        watch(self.state)

    def _fill(self) -> bool:
        """Give as many pieces away as there is room for; whether any is left or under way."""
        room = self.pool.capacity()
        while len(self._running) < room and (self._tasks or self._studies):
            task = self._tasks.popleft() if self._tasks else self._start_task(self._studies.popleft())
            self._running[self.pool.submit(task.function, *task.arguments)] = task
            self.state.under_way[_title(task)] = time.monotonic()
        return bool(self._tasks or self._studies)

    def _start_task(self, path: Path) -> _Task:
        return _Task(_StudyProgress(path), begin_study, (path, self.seed))

    def _on_task_end(self, task: _Task, future: Future[Any]) -> StudyOutcome | None:
        """What a piece of work leads to; the study, where that was its last one."""
        case = task.case
        error = _task_error(future)
        if task.function is measure_film:
            reason = describe_failure(error) if error is not None else future.result()
            case.films -= 1
            if reason is not None:
                case.failed[task.run] = reason
            self._finish_if_measured(case)
            return None
        if error is not None:
            return failed_study(case.path, case.failed, describe_failure(error))
        found = future.result()
        if isinstance(found, StudyStarted):
            case.failed |= found.failed
            case.films = len(found.others)
            self._tasks += [_Task(case, measure_film, (case.path, run, dict(case.failed)), run) for run in found.others]
            self._finish_if_measured(case)
            return None
        return found if isinstance(found, StudyOutcome) else None

    def _finish_if_measured(self, case: _StudyProgress) -> None:
        """Conclude a study once its films are there."""
        if case.films == 0:
            self._tasks.append(_Task(case, finish_study, (case.path, self.seed, dict(case.failed))))

    def _count(self, done: StudyOutcome) -> None:
        self.state.done.append(done.study)
        self.state.runs += sum(1 for row in done.rows if row.get("run"))
        self.state.failures += [{"study": done.study, **failure} for failure in done.failures]


def _task_error(future: Future[Any]) -> BaseException | None:
    """Why a piece of work has no result; None where it has one."""
    if future.cancelled():
        return FrictrackError(
            "whoever worked on it gave it up, as a cluster does that is shut down; run the batch again"
        )
    return future.exception()


def _title(task: _Task) -> str:
    """A piece of work as a person reads it."""
    name = str(task.case.path)
    return f"{name}, {task.run}" if task.run else name
