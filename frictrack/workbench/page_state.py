"""Hold the state of the page: the study as its files are, the running job, and the last message to the user.

The page keeps nothing else, so it also shows changes made by the command line or by another tab.
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

AUTHOR = "page"  # of changes, in the history of the study


class PageState(param.Parameterized):
    """The view of one browser tab on a study; `version` increases whenever the page must be redrawn."""

    version = param.Integer(default=0, doc="increases when the files of the study have changed")
    message = param.String(default="", doc="last message: what was done, or why not")
    is_error = param.Boolean(default=False, doc="whether the message is an error")
    progress = param.Dict(default={}, doc="of the running job: do, done, total, what; empty if there is none")
    run = param.String(default="", doc="name of the selected run")
    attempted = param.Parameter(default=None, doc="model that was tried, shown in the background")

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self.study: Study | None = None
        self.results: Results | None = None
        self.history: CommandHistory | None = None
        self.revision = 0
        self.job: Job | None = None
        self._last_fingerprint: object = None
        self._finished_jobs: set[str] = set()

    # --- reading

    async def update(self) -> None:
        """Read changed files and the progress of the running job."""
        self._follow_job()
        if self._files_changed():
            self._store(await asyncio.to_thread(_read, self.path))

    def load(self) -> None:
        """Read all files, before the page is shown."""
        self._files_changed()
        self._store(_read(self.path))

    def _files_changed(self) -> bool:
        before, self._last_fingerprint = self._last_fingerprint, self._fingerprint()
        return self._last_fingerprint != before

    def _store(self, found: tuple[Study | None, Results | None] | FrictrackError) -> None:
        if isinstance(found, FrictrackError):
            self.notify(str(found), is_error=True)
            return
        self.study, self.results = found
        if self.study is not None:
            self.history = CommandHistory(self.study.output, AUTHOR)
            self.revision = self.history.revision
            self._finished_jobs = {job.folder.name for job in jobs.list_jobs(self.study) if job.state != jobs.RUNNING}
            names = [run.name for run in self.study.runs]
            if self.run not in names:
                self.run = names[0] if names else ""
        self.version += 1

    def _fingerprint(self) -> object:
        """Names, times and sizes of the files from which the page is made."""
        folder = self.study.output if self.study else self.path.parent
        files = [self.path, *sorted(folder.glob("*.h5")), CommandHistory(folder).path]
        return [(str(f), s.st_mtime_ns, s.st_size) for f in files if f.exists() for s in (f.stat(),)]

    @property
    def model(self) -> ModelResults | None:
        """The current model, if one is fitted."""
        return self.results.current if self.results else None

    @property
    def diagnosis(self) -> dict[str, Any] | None:
        """The diagnosis of the current model, if there is one."""
        return self.results.diagnosis if self.results else None

    @property
    def runs(self) -> dict[str, RunTable]:
        """Runs of the study file by name."""
        return {run.name: run for run in self.study.runs} if self.study else {}

    def file_value(self, table: str, key: str, which: str | None = None) -> Any:
        """Read the value of a key in the study file.

        Parameters
        ----------
        table : str
            Table of the study file, such as "study", "camera" or "run".
        key : str
            Key in that table.
        which : str, optional
            Name of the run or effect, for tables that occur several times.

        Returns
        -------
        Any
            The value as it is written; None if it is not there.

        """
        try:
            return read_key(self.path.read_text(encoding="utf-8"), table, key, which)
        except (OSError, FrictrackError):  # while it is being edited by hand
            return None

    @property
    def run_results(self) -> RunResults | None:
        """Results of the selected run, if there are any."""
        return next((r for r in (self.results.runs if self.results else ()) if r.name == self.run), None)

    @property
    def new_recordings(self) -> list[str]:
        """File names of recordings in the folder of the study that are not in the study."""
        try:
            found = find_recordings(self.path.parent)
        except FrictrackError:
            return []
        used = {run.source.resolve() for run in self.runs.values() if isinstance(run.source, Path)}
        return [p.name for p in found if p.resolve() not in used]

    def can_apply(self, do: str) -> bool:
        """Whether there is a change that can be undone or redone.

        Parameters
        ----------
        do : str
            "undo" or "redo".

        """
        done, undone = self.history.undo_stacks() if self.history else ([], [])
        return bool(done if do == "undo" else undone)

    # --- changing

    def notify(self, words: str, *, is_error: bool = False) -> None:
        """Show a message to the user.

        Parameters
        ----------
        words : str
            The message; "" to remove the last one.
        is_error : bool
            Whether it is an error.

        """
        self.param.update(message=words, is_error=is_error)

    def create_study(self, recordings: Sequence[str], keys: dict[str, Any]) -> bool:
        """Write a new study file for some recordings.

        Parameters
        ----------
        recordings : sequence of str
            File names in the folder of the study.
        keys : dict
            Mass, fps and scale as typed; empty ones are left out.

        Returns
        -------
        bool
            Whether the file was written; if not, the message says why.

        """
        try:
            known = {key: value for key, value in keys.items() if value}
            start_study(self.path, [self.path.parent / name for name in recordings], known)
        except FrictrackError as e:
            self.notify(str(e), is_error=True)
            return False
        found = Findings(open_study(self.path))
        found.check_study_file()
        self._notify_done(f"{self.path.name} is written; press Run everything", found.messages)
        return True

    def _notify_done(self, words: str, warnings: Sequence[str]) -> None:
        """Show that something is done, and what is implausible in the study."""
        self.notify("; ".join([words, *(f"to be checked: {warning}" for warning in warnings)]), is_error=bool(warnings))

    def apply_change(self, do: str, **arguments: Any) -> bool:
        """Apply a quick change to the study; it is refused if the study has changed since it was shown.

        Parameters
        ----------
        do : str
            Command of the study's history, such as "edit", "use", "undo".
        **arguments
            Arguments of the command.

        Returns
        -------
        bool
            Whether the change was made; if not, the message says why.

        """
        assert self.study is not None
        try:
            Session(open_study(self.path, allow_no_runs=True), author=AUTHOR, expected_revision=self.revision).apply(
                do, **arguments
            )
        except FrictrackError as e:
            self.notify(str(e), is_error=True)
            return False
        self.revision = CommandHistory(self.study.output).revision
        self.notify(
            " ".join((f"{do}: done", *(str(arguments[k]) for k in ("which", "key") if arguments.get(k) is not None)))
        )
        return True

    def start_job(self, do: str, **arguments: Any) -> None:
        """Start a long command in its own process, see `jobs.start`.

        Parameters
        ----------
        do : str
            The command.
        **arguments
            Arguments of the command.

        """
        if self.study is None:
            return
        try:
            job = jobs.start(self.study, do, expected_revision=self.revision, author=AUTHOR, **arguments)
        except FrictrackError as e:
            self.notify(str(e), is_error=True)
            return
        self.job = job
        self.progress = {"do": do, "done": 0, "total": 0, "what": "starts"}
        self.notify("")

    def cancel(self) -> None:
        """Cancel the running job."""
        if self.job is not None:
            self.job.cancel()

    def _follow_job(self) -> None:
        """Read the progress of the running job, also of one that another tab or an earlier server started."""
        if self.job is None and self.study is not None:
            going = (j for j in jobs.list_jobs(self.study) if j.folder.name not in self._finished_jobs)
            self.job = next((j for j in going if j.state == jobs.RUNNING), None)
        if self.job is None:
            return
        state, spec = self.job.state, self.job.spec
        if state == jobs.RUNNING:
            lines = self.job.progress
            now = {"do": spec["do"], "done": 0, "total": 0, "what": "starts"} | (lines[-1] if lines else {})
            if now != self.progress:
                self.progress = now
            return
        self._finished_jobs.add(self.job.folder.name)
        ended, self.job, self.progress = self.job, None, {}
        words = " ".join((spec["do"], *(str(v) for v in spec["told"].values() if v is not None)))
        if state == jobs.DONE:
            made = ended.result["done"]
            warnings = made.get("warnings", []) if isinstance(made, dict) else []
            self._notify_done(f"{words}: done", [warning["words"] for warning in warnings])
            if spec["do"] == "attempt":
                self._show_attempt(ended)
            elif spec["do"] in ("add", "remove", "fit"):
                self.attempted = None
        elif state == jobs.FAILED:
            self.notify(f"{words}: {ended.result['error']}", is_error=True)
        else:
            self.notify(f"{words}: {state}; finished steps are kept, start it again to continue", is_error=True)

    def _show_attempt(self, job: Job) -> None:
        from frictrack.flow import read_attempt  # noqa: PLC0415

        effect = job.spec["told"]["effect"]
        self.attempted = replace(read_attempt(job.folder / "attempt.h5"), name=f"0_with {effect}")


def _read(path: Path) -> tuple[Study | None, Results | None] | FrictrackError:
    """Read the study and its results (None without a study file); return the error if they cannot be read."""
    if not path.exists():
        return None, None
    try:
        study = open_study(path, allow_no_runs=True)
        return study, read_results(study)
    except FrictrackError as e:
        return e
