"""The journal of a batch: a line for every study that was worked on, so that the next batch does what is missing."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

from frictrack.batch.file_states import are_unchanged
from frictrack.batch.tasks import StudyOutcome
from frictrack.errors import FrictrackError
from frictrack.version import __version__


class Journal:
    """Lines of JSON, only ever appended; a last one that was cut off is none."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def finished(self, studies: Iterable[Path], seed: int) -> dict[Path, StudyOutcome]:
        """Studies of which nothing has changed since they were finished with this seed by this version."""
        held = self._lines()
        kept = ((path, held.get(str(path))) for path in studies)
        return {path: done for path, done in kept if done and done.seed == seed and are_unchanged(done.files)}

    def append(self, done: StudyOutcome) -> None:
        """Put down what came of a study. Raises `FrictrackError` where the journal cannot be written."""
        line = json.dumps({"version": __version__, **asdict(done)}, ensure_ascii=False)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("ab") as file:
                if file.tell() and not _ended(self.path):
                    file.write(b"\n")  # after a line that was cut off
                file.write(line.encode() + b"\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as e:
            raise FrictrackError(
                f"cannot write {self.path}: {e.strerror or e}; what was finished before is kept"
            ) from e

    def _lines(self) -> dict[str, StudyOutcome]:
        """The last line of every study that this version has written."""
        try:
            lines = self.path.read_bytes().split(b"\n")
        except FileNotFoundError:
            return {}
        except OSError as e:
            raise FrictrackError(f"cannot read {self.path}: {e.strerror or e}") from e
        held = {}
        for line in lines:
            try:
                raw = json.loads(line)
                if raw.pop("version") == __version__:
                    held[raw["study"]] = StudyOutcome(**raw)
            except (ValueError, TypeError, KeyError, AttributeError):
                continue  # cut off or not ours: the study is done again
        return held


def _ended(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"
