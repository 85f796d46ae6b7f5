"""Read everything that the page shows of a study from its files: study file, results, history, recordings."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from frictrack.base.errors import FrictrackError
from frictrack.flow import (
    Change,
    CommandHistory,
    ResultsReader,
    SignificanceBudget,
    Surveyed,
    open_study,
    survey_recording,
)
from frictrack.results import ModelResults, Results
from frictrack.study import Study, find_recordings, read_toml
from frictrack.workbench.films import file_version

MAX_RECORDINGS = 1000  # surveyed recordings that are kept


@dataclass(frozen=True)
class Snapshot:
    """What the files of a study said at one moment.

    Attributes
    ----------
    path
        The study file, which need not exist.
    study, results
        The study and its stored results. None without a study file, or if it could not be read so far.
    raw
        The tables of the study file as they are written; empty if it cannot be read.
    changes
        The command history, oldest first.
    tests
        JSON of the tests that were made of its models, as in that of `frictrack history`.
    recordings
        Recordings in the folder of the study file.
    attempted
        The current model with one more effect, by effect, as far as it was fitted for a comparison.
    error
        Why the study file or the results cannot be read; None if they can.

    """

    path: Path
    study: Study | None = None
    results: Results | None = None
    raw: dict[str, Any] = field(default_factory=dict)
    changes: tuple[Change, ...] = ()
    tests: Mapping[str, Any] = field(default_factory=dict)
    recordings: tuple[Surveyed, ...] = ()
    attempted: Mapping[str, ModelResults] = field(default_factory=dict)
    error: str | None = None


class SnapshotReader:
    """Read snapshots of one study file; what has not changed is read once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._results = ResultsReader(with_budgets=False)
        self._last = Snapshot(path)

    def read(self) -> Snapshot:
        """Read the files as they are now; nothing is raised: after an error, what was read last stays."""
        recordings = tuple(_survey(path) for path in _recordings(self.path.parent))
        if not self.path.exists():
            vanished = self._last.study is not None or self._last.error is not None
            gone = f"expected the study file {self.path} but it is gone; put it back, or open the sample study"
            self._last = Snapshot(self.path, recordings=recordings, error=gone if vanished else None)
            return replace(self._last)
        try:
            raw = read_toml(self.path.name, self.path.read_text(encoding="utf-8"))
            study = open_study(self.path, allow_incomplete=True)
            history = CommandHistory(study.output)
            results = self._results.read(study)
            names = [candidate["effect"] for candidate in (results.diagnosis or {}).get("candidates", [])]
            attempted = self._results.attempts(study, names)
            changes, tests = tuple(history.changes), SignificanceBudget(study.output).summary()
            self._last = Snapshot(self.path, study, results, raw, changes, tests, recordings, attempted)
        except (FrictrackError, OSError, UnicodeDecodeError) as e:
            return replace(self._last, recordings=recordings, error=str(e))
        return self._last


def _recordings(folder: Path) -> list[Path]:
    try:
        return find_recordings(folder)
    except (FrictrackError, OSError):
        return []


def _survey(path: Path) -> Surveyed:
    """Look at a recording, unless it was looked at before and has not changed."""
    try:
        state = path.stat()
    except OSError as e:
        return Surveyed(path, problem=e.strerror or str(e))
    pictures = len(os.listdir(path)) if path.is_dir() else 0
    return _surveyed(path, state.st_mtime_ns, state.st_size, pictures)


@lru_cache(maxsize=MAX_RECORDINGS)
def _surveyed(path: Path, *_: int) -> Surveyed:
    try:
        return survey_recording(path)
    except (FrictrackError, OSError) as e:
        return Surveyed(path, problem=str(e))


def surveyed_source(path: Any) -> Surveyed | None:
    """Return what is known of the recording of a run; None for one at an address, or one that is gone."""
    return _survey(path) if isinstance(path, Path) and path.exists() else None


def source_version(path: Any) -> str:
    """Return a text that changes when the recording of a run does; "" for one at an address, or one that is gone."""
    return file_version(path) if isinstance(path, Path) and path.exists() else ""


def list_recordings(snapshot: Snapshot) -> list[dict[str, Any]]:
    """List the recordings in the folder of the study file; `skipped` says why one cannot be used."""
    runs = snapshot.study.runs if snapshot.study else ()
    tables = [each.get("table") if isinstance(each, dict) else each for r in runs for each in (r.drive, r.sensor)]
    used = {path.resolve() for path in (*(run.source for run in runs), *tables) if isinstance(path, Path)}
    return [
        {
            "name": seen.path.name,
            "kind": "table" if seen.is_table else "film",
            "words": seen.words,
            "frames": seen.n_frames or None,
            "width": seen.shape[1] or None,
            "height": seen.shape[0] or None,
            "fps": seen.fps,
            "in_study": seen.path.resolve() in used,
            "skipped": _why_skipped(seen.problem, seen.columns_to_confirm),
        }
        for seen in snapshot.recordings
    ]


def _why_skipped(problem: str, columns: Sequence[str]) -> str | None:
    if problem:
        return problem
    return f"expected headers with units but got none; name them in the study file: {columns[0]}" if columns else None
