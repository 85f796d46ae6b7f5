"""What was done to a study, in order: the lock, the revision and the log through which alone it changes.

A change is made inside a `turn`: nobody else changes the study meanwhile, who saw an older revision is refused, and
the change stands in ``log.jsonl`` with what was before it, so that it can be undone.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from frictrack.errors import FrictrackError
from frictrack.files import alone

NAME = "log.jsonl"


@dataclass
class Change:
    """One line of the log: who did what, and the state that it left behind and led to."""

    rev: int
    at: str
    who: str
    do: str
    told: dict[str, Any] = field(default_factory=dict)  # the words of the command
    before: dict[str, Any] = field(default_factory=dict)  # "toml": text of the study file, "current": a model's group
    after: dict[str, Any] = field(default_factory=dict)

    @property
    def words(self) -> str:
        """The command as one would type it."""
        return " ".join((self.do, *(str(word) for word in self.told.values() if word is not None)))


def _sound(change: Change) -> bool:
    """Whether every part of a line is of its kind."""
    words, tables = (change.at, change.who, change.do), (change.told, change.before, change.after)
    return (
        isinstance(change.rev, int)
        and all(isinstance(word, str) for word in words)
        and all(isinstance(table, dict) for table in tables)
    )


class Ledger:
    """The log of one study. `seen` is the revision that the one who changes it has before their eyes; None: any."""

    def __init__(self, folder: Path, who: str = "python", seen: int | None = None) -> None:
        self.folder = folder
        self.path = folder / NAME
        self.who = who
        self.seen = seen

    @property
    def changes(self) -> list[Change]:
        """All that was done, oldest first. A last line that a power cut left half-written is none."""
        try:
            lines = self.path.read_bytes().split(b"\n")[:-1]
        except FileNotFoundError:
            return []
        try:
            changes = [Change(**json.loads(line)) for line in lines]
        except (ValueError, TypeError, RecursionError) as e:
            raise FrictrackError(self._damaged) from e
        if not all(_sound(change) for change in changes):
            raise FrictrackError(self._damaged)
        return changes

    @property
    def _damaged(self) -> str:
        return f"{self.path} is damaged; move it away, the models tried are not in it"

    @property
    def rev(self) -> int:
        """Number of changes so far."""
        return len(self.changes)

    def stacks(self) -> tuple[list[Change], list[Change]]:
        """What can be undone, and what can be done again, the next one last."""
        done: list[Change] = []
        undone: list[Change] = []
        for change in self.changes:
            if (change.do == "undo" and not done) or (change.do == "redo" and not undone):
                raise FrictrackError(self._damaged)
            if change.do == "undo":
                undone.append(done.pop())
            elif change.do == "redo":
                done.append(undone.pop())
            elif change.do == "restart":
                done, undone = [], []
            elif change.before:
                done, undone = [*done, change], []
        return done, undone

    def check(self) -> None:
        """Raises `FrictrackError` where the study was changed since it was seen."""
        if self.seen is None:
            return
        changes = self.changes
        if self.seen != len(changes):
            last = changes[-1] if changes else Change(0, "", "somebody", "restart")
            raise FrictrackError(
                f"the study was changed meanwhile ({last.who}: {last.words}); look at it as it is now, then do it again"
            )

    @contextmanager
    def turn(self, do: str, **told: Any) -> Iterator[Change]:
        """Alone with the study: change it and say in `before` and `after` what it was and is; then it is logged.

        A change without `before` cannot be undone; a restart cannot, nor anything before it.
        """
        with alone(self.folder):
            self.check()
            self._mend()
            change = Change(self.rev + 1, datetime.now().astimezone().isoformat(timespec="seconds"), self.who, do, told)
            yield change
            with self.path.open("ab") as log:
                log.write(json.dumps(vars(change), ensure_ascii=False).encode() + b"\n")
                log.flush()
                os.fsync(log.fileno())
            self.seen = None if self.seen is None else change.rev

    def _mend(self) -> None:
        """Cut off what a power cut left half-written."""
        if self.path.is_symlink():
            raise FrictrackError(f"expected the log in {self.path} but it is a link to elsewhere; move it away")
        if self.path.exists() and not (text := self.path.read_bytes()).endswith(b"\n") and text:
            with self.path.open("r+b") as log:
                log.truncate(text.rfind(b"\n") + 1)
