"""Read tracks of pose estimation: DeepLabCut (.csv, .h5), datasets of movement (.nc), analysis files of SLEAP (.h5).

A table of DeepLabCut as text has rows scorer, (individuals,) bodyparts, coords above the columns. Each point has the
columns x, y in px (y down) and likelihood; the first column holds the number of the frame. The file is what
``pandas.DataFrame.to_csv`` makes of the table in ``pose_estimation_tensorflow/predict_videos.py`` and
``pose_estimation_pytorch/apis/videos.py`` of github.com/DeepLabCut/DeepLabCut.

`hdf5_contents` opens files in HDF5 in a process of its own.
"""

from __future__ import annotations

import csv
import subprocess
import sys
from collections.abc import Mapping, Sequence
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from frictrack.records import Array
from frictrack.study.table_layout import MAX_UNPACKED_BYTES, TableFile
from frictrack.study.track_formats.track_table import (
    FRAMES,
    SECONDS,
    TargetPositions,
    table_of_tracks,
    with_likely_points,
)

LEVELS = (("scorer", "bodyparts", "coords"), ("scorer", "individuals", "bodyparts", "coords"))  # rows of the header


def is_deeplabcut_text(path: Path) -> bool:
    """Return whether a file begins with the header of DeepLabCut."""
    return _levels(path) is not None


def read_deeplabcut_text(path: Path) -> TableFile:
    """Read the points of a table of DeepLabCut, by frame; unlikely ones count as missing."""
    import pandas as pd  # noqa: PLC0415 - takes half a second, which `--help` does not need

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
    size = path.stat().st_size
    if size > MAX_UNPACKED_BYTES:
        raise ValueError(f"{size / 1e6:.0f} MB")
    with path.open("rb") as file:
        if file.read(len(NETCDF_3)) == NETCDF_3:
            raise ValueError('it is netCDF 3; write it with engine="netcdf4" or "h5netcdf"')
    call = [sys.executable, "-P", "-c", _CHILD, str(path.absolute())]
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
