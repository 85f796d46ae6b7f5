"""The process of one job: `python -m frictrack.workbench.work JOBS/0007`."""

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

LOOK = 0.05  # s between two looks for somebody who wants it to end
OFTEN = 0.1  # s between two lines of progress that only count on


class Diary:
    """Progress into a file; lines that only count on are written ten times a second at most."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._last, self._what = 0.0, ""

    def __call__(self, done: int, total: int, what: str) -> None:
        """One line, unless the last one said the same a moment ago."""
        now = time.monotonic()
        if what == self._what and done < total and now - self._last < OFTEN:
            return
        self._last, self._what = now, what
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"done": done, "total": total, "what": what}) + "\n")


def main(folder: Path) -> None:
    """Do what the folder's ``spec.json`` asks for; the result, or why there is none, is its ``result.json``."""
    with FileLock(folder / "alive"):
        Thread(target=_end_when_asked, args=(folder / "cancel",), daemon=True).start()
        try:
            result = _done(json.loads((folder / "spec.json").read_text(encoding="utf-8")), folder)
        except FrictrackError as e:
            result = {"error": str(e)}
        except Exception as e:  # noqa: BLE001 - the page shows it; the traceback is in output.txt
            result = {"error": f"{type(e).__name__}: {e}"}
            sys.excepthook(type(e), e, e.__traceback__)
        replace_text(folder / "result.json", json.dumps(result))


def _end_when_asked(cancel: Path) -> None:
    """Nothing that was finished is lost: files appear whole, and the next one who works goes on from them."""
    while not cancel.exists():
        time.sleep(LOOK)
    os._exit(130)


def _done(spec: dict[str, Any], folder: Path) -> dict[str, Any]:
    from frictrack.flow import Session, open_study  # noqa: PLC0415 - whoever cancels need not wait for the science
    from frictrack.results import plain  # noqa: PLC0415

    session = Session(open_study(spec["study"]), Diary(folder / "progress.jsonl"), who=spec["who"], seen=spec["seen"])
    done: dict[str, Any] = plain(WORK.get(spec["do"], _applied)(session, spec["do"], folder, **spec["told"]))
    return {"done": done}


def _applied(session: Any, do: str, folder: Path, **told: Any) -> Any:
    return session.apply(do, **told)


def _up_to_date(session: Any, do: str, folder: Path, **told: Any) -> Any:
    return getattr(session, do)(**told)


def _tried(session: Any, do: str, folder: Path, effect: str) -> Any:
    """A model with one effect more, kept beside the job and not in the study."""
    return session.attempt(effect, folder / "attempt.h5")


def _reported(session: Any, do: str, folder: Path) -> Any:
    return {"report": session.report()}


WORK: dict[str, Any] = {
    "measure": _up_to_date,
    "run": _up_to_date,
    "diagnose": _up_to_date,
    "attempt": _tried,
    "report": _reported,
}


if __name__ == "__main__":
    main(Path(sys.argv[1]))
