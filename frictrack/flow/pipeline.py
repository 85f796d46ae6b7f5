"""Bring the stages of one run up to date: read what is stored, compute what is missing or outdated, store it.

A stage is computed again only when its settings, its inputs or the version of frictrack changed. Its key is the hash of
those three; it is stored with the result.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from frictrack.base import __version__
from frictrack.base.errors import FrictrackError, os_errors_as
from frictrack.base.files import hash_file
from frictrack.base.remote import RemoteFile, local_path
from frictrack.flow import store
from frictrack.flow.store import GroupContent, Provenance
from frictrack.records import Displacement, Motion, Run, Track
from frictrack.results import Sensors, to_builtins
from frictrack.settings.repairs import Repair
from frictrack.study import RunTable, Study

if TYPE_CHECKING:
    from frictrack.base.workers import WorkerPool
    from frictrack.recording import Recording
    from frictrack.tracking import TargetModel

MAX_UNSAVED_S = 2.0  # seconds of work that may be lost when the process is killed
# Left out where they are empty: results that were stored before the key existed stay valid.
LATER_KEYS = ("repair", "filter", "order", "window", "causal", "rolling", "radius", "sigma_drive")
# Those that a run has under the same name.
KEYS_OF_RUN = ("name", "rolling", "normal_load", "sigma_drive", "clamp_x", "beam_length", "role", "group", "free")
STAGES_FROM_ANCHOR = ("track", "displacement")  # which use the target of the film that all follow

Progress = Callable[[int, int, str], None]
"""Callable ``progress(done, total, what)``, called while something is being done; 0 of 0 announces a new step."""


def no_progress(done: int, total: int, what: str) -> None:
    """Ignore progress."""


@dataclass(frozen=True)
class Stage:
    """One step of the measuring chain: it computes one group from other groups and from keys of the study file."""

    name: str  # name of the stage and of its group in the file of the run
    inputs: tuple[str, ...]  # names of the stages whose results it needs
    settings: tuple[str, ...]  # keys of ``[[run]]`` that it depends on
    make: Callable[..., Any]  # function ``make(pipeline, *results_of_the_inputs)`` that computes the result
    kind: Any  # record type of the result, or `dict` for several tracks by name


Stages = Mapping[str, Stage]  # by name


class RunPipeline:
    """All stages of one run. `get` returns the result of a stage and computes only what is missing or outdated."""

    def __init__(
        self, study: Study, run: RunTable, stages: Stages, progress: Progress, *, stored_only: bool = False
    ) -> None:
        self.study = study
        self.stored_only = stored_only
        self.run = run
        self.path = study.output / f"{run.name}.h5"
        self.stages = stages
        self._progress = progress
        self.pool: WorkerPool | None = None  # processes that take over segments of a long film
        self.lesson: TargetModel | None = None  # the learnt template, from the track stage to the tracks stage
        self._film: Recording | None = None
        self._results: dict[str, Any] = {}
        self._keys: dict[str, str] = {}
        self._inputs: dict[str, list[tuple[str, str]]] = {}
        self._unsaved: dict[str, GroupContent] = {}
        self._unsaved_since: float | None = None  # time.monotonic() when the oldest unsaved stage began; None: no block

    def progress(self, done: int, total: int, what: str) -> None:
        """Report progress, with the name of the run before `what`."""
        self._progress(done, total, f"{self.run.name}: {what}")

    @cached_property
    def recording(self) -> Recording:
        """The opened recording of a film; a remote one is fetched as far as it is needed."""
        from frictrack.recording import open_recording  # noqa: PLC0415 - loads OpenCV; tables do without

        assert self.run.video is not None
        return open_recording(self.run.video, fps=self.run.fps)

    @contextmanager
    def open_film(self) -> Iterator[Recording]:
        """Open the film with random access; inside nested blocks, a compressed film is decoded only once."""
        from frictrack.recording import random_access  # noqa: PLC0415

        if self._film is not None:
            yield self._film
            return
        with random_access(self.recording) as film:
            self._film = film
            try:
                yield film
            finally:
                self._film = None

    def get(self, name: str) -> Any:
        """Return the result of a stage; it is read if it is up to date, else computed and stored."""
        if name not in self._results:
            self._results[name] = self._read(name) if self.is_current(name) else self._compute(name)
        return self._results[name]

    @contextmanager
    def saved_together(self) -> Iterator[None]:
        """Write the stages that are computed in the block into the file at once; those that took long, when they end.

        They are written also if the block ends by an error or is interrupted.
        """
        if self._unsaved_since is not None:
            yield
            return
        self._unsaved_since = time.monotonic()
        try:
            yield
        finally:
            self._save()
            self._unsaved_since = None

    def _save(self) -> None:
        """Write the stages that are not in the file yet."""
        if self._unsaved:
            store.write(self.path, self._unsaved)
        self._unsaved, self._unsaved_since = {}, time.monotonic()

    def is_current(self, name: str) -> bool:
        """Return whether a stage is stored with the key that it would get today."""
        provenance = self.provenance(name)
        return provenance is not None and (self.stored_only or provenance.key == self.key(name))

    def key(self, name: str) -> str:
        """Return the hash of everything that a stage depends on."""
        if self.stored_only:
            provenance = self.provenance(name)
            return provenance.key if provenance else "never made"
        if name not in self._keys:
            hashes = [found for _, found in self.inputs(name)]
            self._keys[name] = digest([name, __version__, self.settings(name), hashes])
        return self._keys[name]

    def settings(self, name: str) -> dict[str, Any]:
        """Return the keys of the study file that a stage depends on, with their values as JSON has them."""
        found = {key: self.as_written(getattr(self.run, key)) for key in self.stages[name].settings}
        if found.get("incline") and not found["incline"][1]:  # without an error it stands alone, as in stored results
            found["incline"] = found["incline"][0]
        stated = found.get("sigma_drive") is not None  # 0 is an exact drive
        return {k: v for k, v in found.items() if v or k not in LATER_KEYS or (k == "sigma_drive" and stated)}

    def as_written(self, value: Any) -> Any:
        """Convert the value of a key for JSON: numbers to Python numbers, paths as they stand in the study file."""
        if isinstance(value, dict):
            return {key: self.as_written(part) for key, part in value.items()}
        if isinstance(value, Repair):
            return to_builtins(value.to_dict())
        if isinstance(value, list | tuple):
            return [self.as_written(part) for part in value]
        if isinstance(value, RemoteFile):
            return str(value)
        if not isinstance(value, Path):
            return to_builtins(value)
        inside = value.is_relative_to(self.study.folder)
        return (value.relative_to(self.study.folder) if inside else value).as_posix()

    def provenance(self, name: str) -> Provenance | None:
        """Return the provenance of a stored stage."""
        return store.provenance(self.path, name)

    def changed_settings(self, name: str) -> dict[str, tuple[Any, Any]]:
        """Return the keys of the study file that were others when a stage was computed: values then and now."""
        made = self.provenance(name)
        if made is None:
            return {}
        then, now = json.loads(made.settings), to_builtins(self.settings(name))
        values = {key: (then.get(key), now.get(key)) for key in (*now, *LATER_KEYS)}
        return {key: (before, after) for key, (before, after) in values.items() if before != after}

    def inputs(self, name: str) -> list[tuple[str, str]]:
        """Return what a stage is computed from.

        The hashes are computed once; a file that changes later is noticed by the next pipeline.
        """
        if name not in self._inputs:
            stage = self.stages[name]
            groups = [(f":/{other}", self.key(other)) for other in stage.inputs]
            if name in STAGES_FROM_ANCHOR and self.anchor:
                groups.append((f"{self.anchor.path.name}:/track", self.anchor.key("track")))
            paths = self.input_files(stage)
            stored = self.provenance(name) if self.run.video in paths else None  # only a film has a former hash
            known = dict(json.loads(stored.inputs or "[]")) if stored else {}
            files = [(self.as_written(path), self.content_hash(path, known)) for path in paths]
            self._inputs[name] = groups + files
        return self._inputs[name]

    def input_files(self, *stages: Stage) -> list[Path | RemoteFile]:
        """Return the files that some stages read; those of all stages if none is given."""
        keys = [key for stage in stages or self.stages.values() for key in stage.settings]
        return [path for key in keys for path in _paths(getattr(self.run, key))]

    @cached_property
    def anchor(self) -> RunPipeline | None:
        """The film whose point of the target all films follow; None for itself and for tables.

        It is the first by name, so that the order of the runs in the study file changes nothing.
        """
        first = min((r for r in self.study.runs if r.video), key=lambda r: r.name, default=None)
        if first is None or not self.run.video or first.name == self.run.name:
            return None
        return RunPipeline(self.study, first, self.stages, self._progress, stored_only=self.stored_only)

    def content_hash(
        self, path: Path | RemoteFile, known: Mapping[str, str] = MappingProxyType({}), *, reread: bool = False
    ) -> str:
        """Return the hash of a file, or of the files of a folder."""
        if path == self.run.video:
            found, before = self.recording.read_hash(reread=reread), known.get(self.as_written(path), "")
            return before if before not in ("", found) and before == self.recording.sampled_hash else found
        with os_errors_as(f"cannot read {path}"):
            return hash_path(local_path(path), reread=reread)

    @property
    def final_track(self) -> Track:
        """The track of a film with the repairs of the user."""
        repaired = "repaired" in self.stages and (not self.stored_only or self.is_current("repaired"))
        return self.get("repaired" if repaired else "track")

    def to_run(self) -> Run:
        """Return the measured run, as `frictrack.fit` takes it."""
        sensors: Sensors = self.get("sensors")
        return make_run(self.run, self.get("displacement"), self.get("motion"), sensors)

    def _read(self, name: str) -> Any:
        kind = self.stages[name].kind
        if kind is dict:
            return {n: store.read(self.path, f"{name}/{n}", Track) for n in store.names(self.path, name)}
        return store.read(self.path, name, kind)

    def _compute(self, name: str) -> Any:
        """Compute a stage from its inputs and store it."""
        stage = self.stages[name]
        with self.saved_together():
            with self.open_film() if name == "tracks" else nullcontext():  # the track may be computed on the way
                result, provenance = self._call(stage, [self.get(i) for i in stage.inputs])
            self._unsaved[name] = GroupContent(result, provenance)
            if self._unsaved_since is not None and time.monotonic() - self._unsaved_since > MAX_UNSAVED_S:
                self._save()
        return result

    def _new_provenance(self, name: str) -> Provenance:
        inputs, settings = self.inputs(name), json.dumps(self.settings(name), sort_keys=True)
        together = digest([found for _, found in inputs])
        return Provenance(self.key(name), together, json.dumps(inputs), settings, __version__)

    def _call(self, stage: Stage, inputs: list[Any]) -> tuple[Any, Provenance]:
        """Compute the result of a stage and its provenance; name run, stage and notes on the film in an error.

        The provenance comes first: a file that changes while it is read then counts as changed, not as what was read.
        """
        try:
            provenance = self._new_provenance(stage.name)
            return stage.make(self, *inputs), provenance
        except FrictrackError as e:
            film = self.get("recording") if self.run.video and stage.name != "recording" else None
            notes = "".join(f" ({note})" for note in film.notes) if film else ""
            where = f'run "{self.run.name}"'
            what = str(e).removeprefix(f"{where}: ")
            raise FrictrackError(f"{where}, {stage.name}: {what}{notes}", usage=e.usage) from e


def hash_path(path: Path, *, reread: bool = False) -> str:
    """Return the SHA-256 of a file, or of the hashes of the files in a folder. Raise OSError if one cannot be read."""
    files = sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [path]
    found = [hash_file(one, reread=reread) for one in files]
    return found[0] if found == found[:1] else digest(found)


def digest(value: Any) -> str:
    """Return the SHA-256 of a value as JSON; what JSON cannot write is written as `str` does.

    Examples
    --------
    >>> digest({"b": 1, "a": 2}) == digest({"a": 2, "b": 1})
    True

    """
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()


def _paths(value: Any) -> list[Path | RemoteFile]:
    """Return the files that the value of a key names, also inside a table or a list."""
    if isinstance(value, dict | list):
        return [path for part in (value.values() if isinstance(value, dict) else value) for path in _paths(part)]
    return [value] if isinstance(value, Path | RemoteFile) else []


def make_run(run: RunTable, displacement: Displacement, motion: Motion, sensors: Sensors) -> Run:
    """Put the measurements of a run and the keys of its ``[[run]]`` together."""
    if run.mass == "fit" and sensors.drive is None:
        raise FrictrackError(
            'expected a measured drive with mass = "fit" but got none; give drive, or weigh the slider'
        )
    mass, sigma_mass = run.mass if isinstance(run.mass, tuple) else (None, 0.0)
    incline, sigma_incline = run.incline or (0.0, 0.0)
    known: dict[str, Any] = {"mass": mass, "sigma_mass": sigma_mass, "incline": incline, "sigma_incline": sigma_incline}
    known |= dict(zip(("radius", "sigma_radius"), run.radius or (None, 0.0), strict=True))
    known |= {"has_incline": run.incline is not None, "steady": run.is_of_points}
    known |= {key: getattr(run, key) for key in KEYS_OF_RUN}
    known |= {key: _specification(getattr(run, key), key, sensors) for key in ("noise", "drift")}
    measured_with = ("drive", "drive_scatter", "drive_interval", "friction_N", "sigma_friction", "loads")
    known |= {column: getattr(sensors, column) for column in measured_with}
    if sensors.drive is not None and not np.all(measured := np.isfinite(sensors.drive)):
        t, free = sensors.t[measured], run.free or (-np.inf, np.inf)
        known["free"] = (max(free[0], t[0]), min(free[1], t[-1]))
        known["drive"] = np.interp(sensors.t, t, sensors.drive[measured])
    return Run(displacement, motion, **known)


def _specification(found: tuple[float, str] | None, key: str, sensors: Sensors) -> float | None:
    """Return the specification of an instrument in the unit of what it measured: N of friction force, m of position."""
    if found is None:
        return None
    unit = "m" if sensors.friction_N is None else "N"
    if found[1] != unit:
        what = "position" if unit == "m" else "friction force"
        raise FrictrackError(
            f"expected {key} in {unit}, since the {what} was measured, but got {found[0]:g} {found[1]}"
        )
    return found[0]
