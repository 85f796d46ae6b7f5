"""Run a batch: find the studies, skip finished ones, run the others, write tables and page."""

from __future__ import annotations

import glob
import json
import os
import re
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from frictrack.base.errors import FrictrackError
from frictrack.base.files import atomic_write, make_internal_folder
from frictrack.base.version import __version__
from frictrack.base.workers import local_workers
from frictrack.flow.batch.cluster import cluster_workers
from frictrack.flow.batch.tasks import BatchState, Scheduler, StudyOutcome, are_unchanged
from frictrack.flow.batch.trends import condition_trends, find_trends
from frictrack.present.report import write_campaign
from frictrack.results import to_builtins

if TYPE_CHECKING:
    import pandas as pd

MIN_TABLE_INTERVAL_S = 10.0  # between two tables while studies are running
MAX_TABLE_TIME_SHARE = 0.05  # of the whole time
FIRST_COLUMNS = ("study", "run", "role", "verdict", "missing", "reason", "model", "domain")  # of the table of runs


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


def find_studies(patterns: Sequence[str]) -> list[Path]:
    """Find study files, each once, with numbers in names in numerical order (``run_9`` before ``run_10``).

    Parameters
    ----------
    patterns
        Study files, folders (searched with their subfolders) and globs.

    Raises
    ------
    FrictrackError
        (usage) If a pattern matches no study file.

    """
    found: dict[Path, None] = {}
    for pattern in patterns:
        matches = glob.glob(pattern, recursive=True) or [pattern]
        studies = [study for match in matches for study in _studies(Path(match))]
        if not studies:
            raise FrictrackError(f"expected study files in {pattern} but found none", usage=True)
        found |= dict.fromkeys(sorted(studies, key=_natural))
    return list(found)


def _studies(path: Path) -> list[Path]:
    if path.is_dir():
        return list(path.rglob("study.toml"))
    return [path] if path.exists() else []


def _natural(path: Path) -> list[tuple[int, str]]:
    """Return a sorting key by which numbers in a path count as numbers."""
    parts = re.split(r"(\d+)", path.as_posix())
    return [(int(part), "") if part.isdecimal() else (0, part) for part in parts]


class Journal:
    """A file of JSON lines that is only appended to; an incomplete last line is ignored.

    Parameters
    ----------
    path
        The file; it is created when the first study is appended.

    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def finished(self, studies: Iterable[Path], seed: int) -> dict[Path, StudyOutcome]:
        """Return the studies whose files have not changed since this version finished them with this seed.

        Parameters
        ----------
        studies
            Paths of study files.
        seed
            Seed of the diagnoses.

        """
        outcomes = self._lines()
        kept = ((path, outcomes.get(str(path))) for path in studies)
        return {path: done for path, done in kept if done and done.seed == seed and are_unchanged(done.files)}

    def append(self, done: StudyOutcome) -> None:
        """Append the outcome of a study.

        Raises
        ------
        FrictrackError
            If the journal cannot be written.

        """
        line = json.dumps({"version": __version__, **asdict(done)}, ensure_ascii=False)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("ab") as file:
                if file.tell() and not _ended(self.path):
                    file.write(b"\n")  # after an incomplete line
                file.write(line.encode() + b"\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as e:
            raise FrictrackError(
                f"cannot write {self.path}: {e.strerror or e}; what was finished before is kept"
            ) from e

    def _lines(self) -> dict[str, StudyOutcome]:
        """Return the last outcome of every study that this version has written."""
        try:
            lines = self.path.read_bytes().split(b"\n")
        except FileNotFoundError:
            return {}
        except OSError as e:
            raise FrictrackError(f"cannot read {self.path}: {e.strerror or e}") from e
        outcomes = {}
        for line in lines:
            try:
                raw = json.loads(line)
                if raw.pop("version") == __version__:
                    outcomes[raw["study"]] = StudyOutcome(**raw)
            except (ValueError, TypeError, KeyError, AttributeError):
                continue  # incomplete or not ours: the study is run again
        return outcomes


def _ended(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"


def make_table(rows: Sequence[dict[str, Any]]) -> pd.DataFrame:
    """Return the rows as a table; missing values are empty."""
    import pandas as pd  # noqa: PLC0415 - slow to load

    names = list(dict.fromkeys([*FIRST_COLUMNS, *(name for row in rows for name in row)]))
    table = pd.DataFrame(list(rows), columns=names)
    for name in FIRST_COLUMNS:
        table[name] = table[name].astype("string")
    return table


def write_table(rows: Sequence[dict[str, Any]], stem: Path, units: Mapping[str, str]) -> list[Path]:
    """Write ``stem.csv`` and, if pyarrow is installed, ``stem.parquet``, where the fields of parameters have a `unit`.

    Parameters
    ----------
    rows
        One dictionary per run.
    stem
        Path without suffix.
    units
        Units of the parameters.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    FrictrackError
        If a file cannot be written.

    """
    table = make_table(rows)
    paths = [stem.with_name(f"{stem.name}.csv")]
    with atomic_write(paths[0]) as part:
        table.to_csv(part, index=False)
    if find_spec("pyarrow") is not None:
        paths.append(stem.with_name(f"{stem.name}.parquet"))
        with atomic_write(paths[1]) as part:
            _write_parquet(table, part, units)
    return paths


def _write_parquet(table: pd.DataFrame, path: Path, units: Mapping[str, str]) -> None:
    import pyarrow as pa  # noqa: PLC0415 - optional
    import pyarrow.parquet  # noqa: PLC0415

    whole = pa.Table.from_pandas(table, preserve_index=False)
    known = {f"{name}{kind}": unit for name, unit in units.items() for kind in ("", " std", " std_misfit")}
    fields = [one.with_metadata({"unit": known[one.name]}) if one.name in known else one for one in whole.schema]
    pa.parquet.write_table(whole.cast(pa.schema(fields, whole.schema.metadata)), path)
