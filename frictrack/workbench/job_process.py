"""Run one job: `python -m frictrack.workbench.job_process JOBS/0007`.

With `--wait` the process imports everything first and then reads the folder of the job from its standard input. It ends
when its input does, so that it does not outlive the server.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from threading import Thread
from typing import Any

from filelock import FileLock

from frictrack.base.errors import FrictrackError
from frictrack.base.files import replace_text

CANCEL_POLL_S = 0.02  # between two checks for the file that cancels the job
MIN_WRITE_INTERVAL_S = 0.1  # between two lines of progress with the same text


class ProgressFile:
    """Write progress to a file; lines with the same text at most ten times per second."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.phase, self.step = "", ""
        self._last, self._what = 0.0, ""

    def background(self, *found: Any) -> None:
        """Say that the result which the user waits for is stored; what follows runs in the background."""
        self.phase = "background"
        self._write({"done": 0, "total": 0, "what": "the verdict is stored"})

    def __call__(self, done: int, total: int, what: str) -> None:
        """Write one line, unless one with the same text was written just before."""
        self.step = what if total == 0 else self.step  # 0 of 0 announces a new step
        if total and " " not in what:  # "runs", or the name of a search at its end: the page counts runs itself
            return
        now = time.monotonic()
        if what == self._what and done < total and now - self._last < MIN_WRITE_INTERVAL_S:
            return
        self._last, self._what = now, what
        self._write({"done": done, "total": total, "what": what})

    def _write(self, line: dict[str, Any]) -> None:
        more = {"step": self.step} | ({"phase": self.phase} if self.phase else {})
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({**line, **more}) + "\n")


def main(folder: Path) -> None:
    """Run a job."""
    with FileLock(folder / "alive"):
        (folder / "began").touch()
        Thread(target=_end_when_asked, args=(folder,), daemon=True).start()
        try:
            result = _run_job(json.loads((folder / "spec.json").read_text(encoding="utf-8")), folder)
        except FrictrackError as e:
            result = {"error": str(e)}
        except Exception as e:  # noqa: BLE001 - the page shows it; the traceback is in output.txt
            result = {"error": f"{type(e).__name__}: {e}"}
            sys.excepthook(type(e), e, e.__traceback__)
        replace_text(folder / "result.json", json.dumps(result))


def _end_when_asked(folder: Path) -> None:
    """End the process when the file `cancel` appears, or when the results were removed with the folder of the job.

    Finished steps are kept, because files are written completely or not at all.
    """
    while not (folder / "cancel").exists() and (folder / "spec.json").exists():
        time.sleep(CANCEL_POLL_S)
    os._exit(130)


def _run_job(spec: dict[str, Any], folder: Path) -> dict[str, Any]:
    from frictrack.flow import Session, open_study  # noqa: PLC0415 - a job can be cancelled before this import ends
    from frictrack.results import to_builtins  # noqa: PLC0415

    progress = ProgressFile(folder / "progress.jsonl")
    progress(0, 0, "starts")
    session = Session(open_study(spec["study"]), progress, author=spec["who"], expected_revision=spec["seen"])
    done: dict[str, Any] = to_builtins(_perform(session, spec["do"], spec["told"], progress.background))
    return {"done": done}


def _perform(session: Any, do: str, arguments: dict[str, Any], verdict_stored: Callable[..., None]) -> Any:
    """Run one command; some go on in the background once the verdict is stored."""
    from frictrack import flow  # noqa: PLC0415

    if do == "run":
        return flow.run_study(session, verdict_stored, **arguments)
    if do in ("diagnose", "background"):  # the diagnosis, or what is missing of it, then candidates and the report
        return flow.conclude(session, verdict_stored, **arguments)
    if do in ("add_and_diagnose", "remove_and_diagnose"):
        return flow.change_and_diagnose(session, do.partition("_")[0], verdict_stored, **arguments)
    if do == "report":
        return {"report": session.report()}
    return getattr(session, do)(**arguments) if do in ("measure", "attempt") else session.apply(do, **arguments)


# what most jobs need; the process that waits has it ready
IMPORTED_FIRST = ("flow.session", "flow.stored_results", "flow.stages", "flow.opening", "flow.plausibility_checks",
                  "fit", "diagnose", "diagnose.compare", "tracking", "recording", "measure.motion",
                  "measure.friction")  # fmt: skip


def wait() -> None:
    """Import what jobs need, then run the job whose folder comes on the standard input; end with the input."""
    for module in IMPORTED_FIRST:
        import_module(f"frictrack.{module}")
    line = sys.stdin.readline()
    if not line:
        return
    folder = Path(json.loads(line))
    sys.stdout.flush()
    with (folder / "output.txt").open("wb") as output:
        os.dup2(output.fileno(), sys.stdout.fileno())
        os.dup2(output.fileno(), sys.stderr.fileno())
    main(folder)


if __name__ == "__main__":
    if sys.argv[1:] == ["--wait"]:
        wait()
    else:
        main(Path(sys.argv[1]))
