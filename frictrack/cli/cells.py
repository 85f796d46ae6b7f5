"""Cells and tables of what a person reads at the terminal."""

from __future__ import annotations

import math
from typing import Any

from rich.table import Table


def number(value: float | None, digits: int = 4) -> str:
    """A number short enough to read; a dash for none."""
    return "-" if value is None else f"{value:.{digits}g}"


def plus_minus(value: float | None, std: float | None) -> str:
    """A value with its standard deviation, both to the second digit of the latter."""
    if value is None:
        return "not determined"
    if not std:
        return number(value, 6)
    decimals = 1 - math.floor(math.log10(std))
    if not -3 < decimals < 7:
        return f"{value:.5g} ± {std:.2g}"
    decimals = max(decimals, 0)
    return f"{value:.{decimals}f} ± {std:.{decimals}f}"


def table(*headers: str, **style: Any) -> Table:
    """An empty table under some headers, without a box unless one is asked for."""
    made = Table(**{"box": None, "pad_edge": False, "header_style": "dim"} | style)
    for header in headers:
        made.add_column(header, overflow="fold")
    return made
