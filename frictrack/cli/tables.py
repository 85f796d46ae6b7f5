"""Make the tables that are printed to the terminal."""

from __future__ import annotations

import re
from typing import Any

from rich.markup import escape
from rich.table import Table

from frictrack.number_format import format_plain

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
