"""The state of the page: the study as its files say, the running job, and the last message to the user.

The page keeps no state of its own but what is looked at. A change by the command line or another tab shows by itself.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import param

from frictrack.errors import FrictrackError
from frictrack.flow import CommandHistory, Findings, Session, open_study, read_results, start_study
from frictrack.results import ModelResults, Results, RunResults
from frictrack.study import RunTable, Study, find_recordings, read_key
from frictrack.workbench import jobs
from frictrack.workbench.jobs import Job

WHO = "page"


class PageState(param.Parameterized):
    """One browser tab's view of a study; `seen` counts up whenever something else is to be shown."""

    seen = param.Integer(default=0, doc="counts up when the study's files have changed")
    message = param.String(default="", doc="the last word to the user: what was done, or why not")
    is_error = param.Boolean(default=False, doc="whether that is a fault")
    busy = param.Dict(default={}, doc="the work that goes on: do, done, total, what; empty when there is none")
    run = param.String(default="", doc="the run that is looked at")
    ghost = param.Parameter(default=None, doc="a model that was attempted, shown behind the current one")

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self.study: Study | None = None
        self.results: Results | None = None
        self.ledger: CommandHistory | None = None
        self.rev = 0
        self.job: Job | None = None
        self._print: object = None
        self._ended: set[str] = set()

    # --- what is there

    async def look(self) -> None:
        """Read again what has changed in the files, and how far the work has come."""
        self._watch()
        if self._files_changed():
            self._take(await asyncio.to_thread(_read, self.path))

    def look_first(self) -> None:
        """Read the files before there is a page to wait for them."""
        self._files_changed()
        self._take(_read(self.path))

    def _files_changed(self) -> bool:
        before, self._print = self._print, self._fingerprint()
        return self._print != before

    def _take(self, found: tuple[Study | None, Results | None] | FrictrackError) -> None:
        if isinstance(found, FrictrackError):
            self.notify(str(found), is_error=True)
            return
        self.study, self.results = found
        if self.study is not None:
            self.ledger = CommandHistory(self.study.output, WHO)
            self.rev = self.ledger.revision
            self._ended = {job.folder.name for job in jobs.list_jobs(self.study) if job.state != jobs.RUNNING}
            names = [run.name for run in self.study.runs]
            if self.run not in names:
                self.run = names[0] if names else ""
        self.seen += 1

    def _fingerprint(self) -> object:
        """Times of all files from which the page is made."""
        folder = self.study.output if self.study else self.path.parent
        files = [self.path, *sorted(folder.glob("*.h5")), folder / "log.jsonl"]
        return [(str(f), s.st_mtime_ns, s.st_size) for f in files if f.exists() for s in (f.stat(),)]

    @property
    def model(self) -> ModelResults | None:
        """The current model, when one was fitted."""
        return self.results.current if self.results else None

    @property
    def diagnosis(self) -> dict[str, Any] | None:
        """What the diagnosis of the current model says."""
        return self.results.diagnosis if self.results else None

    @property
    def runs(self) -> dict[str, RunTable]:
        """Runs of the study file."""
        return {run.name: run for run in self.study.runs} if self.study else {}

    def written(self, table: str, key: str, which: str | None = None) -> Any:
        """What the study file itself says under a key, None where it says nothing."""
        try:
            return read_key(self.path.read_text(encoding="utf-8"), table, key, which)
        except (OSError, FrictrackError):  # while somebody rewrites it by hand
            return None

    @property
    def measured(self) -> RunResults | None:
        """What was measured of the run that is looked at."""
        return next((r for r in (self.results.runs if self.results else ()) if r.name == self.run), None)

    @property
    def recordings(self) -> list[str]:
        """Recordings beside the study file that are not in the study yet."""
        try:
            found = find_recordings(self.path.parent)
        except FrictrackError:
            return []
        used = {run.source.resolve() for run in self.runs.values() if isinstance(run.source, Path)}
        return [p.name for p in found if p.resolve() not in used]

    def can(self, do: str) -> bool:
        """Whether there is something to undo or to redo."""
        done, undone = self.ledger.undo_stacks() if self.ledger else ([], [])
        return bool(done if do == "undo" else undone)

    # --- what is done

    def notify(self, words: str, *, is_error: bool = False) -> None:
        """Say something to the user."""
        self.param.update(message=words, is_error=is_error)

    def begin(self, recordings: Sequence[str], keys: dict[str, Any]) -> bool:
        """Write the study file of some recordings; whether that went well."""
        try:
            known = {key: value for key, value in keys.items() if value}
            start_study(self.path, [self.path.parent / name for name in recordings], known)
        except FrictrackError as e:
            self.notify(str(e), is_error=True)
            return False
        found = Findings(open_study(self.path))
        found.check_study_file()
        self._notify_done(f"{self.path.name} is written; now run everything", found.messages)
        return True

    def _notify_done(self, words: str, warnings: Sequence[str]) -> None:
        """Say that something is done, and what is implausible in the study."""
        self.notify("; ".join([words, *(f"to be checked: {warning}" for warning in warnings)]), is_error=bool(warnings))

    def do(self, do: str, **arguments: Any) -> bool:
        """A quick change of the study; whether it was made. Refused where the study was changed meanwhile."""
        assert self.study is not None
        try:
            Session(open_study(self.path, allow_no_runs=True), author=WHO, expected_revision=self.rev).apply(
                do, **arguments
            )
        except FrictrackError as e:
            self.notify(str(e), is_error=True)
            return False
        self.rev = CommandHistory(self.study.output).revision
        self.notify(
            " ".join((f"{do}: done", *(str(arguments[k]) for k in ("which", "key") if arguments.get(k) is not None)))
        )
        return True

    def start(self, do: str, **arguments: Any) -> None:
        """Long work, in a process of its own."""
        if self.study is None:
            return
        try:
            job = jobs.start(self.study, do, seen=self.rev, who=WHO, **arguments)
        except FrictrackError as e:
            self.notify(str(e), is_error=True)
            return
        self.job = job
        self.busy = {"do": do, "done": 0, "total": 0, "what": "starts"}
        self.notify("")

    def cancel(self) -> None:
        """End the work that goes on."""
        if self.job is not None:
            self.job.cancel()

    def _watch(self) -> None:
        """The work that goes on, also that of another tab or of a server that is gone."""
        if self.job is None and self.study is not None:
            going = (j for j in jobs.list_jobs(self.study) if j.folder.name not in self._ended)
            self.job = next((j for j in going if j.state == jobs.RUNNING), None)
        if self.job is None:
            return
        state, spec = self.job.state, self.job.spec
        if state == jobs.RUNNING:
            lines = self.job.progress
            now = {"do": spec["do"], "done": 0, "total": 0, "what": "starts"} | (lines[-1] if lines else {})
            if now != self.busy:
                self.busy = now
            return
        self._ended.add(self.job.folder.name)
        ended, self.job, self.busy = self.job, None, {}
        words = " ".join((spec["do"], *(str(v) for v in spec["told"].values() if v is not None)))
        if state == jobs.DONE:
            made = ended.result["done"]
            warnings = made.get("warnings", []) if isinstance(made, dict) else []
            self._notify_done(f"{words}: done", [warning["words"] for warning in warnings])
            if spec["do"] == "attempt":
                self._show_attempt(ended)
            elif spec["do"] in ("add", "remove", "fit"):
                self.ghost = None
        elif state == jobs.FAILED:
            self.notify(f"{words}: {ended.result['error']}", is_error=True)
        else:
            self.notify(f"{words}: {state}; what was finished stays, start it again to go on", is_error=True)

    def _show_attempt(self, job: Job) -> None:
        from frictrack.flow import read_attempt  # noqa: PLC0415

        effect = job.spec["told"]["effect"]
        self.ghost = replace(read_attempt(job.folder / "attempt.h5"), name=f"0_with {effect}")


def _read(path: Path) -> tuple[Study | None, Results | None] | FrictrackError:
    """The study and its results, none where there is no study file yet; or what is wrong with them."""
    if not path.exists():
        return None, None
    try:
        study = open_study(path, allow_no_runs=True)
        return study, read_results(study)
    except FrictrackError as e:
        return e
