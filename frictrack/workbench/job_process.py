"""Run one job: `python -m frictrack.workbench.job_process JOBS/0007`."""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from threading import Thread
from typing import Any

from filelock import FileLock

from frictrack.errors import FrictrackError
from frictrack.files import replace_text

CANCEL_POLL_S = 0.05  # between two checks for the file that cancels the job
MIN_WRITE_INTERVAL_S = 0.1  # between two lines of progress with the same text


class ProgressFile:
    """Write progress to a file; lines with the same text at most ten times per second."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._last, self._what = 0.0, ""

    def __call__(self, done: int, total: int, what: str) -> None:
        """Write one line, unless one with the same text was written just before.

        Parameters
        ----------
        done, total : int
            Steps done, and all steps.
        what : str
            The current step.

        """
        now = time.monotonic()
        if what == self._what and done < total and now - self._last < MIN_WRITE_INTERVAL_S:
            return
        self._last, self._what = now, what
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"done": done, "total": total, "what": what}) + "\n")


def main(folder: Path) -> None:
    """Run a job.

    Parameters
    ----------
    folder : Path
        Folder of the job. The command is read from ``spec.json``; the result or the error is written to
        ``result.json``.

    """
    with FileLock(folder / "alive"):
        (folder / "began").touch()
        Thread(target=_end_when_asked, args=(folder / "cancel",), daemon=True).start()
        try:
            result = _run_job(json.loads((folder / "spec.json").read_text(encoding="utf-8")), folder)
        except FrictrackError as e:
            result = {"error": str(e)}
        except Exception as e:  # noqa: BLE001 - the page shows it; the traceback is in output.txt
            result = {"error": f"{type(e).__name__}: {e}"}
            sys.excepthook(type(e), e, e.__traceback__)
        replace_text(folder / "result.json", json.dumps(result))


def _end_when_asked(cancel: Path) -> None:
    """End the process when the file `cancel` appears.

    Finished steps are kept, because files are written completely or not at all.
    """
    while not cancel.exists():
        time.sleep(CANCEL_POLL_S)
    os._exit(130)


def _run_job(spec: dict[str, Any], folder: Path) -> dict[str, Any]:
    from frictrack.flow import Session, open_study  # noqa: PLC0415 - a job can be cancelled before this import ends
    from frictrack.results import to_builtins  # noqa: PLC0415

    session = Session(
        open_study(spec["study"]),
        ProgressFile(folder / "progress.jsonl"),
        author=spec["who"],
        expected_revision=spec["seen"],
    )
    done: dict[str, Any] = to_builtins(
        ACTIONS.get(spec["do"], _apply_change)(session, spec["do"], folder, **spec["told"])
    )
    return {"done": done}


def _apply_change(session: Any, do: str, folder: Path, **arguments: Any) -> Any:
    return session.apply(do, **arguments)


def _call_session(session: Any, do: str, folder: Path, **arguments: Any) -> Any:
    return getattr(session, do)(**arguments)


def _attempt_effect(session: Any, do: str, folder: Path, effect: str) -> Any:
    """Fit the model with one more effect; the result is stored with the job and not in the study."""
    return session.attempt(effect, folder / "attempt.h5")


def _write_report(session: Any, do: str, folder: Path) -> Any:
    return {"report": session.report()}


ACTIONS: dict[str, Any] = {
    "measure": _call_session,
    "run": _call_session,
    "diagnose": _call_session,
    "attempt": _attempt_effect,
    "report": _write_report,
}


if __name__ == "__main__":
    main(Path(sys.argv[1]))
