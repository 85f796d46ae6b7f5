"""Read XML of other programs within limits: no entities, which could grow without end, and no huge files."""

from __future__ import annotations

from typing import IO, TYPE_CHECKING

from frictrack.study.table_cells import MAX_UNPACKED_BYTES

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element


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
