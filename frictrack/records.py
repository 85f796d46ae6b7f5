"""Define the frozen records that pass from stage to stage; their fields are in SI units and are checked once.

Most records are tables: one row per frame, with NumPy columns of the same length that are read-only. The metadata of a
field names its unit, which the store writes beside the numbers. NaN means "not measured in this frame" in the columns
that allow it. The comments beside the fields appear in ``store/SCHEMA.md``.
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
    """Declare a column of a record.

    Parameters
    ----------
    unit
        Unit of the values.
    nan
        Allow NaN, which means "not measured in this frame".
    kind
        NumPy type of the values.
    **options
        For `dataclasses.field`, for example a default.

    """
    return field(metadata={"unit": unit, "nan": nan, "column": True, "kind": kind}, **options)


def stretches(mask: Mask) -> list[slice]:
    """Return the slices of consecutive True in a mask (n,).

    Examples
    --------
    >>> stretches(np.array([True, True, False, True]))
    [slice(0, 2, None), slice(3, 4, None)]

    """
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False]))))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def scalar(unit: str, **options: Any) -> Any:
    """Declare a number of a record, with its unit.

    Parameters
    ----------
    unit
        Unit of the number.
    **options
        For `dataclasses.field`.

    """
    return field(metadata={"unit": unit}, **options)


class FrameTable:
    """Base of the records with one row per frame; checks the columns when a record is built.

    All columns have the same length, are finite unless NaN is allowed, and become read-only; time rises.

    Raises
    ------
    FrictrackError
        If a column is wrong.

    """

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
        """Return the record with some of its rows.

        Parameters
        ----------
        part
            The rows; at least two remain.

        """
        columns = {f.name: getattr(self, f.name) for f in fields(self) if f.metadata.get("column")}  # type: ignore[arg-type]
        return replace(self, **{name: q[part] for name, q in columns.items() if q is not None})  # type: ignore[type-var]


Point = tuple[float, float]
MEASURED = frozenset({"x_px", "y_px", "angle", "sigma_px", "sigma_y_px", "sigma_angle"})  # of a track: NaN if lost


@dataclass(frozen=True, eq=False)
class Track(FrameTable):
    """Positions of the target in the picture, px, one row per frame (pixel centres are integers, y points down).

    A frame in which the target was not found holds NaN and a reason; in the other frames the reason is "".

    Notes
    -----
    `sigma_px`, `sigma_y_px` and `sigma_angle` are standard deviations per frame; `score` is the match score, at most 1.
    Use `found` for the frames in which the target was found and `lost` for the reasons of the others.

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
    systematic: float = scalar("px", default=0.0)  # rms of the slowly varying error of the positions, besides the noise
    notes: tuple[str, ...] = ()  # notes on the measurement
    sigma_angle: Array | None = column("rad", nan=True, default=None)
    outline: tuple[Point, ...] = ()  # corners of the target in frame `template`, px, if it is not a rectangle
    exclude: tuple[tuple[Point, ...], ...] = ()  # polygons in that frame that do not belong to the target
    obstacles: tuple[tuple[Point, ...], ...] = ()  # polygons fixed in the picture, behind which the target passes

    @property
    def found(self) -> Mask:
        """Frames (n,) in which the target was found."""
        return np.isfinite(self.x_px)

    @property
    def lost(self) -> Counter[str]:
        """Reasons why the target was lost, each with its number of frames.

        Reasons that differ only in a number count as one.
        """
        poor = "match score"
        return Counter(f"{poor} too low" if why.startswith(poor) else why for why in self.reason.tolist() if why)


@dataclass(frozen=True, eq=False)
class Displacement(FrameTable):
    """Unfiltered displacement along the course (x) and across it (y, upward), with its standard deviation.

    Notes
    -----
    `x`, `y`, `sigma_x`, `sigma_y` are in m, `angle` in rad, NaN where not measured. Frames with `valid` False are
    outliers. `pixel_pitch` is the size of a pixel on the course, None for tables.

    """

    t: Array = column("s")
    x: Array = column("m", nan=True)
    y: Array = column("m", nan=True)
    angle: Array = column("rad", nan=True)
    sigma_x: Array = column("m", nan=True)
    sigma_y: Array = column("m", nan=True)
    valid: Mask = column("", kind=np.bool_)
    pixel_pitch: float | None = scalar("m", default=None)
    relative_scale_error: float = scalar("1", default=0.0)
    systematic: float = scalar("m", default=0.0)  # rms of the slowly varying error of the tracker, besides its noise
    shake: tuple[float, ...] = ()  # camera shake that may be left: frequency in Hz, rms along x in m
    notes: tuple[str, ...] = ()
    resolution: float = scalar("m", default=0.0)  # step of which all x are multiples, if it exceeds the noise
    sigma_angle: Array | None = column("rad", nan=True, default=None)

    @property
    def known(self) -> Mask:
        """Frames (n,) in which x was measured."""
        return np.asarray(self.valid & np.isfinite(self.x))

    @property
    def span(self) -> slice:
        """Rows from the first to the last frame in which x was measured; all rows if there are fewer than two."""
        frames = np.flatnonzero(self.known)
        return slice(int(frames[0]), int(frames[-1]) + 1) if len(frames) > 1 else slice(0, len(self))


@dataclass(frozen=True, eq=False)
class Filtered(FrameTable):
    """Low-passed displacement, with what `differentiate` needs to compute standard deviations.

    Notes
    -----
    `x` and `y` are the smoothed displacement, m. `smoother` and `smoother_y` describe the smoother completely, so that
    its derivatives and their standard deviations can be computed later.

    """

    t: Array = column("s")
    x: Array = column("m")
    y: Array = column("m", nan=True)
    sigma_x: Array = column("m", nan=True)  # of the unfiltered input, inf where a frame was missing (it was filled)
    sigma_y: Array = column("m", nan=True)
    cutoff: float = scalar("Hz", default=float("nan"))  # of a plain low-pass; `reason` describes what was done
    cutoff_y: float = scalar("Hz", default=float("nan"))
    asked: bool = False  # whether the user gave that cut-off
    smoother: str = ""  # JSON: the smoother of x
    smoother_y: str = ""
    reason: str = ""  # components into which x was separated, and why
    events: tuple[tuple[int, int], ...] = ()  # first and last row of fast events, such as an impact
    lines: tuple[float, ...] = ()  # Hz, vibrations that were separated from the trend
    shake: tuple[float, ...] = ()  # camera shake that may be left: frequency in Hz, rms along x in m
    y_measured: Array | None = column("m", nan=True, default=None)
    x_measured: Array | None = column("m", nan=True, default=None)  # unfiltered, if later stages need it
    sigma_sensor: Array | None = column("m/s^2", nan=True, default=None)  # of a fused acceleration, inf without one


@dataclass(frozen=True, eq=False)
class Motion(FrameTable):
    """Smoothed displacement, velocity and acceleration with their standard deviations, one row per frame.

    Notes
    -----
    `x` (m), `v` (m/s) and `a` (m/s^2) are along the course, `a_y` (m/s^2) is across it. Rows closer than `guard` to
    either end or to a jump are distorted by the smoother.

    """

    t: Array = column("s")
    x: Array = column("m")
    v: Array = column("m/s")
    a: Array = column("m/s^2")
    a_y: Array = column("m/s^2", nan=True)
    sigma_x: Array = column("m")
    sigma_v: Array = column("m/s")
    sigma_a: Array = column("m/s^2")
    sigma_a_y: Array = column("m/s^2", nan=True)
    guard: int = 0  # frames at either end and around a jump that the smoother distorts
    cutoff: float = scalar("Hz", default=float("nan"))
    events: tuple[tuple[int, int], ...] = ()  # first and last row of fast events
    lines: tuple[float, ...] = ()  # Hz, vibrations
    shake_a: float = scalar("m/s^2", default=0.0)  # rms part of sigma_a that is due to residual camera shake


@dataclass(frozen=True, eq=False)
class Friction(FrameTable):
    """Friction force F = D - m a and the free section in which it is evaluated, one row per frame.

    F > 0 resists motion toward +x. D is the drive force, m the mass, a the acceleration.
    """

    t: Array = column("s")
    F: Array = column("N")
    sigma_F: Array = column("N")
    free: Mask = column("", kind=np.bool_)
    reason: str = ""  # why the free section begins and ends there


@dataclass(frozen=True, eq=False)
class CutoffTradeOff:
    """Error of the acceleration by the cut-off frequency of a plain low-pass; all columns (k,).

    `residual` is the rms of what the low-pass removes and `floor` that of white noise alone, m. `noise` and `lost` are
    the noise that passes and the signal that is removed, m/s^2.
    """

    frequency: Array = column("Hz")
    residual: Array = column("m")
    floor: Array = column("m")
    noise: Array = column("m/s^2")
    lost: Array = column("m/s^2")
    hidden: Array = column("m/s^2")  # rms of the largest vibration of that frequency that would not be detected
    chosen: float = scalar("Hz", default=float("nan"))  # cut-off of highest likelihood, or as given
    least: float = scalar("Hz", default=float("nan"))  # cut-off with the smallest sum of noise and lost signal
    structural: float = scalar("m/s^2", default=float("nan"))  # rms of sigma_a with trend, lines and events separated
    warnings: tuple[str, ...] = ()

    @property
    def total(self) -> Array:
        """Noise and lost signal together (k,), m/s^2."""
        return np.asarray(np.hypot(self.noise, self.lost))

    def at(self, frequency: float) -> tuple[float, float]:
        """Interpolate noise and lost signal at one cut-off, m/s^2.

        Parameters
        ----------
        frequency
            The cut-off, Hz.

        """
        place = np.log(frequency), np.log(self.frequency)
        return float(np.interp(*place, self.noise)), float(np.interp(*place, self.lost))


@dataclass(frozen=True)
class RunEvents:
    """Events of a run: (kind, from, to) in s, in order; rests (from, to) in s; and the noise during the rests, m.

    Kinds: release, impact, stop, start, reversal.
    """

    events: tuple[tuple[str, float, float], ...] = ()
    rests: tuple[tuple[float, float], ...] = ()
    noise_at_rest: float = scalar("m", default=float("nan"))


GRAVITY = 9.80665  # m/s^2, standard


@dataclass(frozen=True, eq=False)
class Run:
    """One recorded slide: its motion and the properties of the slider.

    The run covers the frames of `motion`; other frames of `displacement`, `drive` and `friction_N` are cut off.

    Parameters
    ----------
    displacement, motion
        The measured displacement, and what `differentiate` made of it.
    mass, sigma_mass
        Sliding mass and its standard deviation, kg. None: it is fitted if the drive is measured; otherwise only
        measured friction can be identified.
    name
        Name of the run.
    incline
        Angle of the course, rad; positive if it rises toward +x.
    normal_load
        Normal load, N; by default m g cos(incline).
    drive, friction_N
        Measured drive and friction force at the frames of `displacement`, N, (n,).
    free
        Begin and end of the free section, s, instead of the one that is found.
    clamp_x, beam_length
        Position of the clamp of a beam under the course and its free length, m.
    role
        "fit", or "validation" for a run that is predicted and not fitted.
    group
        Name of a group of runs, for fits per group.
    noise, drift
        Stated white noise and slow error, rms: N if friction was measured, else m.
    has_incline
        Whether gravity drives the run: the free section then starts when motion starts.

    Raises
    ------
    FrictrackError
        If the parts do not fit together.

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
    clamp_x: float | None = scalar("m", default=None)
    beam_length: float | None = scalar("m", default=None)
    role: str = "fit"
    group: str = ""
    noise: float | None = None
    drift: float | None = None
    has_incline: bool = False

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
        """Cut off the frames before the first and after the last one of the motion."""
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
        """Size of a pixel on the course, m; None without a camera."""
        return self.displacement.pixel_pitch

    @property
    def load(self) -> float | None:
        """Normal load, N: as given, else m g cos(incline); None without a mass."""
        if self.normal_load is not None:
            return self.normal_load
        return None if self.mass is None else self.mass * GRAVITY * float(np.cos(self.incline))


@dataclass(frozen=True, eq=False)
class Curve(FrameTable):
    """Measurement and fitted model of one run, at the frames that were fitted (or predicted)."""

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
        """Measured minus modelled displacement (n,), m."""
        return self.x - self.x_model


@dataclass(frozen=True, eq=False)
class ModelledMotion(FrameTable):
    """Motion of one run by the fitted model, at the frames that were fitted (or predicted).

    Standard deviations are those of the fit; mass and scale errors, common to all runs, are not included. They are NaN
    if the model is too far from the data to be linearised.
    """

    t: Array = column("s")
    x: Array = column("m")  # of the slider, without measurement effects
    v: Array = column("m/s")
    a: Array = column("m/s^2")
    F: Array = column("N")
    sigma_x: Array = column("m", nan=True)
    sigma_v: Array = column("m/s", nan=True)
    sigma_a: Array = column("m/s^2", nan=True)
    sigma_F: Array = column("N", nan=True)
    blow: Mask = column("", kind=np.bool_)  # frames of a collision too short to be resolved: a and F are unknown there
    segment: NDArray[np.int_] = column("", kind=np.int_)  # number of the segment that a frame belongs to
    run: str = "run"
    role: str = "fit"
    notes: tuple[str, ...] = ()  # how the standard deviations were computed if the model lacks something
