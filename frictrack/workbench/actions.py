"""What the page can do to a study: quick changes, jobs, new recordings. Every function runs in a thread."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from frictrack import flow
from frictrack.base.errors import FrictrackError, UsageError
from frictrack.workbench import MissingError, OutdatedError, jobs
from frictrack.workbench.live_study import LiveStudy

AUTHOR = "page"  # of changes, in the history of the study
CHANGES = ("edit", "take_in", "leave_out", "define", "use", "undo", "redo")
JOBS: dict[str, tuple[str, ...]] = {  # with the arguments that the page may give
    "run": ("seed",),
    "measure": ("stage", "overlay"),
    "fit": ("model", "search", "over", "seed", "settings", "domain", "per", "profiles", "draws"),
    "add": ("effect", "seed"),
    "remove": ("effect", "seed"),
    "add_and_diagnose": ("effect", "seed"),
    "remove_and_diagnose": ("effect", "seed"),
    "diagnose": ("seed",),
    "attempt": ("effect",),
    "report": (),
    "background": (),
}
CHANGED_INPUT = ("edit", "take_in", "leave_out", "define")  # changes after which running measurements begin again


def check(snapshot: Any, fields: Any, run: str | None) -> Any:
    """Read numbers as they are typed."""
    from frictrack.workbench.summaries import check_fields  # noqa: PLC0415

    texts = {key: "" if text is None else str(text) for key, text in _mapping(fields, "fields").items()}
    return check_fields(texts, run=run, snapshot=snapshot)


def change(live: LiveStudy, do: Any, arguments: Any, seen: Any) -> dict[str, Any]:
    """Make a quick change of the study; jobs that it makes useless are cancelled, measurements begin again.

    Parameters
    ----------
    live : LiveStudy
        The study.
    do : str
        One of `CHANGES`.
    arguments : dict
        Those of the command.
    seen : int
        Revision of the study that the user has seen.

    Returns
    -------
    dict
        "revision" after the change, and "words".

    Raises
    ------
    OutdatedError
        If the study has changed since.
    FrictrackError
        If the change is refused.

    """
    from frictrack.base.number_format import upper_first  # noqa: PLC0415 - loads NumPy
    from frictrack.workbench.summaries import change_words, refuse_implausible  # noqa: PLC0415

    if do not in CHANGES:
        raise UsageError(f"expected one of the changes {', '.join(CHANGES)} but got {do!r}")
    _need_study(live)
    given = _mapping(arguments, "arguments")
    if do == "edit":
        refuse_implausible(str(given.get("table")), str(given.get("key")), given.get("value"))
    study = flow.open_study(live.path, allow_incomplete=True)
    _check_revision(study.output, seen)
    try:
        flow.Session(study, author=AUTHOR, expected_revision=seen).apply(do, **given)
    except FrictrackError:
        _check_revision(study.output, seen)
        raise
    except TypeError as e:
        raise UsageError(f"expected other arguments of {do}: {e}") from e
    history = flow.CommandHistory(study.output)
    live.resumes_background = False
    _end_useless_work(live, do, history.revision)
    return {"revision": history.revision, "words": f"{upper_first(change_words(history.changes[-1]))}."}


def _end_useless_work(live: LiveStudy, do: str, revision: int) -> None:
    """Cancel work on the former state of the study; measurements and runs begin again with the new one."""
    job = live.running_job()
    if job is None:
        return
    spec = job.spec
    if job.summary["background"] or spec["do"] in ("diagnose", "attempt", "report", "background"):
        job.cancel()
    elif spec["do"] in ("run", "measure") and do in CHANGED_INPUT:
        job.cancel()
        job.wait(jobs.MAX_CANCEL_SECONDS)
        _start(live, spec["do"], job.summary["arguments"], revision)


def start_job(live: LiveStudy, do: Any, arguments: Any, seen: Any) -> dict[str, Any]:
    """Start a long command in its own process; see `jobs.start`.

    Parameters
    ----------
    live : LiveStudy
        The study.
    do : str
        One of `JOBS`.
    arguments : dict
        Those of the command.
    seen : int
        Revision of the study that the user has seen.

    Returns
    -------
    dict
        "job", the started job.

    """
    if do not in tuple(JOBS):  # a list or an object cannot be looked up in a dictionary
        raise UsageError(f"expected one of the jobs {', '.join(JOBS)} but got {do!r}")
    _need_study(live)
    given = _mapping(arguments, "arguments")
    if unknown := [key for key in given if key not in JOBS[do]]:
        raise FrictrackError(f"expected arguments of {do} ({', '.join(JOBS[do])}) but got {', '.join(unknown)}")
    _check_revision(live.output, seen)
    live.resumes_background = False
    return {"job": _start(live, do, given, seen).summary}


def _start(live: LiveStudy, do: str, arguments: Mapping[str, Any], seen: int | None) -> jobs.Job:
    return jobs.start(live.path, live.output, jobs.JobSpec(do, arguments, seen, AUTHOR), live.launcher.launch)


def try_effect(live: LiveStudy, effect: str) -> None:
    """Start fitting a candidate, unless other work is in the way or it is being fitted already.

    Parameters
    ----------
    live : LiveStudy
        The study.
    effect : str
        Name of the effect.

    Raises
    ------
    OutdatedError
        If the fit of this candidate has just failed.

    """
    job, last = live.running_job(), live.jobs.last
    same = {"do": "attempt", "arguments": {"effect": effect}, "state": "failed"}
    if job is None and last is not None and {key: last[key] for key in same} == same:
        raise OutdatedError(last["error"])
    if job is not None:
        now = job.summary
        is_fitting_it = now["arguments"] == same["arguments"] or f"+{effect}" in now["what"]
        if is_fitting_it or not (now["background"] or now["do"] == "attempt"):
            return
        live.resumes_background |= now["background"]
    _start(live, "attempt", {"effect": effect}, None)


def cancel(live: LiveStudy) -> dict[str, Any]:
    """Cancel the running job; finished steps are kept."""
    job, live.resumes_background = live.running_job(), False
    if job is not None:
        job.cancel()
    return {"cancelled": job.folder.name if job else None}


def take_in(live: LiveStudy, recordings: Any, fields: Any) -> dict[str, Any]:
    """Write a study file for some recordings, or take them into the study."""
    from frictrack.workbench.summaries import new_study  # noqa: PLC0415

    if not isinstance(recordings, list) or not recordings or not all(isinstance(one, str) for one in recordings):
        raise UsageError("expected the names of recordings in this folder but got none; choose some")
    for name in recordings:
        need_plain_name(name)
    if live.path.exists():
        return change(live, "take_in", {"recordings": recordings}, flow.CommandHistory(live.output).revision)
    texts = {key: str(text) for key, text in _mapping(fields, "fields").items() if text not in (None, "")}
    new_study(live.path, recordings, texts)
    return {"revision": flow.CommandHistory(live.output).revision, "words": f"{live.path.name} is written."}


def copy_sample(live: LiveStudy) -> dict[str, Any]:
    """Copy the sample films and their study file into the folder, if it has neither a study nor recordings."""
    from frictrack import samples  # noqa: PLC0415
    from frictrack.study import list_files  # noqa: PLC0415

    folder = live.path.parent
    if live.path.exists() or list_files(folder):
        raise OutdatedError(f"expected an empty folder but {folder} holds recordings; start frictrack in a new folder")
    written = samples.copy_films(folder)
    if written != live.path:
        written.replace(live.path)
    return {"revision": 0, "words": "The sample study is open."}


def need_plain_name(name: str) -> str:
    """Return a name that cannot lead out of the folder of the study.

    Raises
    ------
    FrictrackError
        If it is none.

    """
    if not name or name.startswith(".") or "\\" in name or Path(name).name != name or not name.isprintable():
        raise UsageError(f'expected the name of a recording in the folder but got "{name}"')
    return name


def _need_study(live: LiveStudy) -> None:
    if not live.path.exists():
        raise MissingError(f"expected the study file {live.path} but it is gone; choose recordings for a new one")


def _check_revision(output: Path, seen: Any) -> None:
    """Refuse a command for a state of the study that is no longer there."""
    if seen is not None and not isinstance(seen, int):
        raise UsageError(f"expected the revision of the study as a number but got {seen!r}")
    try:
        flow.CommandHistory(output, expected_revision=seen).check_revision()
    except FrictrackError as e:
        raise OutdatedError(str(e)) from e


def _mapping(value: Any, what: str) -> dict[str, Any]:
    """Return a JSON object; an empty one for null."""
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise UsageError(f"expected {what} as a JSON object but got {value!r}")
    return value
