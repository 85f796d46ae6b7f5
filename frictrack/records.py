"""The frozen types that flow between the rooms: SI units declared per field, checked once when built.

Every record of the measuring chain is a table: one row per frame, columns that are numpy arrays of the same
length, read-only once inside. ``field(metadata={"unit": "m"})`` names the unit, which `store` writes beside
the numbers. A column is checked by its metadata: ``nan=True`` lets NaN mean "not measured in this frame".
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from frictrack.errors import raise_faults

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def column(unit: str, *, nan: bool = False, kind: Any = np.float64, **options: Any) -> Any:
    """Declare an array field of a record: one value per frame, with its unit."""
    return field(metadata={"unit": unit, "nan": nan, "column": True, "kind": kind}, **options)


def stretches(mask: Mask) -> list[slice]:
    """Slices of consecutive True of a mask (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False]))))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def scalar(unit: str, **options: Any) -> Any:
    """Declare a number field of a record, with its unit."""
    return field(metadata={"unit": unit}, **options)


class FrameTable:
    """Shared border check of the records: same length, finite unless allowed, time rising, read-only."""

    min_rows: ClassVar[int] = 2

    def __post_init__(self) -> None:
        faults: list[str] = []
        n = len(np.atleast_1d(np.asarray(self.t)))  # type: ignore[attr-defined]
        if n < self.min_rows:
            faults.append(f"expected at least {self.min_rows} frames but got {n}")
        for f in fields(self):  # type: ignore[arg-type]
            if f.metadata.get("column"):
                faults += self._check_column(f.name, f.metadata, n)
        t = self.t  # type: ignore[attr-defined]
        if not faults and np.any(np.diff(t) <= 0):
            i = int(np.argmax(np.diff(t) <= 0))
            faults.append(f"expected rising time but got t[{i + 1}] = {t[i + 1]:g} s after t[{i}] = {t[i]:g} s")
        raise_faults(faults, type(self).__name__)

    def _check_column(self, name: str, meta: Any, n: int) -> list[str]:
        value = getattr(self, name)
        if value is None:
            return []
        array = np.array(value, dtype=meta["kind"])
        if array.shape != (n,):
            return [f"expected {name} of shape ({n},) but got {array.shape}"]
        array.setflags(write=False)
        object.__setattr__(self, name, array)
        if array.dtype.kind == "f" and not meta["nan"] and not np.all(np.isfinite(array)):
            bad = int(np.argmin(np.isfinite(array)))
            return [f"expected finite {name} but got {array[bad]} at row {bad}"]
        return []

    def __len__(self) -> int:
        return len(self.t)  # type: ignore[attr-defined]

    def rows(self, part: slice) -> Self:
        """The same record with some of its rows."""
        columns = {f.name: getattr(self, f.name) for f in fields(self) if f.metadata.get("column")}  # type: ignore[arg-type]
        return replace(self, **{name: q[part] for name, q in columns.items() if q is not None})  # type: ignore[type-var]


Point = tuple[float, float]
MEASURED = frozenset({"x_px", "y_px", "angle", "sigma_px", "sigma_y_px", "sigma_angle"})  # of a track: NaN where lost


@dataclass(frozen=True, eq=False)
class Track(FrameTable):
    """Where the target is in every frame, in pixels of the picture (pixel centres are integers, y down).

    A frame in which the target was not found holds NaN and a reason; a found frame has the reason "".
    """

    t: Array = column("s")
    x_px: Array = column("px", nan=True)
    y_px: Array = column("px", nan=True)
    angle: Array = column("rad", nan=True)
    sigma_px: Array = column("px", nan=True)
    sigma_y_px: Array = column("px", nan=True)
    score: Array = column("1", nan=True)
    reason: NDArray[np.str_] = column("", kind=np.str_)
    name: str = "target"
    target: tuple[float, float, float, float] | None = None  # rectangle x, y, w, h in frame `template`, px
    template: int = 0  # number of the frame in which `target` stands
    picture: Array | None = None  # the target averaged over the run, grey values
    systematic: float = scalar("px", default=0.0)  # rms by which places are off slowly, beside the noise
    notes: tuple[str, ...] = ()  # measurement findings, in words
    sigma_angle: Array | None = column("rad", nan=True, default=None)
    outline: tuple[Point, ...] = ()  # corners of the target in frame `template`, px, where it is no rectangle
    exclude: tuple[tuple[Point, ...], ...] = ()  # polygons there that are no part of it
    obstacles: tuple[tuple[Point, ...], ...] = ()  # polygons fixed in the picture that it passes behind

    @property
    def found(self) -> Mask:
        """Frames in which the target was found."""
        return np.isfinite(self.x_px)

    @property
    def lost(self) -> Counter[str]:
        """Why it was not found, and in how many frames; reasons that differ only in their number count as one."""
        poor = "match score"
        return Counter(f"{poor} too low" if why.startswith(poor) else why for why in self.reason.tolist() if why)


@dataclass(frozen=True, eq=False)
class Displacement(FrameTable):
    """Unfiltered displacement along the course (x) and across it (y, up), with its standard deviation."""

    t: Array = column("s")
    x: Array = column("m", nan=True)
    y: Array = column("m", nan=True)
    angle: Array = column("rad", nan=True)
    sigma_x: Array = column("m", nan=True)
    sigma_y: Array = column("m", nan=True)
    valid: Mask = column("", kind=np.bool_)
    pixel_pitch: float | None = scalar("m", default=None)
    relative_scale_error: float = scalar("1", default=0.0)
    systematic: float = scalar("m", default=0.0)  # rms of what a tracker is off by slowly, beside its noise
    shake: tuple[float, ...] = ()  # what may be left of a camera shake: frequency in Hz, rms along x in m
    notes: tuple[str, ...] = ()
    resolution: float = scalar("m", default=0.0)  # step of which all x are multiples, where it exceeds the noise
    sigma_angle: Array | None = column("rad", nan=True, default=None)

    @property
    def known(self) -> Mask:
        """Frames (n,) in which x was measured."""
        return np.asarray(self.valid & np.isfinite(self.x))

    @property
    def span(self) -> slice:
        """From the first to the last frame in which x was measured; all frames where these are fewer than two."""
        frames = np.flatnonzero(self.known)
        return slice(int(frames[0]), int(frames[-1]) + 1) if len(frames) > 1 else slice(0, len(self))


@dataclass(frozen=True, eq=False)
class Filtered(FrameTable):
    """Low-passed displacement; what `differentiate` needs to state standard deviations comes with it."""

    t: Array = column("s")
    x: Array = column("m")
    y: Array = column("m", nan=True)
    sigma_x: Array = column("m", nan=True)  # of the unfiltered input, inf where a frame was missing (it was filled)
    sigma_y: Array = column("m", nan=True)
    cutoff: float = scalar("Hz", default=float("nan"))  # of a plain low-pass; see `reason` for what was done
    cutoff_y: float = scalar("Hz", default=float("nan"))
    asked: bool = False  # whether that cut-off was asked for
    smoother: str = ""  # JSON: what low-passed x
    smoother_y: str = ""
    reason: str = ""  # what x was parted into and why
    events: tuple[tuple[int, int], ...] = ()  # first and last row of what happens faster than the slide: an impact
    lines: tuple[float, ...] = ()  # Hz, vibrations that were followed apart from the trend
    shake: tuple[float, ...] = ()  # what may be left of a camera shake: frequency in Hz, rms along x in m
    y_measured: Array | None = column("m", nan=True, default=None)
    x_measured: Array | None = column("m", nan=True, default=None)  # unfiltered, where what follows needs it
    sigma_sensor: Array | None = column("m/s^2", nan=True, default=None)  # of an acceleration taken in, inf where none


@dataclass(frozen=True, eq=False)
class Motion(FrameTable):
    """Smoothed displacement, velocity and acceleration with their standard deviations."""

    t: Array = column("s")
    x: Array = column("m")
    v: Array = column("m/s")
    a: Array = column("m/s^2")
    a_y: Array = column("m/s^2", nan=True)
    sigma_x: Array = column("m")
    sigma_v: Array = column("m/s")
    sigma_a: Array = column("m/s^2")
    sigma_a_y: Array = column("m/s^2", nan=True)
    guard: int = 0  # frames at either end, and round a jump, that the filter smears
    cutoff: float = scalar("Hz", default=float("nan"))
    events: tuple[tuple[int, int], ...] = ()  # first and last row of what happens faster than the slide
    lines: tuple[float, ...] = ()  # Hz, vibrations
    shake_a: float = scalar("m/s^2", default=0.0)  # of sigma_a, rms: what is left of a camera shake feigns it


@dataclass(frozen=True, eq=False)
class Friction(FrameTable):
    """Friction force F = D - m a (F > 0 resists motion toward +x) and the free section it is judged on."""

    t: Array = column("s")
    F: Array = column("N")
    sigma_F: Array = column("N")
    free: Mask = column("", kind=np.bool_)
    reason: str = ""  # why the free section begins and ends where it does


@dataclass(frozen=True, eq=False)
class CutoffTradeOff:
    """Residual and floor (m), noise, lost and hidden signal in acceleration (m/s^2), by frequency (Hz); all (k,)."""

    frequency: Array = column("Hz")
    residual: Array = column("m")
    floor: Array = column("m")
    noise: Array = column("m/s^2")
    lost: Array = column("m/s^2")
    hidden: Array = column("m/s^2")  # rms that a vibration of that frequency could have without being seen
    chosen: float = scalar("Hz", default=float("nan"))  # of the plain low-pass of the highest likelihood, or as given
    least: float = scalar("Hz", default=float("nan"))  # where noise and lost signal together are smallest
    structural: float = scalar("m/s^2", default=float("nan"))  # rms of sigma_a with trend, lines and events apart
    warnings: tuple[str, ...] = ()

    @property
    def total(self) -> Array:
        """Noise and lost signal together (k,), m/s^2."""
        return np.asarray(np.hypot(self.noise, self.lost))

    def at(self, frequency: float) -> tuple[float, float]:
        """Noise and lost signal at a cut-off, m/s^2."""
        place = np.log(frequency), np.log(self.frequency)
        return float(np.interp(*place, self.noise)), float(np.interp(*place, self.lost))


@dataclass(frozen=True)
class RunEvents:
    """What happens in a run: (kind, from, to) in s, in order; rests (from, to) in s; and the noise seen there, m.

    Kinds: release, impact, stop, start, reversal.
    """

    events: tuple[tuple[str, float, float], ...] = ()
    rests: tuple[tuple[float, float], ...] = ()
    noise_at_rest: float = scalar("m", default=float("nan"))


GRAVITY = 9.80665  # m/s^2, standard


@dataclass(frozen=True, eq=False)
class Run:
    """One recorded slide: its motion and what is known of the slider.

    The run covers the frames of `motion`: what the displacement, `drive` and `friction_N` hold beyond them is cut off.
    `drive` and `friction_N` are given at the frames of `displacement`. `free` overrides the free section.
    `pixel_pitch` (m) belongs to the displacement. Without `mass`, it is fitted
    where the drive is measured; otherwise only measured friction can be identified.
    """

    displacement: Displacement
    motion: Motion
    mass: float | None = scalar("kg", default=None)
    name: str = "run"
    sigma_mass: float = scalar("kg", default=0.0)
    incline: float = scalar("rad", default=0.0)
    normal_load: float | None = scalar("N", default=None)
    drive: Array | None = None  # N, at displacement.t
    friction_N: Array | None = None  # N, at displacement.t
    free: tuple[float, float] | None = None  # s
    clamp_x: float | None = scalar("m", default=None)  # where the beam under the course is clamped
    beam_length: float | None = scalar("m", default=None)
    role: str = "fit"  # or "validation"
    group: str = ""
    noise: float | None = None  # stated white noise, rms: N where friction was measured, else m
    drift: float | None = None  # stated slow error, rms, in the same unit
    has_incline: bool = False  # gravity drives the run: the free section starts where motion starts

    def __post_init__(self) -> None:
        faults = []
        self._cut_to_motion()
        if self.mass is not None and not (np.isfinite(self.mass) and self.mass > 0):
            faults.append(f"expected a mass above 0 kg but got {self.mass:g} kg; give the mass that slides")
        if self.mass is None and self.friction_N is None and self.drive is None:
            faults.append(
                "expected a mass but got none; only runs with measured friction (friction_N), or with a measured drive "
                'and mass = "fit", do without'
            )
        if len(self.displacement) != len(self.motion):
            faults.append(f"expected motion of the same {len(self.displacement)} frames but got {len(self.motion)}")
        for name in ("drive", "friction_N"):
            value = getattr(self, name)
            if value is not None and np.shape(value) != (len(self.displacement),):
                faults.append(f"expected {name} at {len(self.displacement)} frames but got {np.shape(value)}")
        if self.role not in ("fit", "validation"):
            faults.append(f'expected role "fit" or "validation" but got "{self.role}"')
        raise_faults(faults, f'run "{self.name}"')

    def _cut_to_motion(self) -> None:
        """Leave out the frames before the first and after the last one that the motion covers."""
        n, first = len(self.displacement), int(np.searchsorted(self.displacement.t, self.motion.t[0]))
        part = slice(first, first + len(self.motion))
        if len(self.motion) == n or not np.array_equal(self.displacement.t[part], self.motion.t):
            return
        object.__setattr__(self, "displacement", self.displacement.rows(part))
        for name in ("drive", "friction_N"):
            value = getattr(self, name)
            if np.shape(value) == (n,):
                object.__setattr__(self, name, np.asarray(value)[part])

    @property
    def pixel_pitch(self) -> float | None:
        """Metres per pixel, when a camera is known."""
        return self.displacement.pixel_pitch

    @property
    def load(self) -> float | None:
        """Normal load in N: given, else m g cos(incline)."""
        if self.normal_load is not None:
            return self.normal_load
        return None if self.mass is None else self.mass * GRAVITY * float(np.cos(self.incline))


@dataclass(frozen=True, eq=False)
class Curve(FrameTable):
    """One run's measurement beside the fitted model, over the frames that were fitted (or predicted)."""

    t: Array = column("s")
    x: Array = column("m")  # measured displacement
    sigma_x: Array = column("m")
    x_model: Array = column("m")  # fitted displacement, measurement effects included
    v_model: Array = column("m/s")
    a_model: Array = column("m/s^2")
    F_model: Array = column("N")
    run: str = "run"
    role: str = "fit"
    parts: dict[str, Array] = field(default_factory=dict)  # force of each effect, N

    @property
    def residual(self) -> Array:
        """Measured minus modelled displacement, m."""
        return self.x - self.x_model


@dataclass(frozen=True, eq=False)
class ModelledMotion(FrameTable):
    """The motion of one run that a fitted model itself tells, at the frames that were fitted (or predicted).

    The standard deviations are those of the fit: mass and scale are common to all runs and stand apart. NaN: a law
    too far off to be linearised.
    """

    t: Array = column("s")
    x: Array = column("m")  # of the slider, without what measurement effects add to the picture
    v: Array = column("m/s")
    a: Array = column("m/s^2")
    F: Array = column("N")
    sigma_x: Array = column("m", nan=True)
    sigma_v: Array = column("m/s", nan=True)
    sigma_a: Array = column("m/s^2", nan=True)
    sigma_F: Array = column("N", nan=True)
    blow: Mask = column("", kind=np.bool_)  # frames of a collision too short to be resolved: a, F are not known there
    segment: NDArray[np.int_] = column("", kind=np.int_)  # number of the stretch that a frame belongs to
    run: str = "run"
    role: str = "fit"
    notes: tuple[str, ...] = ()  # what the bands rest on where the model misses something, in words
