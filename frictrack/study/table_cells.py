"""Hold the cells of a table and what its format says about the columns; read XML of other programs within limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import IO, TYPE_CHECKING

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

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


def read_limited(file: IO[bytes]) -> bytes:
    """Return the bytes of an open file.

    Parameters
    ----------
    file
        The file, perhaps a part of a ZIP file, which may say that it is smaller than it is.

    Raises
    ------
    ValueError
        If there are more than `MAX_UNPACKED_BYTES`.

    """
    content = file.read(MAX_UNPACKED_BYTES + 1)
    if len(content) > MAX_UNPACKED_BYTES:
        raise ValueError(f"more than {MAX_UNPACKED_BYTES / 1e6:.0f} MB")
    return content


def read_xml(content: bytes) -> Element:
    """Return the root element of an XML file.

    Parameters
    ----------
    content
        The bytes of the file.

    Raises
    ------
    ValueError
        If it defines entities, or is damaged.

    """
    from xml.etree import ElementTree  # noqa: PLC0415 - most studies need no XML

    letters = content.replace(b"\0", b"")  # of UTF-16, too
    if b"<!DOCTYPE" in letters or b"<!ENTITY" in letters:
        raise ValueError("it defines entities")
    try:
        return ElementTree.fromstring(content)  # without entities it cannot grow
    except (ElementTree.ParseError, LookupError) as e:  # LookupError: an encoding that Python does not know
        raise ValueError(str(e)) from e
