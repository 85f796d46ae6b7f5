"""The tasks of a batch, their schedule, and the workers of a Dask cluster.

The films of a study are measured in parallel; then come its fit, diagnosis and report.

A failure is returned as a sentence. A task that was cancelled, as when a cluster loses its scheduler, is tried again.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from stat import S_ISDIR
from typing import Any
from uuid import uuid4

from frictrack.base import __version__
from frictrack.base.errors import FrictrackError, needs_package
from frictrack.base.remote import RemoteFile, locate
from frictrack.base.workers import WorkerPool
from frictrack.flow import Session, open_study, run_pipeline
from frictrack.study import Study

FileStates = dict[str, list[int]]  # path -> size, time of change in ns
Reasons = Mapping[str, str]  # run -> why it failed


def file_states(study: Study) -> FileStates:
    """Return the states of all files of a study: study file, recordings, results."""
    pipelines = [run_pipeline(study, run) for run in study.runs]
    inputs = [path for pipeline in pipelines for path in pipeline.input_files()]
    results = [pipeline.path for pipeline in pipelines] + [study.output / name for name in ("study.h5", "report.html")]
    known = [] if study.prior_file is None else [study.prior_file]
    return {str(path): _state(path) for path in (study.path, *known, *inputs, *results)}


def are_unchanged(files: FileStates) -> bool:
    """Return whether all files have the recorded states; False for no files, or an address that is not allowed."""
    with suppress(FrictrackError):
        return bool(files) and all(_state(locate(path)) == state for path, state in files.items())
    return False


def _state(path: Path | RemoteFile) -> list[int]:
    """Return size and modification time; of a folder the number and total size of its files, and the latest time."""
    if isinstance(path, RemoteFile):
        return path.state()
    try:
        found = path.stat()
        if not S_ISDIR(found.st_mode):
            return [found.st_size, found.st_mtime_ns]
        inside = [one.stat() for one in path.iterdir() if one.is_file()]
    except OSError:
        return []
    return [len(inside), sum(one.st_size for one in inside), max((one.st_mtime_ns for one in inside), default=0)]


@dataclass
class StudyOutcome:
    """The outcome of a study."""

    study: str  # the file, from the root
    summary: dict[str, Any]  # the row of the study in the table of the page
    rows: list[dict[str, Any]]  # one row per run
    units: dict[str, str] = field(default_factory=dict)  # of the parameters
    # states of the study's files; empty if something failed, so that the next batch tries again
    files: FileStates = field(default_factory=dict)
    conditions: dict[str, float | str] = field(default_factory=dict)  # conditions that the study file states, by name
    law: str = ""  # the law as a prior file; "" where there is none, or where it rests on the prior of another study
    seed: int = 0  # seed, seconds: seed of the diagnosis, and computing time, s
    seconds: float = 0.0

    @property
    def failures(self) -> list[dict[str, str]]:
        """Run and reason of every failure; the run is empty if the study itself failed."""
        return [{"run": row.get("run", ""), "reason": row["reason"]} for row in self.rows if row.get("reason")]


@dataclass
class StudyStarted:
    """A study whose first film was measured, so that the others can be measured in parallel."""

    others: list[str]
    failed: dict[str, str]
    reasons: dict[str, str | None] = field(default_factory=dict)  # why each of the others failed; None if it did not


def begin_study(path: Path, seed: int) -> StudyStarted | StudyOutcome:
    """Measure the first film, which defines the tracked point of all others; finish a study that has only one."""
    study = open_study(path)
    films = [run.name for run in study.runs if run.video]
    failed: dict[str, str] = {}
    while len(films) > 1:
        first = films.pop(0)
        reason = _measure_run(without_runs(study, failed), first)
        if reason is None:
            return StudyStarted(films, failed)
        failed[first] = reason
    return finish_study(path, seed, failed)


def measure_film(path: Path, run: str, failed: Reasons) -> str | None:
    """Measure one film."""
    return _measure_run(without_runs(open_study(path), failed), run)


def finish_study(path: Path, seed: int, failed: Reasons) -> StudyOutcome:
    """Fit, diagnose and report a study without the runs that failed."""
    start, failed = time.perf_counter(), dict(failed)
    try:
        study = open_study(path)
        for run in study.runs:
            if run.name not in failed and (reason := _measure_run(without_runs(study, failed), run.name)) is not None:
                failed[run.name] = reason
        if len(failed) == len(study.runs):
            return failed_study(path, failed, "none of its runs could be measured")
        kept = without_runs(study, failed)
        notes = tuple(f'run "{name}" is left out: {reason}' for name, reason in failed.items())
        session = Session(kept, notes=notes)
        done = _outcome(path, session.run(seed), failed)
        done.conditions, done.law = dict(study.conditions), session.law_text() if study.conditions else ""
        for row in done.rows:
            row |= {f"condition {name}": str(value) for name, value in study.conditions.items()}
        done.files = {} if failed else file_states(study)  # what failed is tried again
    except Exception as e:  # noqa: BLE001 - whatever befalls one study must not stop the others
        return failed_study(path, failed, describe_failure(e))
    done.seed, done.seconds = seed, time.perf_counter() - start
    return done


def failed_study(path: Path, failed: Reasons, reason: str) -> StudyOutcome:
    """Return the outcome of a study that failed, and of its runs that did."""
    rows = [{"reason": reason}, *({"run": run, "reason": why} for run, why in failed.items())]
    return StudyOutcome(str(path), {"runs": 0, "reason": reason}, rows)


def describe_failure(e: BaseException) -> str:
    """Return a failure in one line."""
    text = str(e) if isinstance(e, FrictrackError) else f"{type(e).__name__}: {e}"
    return " ".join(text.split())


def without_runs(study: Study, failed: Reasons) -> Study:
    """Return the study without the runs that failed."""
    return replace(study, runs=tuple(run for run in study.runs if run.name not in failed))


def _measure_run(study: Study, name: str) -> str | None:
    """Bring every stage of a run up to date; return the reason if one fails, else None."""
    pipeline = run_pipeline(study, next(run for run in study.runs if run.name == name))
    try:
        for stage in pipeline.stages:
            if not pipeline.is_current(stage):  # what is there need not be read: the study reads it
                pipeline.get(stage)
    except Exception as e:  # noqa: BLE001
        return describe_failure(e).removeprefix(f'run "{name}", ')
    return None


def _outcome(path: Path, result: Mapping[str, Any], failed: Reasons) -> StudyOutcome:
    """Return the outcome of a study that was run."""
    fit, diagnosis = result["fit"], result["diagnose"]
    parameters = fit["parameters"].items()
    shared = {"verdict": diagnosis["verdict"], "missing": " ".join(diagnosis["missing"])}
    shared |= {"model": " ".join(fit["model"]), "domain": fit["domain"]}
    shared |= {name: p["value"] for name, p in parameters}
    shared |= {f"{name} {key}": p[key] for key in ("std", "std_misfit") for name, p in parameters if key in p}
    own = ("run", "role", "level", "noise_um", "segments")
    rows = [shared | {k: run.get(k) for k in own} | run.get("errors", {}) for run in fit["per_run"]]
    rows += [{"run": run, "reason": why} for run, why in failed.items()]
    summary = {"verdict": diagnosis["verdict"], "missing": diagnosis["missing"], "runs": len(fit["per_run"])}
    summary |= {"reduced_chi2": fit["errors"]["reduced_chi2"], "reason": None}
    summary |= {"left_out": list(failed), "results": result["output"]}
    return StudyOutcome(str(path), summary, rows, {name: p["unit"] for name, p in parameters})


POLL_INTERVAL_S = 0.5
MAX_LOSSES = 2  # of one step, after which it is not tried again


@dataclass
class BatchState:
    """The progress of a batch."""

    studies: int  # number of studies
    kept: int = 0  # number of studies that were finished before
    done: list[str] = field(default_factory=list)  # studies that have ended, failed ones included
    runs: int = 0  # number of runs of those
    failures: list[dict[str, str]] = field(default_factory=list)  # "study", "run" and "reason" of every failure
    under_way: dict[str, float] = field(default_factory=dict)  # task -> time at which it began, s
    began: float = field(default_factory=time.monotonic)  # time at which the batch began, s

    @property
    def seconds(self) -> float:
        """Time since the batch began, s."""
        return time.monotonic() - self.began


Watch = Callable[[BatchState], None]


@dataclass
class _Step:
    """A step of a study that waits for its turn, or for its result."""

    study: Path
    function: Callable[..., Any]  # of this module, with its arguments
    arguments: tuple[Any, ...]
    film: str = ""  # that it measures; "" for a step of the whole study
    losses: int = 0  # times that it was cancelled

    @property
    def title(self) -> str:
        """The study, and the film if there is one."""
        return ", ".join(filter(None, (str(self.study), self.film)))


class Scheduler:
    """Submit the steps of all studies to a pool of workers: the first film, the other ones side by side, the rest."""

    def __init__(self, studies: Sequence[Path], seed: int, pool: WorkerPool, state: BatchState) -> None:
        self.pool = pool
        self.state = state
        self._seed = seed
        self._new = deque(_Step(path, begin_study, (path, seed)) for path in studies)
        self._next: deque[_Step] = deque()  # of studies that have begun: they come before new ones
        self._begun: dict[Path, StudyStarted] = {}
        self._running: dict[Future[Any], _Step] = {}

    def run(self, watch: Watch) -> Iterator[StudyOutcome]:
        """Yield the outcome of every study as it ends; call `watch` several times a second."""
        while self._fill() or self._running:
            watch(self.state)
            for future in wait(self._running, timeout=POLL_INTERVAL_S, return_when=FIRST_COMPLETED).done:
                step = self._running.pop(future)
                self.state.under_way.pop(step.title, None)
                if future.cancelled() and step.losses < MAX_LOSSES:
                    self._next.append(replace(step, losses=step.losses + 1))
                elif done := self._outcome(step, _result(future)):
                    self.state.done.append(done.study)
                    self.state.runs += sum(1 for row in done.rows if row.get("run"))
                    self.state.failures += [{"study": done.study, **failure} for failure in done.failures]
                    yield done
        watch(self.state)

    def _fill(self) -> bool:
        """Submit as many steps as the pool has capacity for; return whether any step or study is left."""
        room = self.pool.capacity()
        while len(self._running) < room and (self._next or self._new):
            step = (self._next or self._new).popleft()
            self._running[self.pool.submit(step.function, *step.arguments)] = step
            self.state.under_way[step.title] = time.monotonic()
        return bool(self._next or self._new)

    def _outcome(self, step: _Step, result: Any) -> StudyOutcome | None:
        """Return the outcome of a study if it ends with a step; else None, and what follows waits for its turn."""
        path = step.study
        if isinstance(result, StudyStarted):
            self._begun[path] = result
            self._next += [_Step(path, measure_film, (path, run, dict(result.failed)), run) for run in result.others]
            return None
        if not step.film:
            failed = dict(*step.arguments[2:])  # of `finish_study`
            return result if isinstance(result, StudyOutcome) else failed_study(path, failed, result)
        begun = self._begun[path]
        begun.reasons[step.film] = result
        if len(begun.reasons) == len(begun.others):
            failed = begun.failed | {run: why for run in begun.others if (why := begun.reasons[run]) is not None}
            self._next.append(_Step(path, finish_study, (path, self._seed, failed)))
        return None


def _result(future: Future[Any]) -> Any:
    """Return the result of a step, or a sentence why it has none."""
    if future.cancelled():
        return "its task was cancelled, as happens when workers are shut down; run the batch again"
    error = future.exception()
    return future.result() if error is None else describe_failure(error)


SCHEDULER_TIMEOUT_S = 20.0  # s to wait for the first answer
RESTART_TIMEOUT_S = 300.0  # s to wait for a scheduler that was lost
_CLIENT_LOGGERS = ("distributed.batched", "distributed.client")  # their tracebacks of a lost scheduler are no news


@contextmanager
def cluster_workers(address: str) -> Iterator[WorkerPool]:
    """Open a pool of the workers of a Dask scheduler.

    The workers must see the same files and have the same version of frictrack.
    """
    with needs_package("--scheduler", "frictrack[cluster]"):
        from distributed import Client  # noqa: PLC0415
    for name in _CLIENT_LOGGERS:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        with Client(address, timeout=SCHEDULER_TIMEOUT_S, name="frictrack") as client:
            _check_versions(client)
        client = Client(address, timeout=RESTART_TIMEOUT_S, name="frictrack")  # how long it looks for a lost scheduler
    except FrictrackError:
        raise
    except (OSError, ValueError, TypeError) as e:
        raise FrictrackError(
            f"expected a Dask scheduler at {address} but none answers; start one, as `dask scheduler` does, and give "
            "the address that it prints"
        ) from e
    with client:
        yield _ClusterPool(client, address)


class _ClusterPool:
    """Workers of a Dask cluster. `_run` runs in the loop of the client."""

    def __init__(self, client: Any, address: str) -> None:
        self._client, self._address = client, address

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        found: Future[Any] = Future()
        self._client.loop.add_callback(self._run, found, function, arguments)
        return found

    def capacity(self) -> int:
        """Return twice the number of threads, so that no worker waits for us; 0 while the scheduler is lost."""
        if self._client.status == "closed":
            raise FrictrackError(
                f"the Dask scheduler at {self._address} was lost and none answered there for {RESTART_TIMEOUT_S:g} s; "
                "start it and run the batch again: studies that were finished are kept"
            )
        try:
            return 2 * max(1, sum(self._client.nthreads().values())) if self._client.status == "running" else 0
        except (OSError, RuntimeError):  # it is being lost; the client finds out
            return 0

    async def _run(self, found: Future[Any], function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
        """Compute a task. What is neither its result nor its error happened on the way to us: it is lost."""
        key = f"{function.__name__}-{uuid4()}"  # Dask learns durations by the first part
        future = self._client.submit(function, *arguments, pure=False, key=key)
        try:
            found.set_result(await self._client.gather(future, asynchronous=True))
        except Exception as e:  # noqa: BLE001 - a task may raise anything
            if future.status == "error":
                found.set_exception(e)
            else:
                found.cancel()
                found.set_running_or_notify_cancel()


def _check_versions(client: Any) -> None:
    """Raise `FrictrackError` unless every worker has this version of frictrack."""
    found = client.run(_version, on_error="return")
    if not found:
        raise FrictrackError("expected workers at the scheduler but there are none; start some, as `dask worker` does")
    for worker, theirs in found.items():
        if theirs != __version__:
            raise FrictrackError(
                f"expected frictrack {__version__} on every worker but {worker} says: {theirs}; update it"
            )


def _version() -> str:
    return __version__
