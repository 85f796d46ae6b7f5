"""What a whole study has come to: the one thing that `report`, `plots` and `export` are given.

`flow` fills it from the store; nothing here computes or opens a file.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

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


@dataclass(frozen=True, eq=False)
class RecordingInfo(FrameTable):
    """What stays of a recording once it is tracked: its clock, its identity and its first picture."""

    t: Array = column("s")
    path: str = ""  # as the study file names it
    fps: float = scalar("Hz", default=float("nan"))
    n_frames: int = 0
    bit_depth: int = 8
    hash: str = ""  # sha256 of the file, or of the files of a folder
    picture: NDArray[Any] = field(default_factory=lambda: np.zeros((0, 0)))  # first frame, grey values
    notes: tuple[str, ...] = ()  # findings about the time base, in words
    audit: tuple[tuple[str, str, str], ...] = ()  # of the time base: what was looked at, its value, the verdict
    exposure: float | None = scalar("s", default=None)
    clocked: bool = False  # the camera wrote time stamps, so that no frame can be missing unnoticed


@dataclass(frozen=True, eq=False)
class Sensors(FrameTable):
    """What was measured beside the motion, on the camera's clock at the frames of the displacement."""

    t: Array = column("s")
    drive: Array | None = column("N", default=None)
    a: Array | None = column("m/s^2", nan=True, default=None)  # as the accelerometer has it, NaN where it did not run
    friction_N: Array | None = column("N", default=None)
    known_a: Array | None = column("m/s^2", nan=True, default=None)  # `a` without its gain and bias, if consistent
    sigma_known_a: float | None = scalar("m/s^2", default=None)  # its white noise
    clocks: dict[str, Any] = field(default_factory=dict)  # drive, a, friction_N -> offset_s, gain, verdict, ...
    notes: tuple[str, ...] = ()  # what was found of clocks and agreement, in words


@dataclass(frozen=True, eq=False)
class RunResults:
    """One run, every stage that has been done. `film`, `track` are None for a table, `sensors` for a film."""

    name: str
    source: str  # path of the film or the table, as the study file names it
    displacement: Displacement
    filtered: Filtered
    motion: Motion
    happenings: RunEvents = field(default_factory=RunEvents)
    cutoff: CutoffTradeOff | None = None
    friction: Friction | None = None  # None without a mass and without measured friction
    film: RecordingInfo | None = None
    track: Track | None = None
    tracks: dict[str, Track] = field(default_factory=dict)  # the reference and further targets
    sensors: Sensors | None = None
    quality: dict[str, Any] = field(default_factory=dict)  # what the film says of its own measurement: see flow.quality
    budget: dict[str, Any] = field(default_factory=dict)  # errors of the friction force by source: see flow.budgets
    role: str = "fit"
    group: str = ""
    settings: dict[str, Any] = field(default_factory=dict)  # the run's keys, inherited ones too
    hashes: dict[str, str] = field(default_factory=dict)  # stage -> key of what it was made from
    notes: tuple[str, ...] = ()  # findings of all stages, in words, no doubles

    @property
    def mass(self) -> float | None:
        """Mass in kg where it was weighed."""
        written = self.settings.get("mass")
        return float(written[0]) if isinstance(written, tuple | list) else None


@dataclass(frozen=True, eq=False)
class ModelResults:
    """One model that was tried."""

    name: str  # "1_tustin", the group's name in the store
    equation: str  # the printed model
    summary: dict[str, Any]  # JSON of `frictrack fit`
    curves: tuple[Curve, ...]
    current: bool = False
    diagnosis: dict[str, Any] | None = None  # JSON of `frictrack diagnose` on this model, where it was asked
    figures: dict[str, dict[str, Array]] = field(default_factory=dict)  # small curves of that diagnosis
    motion: tuple[
        ModelledMotion, ...
    ] = ()  # the model's own, one per run; none of a model stored before there was such


@dataclass(frozen=True, eq=False)
class Results:
    """A study: its runs, the models tried in order, and what the comparison and the diagnosis say."""

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
    notes: tuple[str, ...] = ()  # what could not be done, in words
    warnings: tuple[str, ...] = ()  # numbers of the study that are implausible, in words
    outdated: tuple[str, ...] = ()  # what was changed in the study file since all this was made, in words

    @property
    def current(self) -> ModelResults | None:
        """The model in force: the last one tried."""
        return next((m for m in reversed(self.models) if m.current), None)


def to_builtins(value: Any) -> Any:
    """The same value in what JSON knows: numpy becomes Python, what is not finite becomes None."""
    if isinstance(value, dict):
        return {str(k): to_builtins(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return to_builtins(value.tolist())
    if isinstance(value, tuple | list):
        return [to_builtins(v) for v in value]
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value
