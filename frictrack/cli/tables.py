"""Make the tables that are printed to the terminal."""

from __future__ import annotations

from typing import Any

from rich.table import Table


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
