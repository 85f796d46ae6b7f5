"""Hold the cells of a table, and what the format of its file says about the columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

MAX_UNPACKED_BYTES = 256 << 20  # of a workbook, an XML file, or the tracks of another program


@dataclass(frozen=True, eq=False)
class TrackColumns:
    """The columns of one track of a video program, or of one of several runs in a table.

    Parameters
    ----------
    columns
        Headers by short name, with "t" and "x".
    note
        What the user is to know about the frames of this track; empty if nothing.

    """

    columns: Mapping[str, str]
    note: str = ""


@dataclass(frozen=True, eq=False)
class TableFile:
    """The cells of a table, and what the format of the file says about its columns.

    Parameters
    ----------
    frame
        The cells, with the headers of the file; a unit below a header stands in parentheses behind it.
    columns
        Headers by short name, of a program whose columns are known; empty for others.
    program
        The program that wrote it, such as "Tracker" or "Kinovea"; empty if it is not known.
    tracks
        The tracks in a file of a video program, or the runs that a table has side by side. A row in which one has no
        position is missing in this track.
    has_runs
        Whether the tracks are runs of their own.

    """

    frame: pd.DataFrame
    columns: Mapping[str, str] = field(default_factory=dict)
    program: str = ""
    tracks: Sequence[TrackColumns] = ()
    has_runs: bool = False
