"""Make the tables that are printed to the terminal."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from rich.markup import escape
from rich.table import Table

from frictrack.base.number_format import format_plain

MAX_NAME_WIDTH = 20  # characters of a model's name in one line of a table


def table(*headers: str, **style: Any) -> Table:
    """Return an empty table, without a box by default; names in the first column and words of the heads stay whole.

    Parameters
    ----------
    *headers
        Heads of the columns.
    **style
        For `rich.table.Table`.

    """
    new = Table(**{"box": None, "pad_edge": False, "header_style": "dim"} | style)
    for i, header in enumerate(headers):
        new.add_column(header, overflow="fold", no_wrap=i == 0, min_width=max(map(len, header.split()), default=None))
    return new


def filled_columns(headers: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """Return a table of the columns in which any row has a value; others are left out, for the width of the terminal.

    Parameters
    ----------
    headers
        Heads of the columns.
    rows
        Cells of the rows; empty or "-" without a value.

    """
    filled = [i for i in range(len(headers)) if i == 0 or any(row[i] not in ("", "-") for row in rows)]
    new = table(*(headers[i] for i in filled))
    for row in rows:
        new.add_row(*(row[i] for i in filled))
    return new


def break_name(name: str) -> str:
    """Break the name of a model before its plus signs, so that no line is longer than `MAX_NAME_WIDTH` if possible.

    Examples
    --------
    >>> break_name("2_tustin+texture+viscous_modulation").splitlines()
    ['2_tustin+texture', '+viscous_modulation']

    """
    lines = [""]
    for part in re.split(r"(?=\+)", name):
        if lines[-1] and len(lines[-1] + part) > MAX_NAME_WIDTH:
            lines.append("")
        lines[-1] += part
    return "\n".join(lines)


def cell(value: Any) -> str:
    """Format a value of a dictionary for a table."""
    if isinstance(value, float):
        return format_plain(value)
    if isinstance(value, list):
        return escape(", ".join(str(v) for v in value))
    return "" if value is None else escape(str(value))
