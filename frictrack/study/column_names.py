"""Match the columns of a table by name: exactly, by a name with a unit, or by a guess that the user confirms."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence

from frictrack.study.schema import COLUMNS

UNIT = re.compile(r"[(\[]\s*([^()\[\]]+?)\s*[)\]]\s*$")  # "pos (mm)", "Position [mm]"
# Usual names of a column, in English, German, French and Spanish; "/x" ends the names of one program.
_USUAL_NAMES = {
    "t": re.compile(r"t|time|times?tamps?|elapsed time|time stamp|zeit|temps|tiempo"),
    "x": re.compile(r"x|pos(ition)?|x[ _]?pos(ition)?|pos(ition)?[ _]?x|disp(lacement)?|distance|weg|.*/x|x_target"),
    "y": re.compile(r"y|y[ _]?pos(ition)?|pos(ition)?[ _]?y|.*/y"),
    "friction": re.compile(r"friction|friction[ _]force|reibkraft"),
}
REQUIRED = ("t", "x")


def base_name(header: str) -> str:
    """Return a header without its unit.

    Examples
    --------
    >>> base_name("Position (mm)")
    'Position'

    """
    return UNIT.sub("", header).strip()


def find_header(written: str, present: Sequence[str]) -> str | None:
    """Return the header of the table that a name means, or None.

    Parameters
    ----------
    written
        The name in the study file, perhaps with a unit: ``"t (ms)"`` also finds ``"t"``, ``"t"`` also ``"t (ms)"``.
    present
        The headers of the table.

    Examples
    --------
    >>> find_header("pos (mm)", ["t", "pos"]), find_header("pos", ["t", "pos (mm)"]), find_header("x", ["t"])
    ('pos', 'pos (mm)', None)

    """
    if written in present:
        return written
    base = base_name(written)
    if base != written and base in present:
        return base
    alike = [header for header in present if base_name(header) == written]
    return alike[0] if len(alike) == 1 else None


def guess_columns(present: Sequence[str]) -> dict[str, str]:
    """Guess time, position, height and friction by the usual names; a name that could be two columns is left out.

    Parameters
    ----------
    present
        The headers of the table.

    Examples
    --------
    >>> guess_columns(["Time (ms)", "Position (mm)", "F"])
    {'t': 'Time (ms)', 'x': 'Position (mm)'}

    """
    found = {}
    for key, names in _USUAL_NAMES.items():
        alike = [header for header in present if names.fullmatch(base_name(header).casefold())]
        if len(alike) == 1 or (alike and key in REQUIRED and alike[0].endswith("/X")):
            found[key] = alike[0]
    return found


def has_units(columns: Mapping[str, str]) -> bool:
    """Return whether times and positions are there and every header states its unit."""
    return all(key in columns for key in REQUIRED) and all(UNIT.search(header) for header in columns.values())


def columns_line(columns: Mapping[str, str]) -> str:
    """Return the line of a study file that names columns; the SI unit stands where the header has none.

    Parameters
    ----------
    columns
        Headers by short name.

    Examples
    --------
    >>> columns_line({"t": "Time (ms)", "x": "pos"})
    'columns = {t = "Time (ms)", x = "pos (m)"}'

    """
    cells = (f"{key} = {json.dumps(_with_unit(key, header), ensure_ascii=False)}" for key, header in columns.items())
    return f"columns = {{{', '.join(cells)}}}"


def _with_unit(key: str, header: str) -> str:
    return header if UNIT.search(header) else f"{header} ({COLUMNS[key][1]})"
