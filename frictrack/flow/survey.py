"""Look at recordings before a study is made of them: what they hold, their frame rate, their columns."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from frictrack.base.errors import FrictrackError
from frictrack.records import Array
from frictrack.study import (
    TableFile,
    columns_line,
    has_units,
    is_table,
    may_hold,
    open_table,
    propose_columns,
    read_table,
    stated_unit,
    suggest,
)

RATE_IN_NAME = re.compile(
    r"(?<![\d.])(\d+(?:\.\d+)?)[ _-]?(k?)(?:fps|hz)(?![a-z])", re.IGNORECASE
)  # "4000fps", "4 kHz"
FROM_FILE, FROM_NAME = "stated by the file", "from its name"
STANDARD = ("t_s", "x_m")
CAMERA_KEYS = {"scale": "px", "fps": "frames"}  # key of the camera -> unit of a table that needs it
MAX_TRACKS_SHOWN = 6  # names in a list of tracks


@dataclass(frozen=True)
class Surveyed:
    """One recording as it was found.

    Parameters
    ----------
    path
        The film, table, or folder of pictures.
    words
        What it holds, in a few words.
    problem
        Why it cannot be used; empty if it can.
    fps, fps_source
        Frame rate of a film, 1/s, and where it comes from; None if neither file nor name tells the camera's rate.
    runs
        Columns of every run of a table by short name, if the headers tell them with their units; one run without
        columns of anything else.
    columns_to_confirm
        Lines of the study file that name the columns, one per run, if the units are missing or one of several tracks
        is to be chosen.
    left_open
        What that line leaves open: "units" or "track".
    camera_keys
        Keys of the camera that a table needs: "scale" for positions in px, "fps" for times in frames.
    n_frames, shape
        Number of frames of a film, and height and width of its pictures, px; 0 for a table.
    positions
        Positions of a table that needs no camera, m, (n,).
    needs_mass
        Whether its friction force is not measured, so that it follows from mass and acceleration.

    """

    path: Path
    words: str = ""
    problem: str = ""
    fps: float | None = None
    fps_source: str = ""
    runs: Sequence[Mapping[str, str]] = ({},)
    columns_to_confirm: Sequence[str] = ()
    left_open: str = "units"
    camera_keys: tuple[str, ...] = ()
    n_frames: int = 0
    shape: tuple[int, int] = (0, 0)
    positions: Array | None = None
    needs_mass: bool = True

    @property
    def is_usable(self) -> bool:
        """Whether a run can be made of it without asking."""
        return not self.problem and not self.columns_to_confirm

    @property
    def is_table(self) -> bool:
        """Whether it is a table."""
        return is_table(self.path)


def survey_recording(path: Path) -> Surveyed:
    """Look at one recording.

    Parameters
    ----------
    path
        A film, a table, or a folder of pictures.

    """
    if is_table(path):
        return _survey_table(path)
    return _survey_film(path)


def _survey_film(path: Path) -> Surveyed:
    """Open a film; a frame rate in its name counts where the file tells none."""
    from frictrack.recording import open_recording  # noqa: PLC0415 - loads OpenCV; tables do without

    fps, source = None, FROM_FILE
    try:
        film = open_recording(path)
        fps = film.fps
    except FrictrackError:
        fps, source = rate_in_name(path.name), FROM_NAME
        try:
            film = open_recording(path, fps=fps or 1.0)
        except FrictrackError as e:
            return Surveyed(path, problem=str(e).removeprefix(f"{path.name}: "))
    height, width = film.shape
    rate = f", {fps:g} fps ({source})" if fps else ", frame rate of the camera not stated"
    words = f"{film.n_frames} frames of {width} x {height} px{rate}"
    return Surveyed(
        path, words, fps=fps, fps_source=source if fps else "", n_frames=film.n_frames, shape=(height, width)
    )


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
        table = open_table(path, STANDARD)
        if len(table.tracks) > 1 and not table.has_runs:
            return _several_tracks(path, table)
        columns = _columns(table)
        if columns is None and not table.has_runs:
            heads = ", ".join(map(str, table.frame.columns))
            return Surveyed(path, problem=f"no column of times and no column of positions in it, but {heads[:60]}")
        runs = [track.columns for track in table.tracks] if table.has_runs else [columns or {}]
        measured = "friction_N" in table.frame.columns or all("friction" in one for one in runs)
        if not all(has_units(one) or not one for one in runs):
            lines = [columns_line(one) for one in runs]
            bare = ", ".join(dict.fromkeys(h for one in runs for h in one.values() if not stated_unit(h)))
            words = f"{len(table.frame)} rows; the headers {bare} state no units"
            return Surveyed(path, words, columns_to_confirm=lines, needs_mass=not measured)
        read = [read_table(path, one, pixel=1.0, fps=1.0) for one in runs]
    except FrictrackError as e:
        return Surveyed(path, problem=str(e).removeprefix(f"{path.name}: "))
    needed = _camera_keys(runs[0] or table.columns)
    ends = [data.t[-1] - data.t[0] for data in read]
    lengths = ", ".join(f"{end + 1:.0f}" if "fps" in needed else f"{end:.3g}" for end in ends)
    words = f"{', '.join(str(len(data.t)) for data in read)} rows, {lengths} {'frames' if 'fps' in needed else 's'}"
    named = f" of a {table.program} export" if table.program else ""
    if len(runs) > 1:
        words = f"{len(runs)} runs of {words}"
    for one in runs[:MAX_TRACKS_SHOWN] if any(runs) else ():
        named += "; " + ", ".join(f'{key} is "{header}"' for key, header in one.items())
    force = next((h for h in map(str, table.frame.columns) if stated_unit(h) and may_hold(h, "friction")), None)
    if measured:
        named += '; friction is measured: no mass is needed, and normal_load = "5 N" gives its coefficient'
    elif force and not any(force in one.values() for one in runs):
        named += f'; is "{force}" the friction? Then name it in columns: friction = "{force}"'
    positions = None if needed else read[0].x
    words += named
    return Surveyed(path, words, runs=runs, camera_keys=needed, positions=positions, needs_mass=not measured)


def _several_tracks(path: Path, table: TableFile) -> Surveyed:
    """Propose the first of several tracks; the user chooses."""
    headers = [track.columns["x"] for track in table.tracks]
    more = f" and {len(headers) - MAX_TRACKS_SHOWN} more" if len(headers) > MAX_TRACKS_SHOWN else ""
    shown = ", ".join(headers[:MAX_TRACKS_SHOWN]) + more
    words = f"{len(table.frame)} frames with {len(headers)} tracks of {table.program}: {shown}"
    lines = [columns_line({"x": headers[0]})]
    needed = _camera_keys(table.tracks[0].columns)
    return Surveyed(path, words, columns_to_confirm=lines, left_open="track", camera_keys=needed)


def _camera_keys(columns: Mapping[str, str]) -> tuple[str, ...]:
    """Return the keys of the camera that some headers need."""
    return tuple(key for key, unit in CAMERA_KEYS.items() if any(stated_unit(h) == unit for h in columns.values()))


def _columns(table: TableFile) -> dict[str, str] | None:
    """Return the columns that a study file must name; none for standard headers; None if there is no time or position.

    The columns of a known program need no name.
    """
    proposed = propose_columns(table.frame, table.columns)
    heads = list(map(str, table.frame.columns))
    if {"t", "x"} <= table.columns.keys() or all(
        any(head.split(" (")[0] == name for head in heads) for name in STANDARD
    ):
        return {}
    known = [key for key, name in zip(("t", "x"), STANDARD, strict=True) if name in heads or key in proposed]
    return proposed if len(known) == len(STANDARD) else None


def _near(path: Path) -> str:
    """Name the file of its folder that a missing file may be."""
    hint = suggest(path.name, [one.name for one in path.parent.iterdir()] if path.parent.is_dir() else [])
    return f"; {hint}" if hint.startswith("did") else "; check its folder"


def expand_folders(paths: Sequence[Path]) -> list[Path]:
    """Replace folders that hold films or tables by what they hold; one of pictures or tracks is a recording itself.

    Parameters
    ----------
    paths
        Recordings and folders.

    Raises
    ------
    FrictrackError
        (usage) If a path does not exist, or comes twice.

    """
    from frictrack.study import find_recordings, is_picture_folder  # noqa: PLC0415 - only used here

    missing = [f"expected a recording {p} but there is no such file{_near(p)}" for p in paths if not p.exists()]
    found: list[Path] = []
    for path in () if missing else paths:
        alone = not path.is_dir() or is_picture_folder(path) or is_table(path)
        found += [path] if alone else find_recordings(path)
    places = [path.resolve() for path in found]
    twice = [
        f"expected each recording once but got {path} twice" for i, path in enumerate(found) if places[i] in places[:i]
    ]
    if missing or twice:
        raise FrictrackError("; ".join(missing + twice), usage=True)
    return found
