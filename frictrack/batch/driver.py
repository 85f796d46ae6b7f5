"""Run a batch: find the studies, skip finished ones, run the others, write tables and page."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from frictrack.batch.cluster import cluster_workers
from frictrack.batch.conditions import condition_trends
from frictrack.batch.journal import Journal
from frictrack.batch.run_table import write_table
from frictrack.batch.scheduler import BatchState, Scheduler
from frictrack.batch.study_search import find_studies
from frictrack.batch.tasks import StudyOutcome
from frictrack.batch.trends import find_trends
from frictrack.files import make_internal_folder
from frictrack.report import write_campaign
from frictrack.results import to_builtins
from frictrack.workers import local_workers

MIN_TABLE_INTERVAL_S = 10.0  # between two tables while studies are running
MAX_TABLE_TIME_SHARE = 0.05  # of the whole time


def batch(
    patterns: Sequence[str],
    stem: Path,
    seed: int = 0,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    watch: Callable[[BatchState], None] = lambda state: None,
) -> dict[str, Any]:
    """Run every study that is not finished, and write tables, page and journal: JSON of `frictrack batch`.

    Parameters
    ----------
    patterns
        Study files, folders and globs.
    stem
        Path of the output files without suffix.
    seed
        Seed of the diagnoses.
    workers
        Number of processes of this machine; as many as there are processors if None.
    scheduler
        Address of a Dask scheduler, whose workers are used instead.
    watch
        Called several times a second with the state of the batch.

    Raises
    ------
    FrictrackError
        (usage) If a pattern matches no study, or no scheduler answers.

    """
    paths = find_studies(patterns)
    labels = {path.resolve(): path for path in paths}
    journal = Journal(_journal_path(stem))
    outcomes = journal.finished(labels, seed)
    state = BatchState(len(labels), kept=len(outcomes))
    todo = [path for path in labels if path not in outcomes]
    output = _BatchOutput(stem, labels, outcomes)
    if todo:
        with cluster_workers(scheduler) if scheduler else local_workers(workers) as pool:
            for one in Scheduler(todo, seed, pool, state).run(watch):
                journal.append(one)
                outcomes[Path(one.study)] = one
                output.write_if_due()
    return output.write_all(state)


def _journal_path(stem: Path) -> Path:
    """Return the path of the journal, in a hidden folder; the journal of an earlier version is moved there."""
    path, former = make_internal_folder(stem.parent) / f"{stem.name}.jsonl", stem.with_name(f"{stem.name}.jsonl")
    if former.is_file() and not path.exists():
        with suppress(OSError):  # its studies are then run again
            former.replace(path)
    return path


@dataclass
class _BatchOutput:
    """Write the files of a batch."""

    stem: Path
    labels: dict[Path, Path]  # a study file from the root -> as the user named it
    outcomes: dict[Path, StudyOutcome]
    _next: float = 0.0

    def write_if_due(self) -> None:
        """Write the table of the finished studies, unless it was written shortly before."""
        start = time.monotonic()
        if start >= self._next:
            self._write_table()
            end = time.monotonic()
            self._next = end + max(MIN_TABLE_INTERVAL_S, (end - start) / MAX_TABLE_TIME_SHARE)

    def write_all(self, state: BatchState) -> dict[str, Any]:
        """Write tables and page; return the JSON of `batch`."""
        files = self._write_table()
        kept = [(label, self.outcomes[path]) for path, label in self.labels.items() if path in self.outcomes]
        studies = [{"study": str(label), **one.summary} for label, one in kept]
        found = find_trends([one for _, one in kept])
        result: dict[str, Any] = to_builtins(
            {
                "studies": studies,
                "failed": [{"study": str(label), **failure} for label, one in kept for failure in one.failures],
                "kept": state.kept,
                "seconds": state.seconds,
                "runs_per_minute": 60.0 * state.runs / max(state.seconds, 1e-9),
                "verdicts": dict(Counter(one["verdict"] for one in studies if not one["reason"])),
                "trends": [trend.summary() for trend in found],
                "conditions": condition_trends([one for _, one in kept]),
                "tables": [str(path) for path in files],
            }
        )
        plots = [trend.to_plot() for trend in found]
        output = write_campaign(result, plots, self._links(), self.stem.with_name(f"{self.stem.name}.html"))
        return result | {"output": str(output)}

    def _write_table(self) -> list[Path]:
        units = {name: unit for one in self.outcomes.values() for name, unit in one.units.items()}
        return write_table(self._rows(), self.stem, units)

    def _rows(self) -> list[dict[str, Any]]:
        kept = ((label, self.outcomes.get(path)) for path, label in self.labels.items())
        return [{"study": str(label), **row} for label, one in kept if one for row in one.rows]

    def _links(self) -> dict[str, str]:
        """Return the path of every report, relative to the page."""
        folder = self.stem.resolve().parent
        reports = {
            str(label): Path(self.outcomes[path].summary["results"]) / "report.html"
            for path, label in self.labels.items()
            if path in self.outcomes and self.outcomes[path].summary.get("results")
        }
        return {name: Path(os.path.relpath(report, folder)).as_posix() for name, report in reports.items()}
