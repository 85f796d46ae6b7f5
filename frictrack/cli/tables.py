"""Make the tables that are printed to the terminal."""

from __future__ import annotations

from typing import Any

from rich.markup import escape
from rich.table import Table

from frictrack.number_format import format_plain


def table(*headers: str, **style: Any) -> Table:
    """Return an empty table, without a box by default.

    Parameters
    ----------
    *headers
        Heads of the columns.
    **style
        For `rich.table.Table`.

    """
    new = Table(**{"box": None, "pad_edge": False, "header_style": "dim"} | style)
    for header in headers:
        new.add_column(header, overflow="fold")
    return new


def cell(value: Any) -> str:
    """Format a value of a dictionary for a table."""
    if isinstance(value, float):
        return format_plain(value)
    if isinstance(value, list):
        return escape(", ".join(str(v) for v in value))
    return "" if value is None else escape(str(value))
