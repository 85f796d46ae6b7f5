"""Whether results are still what was written, made from one another and from the recordings that lie there.

Four questions, each with its own kind of fault: `damage` (bytes changed since they were written), `missing` or
`leftover` (a file that should be there, or should not), `changed` (a recording, a table or the study file is another
one than was measured) and `outdated` (one result was made again, and what rests on it was not).
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from frictrack import store
from frictrack.errors import FrictrackError
from frictrack.files import is_busy
from frictrack.flow.command_history import FILE_NAME, CommandHistory
from frictrack.flow.pipeline import Progress, RunPipeline, digest, no_progress, stage_key
from frictrack.flow.stages import FILM, TABLE, run_pipeline
from frictrack.flow.tried_models import TriedModels
from frictrack.store import Fault, Provenance
from frictrack.study import Study, load, results_folder

Provenances = Callable[[Path], dict[str, Provenance]]
RUN_AGAIN = "run the study again"
_GROUP = re.compile(r"([^/\\]+\.h5)?:/(.+)")  # as `RunWork.inputs` and `Tried.inputs` name groups
_STUDY = re.compile(r"^\s*(\[study\]|\[\[run\]\])", re.MULTILINE)


def verify(paths: Sequence[Path], progress: Progress = no_progress) -> dict[str, Any]:
    """Look at study files, folders of results, HDF5 files, or folders searched through: JSON of `verify`.

    Nothing is written. Raises `FrictrackError` (usage) for a path where there is nothing to verify.
    """
    files: dict[Path, Path] = {}
    studies: dict[Path, Path] = {}
    for path in paths:
        mine, named = _result_files(path), _study_files(path)
        if not mine and (path in named or not named):
            raise FrictrackError(f"expected results of frictrack in {path} but found none", usage=True)
        files |= {p.resolve(): p for p in mine}
        studies |= {p.resolve(): p for p in named}
    faults, pipelines = _open_studies(studies.values())
    sound: set[Path] = set()
    provenances = lru_cache(maxsize=256)(store.provenances)  # what is told of a file is asked for by those made from it
    for i, path in enumerate(files):
        progress(i, len(files), "files")
        found = store.check(files[path])
        kinds = {fault.kind for fault in found}
        if "foreign" in kinds and files[path] not in paths:
            continue
        if not kinds & {"damage", "foreign"}:
            found += _file_provenance_faults(files[path], provenances)
            sound.add(path)
        faults += found
    progress(len(files), len(files), "files")
    for group in pipelines:
        faults += _study_faults(group, sound)
    folders = dict.fromkeys(path.parent for path in files.values())
    faults += [fault for folder in folders for fault in _folder_faults(folder, sound)]
    return {
        "sound": not faults,
        "files": len(files),
        "studies": len(studies),
        "faults": [{**vars(f), "file": str(f.file), "words": f.words} for f in dict.fromkeys(faults)],
        "without_checksums": [str(files[path]) for path in sound if store.read_header(path) is None],
        "at_work": [str(folder) for folder in folders if is_busy(folder)],
    }


def _result_files(path: Path) -> list[Path]:
    """The HDF5 files that a path stands for."""
    if path.suffix == ".toml" and path.is_file():
        path = _output_folder(path) or path
    if path.is_dir():
        return sorted(p for p in path.rglob("*.h5") if not p.name.startswith("."))
    return [path] if path.suffix == ".h5" and path.exists() else []


def _study_files(path: Path) -> list[Path]:
    """The study files that a path stands for: itself, those in a folder, or the one whose results the folder holds."""
    if path.suffix == ".toml" and path.is_file():
        return [path]
    if not path.is_dir():
        return []
    inside = [p for p in sorted(path.rglob("*.toml")) if _STUDY.search(p.read_text(encoding="utf-8", errors="replace"))]
    beside = [p for p in sorted(path.absolute().parent.glob("*.toml")) if _output_folder(p) == path.absolute()]
    return inside + beside


def _output_folder(path: Path) -> Path | None:
    try:
        return results_folder(path)
    except FrictrackError:
        return None


def _open_studies(paths: Iterable[Path]) -> tuple[list[Fault], list[list[RunPipeline]]]:
    """The runs of every study file, and what is wrong with those that cannot be read or have none."""
    faults, pipelines = [], []
    for path in paths:
        try:
            study = load(path)
            pipelines.append([run_pipeline(study, run, stored_only=True) for run in study.runs])
        except FrictrackError as e:
            faults.append(Fault(path, "", str(e), "put that right; its results are looked at all the same", "changed"))
    return faults, pipelines


def _existing_results(pipelines: list[RunPipeline]) -> list[Path]:
    """The result files of a study that there are."""
    return [
        p for p in (*(pipeline.path for pipeline in pipelines), pipelines[0].study.output / "study.h5") if p.exists()
    ]


def _study_faults(pipelines: list[RunPipeline], sound: set[Path]) -> Iterator[Fault]:
    """What disagrees with the study file and the recordings that it names; of damaged files nothing is told twice."""
    files = _existing_results(pipelines)
    for pipeline in pipelines if files else ():
        if pipeline.path not in files:
            yield Fault(pipeline.path, "", "this run has no results while others have", "run the study", "missing")
        elif pipeline.path.resolve() in sound:
            yield from _run_faults(pipeline)
    if len(files) == len(pipelines) + 1 and all(path.resolve() in sound for path in files):
        yield from _model_faults(pipelines[0].study, pipelines)


def _run_faults(pipeline: RunPipeline) -> Iterator[Fault]:
    """What the run's keys and files are now against what was measured."""
    for name, provenance in ((n, s) for n in pipeline.stages if (s := store.provenance(pipeline.path, n)) is not None):
        then, now = json.loads(provenance.settings), pipeline.settings(name)
        if changed := [key for key in now if then.get(key) != now[key]]:
            words = f"was made with another {' and '.join(changed)} than the study file has now"
            yield Fault(pipeline.path, f"/{name}", words, RUN_AGAIN, "changed")
        else:
            yield from _input_faults(pipeline, name, provenance)


def _input_faults(pipeline: RunPipeline, name: str, provenance: Provenance) -> Iterator[Fault]:
    """Whether the files that a stage read still hold the same."""
    then = {file: found for file, found in json.loads(provenance.inputs or "[]") if not _GROUP.fullmatch(file)}
    try:
        now = {
            str(pipeline.as_written(path)): pipeline.content_hash(path)
            for path in pipeline.input_files(pipeline.stages[name])
        }
    except (FrictrackError, OSError) as e:
        words = f"what it was made from cannot be read ({e})"
        yield Fault(pipeline.path, f"/{name}", words, "put it back; these results still stand", "missing")
        return
    other = [file for file in then if now.get(file) != then[file]]
    if not provenance.inputs and digest([found for _, found in pipeline.inputs(name)]) != provenance.input_hash:
        other = list(now)  # schema 1 named no inputs one by one
    if other:
        words = f"was made from {' and '.join(other)} as it was then, which has changed since; the results are sound"
        yield Fault(pipeline.path, f"/{name}", words, f"put the old one back, or {RUN_AGAIN}", "changed")


def _model_faults(study: Study, pipelines: list[RunPipeline]) -> Iterator[Fault]:
    """Models that were fitted to other runs, or under other words of the study file, than there are now."""
    models = TriedModels(study, pipelines, no_progress, CommandHistory(study.output))
    for group in models.groups:
        if models.is_outdated(group):
            words = "was fitted to other runs, or under other settings, than there are now"
            yield Fault(models.path, f"/models/{group}", words, RUN_AGAIN, "outdated")


def _file_provenance_faults(path: Path, provenances: Provenances) -> list[Fault]:
    """What is wrong with the provenance of a file whose bytes are sound."""
    try:
        return list(_group_provenance_faults(path, provenances))
    except (ValueError, TypeError, KeyError) as e:
        return [Fault(path, "", f"its provenance is not that of frictrack ({e})", RUN_AGAIN)]


def _group_provenance_faults(path: Path, provenances: Provenances) -> Iterator[Fault]:
    """Whether every result of a file tells where it comes from, and comes from what lies there."""
    for group, provenance in provenances(path).items():
        full = f"/{group}"
        if not (provenance.key and provenance.input_hash and provenance.version):
            yield Fault(path, full, "does not say what it was made from", RUN_AGAIN)
            continue
        inputs = json.loads(provenance.inputs or "[]")
        yield from _upstream_faults(path, full, inputs, provenances)
        hashes = [found for _, found in inputs]
        if hashes and (group in FILM or group in TABLE):
            key = stage_key(group, provenance.version, json.loads(provenance.settings), hashes)
            if (key, digest(hashes)) != (provenance.key, provenance.input_hash):
                yield Fault(path, full, "its key is not that of its settings, version and inputs", RUN_AGAIN)


def _upstream_faults(path: Path, full: str, inputs: list[list[str]], provenances: Provenances) -> Iterator[Fault]:
    """Whether the groups that one was made from are there, and were not made again since."""
    for name, key in inputs:
        if found := _GROUP.fullmatch(name):
            other = path.parent / found[1] if found[1] else path
            try:
                held = provenances(other).get(found[2]) if other.exists() else None
            except FrictrackError:
                continue  # told of that file
            if held is None:
                yield Fault(path, full, f"was made from {name}, which is not there", RUN_AGAIN, "missing")
            elif held.key != key:
                yield Fault(path, full, f"was made from {name}, which was made again since", RUN_AGAIN, "outdated")


def _history_has_models(folder: Path) -> bool:
    """Whether the log says that a model was fitted, and not forgotten since."""
    there = False
    with suppress(FrictrackError):  # told as damage
        for change in CommandHistory(folder).changes:
            there = change.command != "restart" and (there or "current" in change.after)
    return there


def _folder_faults(folder: Path, sound: set[Path]) -> Iterator[Fault]:
    """What lies beside the HDF5 files: the log, the report, and what a writer that was killed has left."""
    try:
        changes = CommandHistory(folder)
        changes.undo_stacks()
        if changes.path.exists() and (text := changes.path.read_bytes()) and not text.endswith(b"\n"):
            yield Fault(changes.path, "", "its last line is half-written", "the next change cuts it off", "leftover")
    except (FrictrackError, IndexError, AttributeError) as e:
        words, _, _ = str(e).removeprefix(f"{folder / FILE_NAME} ").partition("; ")
        yield Fault(folder / FILE_NAME, "", words, "move it away; the models tried are not in it")
    study = folder / "study.h5"
    if _history_has_models(folder) and not study.exists():
        yield Fault(
            study, "", "the log tells of models that were tried, but this file is not there", RUN_AGAIN, "missing"
        )
    if study.resolve() in sound and "diagnosis" in store.names(study) and not (folder / "report.html").exists():
        yield Fault(folder / "report.html", "", "there is a diagnosis but no report", "frictrack report", "missing")
    for left in sorted(folder.glob(".*.part*")) if not is_busy(folder) else ():
        yield Fault(left, "", "left by a writer that was killed", "delete it, nothing in it is lost", "leftover")
