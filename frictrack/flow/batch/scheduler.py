"""Schedule the tasks of a batch: the films of a study in parallel, then its fit, diagnosis and report."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from frictrack.base.errors import FrictrackError
from frictrack.base.workers import WorkerPool
from frictrack.flow.batch.tasks import (
    StudyOutcome,
    StudyStarted,
    begin_study,
    describe_failure,
    failed_study,
    finish_study,
    measure_film,
)

POLL_INTERVAL_S = 0.5


@dataclass
class BatchState:
    """The progress of a batch.

    Attributes
    ----------
    studies
        Number of studies.
    kept
        Number of studies that were finished before.
    done
        Studies that have ended, failed ones included.
    runs
        Number of runs of those.
    failures
        "study", "run" and "reason" of every failure.
    under_way
        Task -> time at which it began, s.
    began
        Time at which the batch began, s.

    """

    studies: int
    kept: int = 0
    done: list[str] = field(default_factory=list)
    runs: int = 0
    failures: list[dict[str, str]] = field(default_factory=list)
    under_way: dict[str, float] = field(default_factory=dict)
    began: float = field(default_factory=time.monotonic)

    @property
    def seconds(self) -> float:
        """Time since the batch began, s."""
        return time.monotonic() - self.began

    @property
    def left(self) -> float | None:
        """Estimated time to the end, s; None before the first study has ended."""
        todo = self.studies - self.kept - len(self.done)
        return self.seconds * todo / len(self.done) if self.done else None


Watch = Callable[[BatchState], None]


@dataclass
class _StudyProgress:
    """A study that is being run."""

    path: Path
    films: int = 0  # number of films that are being measured
    failed: dict[str, str] = field(default_factory=dict)  # run -> reason


@dataclass(frozen=True)
class _Task:
    """A call of a function of `frictrack.flow.batch.tasks`; `run` names the film that it measures."""

    study: _StudyProgress
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    run: str = ""


class Scheduler:
    """Submit the tasks of all studies to a pool of workers.

    Parameters
    ----------
    studies
        Paths of the study files.
    seed
        Seed of the diagnoses.
    pool
        The workers.
    state
        Is updated while the batch runs.

    """

    def __init__(self, studies: Sequence[Path], seed: int, pool: WorkerPool, state: BatchState) -> None:
        self.seed = seed
        self.pool = pool
        self.state = state
        self._studies = deque(studies)
        self._tasks: deque[_Task] = deque()  # of studies that have begun: they come before new studies
        self._running: dict[Future[Any], _Task] = {}

    def run(self, watch: Watch) -> Iterator[StudyOutcome]:
        """Yield the outcome of every study as it ends; call `watch` several times a second."""
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
        """Submit as many tasks as the pool has capacity for; return whether any task or study is left."""
        room = self.pool.capacity()
        while len(self._running) < room and (self._tasks or self._studies):
            task = self._tasks.popleft() if self._tasks else self._start_task(self._studies.popleft())
            self._running[self.pool.submit(task.function, *task.arguments)] = task
            self.state.under_way[_title(task)] = time.monotonic()
        return bool(self._tasks or self._studies)

    def _start_task(self, path: Path) -> _Task:
        return _Task(_StudyProgress(path), begin_study, (path, self.seed))

    def _on_task_end(self, task: _Task, future: Future[Any]) -> StudyOutcome | None:
        """Continue the study of a task that has ended; return the outcome if the study has ended."""
        study = task.study
        error = _task_error(future)
        if task.function is measure_film:
            reason = describe_failure(error) if error is not None else future.result()
            study.films -= 1
            if reason is not None:
                study.failed[task.run] = reason
            self._finish_if_measured(study)
            return None
        if error is not None:
            return failed_study(study.path, study.failed, describe_failure(error))
        found = future.result()
        if isinstance(found, StudyStarted):
            study.failed |= found.failed
            study.films = len(found.others)
            self._tasks += [
                _Task(study, measure_film, (study.path, run, dict(study.failed)), run) for run in found.others
            ]
            self._finish_if_measured(study)
            return None
        return found if isinstance(found, StudyOutcome) else None

    def _finish_if_measured(self, study: _StudyProgress) -> None:
        """Submit the last task of a study when all its films have been measured."""
        if study.films == 0:
            self._tasks.append(_Task(study, finish_study, (study.path, self.seed, dict(study.failed))))

    def _count(self, done: StudyOutcome) -> None:
        self.state.done.append(done.study)
        self.state.runs += sum(1 for row in done.rows if row.get("run"))
        self.state.failures += [{"study": done.study, **failure} for failure in done.failures]


def _task_error(future: Future[Any]) -> BaseException | None:
    """Return why a task has no result; None if it has one."""
    if future.cancelled():
        return FrictrackError("its task was cancelled, as happens when workers are shut down; run the batch again")
    return future.exception()


def _title(task: _Task) -> str:
    """Return the name of a task for the user."""
    name = str(task.study.path)
    return f"{name}, {task.run}" if task.run else name
