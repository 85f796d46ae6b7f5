"""Cells and tables of what a person reads at the terminal."""

from __future__ import annotations

from typing import Any

from rich.table import Table


def table(*headers: str, **style: Any) -> Table:
    """An empty table under some headers, without a box unless one is asked for."""
    made = Table(**{"box": None, "pad_edge": False, "header_style": "dim"} | style)
    for header in headers:
        made.add_column(header, overflow="fold")
    return made
