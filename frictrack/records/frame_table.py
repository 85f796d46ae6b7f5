"""Records with columns that have units and are checked when a record is built: what was measured, what a model says."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import Field, dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from frictrack.base import imported
from frictrack.base.errors import needs_package, raise_faults

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.figure import Figure


class NotebookView:
    """Base of records and results that can be drawn; a notebook shows their line of text and their figure."""

    drawn_by: ClassVar[str]  # the function that draws it, "package.module:name"; it is imported when it is called

    def plot(self) -> Figure:
        """Draw it as a matplotlib figure."""
        return imported(self.drawn_by)(self)

    def _repr_html_(self) -> str:
        return imported("frictrack.present.plots:html")(self)

    def to_dataframe(self) -> pd.DataFrame:
        """Return it as a pandas DataFrame; ``attrs["units"]`` holds the units of the columns where they differ."""
        raise NotImplementedError

    def to_xarray(self) -> xr.Dataset:
        """Return it as an xarray Dataset, over the time ``t`` or over the rows of the DataFrame; needs xarray.

        Raises
        ------
        FrictrackError
            If xarray is not installed.

        """
        with needs_package("to_xarray", "xarray"):
            import xarray as xr  # noqa: PLC0415 - optional
        frame = self.to_dataframe()
        dataset = xr.Dataset.from_dataframe(frame.set_index("t") if "t" in frame else frame)
        for name, unit in frame.attrs.get("units", {}).items():
            dataset[name].attrs["units"] = unit
        return dataset


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


def mask_of_spans(spans: Iterable[tuple[int, int]], n: int) -> Mask:
    """Return a mask (n,) that is True from the first to the last frame of each span.

    Examples
    --------
    >>> mask_of_spans([(0, 1), (3, 3)], 5).tolist()
    [True, True, False, True, False]

    """
    mask = np.zeros(n, dtype=np.bool_)
    for first, last in spans:
        mask[first : last + 1] = True
    return mask


def away_from_ends(mask: Mask, guard: int) -> Mask:
    """Return a mask (n,) without `guard` frames at the ends of each stretch; one of at most 3 `guard` is kept whole.

    Examples
    --------
    >>> away_from_ends(np.array([True, True, True, True, False, True]), 1).tolist()
    [False, True, True, False, False, True]

    """
    out = np.zeros(len(mask), dtype=bool)
    for one in stretches(mask):
        less = guard if one.stop - one.start > 3 * guard else 0
        out[one.start + less : one.stop - less] = True
    return out


def scalar(unit: str, limits: Mapping[str, float] | None = None, **options: Any) -> Any:
    """Declare a number of a record, with its unit.

    Parameters
    ----------
    unit
        Unit of the number.
    limits
        For `parse_quantity`.
    **options
        For `dataclasses.field`.

    """
    return field(metadata={"unit": unit, "limits": limits or {}}, **options)


def _is_frozen(value: Any, kind: Any) -> bool:
    """Whether a value is an array of that type that nobody can change: it, and what it is a view of, are read-only."""
    if type(value) is not np.ndarray or value.dtype != kind:
        return False
    while isinstance(value, np.ndarray) and not value.flags["W"]:
        value = value.base
    return value is None


class FrameTable(NotebookView):
    """Base of the records with one row per frame; checks the columns when a record is built.

    All columns have the same length, are finite unless NaN is allowed, and become read-only; time rises.

    Raises
    ------
    FrictrackError
        If a column is wrong.

    """

    min_rows: ClassVar[int] = 2
    signals: ClassVar[tuple[str, ...]] = ()  # columns that a viewer draws against t, the first one above all
    drawn_by = "frictrack.present.plots:table"

    def __post_init__(self) -> None:
        faults: list[str] = []
        n = len(np.atleast_1d(np.asarray(self.t)))  # type: ignore[attr-defined]
        if n < self.min_rows:
            faults.append(f"expected at least {self.min_rows} frames but got {n}")
        for f in self._columns():
            faults += self._check_column(f.name, f.metadata, n)
        t = self.t  # type: ignore[attr-defined]
        if not faults and np.any(np.diff(t) <= 0):
            i = int(np.argmax(np.diff(t) <= 0))
            faults.append(f"expected rising time but got t[{i + 1}] = {t[i + 1]:g} s after t[{i}] = {t[i]:g} s")
        raise_faults(faults, type(self).__name__)

    def _columns(self) -> list[Field[Any]]:
        return [f for f in fields(self) if f.metadata.get("column")]  # type: ignore[arg-type]

    def _check_column(self, name: str, meta: Any, n: int) -> list[str]:
        value = getattr(self, name)
        if value is None:
            return []
        array = value if _is_frozen(value, meta["kind"]) else np.array(value, dtype=meta["kind"])
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

    def __repr__(self) -> str:
        name, t = getattr(self, "name", None) or getattr(self, "run", ""), self.t  # type: ignore[attr-defined]
        named = f' "{name}"' if name else ""
        ranges = [text for f in self._columns() if f.name != "t" and (text := self._range_text(f))]
        head = f"{type(self).__name__}{named}: {len(t)} frames, {t[0]:.6g} to {t[-1]:.6g} s"
        return f"<{'; '.join([head, *ranges])}>"

    def _range_text(self, f: Field[Any]) -> str:
        """Smallest and largest value of a numeric column with its unit; empty for others and where nothing is known."""
        values = getattr(self, f.name)
        if values is None or values.dtype.kind != "f" or not np.any(finite := np.isfinite(values)):
            return ""
        known = values[finite]
        low, high = f"{known.min():.4g}", f"{known.max():.4g}"
        return f"{f.name} {low if low == high else f'{low} to {high}'} {f.metadata['unit']}"

    def to_dataframe(self) -> pd.DataFrame:
        """Return the columns as a pandas DataFrame, one row per frame; ``attrs["units"]`` holds their units.

        Examples
        --------
        >>> from frictrack.records import Displacement
        >>> nan = np.full(2, np.nan)
        >>> seen = Displacement([0, 1], [0, 0.5], nan, nan, nan, nan, [True, True])
        >>> seen.to_dataframe()["x"].tolist(), seen.to_dataframe().attrs["units"]["x"]
        ([0.0, 0.5], 'm')

        """
        import pandas as pd  # noqa: PLC0415 - half a second

        known = [f for f in self._columns() if getattr(self, f.name) is not None]
        frame = pd.DataFrame({f.name: getattr(self, f.name) for f in known})
        frame.attrs["units"] = {f.name: f.metadata["unit"] for f in known}
        return frame

    def rows(self, part: slice) -> Self:
        """Return the record with some of its rows; at least two remain."""
        columns = {f.name: getattr(self, f.name) for f in self._columns()}
        return replace(self, **{name: q[part] for name, q in columns.items() if q is not None})  # type: ignore[type-var]


Point = tuple[float, float]
Codes = NDArray[np.int8]  # what was done in a frame; a record without any repaired frame has none
INTERPOLATED = 2  # code in the column `repaired` of a frame without data
MEASURED = frozenset({"x_px", "y_px", "angle", "sigma_px", "sigma_y_px", "sigma_angle"})  # of a track: NaN if lost


@dataclass(frozen=True, eq=False, repr=False)
class Track(FrameTable):
    """Positions of the target in the picture, px, one row per frame (pixel centres are integers, y points down).

    A frame in which the target was not found holds NaN and a reason; in the other frames the reason is "".

    Notes
    -----
    `sigma_px`, `sigma_y_px` and `sigma_angle` are standard deviations per frame; `score` is the match score, at most 1.
    Use `found` for the frames in which the target was found and `lost` for the reasons of the others.

    Examples
    --------
    >>> import frictrack as ft
    >>> film = ft.open_recording(ft.samples.films_folder() / "fast.avi")
    >>> track = ft.track(film)
    >>> float(track.x_px[140].round(1)), bool(track.sigma_px[140] < 0.002)
    (450.9, True)

    """

    signals: ClassVar[tuple[str, ...]] = ("x_px",)
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
    raised: float = scalar("1", default=1.0)  # factor on the deviations by the scatter of positions along the path
    notes: tuple[str, ...] = ()  # notes on the measurement
    sigma_angle: Array | None = column("rad", nan=True, default=None)
    outline: tuple[Point, ...] = ()  # corners of the target in frame `template`, px, if it is not a rectangle
    exclude: tuple[tuple[Point, ...], ...] = ()  # polygons in that frame that do not belong to the target
    obstacles: tuple[tuple[Point, ...], ...] = ()  # polygons fixed in the picture, behind which the target passes
    repaired: Codes | None = column("", kind=np.int8, default=None)  # 0 measured, 1 tracked, 2 interpolated, 3 left out

    @property
    def found(self) -> Mask:
        """Frames (n,) in which the target was found; an interpolated position is not found."""
        known = np.isfinite(self.x_px)
        return known if self.repaired is None else known & (self.repaired != INTERPOLATED)

    @property
    def measured(self) -> Track:
        """The track with NaN in interpolated frames: what counts as data."""
        if self.repaired is None or not np.any(self.repaired == INTERPOLATED):
            return self
        hidden = np.where(self.repaired == INTERPOLATED, np.nan, 0.0)
        return replace(self, **{name: q + hidden for name in MEASURED if (q := getattr(self, name)) is not None})

    @property
    def lost(self) -> Counter[str]:
        """Reasons why the target was lost, each with its number of frames.

        Reasons that differ only in a number count as one.
        """
        poor = "match score"
        return Counter(f"{poor} too low" if why.startswith(poor) else why for why in self.reason.tolist() if why)


@dataclass(frozen=True, eq=False, repr=False)
class Displacement(FrameTable):
    """Unfiltered displacement along the course (x) and across it (y, upward), with its standard deviation.

    Notes
    -----
    `x`, `y`, `sigma_x`, `sigma_y` are in m, `angle` in rad, NaN where not measured. Frames with `valid` False are
    outliers. `pixel_pitch` is the size of a pixel on the course, None for tables.

    Examples
    --------
    >>> import frictrack as ft
    >>> film = ft.open_recording(ft.samples.films_folder() / "fast.avi")
    >>> displacement = ft.calibrate(ft.track(film), scale="0.5 mm/px")
    >>> float(displacement.x[140].round(4)), int(displacement.valid.sum())
    (0.2254, 147)

    """

    signals: ClassVar[tuple[str, ...]] = ("x",)
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
    raised: float = scalar("1", default=1.0)  # factor on sigma_x by scatter that the picture does not tell of
    shake: tuple[float, ...] = ()  # camera shake that may be left: frequency in Hz, rms along x in m
    notes: tuple[str, ...] = ()
    resolution: float = scalar("m", default=0.0)  # step of which all x are multiples, if it exceeds the noise
    stamped_rate: float | None = scalar("Hz", default=None)  # of a table's time stamps, if the given fps contradicts it
    sigma_angle: Array | None = column("rad", nan=True, default=None)
    repaired: Codes | None = column("", kind=np.int8, default=None)  # 0 measured, 1 tracked, 2 interpolated, 3 left out
    clock_error: float = scalar("1", default=0.0)  # relative deviation of the frame interval, if it is from the stamps
    sigma_v: float = scalar("m/s", default=0.0)  # white noise of measured speeds, from which x is integrated
    radius: float | None = scalar("m", default=None)  # of the circle along which x counts
    sigma_radius: float = scalar("m", default=0.0)

    @property
    def known(self) -> Mask:
        """Frames (n,) in which x was measured."""
        return np.asarray(self.valid & np.isfinite(self.x))

    @property
    def span(self) -> slice:
        """Rows from the first to the last frame in which x was measured; all rows if there are fewer than two."""
        frames = np.flatnonzero(self.known)
        return slice(int(frames[0]), int(frames[-1]) + 1) if len(frames) > 1 else slice(0, len(self))


@dataclass(frozen=True, eq=False, repr=False)
class Filtered(FrameTable):
    """Low-passed displacement, with what `differentiate` needs to compute standard deviations.

    Notes
    -----
    `x` and `y` are the smoothed displacement, m. `smoother` and `smoother_y` describe the smoother completely, so that
    its derivatives and their standard deviations can be computed later.

    """

    signals: ClassVar[tuple[str, ...]] = ("x",)
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
    repaired: Codes | None = column("", kind=np.int8, default=None)  # 0 measured, 1 tracked, 2 interpolated, 3 left out


@dataclass(frozen=True, eq=False, repr=False)
class Motion(FrameTable):
    """Smoothed displacement, velocity and acceleration with their standard deviations, one row per frame.

    Notes
    -----
    `x` (m), `v` (m/s) and `a` (m/s^2) are along the course, `a_y` (m/s^2) is across it. Rows closer than `guard` to
    either end or to a jump are distorted by the smoother.

    Examples
    --------
    >>> import frictrack as ft
    >>> motion = ft.samples.runs()[0].motion
    >>> float(motion.v.max().round(1)), list(motion.to_dataframe())[:4]
    (6.0, ['t', 'x', 'v', 'a'])

    """

    signals: ClassVar[tuple[str, ...]] = ("v",)
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
    filter: str = ""  # JSON: a filter that was asked for, which the force domain uses, too; "" for a plain low-pass
    events: tuple[tuple[int, int], ...] = ()  # first and last row of fast events
    lines: tuple[float, ...] = ()  # Hz, vibrations
    shake_a: float = scalar("m/s^2", default=0.0)  # rms part of sigma_a that is due to residual camera shake
    repaired: Codes | None = column("", kind=np.int8, default=None)  # 0 measured, 1 tracked, 2 interpolated, 3 left out
    smoother: str = ""  # JSON: the smoother of x; "" where a sensor's acceleration entered, which no filter lost


@dataclass(frozen=True, eq=False, repr=False)
class Friction(FrameTable):
    """Friction force F = D - m a and the free section in which it is evaluated, one row per frame.

    F > 0 resists motion toward +x. D is the drive force, m the mass, a the acceleration.
    """

    signals: ClassVar[tuple[str, ...]] = ("F",)
    t: Array = column("s")
    F: Array = column("N")
    sigma_F: Array = column("N")  # without the lag of a slow amplifier, which is not known unless its noise shows it
    free: Mask = column("", kind=np.bool_)
    reason: str = ""  # why the free section begins and ends there
    repaired: Codes | None = column("", kind=np.int8, default=None)  # 0 measured, 1 tracked, 2 interpolated, 3 left out


@dataclass(frozen=True, eq=False)
class CutoffTradeOff:
    """Error of the acceleration by the cut-off frequency of a plain low-pass; all columns (k,).

    `residual` is the rms of what the low-pass removes and `floor` that of white noise alone, m. `noise` and `lost` are
    the noise that passes and the signal that is removed, m/s^2, in most frames: `lost` is a median, no push rules it.
    """

    frequency: Array = column("Hz")
    residual: Array = column("m")
    floor: Array = column("m")
    noise: Array = column("m/s^2")
    lost: Array = column("m/s^2")
    hidden: Array = column("m/s^2")  # rms of the largest vibration of that frequency that would not be detected
    chosen: float = scalar("Hz", default=float("nan"))  # cut-off of highest likelihood, or as given
    least: float = scalar("Hz", default=float("nan"))  # cut-off with the smallest sum of noise and lost signal
    structural: float = scalar("m/s^2", default=float("nan"))  # usual sigma_a with trend, lines and events separated
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


@dataclass(frozen=True, eq=False, repr=False)
class Curve(FrameTable):
    """Measurement and fitted model of one run, at the frames that were fitted (or predicted)."""

    signals: ClassVar[tuple[str, ...]] = ("x", "x_model")
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
    repaired: Codes | None = column("", kind=np.int8, default=None)  # 0 measured, 1 tracked again
    F_filtered: Array | None = column("N", default=None)  # F_model through the filter of the run; None if it has none

    @property
    def residual(self) -> Array:
        """Measured minus modelled displacement (n,), m."""
        return self.x - self.x_model

    @property
    def F_as_measured(self) -> Array:
        """Force of the model (n,), N, comparable with the measured one: through the same filter where that is known."""
        return self.F_model if self.F_filtered is None else self.F_filtered


@dataclass(frozen=True, eq=False, repr=False)
class ModelledMotion(FrameTable):
    """Motion of one run by the fitted model, at the frames that were fitted (or predicted).

    Standard deviations are those of the fit; mass and scale errors, common to all runs, are not included. They are NaN
    if the model is too far from the data to be linearised.
    """

    signals: ClassVar[tuple[str, ...]] = ("v",)
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
