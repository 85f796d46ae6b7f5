"""Put the tracks of a video program into one table: times or frame numbers, and columns x, y, sigma of each track."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from frictrack.records import Array
from frictrack.study.table_layout import TableFile, TrackColumns

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
