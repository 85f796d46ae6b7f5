"""Read tracks of pose estimation and of image correlation.

Pose estimation: DeepLabCut (.csv, .h5), datasets of movement (.nc), analysis files of SLEAP (.h5).

A table of DeepLabCut as text has rows scorer, (individuals,) bodyparts, coords above the columns. Each point has the
columns x, y in px (y down) and likelihood; the first column holds the number of the frame. The file is what
``pandas.DataFrame.to_csv`` makes of the table in ``pose_estimation_tensorflow/predict_videos.py`` and
``pose_estimation_pytorch/apis/videos.py`` of github.com/DeepLabCut/DeepLabCut.

`hdf5_contents` opens files in HDF5 in a process of its own.

Image correlation: solutions of DICe, arrays of pyidi.

DICe (Digital Image Correlation Engine, Sandia) writes one file per frame, or one per subset. Lines that begin with
*** stand above the names of the columns. A file per frame has a row for each subset, and the number of the frame in
its name, ``DICe_solution_012.txt``; a file per subset has a row for each frame, and its own number in its name. The
position, px (y down), is the reference COORDINATE plus the DISPLACEMENT. SIGMA is the standard deviation of the
displacement, px. DICe sets it to -1 where the correlation failed (``Schema::record_failed_step``); STATUS_FLAG then
says why, as a number above 0. Source: ``Output_Spec::write_frame`` of github.com/dicengine/dice.

Displacements of pyidi are read from a NumPy array: (points, frames, 2) in px, rows (y) before columns (x).

pyidi itself saves ``results.pkl`` (``IDIMethod.save`` of github.com/ladisk/pyidi). A pickle can run any code when it is
opened, so it is refused; ``numpy.save`` writes what ``get_displacements`` returns without that risk.
"""

from __future__ import annotations

import csv
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from frictrack.records import Array
from frictrack.study.table_layout import TableFile, TrackColumns, check_size

LEVELS = (("scorer", "bodyparts", "coords"), ("scorer", "individuals", "bodyparts", "coords"))  # rows of the header


def is_deeplabcut_text(path: Path) -> bool:
    """Return whether a file begins with the header of DeepLabCut."""
    return _levels(path) is not None


def read_deeplabcut_text(path: Path) -> TableFile:
    """Read the points of a table of DeepLabCut, by frame; unlikely ones count as missing."""
    levels = _levels(path) or LEVELS[0]
    with path.open(encoding="utf-8-sig", newline="") as file:
        try:
            head = [row[1:] for row in islice(csv.reader(file), len(levels))]
        except csv.Error as e:
            raise ValueError(str(e)) from e
        cells = pd.read_csv(file, header=None)
    names = list(zip(*head[1:], strict=False))  # without the scorer
    if len(names) != len(cells.columns) - 1:
        raise ValueError(f"{len(names)} columns in the header but {len(cells.columns) - 1} in the rows")
    values = cells.apply(pd.to_numeric, errors="raise").to_numpy(dtype=float)
    return deeplabcut_table(names, values[:, 0], values[:, 1:])


def deeplabcut_table(names: Sequence[Sequence[str]], frames: Array, values: Array) -> TableFile:
    """Return the table of some columns of DeepLabCut."""
    points: dict[tuple[str, ...], dict[str, Array]] = {}
    for name, column in zip(names, values.T, strict=True):
        points.setdefault(tuple(name[:-1]), {})[name[-1]] = column
    alone = len({name[0] for name in points}) == 1
    tracks = []
    for name, columns in points.items():
        if not columns.keys() >= {"x", "y"}:
            raise ValueError(f"expected columns x and y of {' '.join(name)} but got {', '.join(columns)}")
        shown = " ".join(name[1:] if alone and len(name) > 1 else name)
        track = TargetPositions(shown, frames, columns["x"], columns["y"])
        tracks.append(with_likely_points(track, columns.get("likelihood", np.full(len(frames), np.nan))))
    return table_of_tracks("DeepLabCut", tracks, FRAMES)


def _levels(path: Path) -> tuple[str, ...] | None:
    """Return the names of the rows above the columns; None if it is no table of DeepLabCut."""
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
        firsts = tuple(line.split(",", 1)[0] for line in islice((file.readline(1 << 20) for _ in range(4)), 4))
    return next((levels for levels in LEVELS if firsts[: len(levels)] == levels), None)


SIGNATURE = b"\x89HDF\r\n\x1a\n"
NETCDF_3 = b"CDF"
TIMEOUT_S, BYTES_PER_EXTRA_SECOND = 30.0, 2e6
_CHILD = "from frictrack.study.track_formats.hdf5_contents import run; run()"


def is_hdf5(path: Path) -> bool:
    """Return whether a file is HDF5, or netCDF of the older kind, which is refused with a sentence."""
    with path.open("rb") as file:
        return file.read(len(SIGNATURE)).startswith((SIGNATURE, NETCDF_3))


def read_hdf5_tracks(path: Path) -> TableFile:
    """Read tracks in HDF5, by time if the file states it, else by frame."""
    found = read_arrays(path)
    if "frames" in found:
        return deeplabcut_table([tuple(map(str, name)) for name in found["names"]], found["frames"], found["values"])
    at, source = found["at"], str(found["source"])
    alone = [len(set(names)) == 1 for names in found["names"].T]
    tracks = []
    for name, x, y, confidence in zip(found["names"], found["x"], found["y"], found["confidence"], strict=True):
        shown = " ".join(str(part) for part, same in zip(name, alone, strict=True) if not same)
        track = TargetPositions(shown, at, x, y)
        tracks.append(with_likely_points(track, confidence) if source == "DeepLabCut" else track)
    return table_of_tracks(str(found["program"]), tracks, SECONDS if found["in_seconds"] else FRAMES)


def read_arrays(path: Path) -> Mapping[str, Any]:
    """Return the arrays that the other process finds in a file; `ValueError` if it cannot read it."""
    return _arrays_of(path.absolute(), path.stat().st_size, path.stat().st_mtime_ns)


@lru_cache(maxsize=1)  # a table is opened for its columns, its units and for every run in it
def _arrays_of(path: Path, size: int, *_: int) -> Mapping[str, Any]:
    with path.open("rb") as file:
        if file.read(len(NETCDF_3)) == NETCDF_3:
            raise ValueError('it is netCDF 3; write it with engine="netcdf4" or "h5netcdf"')
    call = [sys.executable, "-P", "-c", _CHILD, str(path)]
    timeout = TIMEOUT_S + size / BYTES_PER_EXTRA_SECOND
    try:
        done = subprocess.run(call, capture_output=True, timeout=timeout, check=False)
    except subprocess.TimeoutExpired as e:
        raise ValueError(f"it could not be opened within {timeout:.0f} s; it is damaged") from e
    if done.returncode != 0:
        raise ValueError("it could not be opened; it is damaged")
    with np.load(BytesIO(done.stdout), allow_pickle=False) as arrays:
        found = dict(arrays)
    if "error" in found:
        raise ValueError(str(found["error"]))
    return found


NAME = "DICe_solution_*.txt"
FRAME, SUBSET = "FRAME", "SUBSET_ID"  # first column of a file per subset, and per frame
COLUMNS_READ = ("COORDINATE_X", "COORDINATE_Y", "DISPLACEMENT_X", "DISPLACEMENT_Y")
MAX_HEAD_LINES, MAX_LINE = 200, 1 << 16
_NUMBER = re.compile(r"\d+")


def is_dice_folder(path: Path) -> bool:
    """Return whether a folder holds solutions of DICe."""
    return any(path.glob(NAME))


def is_dice_file(path: Path) -> bool:
    """Return whether a text is a solution of DICe."""
    return bool(_dice_header(path).names)


def read_dice(path: Path) -> TableFile:
    """Read the subsets of DICe, by frame, with their standard deviations; failed frames are missing."""
    files = sorted(path.glob(NAME), key=lambda one: (_number_in(one), one.name)) if path.is_dir() else [path]
    check_size(*files)
    parts = [_solution(one) for one in files]
    if len({part.columns[0] for part in parts}) != 1:
        raise ValueError("expected solutions of one kind, by frame or by subset, but got both")
    if parts[0].columns[0] == SUBSET and not path.is_dir():
        raise ValueError("it is the solution of one frame; name the folder of all frames instead")
    cells = pd.concat(parts, ignore_index=True)
    return table_of_tracks("DICe", [_track(rows) for _, rows in cells.groupby(SUBSET)], FRAMES)


def _solution(path: Path) -> pd.DataFrame:
    """Return the rows of one file, with the number of the frame and of the subset."""
    header = _dice_header(path)
    if not (names := header.names):
        raise ValueError(f"{path.name} has no column {FRAME} or {SUBSET}")
    if missing := [name for name in COLUMNS_READ if name not in names]:
        raise ValueError(f"{path.name} lacks {', '.join(missing)}; add them to the output_spec of DICe")
    how: dict[str, Any] = {"sep": header.separator, "skiprows": header.lines_above + 1, "header": None}
    rows = pd.read_csv(path, names=names, index_col=False, encoding_errors="replace", **how)
    rows = rows.apply(pd.to_numeric, errors="raise")
    return rows.assign(**{FRAME if names[0] == SUBSET else SUBSET: _number_in(path)})


class _Header(NamedTuple):
    """The names of the columns of a solution, none if DICe did not write it, and how they stand in the file."""

    names: list[str]
    lines_above: int = 0
    separator: str = ","


def _dice_header(path: Path) -> _Header:
    """Find the names of the columns."""
    with path.open(encoding="utf-8", errors="replace") as file:
        for i in range(MAX_HEAD_LINES):
            line = file.readline(MAX_LINE)
            if not line.startswith("***"):
                names = line.replace(",", " ").split()
                known = names[:1] in ([FRAME], [SUBSET]) and "COORDINATE_X" in names
                return _Header(names if known else [], i, "," if "," in line else r"\s+")
    return _Header([])


def _number_in(path: Path) -> int:
    """Return the last number in the name of a file."""
    return int((_NUMBER.findall(path.stem) or ["0"])[-1])


def _track(rows: pd.DataFrame) -> TargetPositions:
    """Return the positions of one subset; where the correlation failed there is none."""
    rows = rows.sort_values(FRAME).drop_duplicates(FRAME)
    sigma = rows["SIGMA"].to_numpy(dtype=float) if "SIGMA" in rows else None
    failed = np.zeros(len(rows), dtype=bool) if sigma is None else sigma < 0
    places = (rows[f"COORDINATE_{axis}"] + rows[f"DISPLACEMENT_{axis}"] for axis in "XY")
    x, y = (np.where(failed, np.nan, place.to_numpy(dtype=float)) for place in places)
    note = f"DICe could not match {np.sum(failed)} of {len(failed)} frames; they are missing" if np.any(failed) else ""
    if sigma is not None:
        sigma = np.where(failed, np.nan, sigma)
        if np.any(sigma[np.isfinite(x)] <= 0):  # pictures without noise
            sigma = None
    name, frames = f"subset {rows[SUBSET].iloc[0]:.0f}", rows[FRAME].to_numpy(dtype=float)
    return TargetPositions(name, frames, x, y, sigma=sigma, note=note)


SAVE = 'numpy.save("displacements.npy", displacements)'


def read_pyidi_displacements(path: Path) -> TableFile:
    """Read the displacements of points, by frame."""
    found = np.load(path, mmap_mode="r", allow_pickle=False)  # the size is checked before anything is read
    if found.ndim != 3 or found.shape[2] != 2 or found.dtype.kind != "f":
        raise ValueError(f"expected displacements (points, frames, 2) but got {found.dtype} {found.shape}")
    frames = np.arange(found.shape[1], dtype=float)
    points = (np.array(point, dtype=float) for point in found)
    tracks = [TargetPositions(f"point {i}", frames, point[:, 1], point[:, 0]) for i, point in enumerate(points)]
    return table_of_tracks("pyidi", tracks, FRAMES)


def refuse_pickle(path: Path) -> TableFile:
    """Raise `ValueError`: opening a pickle could run any code."""
    raise ValueError(f"a pickle, which can run any code when it is opened, is never read; save with {SAVE}")


SECONDS, FRAMES = "t (s)", "frame (frames)"  # headers of the two clocks
MAX_CELLS = 1 << 25  # of one table
MIN_LIKELIHOOD = 0.6  # pcutoff, below which DeepLabCut takes a point for not seen (its config.yaml)


@dataclass(frozen=True, eq=False)
class TargetPositions:
    """The positions of one target."""

    name: str  # its name in the other program
    at: Array  # times, s, or numbers of the frames in which it was measured, (n,)
    x: Array  # x, y: position in these frames, in `unit`, (n,); NaN where there is none
    y: Array
    unit: str = "px"  # unit of the positions, such as "m" or "px"
    y_down: bool = True  # whether y points down, as in a picture
    sigma: Array | None = None  # standard deviation of the positions, in `unit`, (n,); None if the program states none
    further: Mapping[str, Array] = field(default_factory=dict)  # other columns of it, by header, (n,) each
    note: str = ""  # what the user is to know about its frames


def table_of_tracks(program: str, tracks: Sequence[TargetPositions], clock: str) -> TableFile:
    """Return the table of some tracks; headers hold the name of the track if there are several.

    Parameters
    ----------
    program
        The program that wrote them.
    tracks
        The tracks; those without any position are left out.
    clock
        `SECONDS` or `FRAMES`: what `TargetPositions.at` counts.

    Raises
    ------
    ValueError
        If no track has a position, or there are too many.

    """
    seen = [track for track in tracks if np.any(np.isfinite(track.x))]
    if not seen:
        raise ValueError("it holds no track with positions")
    at = np.unique(np.concatenate([track.at for track in seen]))
    if len(at) * len(seen) > MAX_CELLS:
        raise ValueError(f"{len(seen)} tracks over {len(at)} frames are too many; leave out those that you do not need")
    cells: dict[str, Array] = {clock: at}
    further: dict[str, Array] = {}
    columns = []
    for name, track in zip(_distinct_names(seen), seen, strict=True):
        named = f"{name} " if len(seen) > 1 else ""
        taken = {"x": track.x, "y": track.y} | ({} if track.sigma is None else {"sigma": track.sigma})
        headers = {key: f"{named}{key} ({track.unit})" for key in taken}
        cells |= {headers[key]: _placed(values, track.at, at) for key, values in taken.items()}
        further |= {f"{named}{header}": _placed(values, track.at, at) for header, values in track.further.items()}
        up = {"y": f"-{headers['y']}"} if track.y_down else {}  # a table of frictrack has y up
        columns.append(TrackColumns({"t": clock, **headers, **up}, track.note))
    only = columns[0].columns if len(columns) == 1 else {}
    return TableFile(pd.DataFrame(cells | further), only, program, columns)


def with_likely_points(track: TargetPositions, likelihood: Array) -> TargetPositions:
    """Return a track without the positions that DeepLabCut takes for not seen."""
    unseen = likelihood < MIN_LIKELIHOOD
    if not np.any(unseen):
        return track
    note = (
        f"{np.sum(unseen)} of {len(unseen)} frames have a likelihood below {MIN_LIKELIHOOD:g}, the pcutoff of "
        "DeepLabCut; they count as missing"
    )
    x, y = np.where(unseen, np.nan, track.x), np.where(unseen, np.nan, track.y)
    return replace(track, x=x, y=y, note=note)


def _distinct_names(tracks: Sequence[TargetPositions]) -> list[str]:
    """Return the names of the tracks; those that occur again get a number."""
    taken: Counter[str] = Counter()
    names = []
    for track in tracks:
        name = " ".join(track.name.split()) or "track"
        taken[name] += 1
        names.append(f"{name} {taken[name]}" if taken[name] > 1 else name)
    return names


def _placed(values: Array, places: Array, at: Array) -> Array:
    """Return values at their places of a longer clock; NaN elsewhere."""
    column = np.full(len(at), np.nan)
    column[np.searchsorted(at, places)] = values
    return column
