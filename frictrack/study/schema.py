"""Define the keys of a study file, each with its type and unit.

Each value is checked here by itself; what several keys must satisfy together is checked by `frictrack.study.loading`.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, StringConstraints, ValidationInfo, model_validator

from frictrack.base.errors import suggest
from frictrack.base.polygons import Polygon, are_coordinates, polygon, polygons
from frictrack.base.remote import RemoteFile, is_address, locate
from frictrack.base.units import parse_quantity
from frictrack.records import rolling_inertia
from frictrack.search import METHODS, read_settings
from frictrack.settings.costs import DEFAULT_COSTS
from frictrack.settings.filters import STRUCTURAL, FilterChoice
from frictrack.settings.priors import Prior
from frictrack.settings.repairs import Repair, read_repairs

Value = tuple[float, float]  # in SI units, with its standard deviation
Pair = tuple[float, float]
COLUMNS = {
    "t": ("t_s", "s"),
    "x": ("x_m", "m"),
    "sigma": ("sigma_m", "m"),
    "y": ("y_m", "m"),
    "drive": ("drive_N", "N"),
    "a": ("a_m_s2", "m/s^2"),
    "friction": ("friction_N", "N"),
}  # short name in `columns` -> header and unit in the table
POINT_COLUMNS = {
    "v": ("v_m_s", "m/s"),
    "friction": COLUMNS["friction"],
    "mu": ("mu", "1"),
    "sigma_friction": ("sigma_friction_N", "N"),
    "sigma_mu": ("sigma_mu", "1"),
    "load": ("load_N", "N"),
}  # of a table of speeds and forces
SENSOR_COLUMNS = {key: COLUMNS[key] for key in ("t", "drive", "a", "friction")} | {"pressure": ("pressure_Pa", "Pa")}


def _number(unit: str, **limits: float) -> BeforeValidator:
    """Return a validator of a physical value; its standard deviation is dropped."""
    return BeforeValidator(lambda raw, info: parse_quantity(raw, unit, str(info.field_name), **limits)[0])


def _pair(unit: str, wanted: str, order: str, *, may_be_equal: bool = False, **limits: float) -> BeforeValidator:
    """Return a validator of two values in a certain order."""

    def check(raw: Any, info: ValidationInfo) -> Pair:
        if not isinstance(raw, list) or len(raw) != 2:
            raise ValueError(f"expected {wanted} but got {raw!r}")
        low, high = (parse_quantity(part, unit, str(info.field_name), **limits)[0] for part in raw)
        if low > high or (low == high and not may_be_equal):
            raise ValueError(f"expected {order} but got {raw!r}")
        return low, high

    return BeforeValidator(check)


def _check_names(raw: Iterable[str], known: Iterable[str], where: str = "") -> None:
    """Refuse the first name that is not known."""
    for key in raw:
        if key not in known:
            raise ValueError(f'expected one of {", ".join(known)}{where} but got "{key}"; {suggest(key, known)}')


def _specification(raw: Any, info: ValidationInfo) -> tuple[float, str]:
    """Read the specification of an instrument with its SI unit: N of a load cell, m of a position."""
    name = str(info.field_name)
    if not isinstance(raw, str):
        raise ValueError(f'expected a text with a unit, as in {name} = "0.004 N" or {name} = "5 um", but got {raw!r}')
    try:
        return parse_quantity(raw, "N", name, above=0.0)[0], "N"
    except ValueError:
        return parse_quantity(raw, "m", name, above=0.0)[0], "m"


def _mass(raw: Any) -> Any:
    """Read a mass, kg; "fit" stays as it is."""
    return raw if raw == "fit" else parse_quantity(raw, "kg", "mass", above=0.0)


def read_frame_rate(raw: Any) -> float:
    """Read a frame rate, 1/s: a number, or a text such as "4000 fps", "4000 /s" or "4 kHz".

    Raises
    ------
    ValueError
        If it is none, or not above 0.

    Examples
    --------
    >>> read_frame_rate("4000 fps"), read_frame_rate("4 kHz")
    (4000.0, 4000.0)

    """
    text = _FRAMES_PER_SECOND.sub("", raw) if isinstance(raw, str) else raw
    try:
        return parse_quantity(text, "Hz", "fps", above=0.0)[0]
    except ValueError as e:
        if isinstance(raw, str) and "above 0" not in str(e):
            raise ValueError(f'expected a frame rate such as "4000" or "4 kHz" but got "{raw}"') from e
        raise


def _value(unit: str, **limits: float) -> BeforeValidator:
    """Return a validator of a physical value with its standard deviation."""
    return BeforeValidator(lambda raw, info: parse_quantity(raw, unit, str(info.field_name), **limits))


def _source(raw: Any, info: ValidationInfo) -> Path | RemoteFile:
    """Return an existing file or folder, whose path is relative to the study file, or an address.

    An address is opened only when it is needed. Every file that a study names passes here.
    """
    if not isinstance(raw, str) or not raw:
        raise ValueError(f"expected the path of a file but got {raw!r}")
    path = locate(raw, _folder(info))
    if isinstance(path, Path) and not _exists(path):
        there = [p.name for p in path.parent.iterdir()] if _exists(path.parent / "..") else []
        near = difflib.get_close_matches(path.name, there, 1)
        hint = f'; did you mean "{near[0]}"?' if near else "; paths are relative to the study file"
        raise ValueError(f'expected a file "{raw}" but there is none{hint}')
    return path


def _path(raw: Any, info: ValidationInfo) -> Path:
    """Return an existing file or folder of this machine."""
    path = _source(raw, info)
    if not isinstance(path, Path):
        raise ValueError(f'expected a file of this machine but got "{raw}"; fetch it and give its path')
    return path


def _results_folder(raw: Any) -> Any:
    """Refuse an address as folder of the results."""
    if isinstance(raw, str) and is_address(raw):
        raise ValueError(f'expected a folder of this machine but got "{raw}"')
    return raw


def _prior(raw: Any, info: ValidationInfo) -> Path:
    """Return the path of a prior file whose content is sound."""
    path = _path(raw, info)
    Prior.read(path)
    return path


def _share(raw: Any, info: ValidationInfo) -> float:
    """Read a relative number of at least 0: 0.1 or "10 %"."""
    percent = re.fullmatch(r"\s*(\S+)\s*%\s*", raw) if isinstance(raw, str) else None
    try:
        value = float(percent[1]) / 100 if percent else parse_quantity(raw, "1", str(info.field_name))[0]
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf:
        raise ValueError(f'expected {info.field_name} as a number of at least 0, or "10 %", but got {raw!r}')
    return value


def _exists(path: Path) -> bool:
    """Return whether a path is a file or a folder; pipes and devices may have no end."""
    try:
        return path.is_file() or path.is_dir()
    except OSError:  # a name longer than the system has
        return False


def _is_rectangle(raw: Any) -> bool:
    """Return whether a value is a list of four coordinates, the last two of which are a size."""
    return are_coordinates(raw, 4) and min(raw[2:]) > 0


def _target(raw: Any, info: ValidationInfo) -> Any:
    """Read a rectangle, a click, an outline or the path of a picture; `tracking` checks whether it fits the film."""
    if isinstance(raw, str) and raw:
        return _path(raw, info)
    if are_coordinates(raw, 2) or _is_rectangle(raw):
        return tuple(raw)
    if isinstance(raw, list) and raw and all(isinstance(corner, list) for corner in raw):
        return polygon(raw)
    raise ValueError(f"expected {TARGETS} but got {raw!r}")


def _targets(raw: Any, info: ValidationInfo) -> Any:
    """Read further targets by name."""
    if not isinstance(raw, dict):
        raise ValueError(f"expected further targets as {{name = [x, y, width, height]}} but got {raw!r}")
    for name in raw:
        if name in RESERVED_TRACKS or not NAME.fullmatch(name):
            taken = ", ".join(RESERVED_TRACKS)
            raise ValueError(f'expected names of letters, digits, - and _ other than {taken} but got "{name}"')
    return {name: _target(one, info) for name, one in raw.items()}


def _reference(raw: Any) -> Any:
    """Read the fixed reference: "auto", "none" or a rectangle."""
    if raw in ("auto", "none") or _is_rectangle(raw):
        return raw if isinstance(raw, str) else tuple(raw)
    raise ValueError(f'expected "auto", "none" or a rectangle [x, y, width, height] in px but got {raw!r}')


def _columns(raw: Any) -> Any:
    """Check that the short names of other headers are known."""
    _check_names(raw if isinstance(raw, dict) else (), COLUMNS | POINT_COLUMNS)
    if isinstance(raw, dict) and "v" in raw and (of_record := [key for key in raw if key not in POINT_COLUMNS]):
        raise ValueError(
            f"expected v with friction or mu, for points (v, F) at constant speeds, but got {', '.join(of_record)} as "
            "well; a record over time takes t and x without v"
        )
    return raw


def _drive(raw: Any, info: ValidationInfo) -> Any:
    """Read a drive: a table with its own clock, a constant force, or none."""
    if raw == "none":
        return None
    if isinstance(raw, dict):
        return _sensor_table(raw, info, DRIVE, ("pressure",) if "area" in raw else ("drive",))
    force = isinstance(raw, str) and re.match(r"\s*[+-]?\.?\d", raw) and not _exists(_folder(info) / raw)
    if force or (isinstance(raw, int | float) and not isinstance(raw, bool)):
        return parse_quantity(raw, "N", "drive")[0]
    if isinstance(raw, str) and raw:
        return _path(raw, info)
    raise ValueError(
        'expected a drive as "drive.csv" (t_s, drive_N), a constant "2.5 N", "none" or '
        f'{{table = "p.csv", area = "3.14 cm^2"}} but got {raw!r}'
    )


def _sensor(raw: Any, info: ValidationInfo) -> Any:
    """Read a sensor: a table with its own clock."""
    if isinstance(raw, dict):
        return _sensor_table(raw, info, SENSOR, ("a", "friction"))
    if isinstance(raw, str) and raw:
        return _path(raw, info)
    raise ValueError(
        'expected a sensor as "acc.csv" (t_s, a_m_s2) or {table = "acc.csv", columns = {t = "Time (ms)", '
        f'a = "acc (g)"}}}} but got {raw!r}'
    )


def _sensor_table(raw: dict[str, Any], info: ValidationInfo, keys: tuple[str, ...], wanted: tuple[str, ...]) -> Any:
    """Read the table of a sensor with its keys; every value is checked, and files must exist."""
    _check_names(raw, keys)
    if ("table" in raw) == ("force" in raw):
        came = "both" if "table" in raw else "neither"
        both = 'table = "drive.csv" or force = "2.5 N"' if "force" in keys else 'table = "acc.csv"'
        raise ValueError(f"expected {both} but got {came if 'force' in keys else 'none'}")
    if "force" in raw and (extra := [key for key in ("area", "columns", "offset") if key in raw]):
        raise ValueError(f"expected no {extra[0]} with a constant force: it belongs to a table")
    read = {
        "table": lambda value: _path(value, info),
        "force": lambda value: parse_quantity(value, "N", "force")[0],
        "area": lambda value: parse_quantity(value, "m^2", "area", above=0.0)[0],
        "columns": lambda value: _headers(value, ("t", *wanted)),
        "until": _until,
        "offset": lambda value: value if value == "auto" else _time(value, '"auto"', "offset"),
    }
    return {key: read[key](value) for key, value in raw.items()}


def _time(raw: Any, keyword: str, what: str) -> float:
    """Read a time, s, where a keyword is the alternative."""
    try:
        return parse_quantity(raw, "s", what)[0]
    except ValueError as e:
        raise ValueError(f'expected {what} as {keyword} or a time like "1.2 ms" but got {raw!r}') from e


def _until(raw: Any) -> Any:
    """Read when a drive ends: "release", a time in s, or {"x": the place in m at which it ends}."""
    if raw == "release":
        return raw
    try:
        return {"x": parse_quantity(raw, "m", "until")[0]} if isinstance(raw, str) else _time(raw, '"release"', "until")
    except ValueError:
        return _time(raw, '"release", a place like "30 cm"', "until")


def _headers(raw: Any, keys: tuple[str, ...]) -> dict[str, str]:
    """Read the headers of a sensor's table by short name."""
    if not isinstance(raw, dict) or not all(isinstance(header, str) for header in raw.values()):
        raise ValueError(f'expected columns = {{t = "Time (ms)", {keys[1]} = "..."}} but got {raw!r}')
    _check_names(raw, keys, " in columns")
    return raw


def _folder(info: ValidationInfo) -> Path:
    """Return the folder to which paths are relative."""
    return (info.context or {})["folder"]


def _scale(raw: Any, info: ValidationInfo) -> Any:
    """Return a scale as it is written; files must exist. Its numbers are checked where they are used."""
    if isinstance(raw, str | int | float) and not isinstance(raw, bool):
        return raw
    if isinstance(raw, list) and raw:
        return [_scale(one, info) for one in raw]
    if not isinstance(raw, dict) or not raw:
        wanted = '"0.5 mm/px" or {points = [[x, y], [x, y]], length = "100 mm"}'
        raise ValueError(f"expected {wanted} but got {raw!r}")
    _check_names(raw, SCALE)
    if "board" not in raw:
        return raw
    board = raw["board"]
    found = [_path(one, info) for one in board] if isinstance(board, list) else _path(board, info)
    return {**raw, "board": found}


def _axis(raw: Any) -> Any:
    """Read the direction of the course: a vector [dx, dy], px, or "track"."""
    numbers = isinstance(raw, list) and len(raw) == 2 and all(isinstance(v, int | float) for v in raw)
    if raw == "track" or (numbers and any(raw)):
        return raw
    raise ValueError(f'expected the course axis as [dx, dy] px or "track" but got {raw!r}')


def needs_film(scale: Any) -> bool:
    """Return whether a scale can only be measured in a film; a table has no pixels.

    Parameters
    ----------
    scale
        Value of the key ``scale``.

    """
    first = scale[0] if isinstance(scale, list) else scale
    return isinstance(first, dict) and "length" not in first


def _frame_limit(raw: Any) -> float:
    """Read the largest number of frames in one film; `inf` for any number."""
    is_whole = type(raw) is int or raw == math.inf
    if not (is_whole and raw >= MIN_FRAMES_OF_FILM):
        raise ValueError(f"expected frames as a whole number of at least {MIN_FRAMES_OF_FILM}, or inf, but got {raw!r}")
    return float(raw)


SCALE = (
    "points", "length", "click", "plane", "unit", "target", "board", "squares", "square", "dictionary", "marker",
)  # fmt: skip
DRIVE = ("table", "force", "area", "columns", "until", "offset")  # keys of a drive's table in the study file
SENSOR = ("table", "columns", "offset")
TARGETS = "a rectangle [x, y, width, height] in px, an outline [[x, y], ...], a click [x, y] or a picture's path"
RESERVED_TRACKS = ("target", "reference", "backward")  # tracks that every film has
NAME = re.compile(r"^[A-Za-z0-9_-]{1,60}$")
_FRAMES_PER_SECOND = re.compile(r"\s*(?:fps|(?:1|frames)?\s*/\s*(?:second|sec|s)|frames per second)\s*$")
MIN_FRAMES_OF_FILM = 30  # fewer show no friction
Target = Annotated[Any, BeforeValidator(_target)]
Areas = Annotated[tuple[Polygon, ...], BeforeValidator(polygons)]
Repairs = Annotated[tuple[Repair, ...], BeforeValidator(read_repairs)]
Targets = Annotated[dict[str, Any], BeforeValidator(_targets)]
Reference = Annotated[Any, BeforeValidator(_reference)]
Mass = Annotated[Value | Literal["fit"], BeforeValidator(_mass)]
Scale = Annotated[Any, BeforeValidator(_scale)]
Axis = Annotated[Pair | Literal["track"], BeforeValidator(_axis)]
File = Annotated[Path, BeforeValidator(_path)]
PriorFile = Annotated[Path, BeforeValidator(_prior)]
Factor = Annotated[float, _number("1", above=0.0)]
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Fixed = Annotated[Number | Literal[False], Field(union_mode="left_to_right")]  # 0 is a number, although 0 == False
Words = Annotated[str, StringConstraints(strip_whitespace=True, min_length=1, max_length=60)]
Conditions = dict[Annotated[str, Field(pattern=NAME.pattern)], Number | Words]
Share = Annotated[float, BeforeValidator(_share)]
Source = Annotated[Path | RemoteFile, BeforeValidator(_source)]
Drive = Annotated[Any, BeforeValidator(_drive)]
Sensor = Annotated[Any, BeforeValidator(_sensor)]
Frequency = Annotated[float, _number("Hz", above=0.0)]
FrameRate = Annotated[float, BeforeValidator(read_frame_rate)]
Place = Annotated[float, _number("m")]
Length = Annotated[float, _number("m", above=0.0)]
Load = Annotated[float, _number("N", above=0.0)]
Scatter = Annotated[float, _number("N", least=0.0)]
Energy = Annotated[float, _number("J", above=0.0)]
Specification = Annotated[tuple[float, str], BeforeValidator(_specification)]
Rolling = Annotated[float, BeforeValidator(rolling_inertia)]
Angle = Annotated[Value, _value("rad", above=-math.pi / 2, below=math.pi / 2)]
Radius = Annotated[Value, _value("m")]
Times = Annotated[Pair, _pair("s", "[start, end] in s", "an end after the start")]
Pause = Annotated[float, _number("s", above=0.0)]

Cost = Annotated[float, Field(gt=0, strict=True)]
CostOfChange = Annotated[float, Field(ge=0, strict=True)]  # which may cost nothing
Speeds = Annotated[
    Pair, _pair("m/s", "speeds = [slowest, fastest] in m/s", "the slowest speed first", may_be_equal=True, above=0.0)
]
Masses = Annotated[tuple[Annotated[float, _number("kg", above=0.0)], ...], Field(min_length=1)]
FrameLimit = Annotated[float, BeforeValidator(_frame_limit)]


class Keys(BaseModel):
    """A table of the study file; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)


class StudyTable(Keys):
    """The keys of ``[study]``.

    Attributes
    ----------
    name
        Name of the study in the report; default the name of the folder.
    mass
        Sliding mass of all runs that do not state their own, or "fit".
    model
        First model: a name such as "tustin" or "atm1:2", or a list of effects.
    output
        Folder of the results; default the name of the study file with `_results`.
    prior
        Prior file of another set-up, written by `frictrack export STUDY --to prior`: its law is what is known before
        the fit. Values that scale with the load are converted to the load of this study.
    prior_scale
        Factor on the standard deviations of the prior; above 1, the prior counts less.
    prior_scatter
        Relative standard deviation by which the parameters of two set-ups differ, added to that of the prior.
    conditions
        Conditions in which studies of a campaign differ, by name: numbers, numbers with a unit, or categories.
        `frictrack batch` fits how the law depends on them.
    plausible
        You have checked all numbers, although they look implausible.
    functions
        Functions of z, such as "z^2*exp(-z)", for formulas of a force that no effect explains. They are tried with
        z = u/w and z = (u - c)/w, where u is place, time or speed.

    """

    name: str = ""
    mass: Mass | None = None
    model: str | list[str] = "tustin"
    output: Annotated[str, BeforeValidator(_results_folder)] = ""
    prior: PriorFile | None = None
    prior_scale: Factor = 1.0
    prior_scatter: Share = 0.0
    conditions: Conditions = {}
    plausible: Literal["checked"] | None = None
    functions: tuple[str, ...] = ()


class CameraTable(Keys):
    """The keys of ``[camera]``, which hold for all runs that do not state their own.

    Attributes
    ----------
    fps
        Frame rate while filming, not of the playback. Forces scale with its square.
    scale
        Size of a pixel on the course, in m, or what it is measured from: a ruler, the target, a board, known places.
        For a table of positions, it is the size of the pixel of the camera that measured them.
    lens
        Camera matrix and distortion of a lens that was calibrated before (yml or json of OpenCV).

    """

    fps: FrameRate | None = None
    scale: Scale | None = None
    lens: File | None = None


class CostsTable(Keys):
    """The keys of ``[costs]``: what one more run costs, in any one unit, and what the set-up can do.

    `frictrack diagnose` and `frictrack plan` rate runs by their expected evidence over their cost.

    Attributes
    ----------
    film
        Cost of one more film, above 0; default 1.
    mass
        Added where the mass differs from that of the last run filmed. `inf`: not possible.
    direction
        Added where the run goes the other way than the last one.
    incline
        Added where the incline differs from that of the last run.
    camera
        Added where the frame rate or the zoom differs from that of the last run.
    sensor
        Cost of a sensor that must be bought, mounted and synchronised; default that of ten films.
    check
        Cost of any other measurement without a film, such as a rule or a level; default that of one film.
    speeds
        Slowest and fastest start speed of the set-up, m/s; default [0.3, 8].
    masses
        Masses at hand; default any.
    frames
        Largest number of frames in one film, which the memory of the camera limits; `inf` for any number. Default: as
        many as the longest film has, if that ended while the mass still moved, well within the course; else any number.

    """

    film: Cost = DEFAULT_COSTS.film
    mass: CostOfChange = DEFAULT_COSTS.mass
    direction: CostOfChange = DEFAULT_COSTS.direction
    incline: CostOfChange = DEFAULT_COSTS.incline
    camera: CostOfChange = DEFAULT_COSTS.camera
    sensor: Cost = DEFAULT_COSTS.sensor
    check: Cost = DEFAULT_COSTS.check
    speeds: Speeds = DEFAULT_COSTS.speeds
    masses: Masses = DEFAULT_COSTS.masses
    frames: FrameLimit | None = DEFAULT_COSTS.frames


class SearchTable(Keys):
    """The keys of ``[search]``: how models are fitted, where it is not by variable projection.

    All other keys are settings of the method, by name: `generations`, `restarts` and `seed` of any; `population`,
    `selection`, `bits` (code length L), `crossover` (P_c), `mutation` (P_m), `a`, `b`, `c`, `p_const`, `l_const`, `d`,
    `s`, `as_printed`, `temperature`, `final`, `cooling` and more of the papers' algorithms. A message lists those of a
    method.

    Attributes
    ----------
    method
        Search method.
    over
        Parameters that a global search varies; "nonlinear": the coefficients are solved for every trial.

    """

    model_config = ConfigDict(extra="allow", frozen=True)

    method: Literal["varpro", "ga", "mga", "sa", "sga", "de", "da", "cmaes"]
    over: Literal["all", "nonlinear"] = "all"

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.method != "varpro":
            read_settings(METHODS[self.method], self.settings)
        elif self.settings or self.over != "all":
            raise ValueError(f"expected no settings with varpro but got {', '.join(self.settings) or 'over'}")
        return self

    @property
    def settings(self) -> dict[str, Any]:
        """Settings of the method, as they are written."""
        return dict(self.model_extra or {})

    @property
    def request(self) -> dict[str, Any]:
        """What is asked of a fit."""
        settings = read_settings(METHODS[self.method], self.settings) if self.settings else {}
        return {"search": self.method, "over": self.over, "settings": settings}


class MotionTable(Keys):
    """The keys of ``[motion]``, for all runs that do not state their own; a run with its own filter takes none of them.

    Attributes
    ----------
    filter
        Filter of the displacement, for the motion and the force domain: "structural" (default: trend, vibrations and
        events are separated), "kalman", "butterworth", "savitzky-golay", "gaussian-process" or "papers".
    cutoff
        Cut-off of a filter; without a filter that of a plain low-pass, instead of the separation into trend, vibrations
        and events.
    order
        Order of a Butterworth filter, or degree of the polynomials of a Savitzky-Golay filter.
    window
        Frames of these polynomials, an odd number.
    causal
        Filter forward only, which delays the motion; default forward and backward.

    """

    filter: str | None = None
    cutoff: Frequency | None = None
    order: int | None = None
    window: int | None = None
    causal: bool | None = None

    @property
    def filter_choice(self) -> FilterChoice:
        """The filter of the displacement."""
        return FilterChoice(self.filter or STRUCTURAL, self.cutoff, self.order, self.window, bool(self.causal))


class RunTable(CameraTable, MotionTable):
    """The keys of ``[[run]]``; after loading, with those that it inherits from ``[study]`` and ``[camera]``.

    Attributes
    ----------
    name
        Name of the run in results and figures; default the name of its file.
    video
        Film, or a folder of pictures; a path relative to the study file, or an address.
    table
        Table of measured positions or friction instead of a film: CSV, Excel, or the tracks of another program. With
        `v` in `columns` it holds points (v, F) of a bench that measures friction at constant speeds.
    mass
        Sliding mass, where it differs from that of the study, or "fit" where the drive is measured.
    fps, scale, lens
        As in ``[camera]``, where they differ.
    target
        Where the target is in the first frame, or a picture of it, where it is not found automatically.
    reference
        Fixed object that shows the shake of the camera: a rectangle in px.
    targets
        Further targets to track, by name, each given as `target` is.
    clamp_x
        Position at which the beam under the course is clamped, for `beam_vibration`.
    beam_length
        Free length of that beam.
    pause
        Time since the end of the run before it in this list, on the same surfaces, for `run_in` and `heating`; given
        for all runs from the second on.
    template
        Number of the frame in which `target` is given; default the first.
    exclude
        Polygons or rectangles in that frame that move with the target and are not part of it.
    obstacles
        Polygons or rectangles fixed in the picture, behind which the target passes.
    repair
        Frames that were tracked wrongly or lost, each span with from, to and how: "track" (again, from target in
        frame), "interpolate" or "leave_out".
    axis
        Direction of +x in the picture, in px, or along the path of the target; default the picture's x.
    origin_px
        Place in the picture at which x is zero; default the corner of the picture, or the origin of known places.
    x_offset
        Length that is added to all positions, so that runs share one course.
    free
        Begin and end of the free section that is fitted, where the automatic choice is wrong.
    filter, cutoff, order, window, causal
        As in ``[motion]``, where they differ.
    incline
        Angle by which the course rises toward +x; negative where it falls. With its error ("3.6 +/- 0.1 deg") it is one
        unknown of the fit: `slope`, held to the stated angle within the error.
    radius
        Radius of a circular course along which x counts, below 0 for a crest; not needed where x and y are known. With
        incline, that where x = 0, the circle stands upright.
    rolling
        Shape of a body that rolls without slipping ("disc", "ball", "hollow ball", "ring"), or its moment of inertia
        over m r^2; default one that slides.
    normal_load
        Normal load, where it is not m g cos(incline).
    drive
        Force that drives the mass: a table with its own clock, a constant, or a pressure with its area.
    sigma_drive
        Standard deviation of the errors of the drive from frame to frame; 0 for one that is exact.
    sensor
        Accelerometer or load cell: a table with its own clock.
    columns
        Headers of the table by short name, where they are not the standard ones.
    impact_energy
        Energy of the hammer; the kinetic energy at release must be smaller.
    noise
        White noise of the instrument, rms: N of a load cell, m of positions.
    drift
        Slowly varying error of the instrument, rms, in the same units.
    group
        Name of a group of runs, for one fit per group, or to compare a parameter between groups.
    role
        Whether the run is fitted, or predicted only.
    note
        Remark for readers of the study file.
    plausible
        You have checked the numbers of this run, although they look implausible.

    """

    name: str = ""
    video: Source | None = None
    table: Source | None = None
    mass: Mass | None = None
    target: Target | None = None
    reference: Reference = "auto"
    targets: Targets = {}
    clamp_x: Place | None = None
    beam_length: Length | None = None
    pause: Pause | None = None
    template: Annotated[int, Field(ge=0)] | None = None
    exclude: Areas = ()
    obstacles: Areas = ()
    repair: Repairs = ()
    axis: Axis | None = None
    origin_px: Pair | None = None
    x_offset: Place = 0.0
    free: Times | None = None
    incline: Angle | None = None
    radius: Radius | None = None
    rolling: Rolling = 0.0
    normal_load: Load | None = None
    drive: Drive | None = None
    sigma_drive: Scatter | None = None
    sensor: Sensor | None = None
    columns: Annotated[dict[str, str], BeforeValidator(_columns)] = {}
    impact_energy: Energy | None = None
    noise: Specification | None = None
    drift: Specification | None = None
    group: str = ""
    role: Literal["fit", "validation"] = "fit"
    note: str = ""
    plausible: Literal["checked"] | None = None

    @property
    def is_of_points(self) -> bool:
        """Whether its table holds speeds and forces, instead of a record over time."""
        return "v" in self.columns

    @property
    def source(self) -> Path | RemoteFile:
        """The film or the table."""
        path = self.video or self.table
        assert path is not None  # checked by `load`
        return path


def _per_run(raw: Any) -> Any:
    """Read a list of parameters, or which ones have a value per run (true) or one for all (false)."""
    if isinstance(raw, list) and all(isinstance(name, str) for name in raw):
        return dict.fromkeys(raw, True)
    if isinstance(raw, dict) and all(isinstance(v, bool) for v in raw.values()):
        return raw
    raise ValueError(f"expected [parameter, ...] or {{parameter = true or false}} but got {raw!r}")


class EffectTable(Keys):
    """The keys of ``[[effect]]``: settings of one effect, or a new effect with `formula`.

    Attributes
    ----------
    effect
        Name of an effect of the library, or of the new one.
    fix
        Values of parameters that are not fitted, by name; false frees one that is fixed by default.
    bounds
        Lowest and highest value of parameters, by name, in SI units.
    prior
        Mean and standard deviation of parameters, by name, known from elsewhere than the runs.
    tie
        Parameters that equal another one or a multiple of it, by name: "2*vibration.frequency".
    per_run
        Parameters with one value per run; {name = false} for one value for all runs.
    follows_level
        Whether the friction level of each run multiplies it, where friction scatters from run to run.
    formula
        Force in N, or shift of the picture in m, of a new effect, as a text.
    units
        Units of the parameters of a formula, by name.
    acts_on
        Whether a formula is a force or an error of the measured position.

    """

    effect: str
    fix: dict[str, Fixed] = {}
    bounds: dict[str, Pair] = {}
    prior: dict[str, Pair] = {}
    tie: dict[str, str] = {}
    per_run: Annotated[dict[str, bool], BeforeValidator(_per_run)] = {}
    follows_level: bool | None = None
    formula: str | None = None
    units: dict[str, str] = {}
    acts_on: Literal["force", "measurement"] = "force"


class StudyFile(Keys):
    """The tables of a study file."""

    study: StudyTable = StudyTable()
    camera: CameraTable = CameraTable()
    motion: MotionTable = MotionTable()
    run: tuple[RunTable, ...] = ()
    effect: tuple[EffectTable, ...] = ()
    costs: CostsTable = CostsTable()
    search: SearchTable | None = None
