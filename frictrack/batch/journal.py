"""Keep the journal of a batch: one line per finished study, so that the next batch runs only the others."""

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
