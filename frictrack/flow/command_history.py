"""Record every change of a study in a log, one line of JSON each; lock the study while it is being changed.

The log is ``.frictrack/log.jsonl`` in the folder of the results. Every line holds the command and the state before
and after it, so that a change can be undone. The number of lines is the revision of the study: a user whose page shows
an older revision is refused instead of overwriting the change of another user.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from frictrack.base.errors import FrictrackError
from frictrack.base.files import INTERNAL_FOLDER, lock_folder

FILE_NAME = "log.jsonl"
_KEYS = {  # key of a line in the log -> field of `Change`
    "rev": "revision",
    "at": "time",
    "who": "author",
    "do": "command",
    "told": "arguments",
    "before": "before",
    "after": "after",
}


@dataclass
class Change:
    """One change of a study, and the state before and after it.

    Attributes
    ----------
    revision
        Number of the change, from 1.
    time
        Local time in ISO 8601.
    author
        Where the command came from, as "cli" or "page".
    command, arguments
        Name and arguments of the command; see `Session.apply`.
    before, after
        The parts of the state that changed: "toml", the text of the study file, or "current", the group of the current
        model. A change without `before` cannot be undone.

    """

    revision: int
    time: str
    author: str
    command: str
    arguments: dict[str, Any] = field(default_factory=dict)
    before: dict[str, Any] = field(default_factory=dict)
    after: dict[str, Any] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """The command as one would type it."""
        return " ".join((self.command, *(str(value) for value in self.arguments.values() if value is not None)))

    def to_json(self) -> str:
        """Return the line of the log."""
        return json.dumps({key: getattr(self, name) for key, name in _KEYS.items()}, ensure_ascii=False)

    @classmethod
    def from_json(cls, line: bytes) -> Change:
        """Read a line of the log.

        Raises
        ------
        ValueError
            If the line is not JSON, or a value has the wrong type.
        TypeError, AttributeError, KeyError
            If keys are missing or unknown.

        """
        change = cls(**{_KEYS[key]: value for key, value in json.loads(line).items()})
        texts, tables = (change.time, change.author, change.command), (change.arguments, change.before, change.after)
        sound = isinstance(change.revision, int) and all(isinstance(text, str) for text in texts)  # type: ignore[redundant-expr]  # as read
        if not (sound and all(isinstance(table, dict) for table in tables)):
            raise ValueError("expected the types of a change")
        return change


def undo_stacks(changes: Sequence[Change]) -> tuple[list[Change], list[Change]]:
    """Return the changes that can be undone, and those that can be redone; the next one is last in both lists.

    Parameters
    ----------
    changes
        All changes, oldest first.

    Raises
    ------
    ValueError
        If more is undone or redone than was done.

    """
    done: list[Change] = []
    undone: list[Change] = []
    for change in changes:
        if (change.command == "undo" and not done) or (change.command == "redo" and not undone):
            raise ValueError(f"change {change.revision} has nothing to {change.command}")
        if change.command == "undo":
            undone.append(done.pop())
        elif change.command == "redo":
            done.append(undone.pop())
        elif change.command == "restart":
            done, undone = [], []
        elif change.before:
            done, undone = [*done, change], []
    return done, undone


class CommandHistory:
    """The log of one study.

    Parameters
    ----------
    folder
        Folder of the results of the study.
    author
        Recorded with every change.
    expected_revision
        The revision that the author has seen. A change is refused if the study is at another one; None allows any.

    """

    def __init__(self, folder: Path, author: str = "python", expected_revision: int | None = None) -> None:
        self.folder = folder
        self.author = author
        self.expected_revision = expected_revision

    @property
    def path(self) -> Path:
        """The log; that of earlier versions lies among the results, until the next change moves it."""
        path, former = self.folder / INTERNAL_FOLDER / FILE_NAME, self.folder / FILE_NAME
        return former if former.exists() and not path.exists() else path

    @property
    def changes(self) -> list[Change]:
        """All changes, oldest first. An incomplete last line, as a power cut leaves it, is ignored.

        Raises `FrictrackError` if the log is damaged.
        """
        try:
            lines = self.path.read_bytes().split(b"\n")[:-1]
        except FileNotFoundError:
            return []
        try:
            return [Change.from_json(line) for line in lines]
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as e:
            raise FrictrackError(self._damaged) from e

    @property
    def _damaged(self) -> str:
        return f"{self.path} is damaged; move it away, the models tried are not in it"

    @property
    def revision(self) -> int:
        """Number of changes so far."""
        return len(self.changes)

    def undo_stacks(self) -> tuple[list[Change], list[Change]]:
        """Return the changes that can be undone, and those that can be redone; see `undo_stacks`."""
        try:
            return undo_stacks(self.changes)
        except ValueError as e:
            raise FrictrackError(self._damaged) from e

    def check_revision(self) -> None:
        """Raise `FrictrackError` if the study is not at the expected revision."""
        if self.expected_revision is None:
            return
        changes = self.changes
        if self.expected_revision != len(changes):
            last = changes[-1] if changes else Change(0, "", "somebody", "restart")
            raise FrictrackError(
                f"the study was changed meanwhile ({last.author}: {last.text}); reload it, then repeat the command"
            )

    @contextmanager
    def record(self, command: str, **arguments: Any) -> Iterator[Change]:
        """Lock the study, yield a change to be completed, and write it to the log if the block succeeds.

        Parameters
        ----------
        command, **arguments
            The command, as `Session.apply` takes it.

        Yields
        ------
        Change
            The block changes the study and sets `before` and `after`. A change without `before` cannot be undone; a
            restart cannot be undone either, nor anything before it.

        Raises
        ------
        FrictrackError
            If the study is not at the expected revision, or the log is damaged or cannot be written.

        """
        with lock_folder(self.folder):
            self.check_revision()
            path = self._move_former_log()
            self._cut_incomplete_line()
            time = datetime.now().astimezone().isoformat(timespec="seconds")
            change = Change(self.revision + 1, time, self.author, command, arguments)
            yield change
            with path.open("ab") as log:
                log.write(change.to_json().encode() + b"\n")
                log.flush()
                os.fsync(log.fileno())
            self.expected_revision = None if self.expected_revision is None else change.revision

    def _move_former_log(self) -> Path:
        """Move the log of an earlier version to its place; return the place."""
        path, former = self.folder / INTERNAL_FOLDER / FILE_NAME, self.folder / FILE_NAME
        for place in (path, former):
            if place.is_symlink():
                raise FrictrackError(f"expected the log in {place} but it is a link to another place; remove the link")
        if former.exists() and not path.exists():
            former.replace(path)
        return path

    def _cut_incomplete_line(self) -> None:
        """Remove what a power cut left of a line."""
        if self.path.exists() and not (text := self.path.read_bytes()).endswith(b"\n") and text:
            with self.path.open("r+b") as log:
                log.truncate(text.rfind(b"\n") + 1)
