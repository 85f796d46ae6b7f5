"""The table of stages of one run, and the work of bringing them up to date.

A stage is made again only when its settings, what it is made from, or the version of frictrack changed: its
key is the hash of those, written beside the result.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from frictrack import models, store
from frictrack.errors import FrictrackError
from frictrack.events import happenings
from frictrack.flow.beside import known, sensed
from frictrack.flow.copies import copy_notes
from frictrack.flow.films import calibrated, recorded, tracked, tracked_beside
from frictrack.flow.tables import own_table, tabled
from frictrack.friction import friction
from frictrack.motion import differentiate, low_pass, trade
from frictrack.plausibility import missing_incline, path_angle
from frictrack.records import (
    Displacement,
    Filtered,
    Friction,
    Happenings,
    Motion,
    Run,
    Track,
    Trade,
)
from frictrack.remote import Remote, local
from frictrack.results import Film, Sensors, plain
from frictrack.store import GroupContent, Provenance
from frictrack.study import RunTable, Study
from frictrack.version import __version__

if TYPE_CHECKING:
    from frictrack.recording import Recording
    from frictrack.tracking import TargetModel

MASS_LAW = "coulomb,viscous"  # beside which the drive tells a mass before anything else is fitted
Progress = Callable[[int, int, str], None]


def silent(done: int, total: int, what: str) -> None:
    """Progress that nobody watches."""


@dataclass(frozen=True)
class Stage:
    """One step of the measuring chain: from the groups `inputs` and some keys of the run to one group."""

    name: str
    inputs: tuple[str, ...]
    settings: tuple[str, ...]  # keys of [[run]] that it depends on
    make: Callable[..., Any]  # (work, *inputs) -> kind
    kind: Any


class RunWork:
    """One run on its way: what is stored is read, what is missing or stale is made and stored.

    Of a run that is `kept` all that is stored counts as current: nothing is made, no recording is opened.
    """

    def __init__(self, study: Study, run: RunTable, progress: Progress = silent, *, kept: bool = False) -> None:
        self.study = study
        self.kept = kept
        self.run = run
        self.path = study.output / f"{run.name}.h5"
        self.stages = FILM if run.video else TABLE
        self._progress = progress
        self.lesson: TargetModel | None = None  # what the film has taught of its target, while it is at hand
        self._film: Recording | None = None
        self._made: dict[str, Any] = {}
        self._keys: dict[str, str] = {}
        self._sources: dict[str, list[tuple[str, str]]] = {}
        self._provenances: dict[str, Provenance | None] = {}

    def progress(self, done: int, total: int, what: str) -> None:
        """Pass on what a stage says of itself, with the run's name."""
        self._progress(done, total, f"{self.run.name}: {what}")

    @cached_property
    def recording(self) -> Recording:
        """The film, opened."""
        from frictrack.recording import open_recording  # noqa: PLC0415 - loads OpenCV; tables do without

        assert self.run.video is not None
        return open_recording(local(self.run.video), fps=self.run.fps)

    @contextmanager
    def filmed(self) -> Iterator[Recording]:
        """The film with random access: a compressed one is decoded once for all that is done inside."""
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
        """The result of a stage, brought up to date; None where the stage has nothing to give."""
        if name not in self._made:
            self._made[name] = self._load(name) if self.is_current(name) else self._make(name)
        return self._made[name]

    def is_current(self, name: str) -> bool:
        """Whether the stored result is what would be made today."""
        provenance = self._provenance(name)
        return provenance is not None and (self.kept or provenance.key == self.key(name))

    def key(self, name: str) -> str:
        """Hash of everything the stage depends on."""
        if self.kept:
            provenance = self._provenance(name)
            return provenance.key if provenance else "never made"
        if name not in self._keys:
            hashes = [found for _, found in self.inputs(name)]
            self._keys[name] = key_of(name, __version__, self.settings(name), hashes)
        return self._keys[name]

    def settings(self, name: str) -> dict[str, Any]:
        """The keys of the study file on which the stage depends, paths as they stand there."""
        return {k: self.written(getattr(self.run, k)) for k in self.stages[name].settings}

    def written(self, value: Any) -> Any:
        """A key's value as JSON has it, a path as the study file has it."""
        if isinstance(value, dict):
            return {key: self.written(part) for key, part in value.items()}
        if isinstance(value, list):
            return [self.written(part) for part in value]
        if isinstance(value, Remote):
            return str(value)
        if not isinstance(value, Path):
            return plain(value)
        inside = value.is_relative_to(self.study.folder)
        return (value.relative_to(self.study.folder) if inside else value).as_posix()

    def _provenance(self, name: str) -> Provenance | None:
        """Where the stored result comes from; of a run that is kept it is read once."""
        if not self.kept:
            return store.provenance(self.path, name)
        if name not in self._provenances:
            self._provenances[name] = store.provenance(self.path, name)
        return self._provenances[name]

    def changed(self) -> list[str]:
        """Keys of the study file that have other values now than when the stored stages were made."""
        held = {name: provenance for name in self.stages if (provenance := self._provenance(name)) is not None}
        pairs = ((json.loads(provenance.settings), plain(self.settings(name))) for name, provenance in held.items())
        return list(dict.fromkeys(key for then, now in pairs for key in now if then.get(key) != now[key]))

    def inputs(self, name: str) -> list[tuple[str, str]]:
        """What a stage is made from: each group with its key, each file with its hash, as they were first looked at.

        ":/track" is a group of the run's own file, "v3.h5:/track" one of a file beside it; all else are inputs.
        """
        if name not in self._sources:
            stage = self.stages[name]
            groups = [(f":/{other}", self.key(other)) for other in stage.inputs]
            if name == "displacement" and self.anchor:
                groups.append((f"{self.anchor.path.name}:/track", self.anchor.key("track")))
            files = [(self.written(path), self.content(path)) for path in self.files(stage)]
            self._sources[name] = groups + files
        return self._sources[name]

    def files(self, *stages: Stage) -> list[Path | Remote]:
        """Files that stages read, all of them unless named."""
        keys = [key for stage in stages or self.stages.values() for key in stage.settings]
        return [path for key in keys for path in _paths(getattr(self.run, key))]

    @cached_property
    def anchor(self) -> RunWork | None:
        """The study's first film, whose point of the body all films follow; None for itself and for tables."""
        first = next((r for r in self.study.runs if r.video), None)
        if first is None or not self.run.video or first.name == self.run.name:
            return None
        return RunWork(self.study, first, self._progress, kept=self.kept)

    def content(self, path: Path | Remote) -> str:
        """Hash of a file, or of the files of a folder. Raises `FrictrackError` where it cannot be read."""
        if path == self.run.video:
            return self.recording.hash
        try:
            return hashed(local(path))
        except OSError as e:
            raise FrictrackError(f"cannot read {path}: {e.strerror or e}") from e

    def _load(self, name: str) -> Any:
        kind = self.stages[name].kind
        if kind is dict:
            return {n: store.read(self.path, f"{name}/{n}", Track) for n in store.names(self.path, name)}
        return store.read(self.path, name, kind)

    def _make(self, name: str) -> Any:
        stage = self.stages[name]
        with self.filmed() if name == "tracks" else nullcontext():  # the track may be made on the way
            made, provenance = self._called(stage, [self.get(i) for i in stage.inputs])
        store.write(self.path, {name: GroupContent(made, provenance)})
        return made

    def _new_provenance(self, name: str) -> Provenance:
        inputs, settings = self.inputs(name), json.dumps(self.settings(name), sort_keys=True)
        together = digest([found for _, found in inputs])
        return Provenance(self.key(name), together, json.dumps(inputs), settings, __version__)

    def _called(self, stage: Stage, inputs: list[Any]) -> tuple[Any, Provenance]:
        """What a stage makes of its inputs; a failure says in which run and stage, and what is known of the film.

        The provenance comes first: a file that changes while it is read then counts as changed, not as what was read.
        """
        try:
            provenance = self._new_provenance(stage.name)
            return stage.make(self, *inputs), provenance
        except FrictrackError as e:
            film = self.get("recording") if self.run.video and stage.name != "recording" else None
            notes = "".join(f" ({note})" for note in film.notes) if film else ""
            where = f'run "{self.run.name}"'
            told = str(e).removeprefix(f"{where}: ")
            raise FrictrackError(f"{where}, {stage.name}: {told}{notes}", usage=e.usage) from e

    def record(self) -> Run:
        """The run as the fit wants it."""
        sensors: Sensors = self.get("sensors")
        return _run(self, self.get("displacement"), self.get("motion"), sensors)


def copied(works: Sequence[RunWork]) -> dict[str, str]:
    """Findings on runs that are the same recording as an earlier one."""
    displacements = {work.run.name: work.get("displacement") for work in works}
    films = {work.run.name: work.get("recording").hash for work in works if work.run.video}
    return copy_notes(displacements, films)


def key_of(name: str, version: str, settings: dict[str, Any], hashes: list[str]) -> str:
    """The key of a stage: hash of its name, the version of frictrack, its settings and the hashes of its inputs."""
    return digest([name, version, settings, hashes])


def hashed(path: Path) -> str:
    """SHA-256 of a file, or of those of the files in a folder. Raises `OSError` where one cannot be read."""
    files = sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [path]
    found = []
    for one in files:
        with one.open("rb") as file:
            found.append(hashlib.file_digest(file, "sha256").hexdigest())
    return found[0] if found == found[:1] else digest(found)


def digest(value: Any) -> str:
    """SHA-256 of anything that JSON can write."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()


def _paths(value: Any) -> list[Path | Remote]:
    """The files that a key names, also inside a table or a list."""
    if isinstance(value, dict | list):
        return [path for part in (value.values() if isinstance(value, dict) else value) for path in _paths(part)]
    return [value] if isinstance(value, Path | Remote) else []


def _tabled(work: RunWork) -> Displacement:
    return tabled(own_table(work.run), work.run)


def _filtered(work: RunWork, displacement: Displacement, sensors: Sensors) -> Filtered:
    return low_pass(displacement, work.run.cutoff, acceleration=known(sensors))


def _friction(work: RunWork, displacement: Displacement, motion: Motion, sensors: Sensors) -> Friction:
    run = _run(work, displacement, motion, sensors)
    if run.mass is not None or run.friction_N is not None:
        return _judged(work, run)
    weighed, says = _weighed(run)
    found = friction(weighed)
    return replace(found, reason=f"{found.reason}; {says}")


def _judged(work: RunWork, run: Run) -> Friction:
    """The friction of a run; where it has no free section, what is missing for one."""
    try:
        return friction(run)
    except FrictrackError as e:
        lacks = missing_incline(run, path_angle(work.get("track")) if "track" in work.stages else None)
        if lacks is None:
            raise
        raise FrictrackError(lacks.words) from e


def _weighed(run: Run) -> tuple[Run, str]:
    """A run of unknown mass with the one that its drive tells beside dry and viscous friction, and words for it."""
    from frictrack.fit import fit  # noqa: PLC0415 - a second that runs of known mass need not wait for

    found = fit(models.parse(MASS_LAW), [run]).parameters["mass.m"]
    if found.value is None or found.std is None:
        raise FrictrackError(f'mass = "fit": {found.reason}')
    says = f"mass {found.value:.4g} ± {found.std:.2g} kg as the drive tells beside Coulomb and viscous friction"
    return replace(run, mass=found.value, sigma_mass=found.std), says


def _run(work: RunWork, displacement: Displacement, motion: Motion, sensors: Sensors) -> Run:
    run = work.run
    if run.mass == "fit" and sensors.drive is None:
        raise FrictrackError(
            'expected a measured drive with mass = "fit" but got none; give drive, or weigh the slider'
        )
    mass, sigma = run.mass if isinstance(run.mass, tuple) else (None, 0.0)
    return Run(
        displacement,
        motion,
        mass=mass,
        sigma_mass=sigma,
        name=run.name,
        incline=run.incline or 0.0,
        has_incline=run.incline is not None,
        normal_load=run.normal_load,
        drive=sensors.drive,
        friction_N=sensors.friction_N,
        free=run.free,
        clamp_x=run.clamp_x,
        beam_length=run.beam_length,
        role=run.role,
        group=run.group,
        noise=_stated(run.noise, "noise", sensors),
        drift=_stated(run.drift, "drift", sensors),
    )


def _stated(found: tuple[float, str] | None, key: str, sensors: Sensors) -> float | None:
    """An instrument's specification in the unit of what was measured: N of a friction force, m of a position."""
    if found is None:
        return None
    unit = "m" if sensors.friction_N is None else "N"
    if found[1] != unit:
        what = "position" if unit == "m" else "friction force"
        raise FrictrackError(
            f"expected {key} in {unit}, since the {what} was measured, but got {found[0]:g} {found[1]}"
        )
    return found[0]


def _chain(*head: Stage) -> dict[str, Stage]:
    """A table of stages: the head, and what every run goes through after its displacement."""
    tail = (
        Stage("sensors", ("displacement",), ("drive", "sensor"), lambda work, d: sensed(work.run, d), Sensors),
        Stage("filtered", ("displacement", "sensors"), ("cutoff",), _filtered, Filtered),
        Stage("motion", ("filtered",), (), lambda work, filtered: differentiate(filtered), Motion),
        Stage("cutoff", ("displacement", "filtered", "motion"), (), lambda work, d, f, m: trade(d, f, m), Trade),
        Stage(
            "friction",
            ("displacement", "motion", "sensors"),
            ("mass", "incline", "normal_load", "free"),
            _friction,
            Friction,
        ),
        Stage(
            "events",
            ("displacement", "motion", "sensors"),
            ("mass", "incline", "normal_load", "free"),
            lambda work, *inputs: happenings(_run(work, *inputs)),
            Happenings,
        ),
    )
    return {stage.name: stage for stage in (*head, *tail)}


FILM = _chain(
    Stage("recording", (), ("video", "fps"), recorded, Film),
    Stage("track", ("recording",), ("target", "template", "exclude", "obstacles"), tracked, Track),
    Stage("tracks", ("recording", "track"), ("reference", "targets", "obstacles"), tracked_beside, dict),
    Stage(
        "displacement",
        ("tracks", "track"),
        ("scale", "lens", "axis", "origin_px", "x_offset"),
        lambda work, tracks, track: calibrated(work, track, tracks),
        Displacement,
    ),
)
TABLE = _chain(
    Stage("displacement", (), ("table", "columns", "fps", "scale", "x_offset"), _tabled, Displacement),
)
