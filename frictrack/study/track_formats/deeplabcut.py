"""Read the tables of DeepLabCut as text: rows scorer, (individuals,) bodyparts, coords above the columns.

Each point has the columns x, y in px (y down) and likelihood; the first column holds the number of the frame. The file
is what ``pandas.DataFrame.to_csv`` makes of the table in ``pose_estimation_tensorflow/predict_videos.py`` and
``pose_estimation_pytorch/apis/videos.py`` of github.com/DeepLabCut/DeepLabCut. The same table in HDF5 is read by
`frictrack.study.track_formats.hdf5_tracks`.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from frictrack.records import Array
from frictrack.study.table_cells import TableFile
from frictrack.study.track_formats.track_table import FRAMES, TargetPositions, table_of_tracks, with_likely_points

LEVELS = (("scorer", "bodyparts", "coords"), ("scorer", "individuals", "bodyparts", "coords"))  # rows of the header


def is_deeplabcut_text(path: Path) -> bool:
    """Return whether a file begins with the header of DeepLabCut."""
    return _levels(path) is not None


def read_deeplabcut_text(path: Path) -> TableFile:
    """Read the points of a table of DeepLabCut, by frame; unlikely ones count as missing.

    Parameters
    ----------
    path
        A .csv file.

    Raises
    ------
    ValueError
        If it is damaged.

    """
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
    """Return the table of some columns of DeepLabCut.

    Parameters
    ----------
    names
        For each column (individual,) body part and coordinate: x, y or likelihood.
    frames
        Numbers of the frames, (n,).
    values
        The columns, (n, len(names)).

    Raises
    ------
    ValueError
        If a point lacks a coordinate.

    """
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
