"""Define the results of a whole study, which `report`, `plots` and `export` take.

`flow` fills them from the store; nothing here computes or opens a file.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from frictrack.records import (
    Array,
    Curve,
    CutoffTradeOff,
    Displacement,
    Filtered,
    FrameTable,
    Friction,
    ModelledMotion,
    Motion,
    RunEvents,
    Track,
    column,
    scalar,
)
from frictrack.search import Convergence

BACKWARD = "backward"  # name of the track of the target from the last frame to the first, which is a check


@dataclass(frozen=True, eq=False)
class RecordingInfo(FrameTable):
    """What is stored of a recording: its clock, its identity and its first frame.

    `fps` is the frame rate that is used, Hz. `t` are the times of the frames, s. `audit` lists every check of the time
    base.
    """

    t: Array = column("s")
    path: str = ""  # as the study file names it
    fps: float = scalar("Hz", default=float("nan"))
    n_frames: int = 0
    bit_depth: int = 8
    hash: str = ""  # sha256 of the file, or of the files of a folder; of a remote film what the store states
    picture: NDArray[Any] = field(default_factory=lambda: np.zeros((0, 0)))  # first frame, grey values
    notes: tuple[str, ...] = ()  # notes on the time base
    audit: tuple[tuple[str, str, str], ...] = ()  # of the time base: what was checked, its value, the verdict
    exposure: float | None = scalar("s", default=None)
    clocked: bool = False  # the camera wrote time stamps, so a missing frame is always noticed


@dataclass(frozen=True, eq=False)
class Sensors(FrameTable):
    """Quantities that other instruments measured, on the camera's clock at the frames of the displacement.

    A quantity that was not measured is None. `known_a` is the acceleration for the smoother: without gain and bias, and
    only if it agrees with the camera.
    """

    signals: ClassVar[tuple[str, ...]] = ("friction_N", "a", "drive")
    t: Array = column("s")
    drive: Array | None = column("N", nan=True, default=None)  # NaN beyond its record
    drive_scatter: float | None = scalar("N", default=None)  # noise of a drive that is sampled less often
    drive_interval: float | None = scalar("s", default=None)  # between its samples
    a: Array | None = column("m/s^2", nan=True, default=None)  # of the accelerometer, NaN where it did not run
    friction_N: Array | None = column("N", nan=True, default=None)  # NaN where the cell was not read
    sigma_friction: Array | None = column("N", default=None)  # of points (v, F), as `loads`
    loads: Array | None = column("N", default=None)
    known_a: Array | None = column("m/s^2", nan=True, default=None)  # `a` without its gain and bias, if consistent
    sigma_known_a: float | None = scalar("m/s^2", default=None)  # its white noise
    clocks: dict[str, Any] = field(default_factory=dict)  # drive, a, friction_N -> offset_s, gain, verdict, ...
    notes: tuple[str, ...] = ()  # notes on clocks and agreement


@dataclass(frozen=True, eq=False)
class RunResults:
    """The results of one run, with every stage that was computed.

    `film` and `track` are None for a table of positions, `friction` without a mass and without measured friction.
    `quality` and `budget` are the summaries of `frictrack track` and `frictrack friction`.
    """

    name: str
    source: str  # path of the film or the table, as the study file names it
    displacement: Displacement
    filtered: Filtered
    motion: Motion
    events: RunEvents = field(default_factory=RunEvents)
    cutoff: CutoffTradeOff | None = None
    friction: Friction | None = None  # None without a mass and without measured friction
    film: RecordingInfo | None = None
    track: Track | None = None
    tracks: dict[str, Track] = field(default_factory=dict)  # the reference and further targets
    sensors: Sensors | None = None
    quality: dict[str, Any] = field(default_factory=dict)  # how well the film was measured; see flow.track_quality
    budget: dict[str, Any] = field(default_factory=dict)  # error budget of the friction force; see flow.stored_results
    role: str = "fit"
    group: str = ""
    settings: dict[str, Any] = field(default_factory=dict)  # keys of the run, inherited ones included
    hashes: dict[str, str] = field(default_factory=dict)  # stage -> its key
    notes: tuple[str, ...] = ()  # notes of all stages, each once

    @property
    def is_of_points(self) -> bool:
        """Whether its rows are points (v, F) at constant speeds, without time and place."""
        return "v" in (self.settings.get("columns") or {})

    @property
    def all_tracks(self) -> dict[str, Track]:
        """All tracks of a film by name, that of the target first; none for a table."""
        return {} if self.track is None else {self.track.name: self.track, **self.tracks}

    @property
    def mass(self) -> float | None:
        """Mass, kg, if it was weighed."""
        written = self.settings.get("mass")
        return float(written[0]) if isinstance(written, tuple | list) else None


@dataclass(frozen=True, eq=False)
class ModelResults:
    """The results of one model that was tried.

    `summary` is what `frictrack fit --json` prints: parameters, standard deviations, errors per run. `curves` and
    `motion` hold, per run, the measurement beside the model and the motion by the model.
    """

    name: str  # "1_tustin", the group's name in the store
    equation: str  # the printed model
    summary: dict[str, Any]  # JSON of `frictrack fit`
    curves: tuple[Curve, ...]
    current: bool = False
    diagnosis: dict[str, Any] | None = None  # JSON of `frictrack diagnose` on this model, if it was asked for
    figures: dict[str, dict[str, Array]] = field(default_factory=dict)  # small curves of that diagnosis
    motion: tuple[ModelledMotion, ...] = ()  # one per run; empty for models of early versions
    convergence: dict[str, Convergence] = field(default_factory=dict)  # of a global search, by group; "all" without


@dataclass(frozen=True)
class OutdatedPart:
    """A result that does not belong to the study file or the model of now.

    Attributes
    ----------
    what
        "track" (the picture was measured otherwise), "motion", "model", "diagnosis" or "report".
    name
        Name of the run or of the model's group; "" for the report.
    reason
        What has changed since, in one clause.
    command, arguments
        Method of `frictrack.flow.Session` that brings it up to date, and its arguments.

    """

    what: str
    name: str
    reason: str
    command: str
    arguments: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Results:
    """The results of a study: runs, models in the order in which they were tried, comparison and diagnosis.

    Examples
    --------
    Print the parameters of the current model of a study that was run before::

        from frictrack.flow import open_study, read_results
        results = read_results(open_study("study.toml"))
        print(results.current.summary["parameters"])

    """

    name: str
    path: Path  # the study file
    output: Path  # the folder of the results
    version: str  # of frictrack
    runs: tuple[RunResults, ...]
    models: tuple[ModelResults, ...] = ()
    comparison: dict[str, Any] | None = None  # JSON of `frictrack compare`
    diagnosis: dict[str, Any] | None = None  # JSON of `frictrack diagnose` on the current model
    figures: dict[str, dict[str, Array]] = field(default_factory=dict)  # small curves of that diagnosis
    papers: ModelResults | None = None  # the current model by the papers' route: force domain, SGA
    notes: tuple[str, ...] = ()  # what could not be computed
    # numbers of the study: JSON of `frictrack.measure.plausibility.Finding`
    implausible: tuple[dict[str, Any], ...] = ()
    outdated_parts: tuple[OutdatedPart, ...] = ()  # results that do not belong to the study file of now

    @property
    def warnings(self) -> tuple[str, ...]:
        """The implausible numbers of the study as sentences."""
        return tuple(str(found["words"]) for found in self.implausible)

    @property
    def outdated(self) -> tuple[str, ...]:
        """What was changed in the study file since the results were computed, each change once."""
        return tuple(dict.fromkeys(part.reason for part in self.outdated_parts))

    @property
    def current(self) -> ModelResults | None:
        """The current model; None if no model was tried."""
        return next((m for m in reversed(self.models) if m.current), None)


def to_builtins(value: Any) -> Any:
    """Convert a value for JSON: NumPy types become Python types, numbers that are not finite become None.

    Parameters
    ----------
    value
        A number, text, array, list, tuple or dictionary.

    Examples
    --------
    >>> to_builtins({"x": np.array([1.0, np.nan])})
    {'x': [1.0, None]}

    """
    if isinstance(value, dict):
        return {str(k): to_builtins(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return to_builtins(value.tolist())
    if isinstance(value, tuple | list):
        return [to_builtins(v) for v in value]
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value
