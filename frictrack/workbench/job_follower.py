"""Follow the jobs of a study, also those that another server or an earlier one started."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from frictrack.errors import FrictrackError
from frictrack.files import INTERNAL_FOLDER


@dataclass(frozen=True)
class JobsNow:
    """The running job and the one that ended last, as the page shows them; see `Job.summary`."""

    running: dict[str, Any] | None = None
    last: dict[str, Any] | None = None


class JobFollower:
    """Find the running and the last ended job; one that ended before the server started counts only if interrupted."""

    def __init__(self) -> None:
        self._began = time.time()
        self._ended: set[str] = set()
        self._output: Path | None = None
        self._last: dict[str, Any] | None = None

    def look(self, output: Path) -> JobsNow:
        """Look at the jobs as they are now.

        Parameters
        ----------
        output : Path
            Folder of the results.

        """
        if output != self._output:
            self._output, self._ended, self._last = output, set(), None
        running = None
        for name in self._names(output):
            if name in self._ended or not self._is_written(output, name):
                continue
            try:
                found = self._summary(output, name)
            except (FrictrackError, OSError, KeyError):  # damaged, or removed meanwhile
                self._ended.add(name)
                continue
            if found["state"] == "running":
                running = found
            else:
                self._ended.add(name)
                self._last = found if found["state"] == "interrupted" or self._is_new(output, name) else None
        return JobsNow(running, self._last)

    def _is_written(self, output: Path, name: str) -> bool:
        """Whether a job is there, not only the folder for it, which is made a moment before."""
        return (output / INTERNAL_FOLDER / "jobs" / name / "spec.json").exists()

    def _is_new(self, output: Path, name: str) -> bool:
        """Whether a job ended since the server started."""
        times = [self._began]
        for file in ("result.json", "cancel"):
            with suppress(OSError):
                times.append((output / INTERNAL_FOLDER / "jobs" / name / file).stat().st_mtime)
        return len(times) > 1 and max(times[1:]) >= self._began

    def _names(self, output: Path) -> list[str]:
        with suppress(OSError):
            return sorted(name for name in os.listdir(output / INTERNAL_FOLDER / "jobs") if name.isdecimal())
        return []

    def _summary(self, output: Path, name: str) -> dict[str, Any]:
        from frictrack.workbench.jobs import Job  # noqa: PLC0415

        return Job(output / INTERNAL_FOLDER / "jobs" / name).summary
