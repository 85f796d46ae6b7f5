"""Find the layout of a text table: separator, decimal sign, lines before the header, and a row of units.

`TableFile` holds the cells of a table and what its format says about the columns.
"""

from __future__ import annotations

import codecs
import csv
import itertools
import re
import zipfile
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from frictrack.base.units import is_ordinary_unit

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

    import pandas as pd

MAX_UNPACKED_BYTES = 256 << 20  # of a workbook, an XML file, or the tracks of another program


@dataclass(frozen=True, eq=False)
class TrackColumns:
    """The columns of one track of a video program, or of one of several runs in a table."""

    columns: Mapping[str, str]  # headers by short name, with "t" and "x"
    note: str = ""  # what the user is to know about the frames of this track; empty if nothing


@dataclass(frozen=True, eq=False)
class TableFile:
    """The cells of a table, and what the format of the file says about its columns."""

    # the cells, with the headers of the file; a unit below a header stands in parentheses behind it
    frame: pd.DataFrame
    # headers by short name, of a program whose columns are known; empty for others
    columns: Mapping[str, str] = field(default_factory=dict)
    program: str = ""  # the program that wrote it, such as "Tracker" or "Kinovea"; empty if it is not known
    # the tracks in a file of a video program, or the runs that a table has side by side. A row in which one has no
    # position is missing in this track
    tracks: Sequence[TrackColumns] = ()
    has_runs: bool = False  # whether the tracks are runs of their own
    above: str = ""  # lines above the rows, in which a mass or a rate may be stated


def check_size(*files: Path) -> None:
    """Raise `ValueError` if files, with all that is packed in them, are too large to be read."""
    size = sum(one.stat().st_size for one in files)
    for one in filter(zipfile.is_zipfile, files):
        with zipfile.ZipFile(one) as packed:
            size += sum(part.file_size for part in packed.infolist())
    if size > MAX_UNPACKED_BYTES:
        raise ValueError(f"{size / 1e6:.0f} MB when unpacked, at most {MAX_UNPACKED_BYTES / 1e6:.0f} MB are read")


def read_xml(content: bytes) -> Element:
    """Return the root element of an XML file."""
    from xml.etree import ElementTree  # noqa: PLC0415 - most studies need no XML

    letters = content.replace(b"\0", b"")  # of UTF-16, too
    if b"<!DOCTYPE" in letters or b"<!ENTITY" in letters:
        raise ValueError("it defines entities")
    try:
        return ElementTree.fromstring(content)  # without entities it cannot grow
    except (ElementTree.ParseError, LookupError) as e:  # LookupError: an encoding that Python does not know
        raise ValueError(str(e)) from e


MAX_HEAD_LINES = 200  # lines in which the header is searched: titles and settings of an instrument may stand before it
MAX_BYTES_DECODED = 1 << 20  # from which the encoding is found
MAX_TEXT_COLUMNS, MAX_LINE_CHARACTERS = 10_000, 1 << 20  # the time to read a column does not depend on its rows alone
WHITESPACE = r"\s+"  # separator of columns that only spaces separate
SEPARATORS = "\t;,"
MIN_COLUMNS = 2
FRACTION = re.compile(r'"?[+-]?\d*([.,])\d+(?:[eE][+-]?\d+)?"?$')  # a number with a decimal sign
_FIRST_OF_GB2312 = 0xA1  # byte of its usual letters
_ONLY_NUMBERS = re.compile(r'[\d+\-.,;:eE\s"]+')  # a line that is no header
_QUOTED = re.compile(r'"[^"]*"')
_THOUSANDS = re.compile(r"[1-9]\d{0,2}(?:,\d{3})+")
_NUMBER = re.compile(r"[+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?")
_TIME_CODE = re.compile(r"-? ?\d+(?::\d+){1,3}(?:[.,]\d+)?")  # 0:00:01:25, 00:01.25
_UNIT_CELL = re.compile(r"[(\[]?\s*([^()\[\]]{1,12}?)\s*[)\]]?")

_STATED = {  # what an owner writes above a table
    "mass": re.compile(r"\b(?:mass[ae]?|m|质量|質量)\b[^\d\n]{0,12}?([\d.,]*\d\s*k?g)\b", re.IGNORECASE),
    "fps": re.compile(
        r"(?:rate|fps|frequency|frequenz|fréquence|采样率)\b[^\d\n]{0,12}?([\d.,]*\d)\s*(?:Hz|fps|1/s|S/s|samples)",
        re.IGNORECASE,
    ),
    "count": re.compile(
        r"([\d.,]*\d\s*[nuµm]m)\s*(?:/|per|pro|par)\s*(?:count|inc|imp|pulse|tick|digit|lsb|step)", re.I
    ),
}
Line = tuple[int, str]  # its number in the file, from 0, and its text


@dataclass(frozen=True)
class TableLayout:
    """Where the header of a table stands, and how its cells are written."""

    separator: str  # separator, decimal: separator of the columns, and decimal sign
    decimal: str
    header: tuple[str, ...]  # names in the header
    units: tuple[str, ...] = ()  # units below the header, one per name; empty if there is no such row
    # cells of the line above the header, one per name: what a program names a group of columns by
    groups: tuple[str, ...] = ()
    skipped: tuple[int, ...] = ()  # numbers of the lines, from 0, that are neither header nor data
    encoding: str = "utf-8-sig"  # encoding of the text
    in_comment: bool = False  # whether the header is a comment
    above: str = ""  # the lines up to the header


def find_layout(path: Path, wanted: Collection[str]) -> TableLayout:
    """Find the layout of a text table. Empty lines and lines that begin with # do not count.

    If the first line holds numbers, the comment above it is the header, provided that it has as many names.
    """
    encoding = text_encoding(path)
    with path.open(encoding=encoding) as file:
        lines = ((i, line) for i, line in enumerate(_lines(file)) if line.strip())
        seen = list(itertools.islice(lines, MAX_HEAD_LINES))
        head = [(i, line) for i, line in seen if not line.startswith("#")]
        in_comment = bool(head) and _ONLY_NUMBERS.fullmatch(head[0][1].strip()) is not None
        first = len(split(head[0][1], _separator([head[0][1]]))) if head else 0
        named = [(i, line.lstrip("# ")) for i, line in seen if in_comment and i < head[0][0]]
        above = [one for one in named if len(split(one[1], _separator([one[1]]))) == first][-1:] or named[-1:]
        head = [*above, *head]
        texts = [line for _, line in head]
        at = header_row([split(line, _separator(texts[i : i + 3])) for i, line in enumerate(texts)], wanted)
        separator = _separator(texts[at : at + 3])
        rows = [split(line, separator) for line in texts[at : at + 2]]
        below = rows[1] if len(rows) > 1 and is_units_row(rows[0], rows[1]) else []
        first = at + 2 if below else at + 1
        rest = itertools.chain(head[first:], lines)
        decimal = decimal_sign((cell for _, line in rest for cell in split(line, separator)), separator)
    if rows and len(rows[0]) > MAX_TEXT_COLUMNS:
        raise ValueError(f"{len(rows[0])} columns, at most {MAX_TEXT_COLUMNS} are read; keep time and position")
    number = head[at][0] if head else 0
    above_names = split(head[at - 1][1], separator) if at else []  # one stands for all columns up to the next one
    return TableLayout(
        separator,
        decimal,
        tuple(rows[0]) if rows else (),
        tuple(below),
        tuple(itertools.accumulate(above_names, lambda last, cell: cell or last)),
        (*range(number), *([head[at + 1][0]] if below else [])),
        encoding,
        bool(above) and at == 0 and len(rows) > 1 and len(rows[0]) == len(rows[1]),
        "".join(line for i, line in seen if i <= number),
    )


def _lines(file: TextIO) -> Iterator[str]:
    """Yield lines of limited length; a text without line ends is not read to its end."""
    while line := file.readline(MAX_LINE_CHARACTERS):
        if len(line) == MAX_LINE_CHARACTERS:
            raise ValueError(f"a line of more than {MAX_LINE_CHARACTERS} characters; keep time and position")
        yield line


def text_encoding(path: Path) -> str:
    """Return the encoding of a text: UTF-8, UTF-16 by its mark or its zeros, else that of Windows in Asia or the West.

    Instruments still write the letters of "µm" and "°" in the last one.
    """
    with path.open("rb") as file:
        head = file.read(MAX_BYTES_DECODED)
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    zeros = [head[i::2].count(0) for i in (0, 1)]  # of UTF-16 every second byte is 0, the second of each pair in LE
    if max(zeros) > len(head) / 4:
        return "utf-16-le" if zeros[1] > zeros[0] else "utf-16-be"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        letters = re.findall(rb"[\x80-\xff]+", head)  # those of Asia come in pairs, those of Europe mostly alone
        pairs = all(len(one) % 2 == 0 for one in letters)
        japanese = any(min(one[::2]) < _FIRST_OF_GB2312 for one in letters)
        return "utf-8-sig" if b"\0" in head else "cp1252" if not pairs else "cp932" if japanese else "gb18030"
    return "utf-8-sig"


def header_row(rows: Sequence[Sequence[str]], wanted: Collection[str]) -> int:
    """Return the place of the header: the last row without numbers before the first of numbers; 0 if there is none.

    The first row that holds one of the `wanted` names, which only stand in a header, is it in any case.
    """
    for i, row in enumerate(rows):
        if set(row) & set(wanted):
            return i
        below = rows[i + 1 : i + 3]
        if below and is_units_row(row, below[0]):
            below = below[1:]
        if _is_header(row) and below and sum(map(is_number, below[0])) >= MIN_COLUMNS:
            return i
    return 0


def split(line: str, separator: str) -> list[str]:
    """Split a line into cells without quotes and surrounding spaces.

    Examples
    --------
    >>> split('"1,5"; 2', ";")
    ['1,5', '2']

    """
    if separator == WHITESPACE:
        return line.split()
    try:
        cells = next(csv.reader([line.strip("\n\r")], delimiter=separator, skipinitialspace=True))
    except (csv.Error, StopIteration):
        cells = line.split(separator)
    return [cell.strip() for cell in cells]


def is_units_row(header: Sequence[str], row: Sequence[str]) -> bool:
    """Return whether a row below a header holds units: no numbers, and at least one unit that is known.

    Examples
    --------
    >>> is_units_row(["t", "x", "note"], ["(ms)", "mm", "-"]), is_units_row(["t", "x"], ["0", "1"])
    (True, False)

    """
    units = [found[1] for cell in row if cell and (found := _UNIT_CELL.fullmatch(cell))]
    filled = [cell for cell in row if cell]
    if not _is_header(header) or len(units) != len(filled) or len(row) != len(header):
        return False
    return not any(map(is_number, filled)) and any(map(is_ordinary_unit, units))


def is_number(cell: str) -> bool:
    """Return whether a cell is a number or a time code such as 0:00:01:25."""
    return bool(_NUMBER.fullmatch(cell) or _TIME_CODE.fullmatch(cell))


def bare_unit(cell: str) -> str:
    """Return a unit without brackets.

    Examples
    --------
    >>> bare_unit("[ mm ]")
    'mm'

    """
    found = _UNIT_CELL.fullmatch(cell.strip())
    return found[1] if found else ""


def stated(above: str) -> dict[str, str]:
    r"""Return what lines above a table state: "mass", "fps", and "count", the size of a count.

    Examples
    --------
    >>> stated("Masse;0,42 kg\nscale: 5 um/count\nSample rate: 500 Hz")
    {'mass': '0.42 kg', 'fps': '500', 'count': '5 um'}

    """
    found = {key: what.search(above) for key, what in _STATED.items()}
    return {key: one[1].replace(",", ".") for key, one in found.items() if one}


def _is_header(row: Sequence[str]) -> bool:
    names = [cell for cell in row if cell]
    return len(names) >= MIN_COLUMNS and not any(map(is_number, names))


def decimal_sign(cells: Iterable[str], separator: str) -> str:
    """Return the decimal sign of the first number that has one, a point if none has; 1,234 is none with commas."""
    if separator == ",":
        cells = (cell for cell in cells if not _THOUSANDS.fullmatch(cell))
    return next((sign[1] for cell in cells if (sign := FRACTION.match(cell))), ".")


def _separator(head: Sequence[str]) -> str:
    """Return the character that stands equally often in the header and in the rows, and most often."""
    counts = {sign: [_QUOTED.sub("", line).count(sign) for line in head] for sign in SEPARATORS}
    best = max(counts, key=lambda sign: (len(set(counts[sign])) == 1 and counts[sign][0] > 0, sum(counts[sign][:1])))
    spaced = not any(counts[best]) and all(len(line.split()) > 1 for line in head)
    return WHITESPACE if spaced else best
