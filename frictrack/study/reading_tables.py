"""Read tables of measurements as columns in SI units, and check them; `table_files` opens the files."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError, raise_faults, suggest
from frictrack.base.number_format import first_words
from frictrack.base.remote import local_path
from frictrack.base.units import parse_quantity
from frictrack.records import GRAVITY, Array, Mask
from frictrack.study import column_names
from frictrack.study.schema import COLUMNS, POINT_COLUMNS, SENSOR_COLUMNS, RunTable
from frictrack.study.table_layout import TableFile, TrackColumns

if TYPE_CHECKING:
    import pandas as pd

MAX_VALUE = 1e12  # in SI units, far beyond any measurement of sliding
MIN_INTERVAL_S = 1e-9  # between rows
# Ranges of clocks, s: of 8 to 32 bits of a decimal step down to 1 ns; of a second, a minute, an hour, 12 and 24 hours.
COUNTER_RANGES = (
    *(2.0**bits * 10.0**-digits for bits in range(8, 33) for digits in range(10)),
    *(1.0, 60.0, 3600.0, 43200.0, 86400.0),
)
MAX_JUMP_STEPS = 3.0  # usual steps, from which a clock that rolls over, and the position then, may differ
MAX_ROLLOVERS_SHARE = 0.1  # of rows
TIME_REMEDY = (
    "sort the rows; put records that begin anew into files of their own; or, if the rows are evenly spaced, give their "
    "rate as fps, which then decides"
)
MIN_RISES = 4  # of time stamps that else repeat the one before
MIN_ROWS_FOR_REPEATS = 16  # rows from which time stamps may repeat
MIN_NUMBERS_SHARE = 0.5  # of the cells of a column that is proposed as time or position
DAY_S = 86400.0
MAX_STEP_OF_DAYS = 1e-6  # between times without a unit: closer ones are days, as Excel counts them
_ISO_DATE = re.compile(r"\d{4}-\d\d-\d\d[ T]\d")
_DATE = re.compile(r"\d{1,4}[-./]\d{1,2}[-./]\d{1,4}[ T]\d")
_AFTERNOON = re.compile(r"\s*([ap])\.?m\.?$", re.IGNORECASE)
_ROW_COUNTER = re.compile(
    r"(frame|sample|slice|image|picture|bild|index|row|point|nr|no)?s?[ _.]*(#|no\.?|nr\.?|n°|number|id)?", re.I
)
ARDUINO_CLOCKS = {"micros": "us", "millis": "ms"}  # by the functions that read them
EPOCHS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
EPOCH_S = (9e8, 4.2e9)  # since 1970: the years 1998 to 2103
MAX_EPOCH_STEP_S = 10.0  # between rows whose times count from 1970
ANGLE_NOTE = (
    "the positions are angles: x counts radians, mass stands for the moment of inertia in kg m^2, forces for torques "
    "in N m; for the way of a wheel of 25 mm radius, write its unit as (25 mm/rad)"
)
NO_COLUMNS: Mapping[str, str] = {}
CAMERA_UNITS = {  # units that only the camera knows, and the unit they stand for -> what tells it, and an example
    ("px", "m"): ("scale", 'scale = "0.5 mm/px"'),
    ("frames", "s"): ("frame rate", "fps = 240"),
}
Camera = Mapping[str, float | None]  # "px" and "frames" in m and s; None if it is not known


@dataclass(frozen=True, eq=False)
class TableData:
    """The columns of a table in SI units, each of shape (n,); None for a column that is not there."""

    t: Array  # time, s
    x: Array | None = None  # x, y: position along and across the course, m
    sigma: Array | None = None  # standard deviation of x, m
    y: Array | None = None
    drive: Array | None = None  # drive, friction: drive force and friction force, N
    a: Array | None = None  # acceleration, m/s^2
    friction: Array | None = None
    pressure: Array | None = None  # pressure of a drive, Pa
    # v, mu, sigma_friction, sigma_mu, load: of points (v, F): constant speed, m/s, friction coefficient, standard
    # deviations of force, N, and coefficient, and normal load, N
    v: Array | None = None
    mu: Array | None = None
    sigma_friction: Array | None = None
    sigma_mu: Array | None = None
    load: Array | None = None
    notes: tuple[str, ...] = ()  # what the program that tracked the positions says about them
    # frame rate of the time stamps, Hz, if the given one contradicts it and replaced it
    stamped_rate: float | None = None
    # relative standard deviation of the interval of the rows, where it was fitted to the time stamps
    clock_error: float = 0.0
    of_speeds: bool = False  # whether x is the integral of measured speeds
    # of a table on an even clock: the number of each row in the file, from 0, and whether it holds a sample of its own;
    # of others empty
    numbers: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    valid: Mask = field(default_factory=lambda: np.empty(0, dtype=np.bool_))


def read_table(
    path: Path, columns: Mapping[str, str] = NO_COLUMNS, *, pixel: float | None = None, fps: float | None = None
) -> TableData:
    """Read the table of a run: columns t_s and x_m, and sigma_m, y_m, drive_N, a_m_s2, friction_N if they are there.

    Parameters
    ----------
    path
        A text or Excel file with a header line, or tracks of another program; see `frictrack.study.table_files` and
        `frictrack.study.track_formats`.
    columns
        Other headers by short name: ``{"t": "Time (ms)", "friction": "-F (uN)"}``. The unit stands in parentheses (SI
        without them), in the file or only here; a leading minus flips the sign.
    pixel
        Size of a pixel, m, for positions in px.
    fps
        Frame rate, 1/s, for times that are numbers of frames.

    Returns
    -------
    TableData
        The columns in SI units.

    Raises
    ------
    FrictrackError
        With all faults: a column is missing, a value is not a number, time does not rise, fewer than two rows.

    """
    table = _opened(path, _wanted(columns))
    _check_choice(table, columns, path.name)
    chosen = chosen_track(table, columns)
    camera = {"px": pixel, "frames": 1.0 / fps if fps else None}
    table, gaps = _without_gaps(table, chosen.columns)
    values = _read(table, path.name, chosen.columns, camera=camera)
    notes = (chosen.note, gaps, *values.pop("notes", ()))
    return TableData(**values, notes=tuple(note for note in notes if note))


def read_run_table(run: RunTable) -> TableData:
    """Read the table of a run; see `read_table`.

    Parameters
    ----------
    run
        The ``[[run]]``, with a table.

    """
    assert run.table is not None
    scale: Any = None if isinstance(run.scale, dict | list) else run.scale
    pixel = None if scale is None else parse_quantity(scale, "m/px", "scale")[0]
    return read_table(local_path(run.table), run.columns, pixel=pixel, fps=run.fps)


def read_points(path: Path, columns: Mapping[str, str]) -> TableData:
    """Read a table of points (v, F) at constant speeds; `t` counts its rows.

    Parameters
    ----------
    path
        A text or Excel file with a header line.
    columns
        Headers by short name: v, and friction or mu.

    """
    values = _read(_opened(path, _wanted(columns, POINT_COLUMNS)), path.name, columns, POINT_COLUMNS)
    return TableData(np.arange(len(values["v"]), dtype=float), **values)


def read_frame(frame: pd.DataFrame, columns: Mapping[str, str] = NO_COLUMNS, name: str = "table") -> TableData:
    """Take the columns of a run from a pandas DataFrame; see `read_table`.

    Parameters
    ----------
    frame
        One row per sample.
    columns
        Other headers by short name.
    name
        Name of the table in messages.

    """
    return TableData(**_read(TableFile(frame.copy(deep=False)), name, columns))


def read_sensor_table(path: Path, wanted: Sequence[str], columns: Mapping[str, str] = NO_COLUMNS) -> TableData:
    """Read the table of a sensor with its own clock.

    Parameters
    ----------
    path
        A text or Excel file with a header line and a column t_s.
    wanted
        Short names of columns ("a", "friction", "drive", "pressure"), of which at least one must be there.
    columns
        Other headers by short name, as for `read_table`. An acceleration may be in units of gravity: ``"a (g)"``.

    Returns
    -------
    TableData
        The columns in SI units; an empty cell is NaN.

    Raises
    ------
    FrictrackError
        With all faults.

    """
    known = {key: SENSOR_COLUMNS[key] for key in ("t", *wanted)}
    values = _read(_opened(path, _wanted(columns, known)), path.name, columns, known)
    if len(values) == 1:
        headers = " or ".join(SENSOR_COLUMNS[name][0] for name in wanted)
        raise FrictrackError(
            f"{path.name}: expected a column {headers} in addition to t_s but got none; "
            f'name it with {{table = "{path.name}", columns = {{{wanted[0]} = "..."}}}}'
        )
    return TableData(**values)


def chosen_track(table: TableFile, columns: Mapping[str, str]) -> TrackColumns:
    """Return the headers of a table by short name: those given, and the others of the track whose x they name."""
    if len(table.tracks) != 1 and (not columns or not table.tracks):
        return TrackColumns({**table.columns, **columns})
    for track in table.tracks:
        if _header_of_x(columns, [track.columns["x"]], track.columns["x"]) is not None:
            return replace(track, columns={**track.columns, **columns})
    clock = {"t": table.tracks[0].columns["t"]} if table.tracks else {}  # the same for all
    return TrackColumns(clock | dict(columns))


def _header_of_x(columns: Mapping[str, str], present: Sequence[str], default: str = "") -> str | None:
    """Return the header among those present that the study file means by x."""
    return column_names.find_header(_unsigned(columns.get("x", default), present)[0], present)


def _check_choice(table: TableFile, columns: Mapping[str, str], name: str) -> None:
    """Raise an error that names the tracks if there are several and the study file chooses none."""
    if len(table.tracks) < 2 or "x" in columns:
        return
    headers = [track.columns["x"] for track in table.tracks]
    one, there = ("a run", "the table") if table.has_runs else ("a track", table.program)
    raise FrictrackError(
        f"{name}: expected the name of {one}, as {there} has {len(headers)}; choose one in its [[run]] with "
        f"{column_names.columns_line({'x': headers[0]})}; known are {first_words(headers)}"
    )


def _without_gaps(table: TableFile, columns: Mapping[str, str]) -> tuple[TableFile, str]:
    """Return the rows that have a time and a position, and a note on those between them that have none."""
    present = [str(header).strip() for header in table.frame.columns]
    needed = [(key, COLUMNS[key][0]) for key in column_names.REQUIRED]
    headers = [column_names.find_header(_unsigned(columns.get(k, s), present)[0], present) for k, s in needed]
    if None in headers or any(present.count(str(header)) > 1 for header in headers):
        return table, ""
    timed, placed = (table.frame.iloc[:, present.index(str(header))].notna().to_numpy() for header in headers)
    if not (timed.any() and placed.any()):
        return table, ""
    end = len(timed) - int(np.argmax(timed[::-1]))  # summary lines at the end have no time
    filled = placed & (np.arange(len(timed)) < end)
    if filled.all():
        return table, ""
    inside = np.flatnonzero(filled)
    gaps = int(inside[-1] - inside[0] + 1 - len(inside))
    note = f"{gaps} of {len(inside) + gaps} rows have no position; they count as missing"
    return replace(table, frame=table.frame[filled]), note if gaps and not table.tracks else ""


def _opened(path: Path, wanted: Collection[str]) -> TableFile:
    """Open a table; pandas takes half a second to load, which runs of arrays do not need."""
    from frictrack.study.table_files import open_table  # noqa: PLC0415

    return open_table(path, wanted)


def _wanted(columns: Mapping[str, str], known: Mapping[str, tuple[str, str]] = COLUMNS) -> set[str]:
    """Return names that only stand in a header."""
    return {header for header, _ in known.values()} | {header.lstrip("-") for header in columns.values()}


def _read(
    table: TableFile,
    name: str,
    columns: Mapping[str, str],
    known: Mapping[str, tuple[str, str]] = COLUMNS,
    *,
    camera: Camera = MappingProxyType({}),
) -> dict[str, Any]:
    """Read the columns of `known` that are there; empty cells are allowed in columns that are not required."""
    frame = table.frame
    present = [str(header).strip() for header in frame.columns]
    frame.columns = present
    required = [key for key in (*column_names.REQUIRED, "v") if key in known]
    faults: list[str] = []
    values: dict[str, Any] = {}
    notes: tuple[str, ...] = ()
    missing, of_speeds = [], False
    for key, (standard, unit) in known.items():
        written, sign = _unsigned(columns.get(key, standard), present)
        header = column_names.find_header(written, present)
        if header is None and key in columns:
            faults.append(f'expected a column "{written}" but got {first_words(present)}; {suggest(written, present)}')
        elif header is None and key in required:
            missing.append(key)
        elif header is not None and present.count(header) > 1:
            faults.append(f'expected one column "{header}" but got {present.count(header)}')
        elif header is not None:
            gaps = known is not COLUMNS and key not in required
            speeds = key == "x" and column_names.is_speed(written if column_names.UNIT.search(written) else header)
            of_speeds |= speeds
            factor = sign * _factor(written, header, standard, "m/s" if speeds else unit, camera)
            values[key], found = _column(frame[header], factor, gaps=gaps)
            if key == "t" and factor == DAY_S and len(values[key]):
                values[key] = values[key] - DAY_S * np.floor(frame[header].iloc[0])  # dates: seconds of the first day
            faults += found
    if missing:
        faults.append(_missing_columns(missing, frame, columns, name if known is not COLUMNS else ""))
    if not faults and "t" in known:
        values["t"], notes = _rising(values["t"], values.get("x"), camera.get("frames") if known is COLUMNS else None)
        faults += _time_faults(values["t"])
        if "sigma" in values and not np.all(values["sigma"] > 0):
            faults.append(f"expected standard deviations above 0 but got {np.min(values['sigma']):g} m")
    raise_faults(faults, name)
    notes += (ANGLE_NOTE,) * column_names.is_angle(columns.get("x", ""))
    values |= {"notes": notes} if notes else {}
    values |= _way_of_wheel(values.get("x"), columns.get("x", ""))
    return _integrated(values) if of_speeds else values


def _way_of_wheel(x: Array | None, header: str) -> dict[str, Array]:
    """Return the way (n,) of a wheel whose angle begins anew with every turn, m, where the header states a radius."""
    radius = column_names.radius(header)
    return {} if x is None or radius is None else {"x": np.unwrap(x, period=2 * np.pi * radius[0])}


def _integrated(values: dict[str, Any]) -> dict[str, Any]:
    """Return columns whose x holds speeds, m/s, with positions: each speed is that of one interval about its time."""
    t, v = values["t"], values["x"]
    frames = np.maximum(np.rint(np.diff(t) / np.median(np.diff(t))), 1.0)
    interval = float(t[-1] - t[0]) / float(np.sum(frames))
    missing = (frames - 1) * (v[1:] + v[:-1]) / 2
    late = t + interval / 2  # the errors of neighbouring steps between the ends of intervals are independent
    columns = {key: np.interp(late, t, q) for key, q in values.items() if isinstance(q, np.ndarray) and key != "t"}
    note = "the positions are integrated from speeds; the errors of these add up in them"
    moved = {"t": late, "x": interval * np.cumsum(np.append(0.0, v[1:] + missing)), "of_speeds": True}
    return {**columns, **moved, "notes": (*values.get("notes", ()), note)}


def _missing_columns(missing: Sequence[str], frame: pd.DataFrame, columns: Mapping[str, str], sensor: str) -> str:
    """Say which columns are missing, which are there, and the line of the study file that names them."""
    present = list(frame.columns)
    if not columns and not sensor and (points := column_names.guess_points(present)):
        return (
            f"expected columns of times and positions but got {first_words(present)}; if these are forces at constant "
            f"speeds, write {column_names.columns_line(points)} in its [[run]]"
        )
    wanted = " and ".join(f'"{COLUMNS[key][0]}"' for key in missing)
    expected = f"expected {'columns' if len(missing) > 1 else 'a column'} {wanted} but got {first_words(present)}"
    proposed = propose_columns(frame, columns)
    line = column_names.columns_line({key: header for key, header in proposed.items() if key in missing or not sensor})
    if not proposed.keys() >= set(missing):
        return f"{expected}; a table needs a column of times and a column of positions"
    where = f'{{table = "{sensor}", {line}}}' if sensor else f"{line} in its [[run]]"
    bare = any(column_names.stated_unit(proposed[key]) is None for key in missing)
    units = ", with the units of the file, or the size of a count, in the brackets" if bare else ""
    return f"{expected}; to name them, write {where}{units}"


def propose_columns(frame: pd.DataFrame, columns: Mapping[str, str] = NO_COLUMNS) -> dict[str, str]:
    """Propose the headers of a table that lacks standard ones: by usual names, else the first columns of numbers.

    Parameters
    ----------
    frame
        The table.
    columns
        Headers that are known by short name.

    Returns
    -------
    dict of str to str
        Headers by short name; without "t" or "x" if there is no column of numbers for it.

    """
    present = [str(header) for header in frame.columns]
    standard = {key: header for key, (header, _) in COLUMNS.items() if header in present}
    others = [header for header in present if header not in standard.values()]
    found = column_names.guess_columns(others) | standard | dict(columns)
    # by place: a header may be there twice
    numbers = {i: h for i, h in enumerate(present) if not h.startswith("Unnamed: ") and _are_numbers(frame.iloc[:, i])}
    clocks = [i for i, h in numbers.items() if column_names.may_hold(h, "t") and _rises_evenly(frame.iloc[:, i])]
    if "t" not in found and len(clocks) == 1:
        clock = present[clocks[0]]
        found = {key: header for key, header in found.items() if header != clock} | {"t": clock}
    lengths = [header for header in numbers.values() if not column_names.is_named_speed(header)]
    for key, choice in (("t", list(numbers.values())), ("x", lengths)):
        free = (header for header in choice if header not in found.values() and column_names.may_hold(header, key))
        if key not in found and (header := next(free, None)) is not None:
            found[key] = header
    if "x" not in found and (speed := next((h for h in numbers.values() if column_names.is_named_speed(h)), None)):
        found["x"] = speed if column_names.stated_unit(speed) else f"{speed} (m/s)"
    if found.get("t") in present and column_names.stated_unit(found["t"]) is None and found["t"] != COLUMNS["t"][0]:
        unit = _clock_unit(frame.iloc[:, present.index(found["t"])])
        found["t"] += f" ({unit})" if unit else ""
    return {key: found[key] for key in COLUMNS if key in found and found[key] != COLUMNS[key][0]}


def _clock_unit(series: pd.Series[Any]) -> str:
    """Return the unit of times whose header states none, where the values tell: dates, days, since 1970, frames."""
    if series.dtype.kind not in "fiu":
        return "s"  # dates and time codes are read as seconds
    times = _numbers(series)
    times = times[np.isfinite(times)]
    if unit := ARDUINO_CLOCKS.get(str(series.name).strip().casefold()):
        return unit
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    if 0 < step < MAX_STEP_OF_DAYS:
        return "d"
    for unit, size in EPOCHS.items() if step else ():
        if EPOCH_S[0] < times[0] * size < EPOCH_S[1] and step * size < MAX_EPOCH_STEP_S:
            return unit
    counts_rows = step == 1.0 and _ROW_COUNTER.fullmatch(column_names.base_name(str(series.name)).strip())
    return "frames" if counts_rows else ""


def _rises_evenly(series: pd.Series[Any]) -> bool:
    """Return whether a column may be a clock: every value is one interval, to half of it, above the one before."""
    steps = np.diff(_numbers(series))
    return len(steps) > 0 and bool(np.all(np.abs(steps - np.median(steps)) < 0.5 * np.median(steps)))


def _are_numbers(series: pd.Series[Any]) -> bool:
    return len(series) > 0 and bool(np.mean(np.isfinite(_numbers(series))) > MIN_NUMBERS_SHARE)


def _unsigned(written: str, present: Sequence[str]) -> tuple[str, float]:
    """Return the header without its sign, and the sign."""
    if written.startswith("-") and written not in present:
        return written[1:].strip(), -1.0
    return written, 1.0


def _factor(written: str, header: str, standard: str, unit: str, camera: Camera) -> float:
    """Return the size of the column's unit in SI units."""
    if wheel := column_names.radius(written) if unit == "m" else None:
        return wheel[0] * column_names.ANGLES.get(column_names.stated_unit(header) or "", wheel[1])
    named = column_names.stated_unit(written if column_names.UNIT.search(written) else header)
    if unit == "m/s" and column_names.TURNS.fullmatch(named or header):
        raise FrictrackError(
            f'expected a sliding speed in m/s or mm/s but got "{header}", a turning speed; add a column of '
            "v = 2 pi r n / 60 with the radius r of the track and the turns n per minute"
        )
    if named is None or header == standard == written:
        return 1.0
    if (named, unit) == ("g", "m/s^2"):
        return GRAVITY
    if (named, unit) in CAMERA_UNITS:
        what, example = CAMERA_UNITS[named, unit]
        size = camera.get(named)
        if size is None:
            raise FrictrackError(
                f'expected the {what} of "{header}" in {named} but got none; give {example} in [camera]'
            )
        return size
    return column_names.unit_size(named, unit, header)


def _numbers(series: pd.Series[Any]) -> Array:
    """Return the numbers of a column, time codes as seconds; NaN for other texts."""
    import pandas as pd  # noqa: PLC0415 - half a second, which runs of arrays do not need

    if series.dtype.kind == "m":
        return np.asarray(series.dt.total_seconds(), dtype=float)
    with np.errstate(over="ignore"):
        try:
            numbers = pd.to_numeric(series, errors="coerce")
        except OverflowError:  # a whole number of more than 308 digits; written as text it is infinite
            numbers = pd.to_numeric(series.astype(str), errors="coerce")
        values = np.full(len(series), np.nan) if series.dtype.kind == "M" else np.array(numbers, dtype=float)
    others = np.flatnonzero(np.isnan(values) & series.notna().to_numpy())
    if len(others) and _DATE.match(str(series.iloc[int(others[0])]).strip()):
        return _seconds_of_day(series)
    for i in others:
        text = str(series.iloc[int(i)]).strip()
        if ":" not in text:
            break
        values[i] = _seconds(text)
    return values


def _seconds_of_day(series: pd.Series[Any]) -> Array:
    """Return the seconds of dates with times since the midnight before the first; NaN for other texts."""
    import pandas as pd  # noqa: PLC0415

    texts = series.astype(str).str.replace(",", ".")
    iso = bool(_ISO_DATE.match(str(texts.iloc[0]).strip()))
    orders = ({"format": "ISO8601"},) if iso else ({"format": "mixed", "dayfirst": first} for first in (True, False))
    read = [pd.to_datetime(texts, errors="coerce", utc=True, **how) for how in orders]
    moments = min(read, key=np.ptp)  # a day that is read as a month leaps at midnight
    return np.array((moments - moments.min().normalize()).dt.total_seconds(), dtype=float)


def _seconds(text: str) -> float:
    """Return the seconds of a time code h:mm:ss:cc, mm:ss.ccc, h:mm:ss or h:mm:ss pm; NaN for another text."""
    negative, text = text.startswith("-"), text.lstrip("- ")
    half = _AFTERNOON.search(text)
    parts = _AFTERNOON.sub("", text).replace(",", ".").split(":")
    if half and parts[0].isdigit():
        parts[0] = str(int(parts[0]) % 12 + 12 * (half[1] in "pP"))
    if len(parts) == 4:  # the last part are hundredths or thousandths of a second
        parts = [*parts[:2], f"{parts[2]}.{parts[3]}"]
    try:
        seconds = sum(float(part) * 60.0**i for i, part in enumerate(reversed(parts)))
    except ValueError:
        return float("nan")
    return -seconds if negative else seconds


def _column(series: pd.Series[Any], factor: float, *, gaps: bool = False) -> tuple[Array, list[str]]:
    with np.errstate(over="ignore"):
        values = factor * _numbers(series)
    bad = np.flatnonzero(~(np.abs(values) < MAX_VALUE) & ~(series.isna().to_numpy() & gaps))
    if len(bad) == 0:
        return values, []
    value = series.iloc[int(bad[0])]
    more = f" and {len(bad) - 1} more" if len(bad) > 1 else ""
    expected = f"expected numbers below {MAX_VALUE:g} (SI)" if np.isfinite(values[bad[0]]) else "expected numbers"
    return values, [f'{expected} in "{series.name}" but got {str(value)[:40]} in row {bad[0] + 1}{more}']


def _rising(t: Array, x: Array | None, interval: float | None) -> tuple[Array, tuple[str, ...]]:
    """Times (n,) that rise where a counter rolled over, or by an interval that is given, s; and a note."""
    t, notes = unrolled_clock(t, x)
    if interval and len(t) > 1 and _time_faults(t):
        words = "the time stamps do not rise: the rows are taken as evenly spaced by the given fps"
        return np.asarray(interval * np.arange(len(t)), dtype=np.float64), (words,)
    return t, notes


def unrolled_clock(t: Array, x: Array | None) -> tuple[Array, tuple[str, ...]]:
    """Return times (n,) of a counter that rolled over as one course, and a note.

    Beyond the usual step it then jumps back by the whole range of a counter, always the same, while positions x (n,) go
    on.
    """
    steps = np.diff(t)
    back = np.flatnonzero(steps < 0)
    if x is None or not len(back) or len(back) > MAX_ROLLOVERS_SHARE * len(t) or not np.any(steps > 0):
        return t, ()
    usual = float(np.median(steps[steps > 0]))
    full = float(min(COUNTER_RANGES, key=lambda one: abs(one + np.median(steps[back]) - usual)))
    moved = np.abs(np.diff(x))
    near = np.array([np.max(moved[[k for k in (i - 1, i + 1) if 0 <= k < len(moved)]]) for i in back])
    rolled = np.all(np.abs(steps[back] + full - usual) < MAX_JUMP_STEPS * usual) and np.ptp(t) <= full
    if not (rolled and np.all(moved[back] <= MAX_JUMP_STEPS * near)):
        return t, ()
    out = t + full * np.concatenate(([0.0], np.cumsum(steps < 0)))
    count = "once" if len(back) == 1 else f"{len(back)} times"
    return out, (f"the clock rolled over {count}, at {full:.10g} s: unwrapped",)


def _time_faults(t: Array) -> list[str]:
    if len(t) < 2:
        return [f"expected at least two rows but got {len(t)}"]
    steps = np.diff(t)
    repeated = np.sum(steps > 0) >= MIN_RISES  # the stamps are rounded, or the clock is read less often than rows come
    back = np.flatnonzero((steps < 0) if repeated and len(t) >= MIN_ROWS_FOR_REPEATS else (steps <= 0))
    if len(back):
        i = int(back[0])
        return [f"expected rising time but got {t[i + 1]:g} s after {t[i]:g} s in row {i + 2}; {TIME_REMEDY}"]
    if (step := float(np.median(steps[steps > 0]))) < MIN_INTERVAL_S:
        return [f"expected rows {MIN_INTERVAL_S:g} s apart or more but got {step:g} s; check the unit of the time"]
    return []
