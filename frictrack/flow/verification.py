"""Verify stored results: undamaged, computed from one another, and from the recordings that are there now.

Every fault has a kind: `damage` (bytes changed since they were written), `missing` or `leftover` (a file that should
exist, or should not), `changed` (a recording, a table or the study file differs from what was measured) and `outdated`
(a result was computed again, but not what depends on it).

`stored_values` reads every value of a file of results, so that two copies of them can be compared. JSON texts are read
as what they hold. Values of the same name inside a list are one array, whose largest magnitude is the scale of their
differences.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np

from frictrack.base.errors import FrictrackError, UsageError, result_or_none
from frictrack.base.files import is_busy
from frictrack.flow import store
from frictrack.flow.command_history import CommandHistory
from frictrack.flow.pipeline import Progress, RunPipeline, digest, no_progress
from frictrack.flow.store import Fault, Provenance
from frictrack.flow.tried_models import TriedModels, stored_models
from frictrack.study import load, results_folder

Provenances = Callable[[Path], dict[str, Provenance]]
RUN_AGAIN = "run the study again"
_GROUP = re.compile(r"([^/\\]+\.h5)?:/(.+)")  # name of a group in `RunPipeline.inputs` and `TriedModels.inputs`
_STUDY = re.compile(r"^\s*(\[study\]|\[\[run\]\])", re.MULTILINE)


def verify(paths: Sequence[Path], progress: Progress = no_progress) -> dict[str, Any]:
    """Verify study files, folders of results or HDF5 files. Nothing is written.

    Parameters
    ----------
    paths
        The files; folders are searched.
    progress
        Called as ``progress(done, total, "files")``.

    Returns
    -------
    dict
        JSON of `frictrack verify`: "sound" (bool), "faults" (list), numbers of files and studies, ...

    Raises
    ------
    FrictrackError
        (usage) If a path contains nothing to verify.

    """
    files: dict[Path, Path] = {}
    studies: dict[Path, Path] = {}
    for path in paths:
        mine, named = _result_files(path), _study_files(path)
        if not mine and (path in named or not named):
            raise UsageError(f"expected results of frictrack in {path} but found none")
        files |= {p.resolve(): p for p in mine}
        studies |= {p.resolve(): p for p in named}
    faults: list[Fault] = []
    opened: list[TriedModels] = []
    for path in studies.values():
        try:
            opened.append(stored_models(load(path)))
        except FrictrackError as e:
            faults.append(Fault(path, "", str(e), "correct it; its results are verified all the same", "changed"))
    sound: set[Path] = set()
    provenances = lru_cache(maxsize=256)(store.provenances)  # a file is asked for by every file computed from it
    for i, path in enumerate(files):
        progress(i, len(files), "files")
        fault = store.check(files[path])
        if fault is None:
            faults += _file_provenance_faults(files[path], provenances)
            sound.add(path)
        elif fault.kind != "foreign" or files[path] in paths:
            faults.append(fault)
    progress(len(files), len(files), "files")
    folders = dict.fromkeys(path.parent for path in files.values())
    faults += [fault for models in opened for fault in _study_faults(models, sound)]
    faults += [fault for folder in folders for fault in _folder_faults(folder, sound)]
    return {
        "sound": not faults,
        "files": len(files),
        "studies": len(studies),
        "faults": [{**vars(f), "file": str(f.file), "words": f.words} for f in dict.fromkeys(faults)],
        "without_checksums": [str(files[path]) for path in sound if not store.read_header(path).version],
        "partly_hashed": [str(film) for models in opened for film in _partly_hashed(models.pipelines)],
        "at_work": [str(folder) for folder in folders if is_busy(folder)],
    }


def _result_files(path: Path) -> list[Path]:
    """Return the HDF5 files of a path."""
    if path.suffix == ".toml" and path.is_file():
        path = result_or_none(results_folder, path) or path
    if path.is_dir():
        return sorted(path.rglob("[!.]*.h5"))
    return [path] if path.suffix == ".h5" and path.exists() else []


def _study_files(path: Path) -> list[Path]:
    """Return the study files of a path: itself, those in a folder, and those whose results the folder holds."""
    if path.suffix == ".toml" and path.is_file():
        return [path]
    if not path.is_dir():
        return []
    inside = [p for p in sorted(path.rglob("*.toml")) if _STUDY.search(p.read_text(encoding="utf-8", errors="replace"))]
    results = path.absolute()
    owners = [p for p in sorted(results.parent.glob("*.toml")) if result_or_none(results_folder, p) == results]
    return inside + owners


def _study_faults(models: TriedModels, sound: set[Path]) -> Iterator[Fault]:
    """Find differences between results and the study file with its recordings; damaged files are skipped."""
    files = [p for p in (*(pipeline.path for pipeline in models.pipelines), models.path) if p.exists()]
    for pipeline in models.pipelines if files else ():
        if pipeline.path not in files:
            yield Fault(pipeline.path, "", "this run has no results while others have", "run the study", "missing")
        elif pipeline.path.resolve() in sound:
            yield from _run_faults(pipeline)
    if len(files) == len(models.pipelines) + 1 and all(path.resolve() in sound for path in files):
        for group in filter(models.is_outdated, models.groups):
            words = "was fitted to other runs, or under other settings, than there are now"
            yield Fault(models.path, f"/models/{group}", words, RUN_AGAIN, "outdated")


def _run_faults(pipeline: RunPipeline) -> Iterator[Fault]:
    """Compare the keys and files of a run with those that its results were computed from."""
    for name, provenance in ((n, s) for n in pipeline.stages if (s := pipeline.provenance(n)) is not None):
        if changed := pipeline.changed_settings(name):
            words = f"was made with another {' and '.join(changed)} than the study file has now"
            yield Fault(pipeline.path, f"/{name}", words, RUN_AGAIN, "changed")
        else:
            yield from _input_faults(pipeline, name, provenance)


def _input_faults(pipeline: RunPipeline, name: str, provenance: Provenance) -> Iterator[Fault]:
    """Find files that a stage read and that have changed since."""
    then = {file: found for file, found in json.loads(provenance.inputs or "[]") if not _GROUP.fullmatch(file)}
    try:
        paths = pipeline.input_files(pipeline.stages[name])
        now = {str(pipeline.as_written(path)): pipeline.content_hash(path, then, reread=True) for path in paths}
    except (FrictrackError, OSError) as e:
        words = f"its input cannot be read ({e})"
        yield Fault(pipeline.path, f"/{name}", words, "restore the input; these results are still valid", "missing")
        return
    other = [file for file in then if now.get(file) != then[file]]
    if not provenance.inputs and digest([found for _, found in pipeline.inputs(name)]) != provenance.input_hash:
        other = list(now)  # schema 1 did not list the inputs
    if other:
        words = f"was made from {' and '.join(other)} as it was then, which has changed since; the results are sound"
        yield Fault(pipeline.path, f"/{name}", words, f"put the old one back, or {RUN_AGAIN}", "changed")


def _partly_hashed(pipelines: list[RunPipeline]) -> Iterator[Path]:
    """Find results whose film was identified by some of its bytes, as earlier versions did."""
    for pipeline in pipelines:
        with suppress(FrictrackError, OSError):  # files that cannot be read are faults of their own
            provenance = store.provenance(pipeline.path, "recording")
            if provenance is not None and pipeline.recording.sampled_hash in provenance.inputs:
                yield pipeline.path


def _file_provenance_faults(path: Path, provenances: Provenances) -> list[Fault]:
    """Find faults of provenance in a file whose bytes are sound."""
    try:
        return list(_group_provenance_faults(path, provenances))
    except (ValueError, TypeError, KeyError) as e:
        return [Fault(path, "", f"its provenance was not written by frictrack ({e})", RUN_AGAIN)]


def _group_provenance_faults(path: Path, provenances: Provenances) -> Iterator[Fault]:
    """Check that every result states its inputs, and was computed from those that are there."""
    for group, provenance in provenances(path).items():
        full = f"/{group}"
        if not (provenance.key and provenance.input_hash and provenance.version):
            yield Fault(path, full, "does not say what it was made from", RUN_AGAIN)
            continue
        for name, key in json.loads(provenance.inputs or "[]"):
            if found := _GROUP.fullmatch(name):
                other = path.parent / found[1] if found[1] else path
                with suppress(FrictrackError):  # reported for that file
                    source = provenances(other).get(found[2]) if other.exists() else None
                    if source is None:
                        yield Fault(path, full, f"was made from {name}, which is not there", RUN_AGAIN, "missing")
                    elif source.key != key:
                        words = f"was made from {name}, which was made again since"
                        yield Fault(path, full, words, RUN_AGAIN, "outdated")


def _history_has_models(folder: Path) -> bool:
    """Return whether a model was fitted since the last restart, by the log; a damaged log is a fault of its own."""
    changes = result_or_none(lambda: CommandHistory(folder).changes) or []
    since = takewhile(lambda change: change.command != "restart", reversed(changes))
    return any("current" in change.after for change in since)


def _folder_faults(folder: Path, sound: set[Path]) -> Iterator[Fault]:
    """Check what lies beside the HDF5 files: the log, the report, and leftovers of writers that were killed."""
    changes = CommandHistory(folder)
    try:
        changes.undo_stacks()
        if changes.path.exists() and (text := changes.path.read_bytes()) and not text.endswith(b"\n"):
            yield Fault(changes.path, "", "its last line is half-written", "the next change cuts it off", "leftover")
    except (FrictrackError, IndexError, AttributeError) as e:
        words, _, _ = str(e).removeprefix(f"{changes.path} ").partition("; ")
        yield Fault(changes.path, "", words, "move it away; the models tried are not in it")
    study = folder / "study.h5"
    if _history_has_models(folder) and not study.exists():
        words = "the log lists models that were tried, but this file does not exist"
        yield Fault(study, "", words, RUN_AGAIN, "missing")
    if study.resolve() in sound and "diagnosis" in store.names(study) and not (folder / "report.html").exists():
        yield Fault(folder / "report.html", "", "there is a diagnosis but no report", "frictrack report", "missing")
    for left in sorted(folder.glob(".*.part*")) if not is_busy(folder) else ():
        yield Fault(left, "", "left by a writer that was killed", "delete it, nothing in it is lost", "leftover")


LINKS = ("runs", "diagnosis")  # in study.h5: the files of the runs, and the diagnosis of the current model


EXCLUDED = {  # attributes of groups that may differ although the results are the same, and why
    ("key", "input_hash", "inputs", "settings", "version"): "hashes of provenance include paths and versions",
    ("sha256",): "a checksum covers the provenance too",
    ("path",): "a recording may lie in another folder",
    ("hash",): "recordings are compared before; one that was read in parts has the hash of its store",
}
_NAMES_EXCLUDED = {name for names in EXCLUDED for name in names}
Values = dict[str, list[Any]]
"""Values by name: numbers, texts, bool, None, and arrays; in lists, in order."""


def stored_values(path: Path) -> dict[str, Values]:
    """Read every value of a file of results.

    Parameters
    ----------
    path
        The file, ``study.h5`` or that of a run.

    Returns
    -------
    dict
        By name of the group, the values by name: ``["models/1_tustin"]["summary.errors.rms_displacement_um"]``.

    Raises
    ------
    FrictrackError
        If the file is missing or damaged.

    """
    with store.snapshot(path):  # whatever is wrong in it becomes one sentence
        models = store.names(path, "models")
        own = {"models": store.attributes(path, "models")} if models else {}
        groups = [name for name in store.names(path) if name not in (*LINKS, "models")]
        groups += [f"models/{name}" for name in models]
        read = own | {group: store.read(path, group) for group in groups}
        return {group: _values(content) for group, content in read.items()}


def _values(content: Mapping[str, Any]) -> Values:
    found: Values = {}
    for name, value in content.items():
        if name not in _NAMES_EXCLUDED:
            for where, leaf in _leaves(name, value):
                found.setdefault(where, []).append(leaf)
    return found


def _leaves(where: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield name and value of everything inside a value; texts of JSON are read."""
    value = _decoded(value)
    if isinstance(value, dict):
        for name, part in value.items():
            yield from _leaves(f"{where}.{name}", part)
    elif isinstance(value, list):
        yield f"{where}.length", len(value)
        for part in value:
            yield from _leaves(f"{where}[]", part)
    else:
        yield where, value


def _decoded(value: Any) -> Any:
    """Return what a text of JSON holds; anything else as it is."""
    if isinstance(value, np.ndarray) and value.ndim == 0 and value.dtype.kind in "UOS":
        value = str(value)
    if isinstance(value, str) and value[:1] in ("{", "["):
        try:
            return json.loads(value)
        except (ValueError, RecursionError):
            return value
    return value
