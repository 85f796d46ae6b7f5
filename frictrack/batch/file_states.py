"""Whether the files of a study are those of last time: by size and time of change, without reading any."""

from __future__ import annotations

from pathlib import Path
from stat import S_ISDIR

from frictrack.flow import run_pipeline
from frictrack.remote import RemoteFile, is_remote
from frictrack.study import Study

FileStates = dict[str, list[int]]  # path -> size, time of change in ns


def file_states(study: Study) -> FileStates:
    """What a study rests on, and what it has come to, as the files are now."""
    pipelines = [run_pipeline(study, run) for run in study.runs]
    inputs = [path for pipeline in pipelines for path in pipeline.input_files()]
    results = [pipeline.path for pipeline in pipelines] + [study.output / name for name in ("study.h5", "report.html")]
    return {str(path): _state(path) for path in (study.path, *inputs, *results)}


def are_unchanged(files: FileStates) -> bool:
    """Whether all is as it was seen."""
    return bool(files) and all(_state(_file(path)) == state for path, state in files.items())


def _file(text: str) -> Path | RemoteFile:
    return RemoteFile(text) if is_remote(text) else Path(text)


def _state(path: Path | RemoteFile) -> list[int]:
    """Size and time of change; of a folder the number and size of its files, and the last change of any."""
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
