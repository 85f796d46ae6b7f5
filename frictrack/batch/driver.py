"""A batch from the beginning to its page."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from frictrack.batch import table
from frictrack.batch.campaign import Campaign, State
from frictrack.batch.find import find_studies
from frictrack.batch.journal import Journal
from frictrack.batch.trends import trends
from frictrack.batch.work import Done
from frictrack.report import campaign as page
from frictrack.results import plain
from frictrack.workers import cluster_workers, local_workers

PAUSE = 10.0  # s between two tables while studies are being done
SHARE = 0.05  # of the time that tables may take


def batch(
    patterns: Sequence[str],
    stem: Path,
    seed: int = 0,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    watch: Callable[[State], None] = lambda state: None,
) -> dict[str, Any]:
    """Run every study that is not finished and write the tables and the page: JSON of `batch`.

    `stem` is the path of what is written, without an ending. Works on `workers` processes of this machine, or with a
    `scheduler` on the workers of a Dask cluster; `watch` is told how far it is. Raises `FrictrackError` (usage)
    where a pattern finds no study, and where no scheduler answers.
    """
    paths = find_studies(patterns)
    labels = {path.resolve(): path for path in paths}
    journal = Journal(stem.with_name(f"{stem.name}.jsonl"))
    done = journal.finished(labels, seed)
    state = State(len(labels), kept=len(done))
    todo = [path for path in labels if path not in done]
    told = _Told(stem, labels, done)
    if todo:
        with cluster_workers(scheduler) if scheduler else local_workers(workers) as pool:
            for one in Campaign(todo, seed, pool, state).worked(watch):
                journal.note(one)
                done[Path(one.study)] = one
                told.now_and_then()
    return told.whole(state)


@dataclass
class _Told:
    """What is written of a batch."""

    stem: Path
    labels: dict[Path, Path]  # a study file from the root -> as the user named it
    done: dict[Path, Done]
    _next: float = 0.0

    def now_and_then(self) -> None:
        """The table of what is there, unless it was written just now."""
        start = time.monotonic()
        if start >= self._next:
            table.write(self._rows(), self.stem)
            end = time.monotonic()
            self._next = end + max(PAUSE, (end - start) / SHARE)

    def whole(self, state: State) -> dict[str, Any]:
        """Tables and page of all: JSON of `batch`."""
        files = table.write(self._rows(), self.stem)
        kept = [(label, self.done[path]) for path, label in self.labels.items() if path in self.done]
        studies = [{"study": str(label), **one.summary} for label, one in kept]
        found = trends([one for _, one in kept])
        result: dict[str, Any] = plain(
            {
                "studies": studies,
                "failed": [{"study": str(label), **failure} for label, one in kept for failure in one.failures],
                "kept": state.kept,
                "seconds": state.seconds,
                "runs_per_minute": 60.0 * state.runs / max(state.seconds, 1e-9),
                "verdicts": dict(Counter(one["verdict"] for one in studies if not one["reason"])),
                "trends": [trend.summary() for trend in found],
                "tables": [str(path) for path in files],
            }
        )
        drawn = [trend.drawn() for trend in found]
        output = page.write(result, drawn, self._links(), self.stem.with_name(f"{self.stem.name}.html"))
        return result | {"output": str(output)}

    def _rows(self) -> list[dict[str, Any]]:
        kept = ((label, self.done.get(path)) for path, label in self.labels.items())
        return [{"study": str(label), **row} for label, one in kept if one for row in one.rows]

    def _links(self) -> dict[str, str]:
        """Where the report of a study is, seen from the page."""
        folder = self.stem.resolve().parent
        reports = {
            str(label): Path(self.done[path].summary["results"]) / "report.html"
            for path, label in self.labels.items()
            if path in self.done and self.done[path].summary.get("results")
        }
        return {name: Path(os.path.relpath(report, folder)).as_posix() for name, report in reports.items()}
