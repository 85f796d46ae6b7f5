"""Record size and modification time of a study's files, to find out without reading them whether they changed."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from stat import S_ISDIR

from frictrack.errors import FrictrackError
from frictrack.flow import run_pipeline
from frictrack.remote import RemoteFile, locate
from frictrack.study import Study

FileStates = dict[str, list[int]]  # path -> size, time of change in ns


def file_states(study: Study) -> FileStates:
    """Return the states of all files of a study: study file, recordings, results.

    Returns
    -------
    dict of str to list of int
        By path: size, bytes, and modification time, ns; empty for a file that does not exist.

    """
    pipelines = [run_pipeline(study, run) for run in study.runs]
    inputs = [path for pipeline in pipelines for path in pipeline.input_files()]
    results = [pipeline.path for pipeline in pipelines] + [study.output / name for name in ("study.h5", "report.html")]
    known = [] if study.prior_file is None else [study.prior_file]
    return {str(path): _state(path) for path in (study.path, *known, *inputs, *results)}


def are_unchanged(files: FileStates) -> bool:
    """Return whether all files have the recorded states; False for no files, or an address that is not allowed."""
    with suppress(FrictrackError):
        return bool(files) and all(_state(locate(path)) == state for path, state in files.items())
    return False


def _state(path: Path | RemoteFile) -> list[int]:
    """Return size and modification time; of a folder the number and total size of its files, and the latest time."""
    if isinstance(path, RemoteFile):
        return path.state()
    try:
        found = path.stat()
        if not S_ISDIR(found.st_mode):
            return [found.st_size, found.st_mtime_ns]
        inside = [one.stat() for one in path.iterdir() if one.is_file()]
    except OSError:
        return []
    return [len(inside), sum(one.st_size for one in inside), max((one.st_mtime_ns for one in inside), default=0)]
