"""Make a new study of recordings and tables: say what is in them, propose the keys, and write the study file."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from frictrack import measure, study
from frictrack.base.errors import FrictrackError, UsageError, result_or_none, suggest
from frictrack.base.files import replace_text
from frictrack.base.number_format import first_words, format_number
from frictrack.base.units import lacks_unit, parse_quantity
from frictrack.flow.opening import check_inputs, open_study
from frictrack.flow.plausibility_checks import known_pitch
from frictrack.flow.stages import run_pipeline
from frictrack.records import Array
from frictrack.sampling import unwrapped
from frictrack.study import COLUMNS, Study, columns_line, has_units, stated_unit

# "4000fps", "4 kHz"
RATE_IN_NAME = re.compile(r"(?<![\d.])(\d+(?:\.\d+)?)[ _-]?(k?)(?:fps|hz)(?![a-z])", re.IGNORECASE)
FROM_FILE, FROM_NAME = "stated by the file", "from its name"
STANDARD = ("t_s", "x_m")
SENSORS = {"drive": ("drive",), "sensor": ("friction", "a")}  # key of a run -> columns of its table
SWINGING = ("coulomb", "viscous", "spring")  # the first model of masses that swing
CAMERA_KEYS = {"scale": "px", "fps": "frames"}  # key of the camera -> unit of a table that needs it
MAX_TRACKS_SHOWN = 6  # names in a list of tracks
SAME_CORRELATION = 0.98  # of the steps of two columns, from which they hold the same, as two encoders do


@dataclass(frozen=True)
class Surveyed:
    """One recording as it was found."""

    path: Path  # the film, table, or folder of pictures
    words: str = ""  # what it holds, in a few words
    problem: str = ""  # why it cannot be used; empty if it can
    # fps, fps_source: frame rate of a film, 1/s, and where it comes from; None if neither file nor name tells the
    # camera's rate
    fps: float | None = None
    fps_source: str = ""
    # columns of every run of a table by short name, if the headers tell them with their units; one run without
    # columns of anything else
    runs: Sequence[Mapping[str, str]] = ({},)
    # lines of the study file that name the columns, one per run, if the units are missing or one of several tracks is
    # to be chosen
    columns_to_confirm: Sequence[str] = ()
    left_open: str = "units"  # what that line leaves open: "units" or "track"
    # keys of the camera that a table needs: "scale" for positions in px, "fps" for times in frames
    camera_keys: tuple[str, ...] = ()
    # n_frames, shape: number of frames of a film, and height and width of its pictures, px; 0 for a table
    n_frames: int = 0
    shape: tuple[int, int] = (0, 0)
    positions: Array | None = None  # positions of a table that needs no camera, m, (n,)
    stated: Mapping[str, str] = field(default_factory=dict)  # mass, fps and size of a count above the rows of a table
    keys: Mapping[str, str] = field(default_factory=dict)  # further keys of its runs
    sensor: str = ""  # "drive" or "sensor" of a table that has no positions but one of these, with its own clock
    needs_mass: bool = True  # whether its friction force is not measured, so that it follows from mass and acceleration

    @property
    def is_usable(self) -> bool:
        """Whether a run can be made of it without asking."""
        return not self.problem and not self.columns_to_confirm

    @property
    def is_table(self) -> bool:
        """Whether it is a table."""
        return study.is_table(self.path)


def survey_recording(path: Path) -> Surveyed:
    """Look at one recording.

    Parameters
    ----------
    path
        A film, a table, or a folder of pictures.

    """
    return _survey_table(path) if study.is_table(path) else _survey_film(path)


def _survey_film(path: Path) -> Surveyed:
    """Open a film; a frame rate in its name counts where the file tells none."""
    from frictrack.recording import open_recording  # noqa: PLC0415 - loads OpenCV; tables do without

    film = result_or_none(open_recording, path)
    fps, source = (rate_in_name(path.name), FROM_NAME) if film is None else (film.fps, FROM_FILE)
    try:
        film = film or open_recording(path, fps=fps or 1.0)
    except FrictrackError as e:
        return Surveyed(path, problem=str(e).removeprefix(f"{path.name}: "))
    height, width = film.shape
    rate = f", {fps:g} fps ({source})" if fps else ", frame rate of the camera not stated"
    words = f"{film.n_frames} frames of {width} x {height} px{rate}"
    source = source if fps else ""
    return Surveyed(path, words, fps=fps, fps_source=source, n_frames=film.n_frames, shape=(height, width))


def rate_in_name(name: str) -> float | None:
    """Return the frame rate in the name of a file, 1/s; None if there is none.

    Examples
    --------
    >>> rate_in_name("slow_4000fps.avi"), rate_in_name("run 7, 10kHz.mp4"), rate_in_name("v3.avi")
    (4000.0, 10000.0, None)

    """
    found = RATE_IN_NAME.search(name)
    return float(found[1]) * (1000.0 if found[2] else 1.0) if found else None


def _survey_table(path: Path) -> Surveyed:
    try:
        table = study.open_table(path, STANDARD)
        heads = list(map(str, table.frame.columns))
        if len(table.tracks) > 1 and not table.has_runs:
            return _several_tracks(path, table)
        if points := study.guess_points(heads):
            return _survey_points(path, table, points)
        runs = _runs_of_table(table)
        return _survey_runs(path, table, runs) if runs else _without_positions(path, heads)
    except FrictrackError as e:
        return Surveyed(path, problem=str(e).removeprefix(f"{path.name}: "))


def _survey_runs(path: Path, table: study.TableFile, runs: list[Mapping[str, str]]) -> Surveyed:
    """Read a table of times and positions, of one run or of several; raises FrictrackError."""
    heads, said = list(map(str, table.frame.columns)), study.stated(table.above)
    measured = "friction_N" in heads or all("friction" in one for one in runs)
    of_drive = "" if measured or any("drive" in one for one in runs) else _possible_drive(table, runs)
    if not all(has_units(one) or not one for one in runs):
        lines = [columns_line(one) for one in runs]
        bare = ", ".join(dict.fromkeys(h for one in runs for h in one.values() if not stated_unit(h)))
        words = f"{len(table.frame)} rows; the headers {bare} state no units{of_drive}"
        return Surveyed(path, words, columns_to_confirm=lines, needs_mass=not measured, stated=said)
    needed = _camera_keys(runs[0] or table.columns)
    read = [study.read_table(path, one, pixel=1.0, fps=1.0 if "fps" in needed else None) for one in runs]
    unit, written = ("frames", "{:.0f}") if "fps" in needed else ("s", "{:.3g}")
    lengths = ", ".join(written.format(data.t[-1] - data.t[0] + (unit == "frames")) for data in read)
    words = f"{', '.join(str(len(data.t)) for data in read)} rows, {lengths} {unit}"
    words = f"{len(runs)} runs of {words}" if len(runs) > 1 else words
    words += f" of a {table.program} export" if table.program else ""
    for one in runs[:MAX_TRACKS_SHOWN] if any(runs) else ():
        words += "; " + ", ".join(f'{key} is "{header}"' for key, header in one.items())
    known = {header for header, _ in COLUMNS.values()} | {header for one in runs for header in one.values()}
    force = study.unnamed_force(heads, known)
    if measured:
        words += '; friction is measured: no mass is needed, and normal_load = "5 N" gives its coefficient'
    elif force:
        words += (
            f'; is "{force}" the friction? Then name it in columns: friction = "{force}"; if the drive: drive = ...'
        )
    words += of_drive
    return Surveyed(
        path,
        words + "".join(f"; {key} {value} is stated above its rows" for key, value in said.items()),
        runs=runs,
        camera_keys=tuple(key for key in needed if key not in said),
        positions=None if needed or force else _free_course(read[0]),
        stated=said,
        needs_mass=not measured and "mass" not in said,
    )


def _free_course(data: study.TableData) -> Array | None:
    """Return the positions of a table, m, as one course; None where a drive moves the mass."""
    return None if data.x is None or data.drive is not None else unwrapped(data.x)[0]


def _possible_drive(table: study.TableFile, runs: Sequence[Mapping[str, str]]) -> str:
    """Name columns to and fro of no known unit, one of which may set the force of a drive; and say how it is given."""
    from pandas import to_numeric  # noqa: PLC0415 - loaded with the first table

    heads, read = list(map(str, table.frame.columns)), [header for header, _ in COLUMNS.values()]
    read += [h for one in (*runs, table.columns) for header in one.values() if (h := study.find_header(header, heads))]
    steps = {h: to_numeric(table.frame[h], errors="coerce").diff() for h in heads if h in read or not _has_use(h)}
    found = [h for h, step in steps.items() if h not in read and step.min() < 0 < step.max()]
    found = [
        h for h in found if not any(abs(steps[h].corr(steps[one])) > SAME_CORRELATION for one in read if one in steps)
    ]
    if not found:
        return ""
    line = f"drive = {json.dumps(study.base_name(found[0]) + ' (35 N)', ensure_ascii=False)}"
    what = "if one is a voltage, current or share of a drive, name it with its force per unit"
    return f"; not read: {first_words(found, MAX_TRACKS_SHOWN)}; {what}: {line}"


def _has_use(header: str) -> bool:
    """Whether the unit of a column is that of a short name."""
    return stated_unit(header) is not None and any(study.may_hold(header, key) for key in COLUMNS)


def _runs_of_table(table: study.TableFile) -> list[Mapping[str, str]]:
    """Return the columns of every run; none if it has no times and positions."""
    if table.has_runs:
        return [track.columns for track in table.tracks]
    columns, count = _columns(table), study.stated(table.above).get("count")
    if columns and count and stated_unit(columns["x"]) is None:
        columns["x"] += f" ({count})"
    return [] if columns is None else [columns]


def _without_positions(path: Path, heads: Sequence[str]) -> Surveyed:
    """Say what a table without positions holds, and what to do with it."""
    shown = first_words(heads, MAX_TRACKS_SHOWN)
    kind = next((kind for kind, keys in SENSORS.items() if any(COLUMNS[key][0] in heads for key in keys)), "")
    if COLUMNS["t"][0] in heads and kind:
        use = f'write {kind} = "{path.name}" in the [[run]] that it belongs to'
        return Surveyed(path, problem=f"{shown}: a {kind} with its own clock; {use}", sensor=kind)
    units = [stated_unit(head) for head in heads]
    forces = any(unit == "g" or study.may_hold(f"({unit})", key) for unit in units if unit for key in ("friction", "a"))
    also = "; a force or an acceleration needs positions of the same run beside it, in columns or a table of their own"
    return Surveyed(path, problem=f"no column of times and no column of positions in it, but {shown}{also * forces}")


def _with_sensors(found: Sequence[Surveyed], sensors: Sequence[Surveyed]) -> Iterator[Surveyed]:
    """Yield the tables with the drive or sensor whose file name holds their own, or that is the only one of all."""
    for one in found:
        only = sensors if len(sensors) == len(found) == 1 else ()
        own = [each for each in sensors if _names_run(each.path.stem, one.path.stem)] or only
        if len(own) != 1 or not one.is_table:
            yield one
            continue
        words = f'{one.words}; {own[0].sensor} is "{own[0].path.name}"'
        yield replace(one, words=words, keys={own[0].sensor: own[0].path.name})


def _names_run(name: str, run: str) -> bool:
    """Whether the name of a file holds that of a run as a word: "drive_a" that of "a"."""
    return run.casefold() in re.split(r"[\W_]+", name.casefold())


def _survey_points(path: Path, table: study.TableFile, columns: dict[str, str]) -> Surveyed:
    """Read a table of points (v, F) at constant speeds; raises FrictrackError."""
    if not has_units(columns):
        words = f"{len(table.frame)} rows; the headers {', '.join(columns.values())} state no units"
        return Surveyed(path, words, columns_to_confirm=[columns_line(columns)], needs_mass=False)
    data = measure.tables.points_of_table(study.read_points(path, columns))
    assert data.v is not None
    named = ", ".join(f'{key} is "{header}"' for key, header in columns.items())
    speeds = f"{data.v.min():.3g} to {data.v.max():.3g} m/s"
    words = f"{len(data.v)} points (v, F) at constant speeds, {speeds}; {named}"
    return Surveyed(path, words, runs=[columns], needs_mass=False)


def _several_tracks(path: Path, table: study.TableFile) -> Surveyed:
    """Propose the first of several tracks; the user chooses."""
    headers = [track.columns["x"] for track in table.tracks]
    shown = first_words(headers, MAX_TRACKS_SHOWN)
    words = f"{len(table.frame)} frames with {len(headers)} tracks of {table.program}: {shown}"
    lines = [columns_line({"x": headers[0]})]
    needed = _camera_keys(table.tracks[0].columns)
    return Surveyed(path, words, columns_to_confirm=lines, left_open="track", camera_keys=needed)


def _camera_keys(columns: Mapping[str, str]) -> tuple[str, ...]:
    """Return the keys of the camera that some headers need."""
    return tuple(key for key, unit in CAMERA_KEYS.items() if any(stated_unit(h) == unit for h in columns.values()))


def _columns(table: study.TableFile) -> dict[str, str] | None:
    """Return the columns that a study file must name; none for standard headers; None if there is no time or position.

    The columns of a known program need no name.
    """
    proposed = study.propose_columns(table.frame, table.columns)
    heads = list(map(str, table.frame.columns))
    if {"t", "x"} <= table.columns.keys() or {head.split(" (")[0] for head in heads} >= set(STANDARD):
        return {}
    known = [key for key, name in zip(("t", "x"), STANDARD, strict=True) if name in heads or key in proposed]
    return proposed if len(known) == len(STANDARD) else None


def _near(path: Path) -> str:
    """Name the file of its folder that a missing file may be."""
    hint = suggest(path.name, [one.name for one in path.parent.iterdir()] if path.parent.is_dir() else [])
    return f"; {hint}" if hint.startswith("did") else "; check its folder"


def expand_folders(paths: Sequence[Path]) -> list[Path]:
    """Replace folders that hold films or tables by what they hold; one of pictures or tracks is a recording itself."""
    missing = [f"expected a recording {p} but there is no such file{_near(p)}" for p in paths if not p.exists()]
    found: list[Path] = []
    for path in () if missing else paths:
        found += [path] if _is_one_recording(path) else study.find_recordings(path)
    places = [path.resolve() for path in found]
    again = [path for i, path in enumerate(found) if places[i] in places[:i]]
    twice = [f"expected each recording once but got {path} twice" for path in again]
    if missing or twice:
        raise UsageError("; ".join(missing + twice))
    return found


def _is_one_recording(path: Path) -> bool:
    """Return whether a path is a file, or a folder that is a recording itself."""
    return not path.is_dir() or study.writing.is_picture_folder(path) or study.is_table(path)


FILL_IN = "FILL IN: "  # before the explanation of a key that must be given
LEFT_OPEN = {
    "units": "with the units of the file, or the size of a count, in the brackets",
    "track": "with the name of the track",
}
_KEY = re.compile(r'\b(mass|scale|fps) = (?="?[\d.])')


def check_entered(keys: Mapping[str, Any]) -> None:
    """Refuse implausible numbers of the command line before anything is written.

    Parameters
    ----------
    keys
        mass, scale and fps as they were typed; None if not given.

    Raises
    ------
    FrictrackError
        (usage) With all of them, each with what was read and what to type instead.

    """
    checked = 'if it is right, set plausible = "checked"'
    in_file = f"{checked} in a study file, which `frictrack init` writes"
    implausible = measure.plausibility.implausible_entries(read_keys(keys))
    found = [_KEY.sub(r"--\1 ", str(one)).replace(checked, in_file) for one in implausible]
    if found:
        raise UsageError("; ".join(found))


def read_keys(keys: Mapping[str, Any]) -> measure.plausibility.EnteredValues:
    """Read the numbers that a user typed."""
    mass, scale, fps = (keys.get(key) for key in ("mass", "scale", "fps"))
    bare = frozenset(key for key in ("mass", "scale") if lacks_unit(keys.get(key)))
    try:
        kilograms = None if mass in (None, "fit") else parse_quantity(mass, "kg", "mass", above=0.0)[0]
        return measure.plausibility.EnteredValues(mass=kilograms, pitch=known_pitch(scale), fps=fps, bare=bare)
    except ValueError as e:
        raise UsageError(str(e)) from e


def describe_keys(keys: Mapping[str, Any]) -> str:
    """Describe the numbers of the command line as they were read.

    Examples
    --------
    >>> describe_keys({"mass": "350g", "scale": "0.5mm/px", "fps": 4000.0})
    'mass 0.350 kg, scale 0.500 mm/px, 4000 fps'

    """
    read = read_keys(keys)
    numbers = (("mass {} kg", read.mass, 1.0), ("scale {} mm/px", read.pitch, 1e3))
    said = [words.format(format_number(factor * value)) for words, value, factor in numbers if value is not None]
    return ", ".join([*said, *([] if read.fps is None else [f"{read.fps:g} fps"])])


def start_study(
    path: Path,
    recordings: Sequence[Path],
    keys: Mapping[str, Any],
    tell: Callable[[str], None] = lambda line: None,
    *,
    allow_incomplete: bool = False,
) -> Study:
    """Write the study file of some recordings and open it; it is removed again if a recording cannot be used.

    Parameters
    ----------
    path
        Path of the new study file.
    recordings
        Films and tables, and folders of them.
    keys
        Known keys of ``[study]`` and ``[camera]``: mass, model, fps, scale.
    tell
        Called with one line about each recording.
    allow_incomplete
        Mass, scale and frame rate may still be missing.

    Raises
    ------
    FrictrackError
        (usage) If the study file exists or a recording is missing; otherwise what is wrong with each recording.

    """
    paths = expand_folders(recordings)
    study.writing.refuse_existing(path)
    read_keys(keys)
    found = [survey_recording(one) for one in paths]
    for one in found:
        if one.is_usable:
            tell(f"{one.path}: {one.words}")
    faults = [f"{one.path.name}: {one.problem or _to_confirm(one)}" for one in found if not one.is_usable]
    if faults:
        raise FrictrackError("; ".join(faults))
    study.write_study(path, [new for one in found for new in _new_runs(one, keys)], keys)
    try:
        made = open_study(path, allow_incomplete=allow_incomplete)
        if not allow_incomplete:
            check_inputs([run_pipeline(made, run) for run in made.runs])
    except FrictrackError:
        path.unlink()
        raise
    return made


def _to_confirm(one: Surveyed) -> str:
    return (
        f"{one.words}; `frictrack init {one.path.parent}` writes a study file, in which its columns are to be named: "
        f"{one.columns_to_confirm[0]}, {LEFT_OPEN[one.left_open]}"
    )


def _new_runs(one: Surveyed, keys: Mapping[str, Any]) -> list[study.writing.NewRun]:
    """Return the entries of its runs: the frame rate of its name, if nothing else tells it, and columns of a table."""
    rate = {"fps": _whole(one.fps)} if one.fps and one.fps_source != FROM_FILE else {}
    above = {key: one.stated[key] for key in ("mass", "fps") if key in one.stated}
    own: dict[str, Any] = {key: value for key, value in {**rate, **one.keys, **above}.items() if not keys.get(key)}
    if one.columns_to_confirm:
        comments = [f"FILL IN the {one.left_open}: {line}" for line in one.columns_to_confirm]
        return [study.writing.NewRun(one.path, own, comment) for comment in comments]
    return [study.writing.NewRun(one.path, own | ({"columns": columns} if columns else {})) for columns in one.runs]


def _whole(rate: float | None) -> float | None:
    """Return a whole number as an integer, which a study file shows without a fraction."""
    return int(rate) if rate is not None and rate == int(rate) else rate


def propose_study(places: Path | Sequence[Path], keys: Mapping[str, Any]) -> dict[str, Any]:
    """Write a commented study file for what a folder holds, or for some recordings: JSON of `frictrack init`.

    Parameters
    ----------
    places
        Folder with recordings; or recordings, beside the first of which the study file is written.
    keys
        Known keys of ``[study]`` and ``[camera]``: mass, fps, scale.

    Returns
    -------
    dict
        "study" and "output", the path of the file; "runs", names of the recordings in it; "found" and "skipped", what
        each file holds or why it was left out; "fill_in", the keys that the user must give.

    Raises
    ------
    FrictrackError
        (usage) If there is no such folder, or the study file exists; otherwise if it has no recordings.

    """
    paths = [places] if isinstance(places, Path) else list(places)
    if lacking := [path for path in paths if not path.exists()]:
        raise UsageError(f"expected a folder with recordings, or recordings, but got {lacking[0]}")
    one_folder = len(paths) == 1 and not _is_one_recording(paths[0])
    folder = paths[0] if one_folder else paths[0].parent
    study.writing.refuse_existing(folder / "study.toml")
    seen = [survey_recording(path) for path in (study.list_files(folder) if one_folder else paths)]
    found = [one for one in seen if not one.problem]
    found = list(_with_sensors(found, [one for one in seen if one.sensor]))
    used = {name for one in found for name in one.keys.values()}
    seen = [one for one in seen if one.path.name not in used]
    skipped = [{"file": one.path.name, "reason": one.problem} for one in seen if one.problem]
    if not found:
        reasons = "".join(f"; {one['file']}: {one['reason']}" for one in skipped)
        raise FrictrackError(f"expected films or tables in {folder} but found none{reasons}")
    swings = {one.path.name: one.positions for one in found if one.positions is not None}
    shifted = measure.plausibility.shifted_swings(swings)
    shifts = {name: f"; {measure.plausibility.describe_shift(shift, first)}" for name, first, shift in shifted}
    rates = {one.fps for one in found if not one.is_table}
    common = {"fps": _whole(next(iter(rates)))} if len(rates) == 1 and None not in rates and not keys.get("fps") else {}
    known = {key: value for key, value in (*keys.items(), *common.items()) if value is not None}
    remarks = _remarks(found, known)
    swinging = [measure.plausibility.swing_centre(x) is not None for x in swings.values()]
    if swings and all(swinging) and all(one.needs_mass for one in found) and not known.get("model"):
        known["model"] = list(SWINGING)
        remarks["model"] = "the positions swing about one place, so that a spring, or its weight, draws the mass back; "
    runs = [new for one in found for new in _new_runs(one, known)]
    path = study.write_study(folder / "study.toml", runs, known, commented=True, remarks=remarks)
    if "model" in remarks and shifts:
        spring = {"effect": "spring", "per_run": ["x_0"]}
        replace_text(path, study.writing.with_effect(path.read_text(encoding="utf-8"), spring))
    return {
        "study": str(path),
        "runs": [one.path.name for one in found],
        "found": [{"file": one.path.name, "words": one.words + shifts.get(one.path.name, "")} for one in found],
        "skipped": skipped,
        "fill_in": [key for key, words in remarks.items() if words.startswith("FILL IN")]
        + [f"columns of {one.path.name}" for one in found if one.columns_to_confirm],
        "output": str(path),
    }


def _remarks(found: Sequence[Surveyed], known: Mapping[str, Any]) -> dict[str, str]:
    """Return words before the explanation of a key: that it is to be filled in, or where its value comes from."""
    films = [one for one in found if not one.is_table]
    needed = {*(("scale",) if films else ()), *(key for one in found for key in one.camera_keys)}
    needed |= {"mass"} if any(one.needs_mass for one in found) else set()
    remarks = {key: FILL_IN for key in ("mass", "scale", "fps") if key not in known and key in needed}
    unknown = ", ".join(one.path.name for one in films if one.fps is None)
    if unknown and "fps" not in known:
        remarks["fps"] = f"{FILL_IN}(not stated by {unknown}; an .avi or .mp4 often states the speed of showing) "
    elif films and known.get("fps") == films[0].fps:
        remarks["fps"] = f"{films[0].fps_source}: "
    return remarks
