"""Build tables of text that the templates of the report and the page set as HTML."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from frictrack.number_format import DASH

Cell = str | Markup


@dataclass(frozen=True)
class TextTable:
    """A table of text.

    Attributes
    ----------
    heads : tuple of str
        One heading per column.
    rows : tuple of tuples
        Cells as plain text, or as `Markup` where they contain HTML.
    numeric : frozenset of int
        Indices of the columns that are aligned to the right.

    """

    heads: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    numeric: frozenset[int] = frozenset()


def make_table(heads: Sequence[str], rows: Sequence[Sequence[Cell]], numeric: Sequence[int] = ()) -> TextTable:
    """Build a table and leave out its empty columns.

    Parameters
    ----------
    heads : sequence of str
        One heading per column.
    rows : sequence of sequences
        One cell per column in each row. A column is empty if its cells are all "" or a dash.
    numeric : sequence of int
        Indices of the columns of numbers, counted before any column is left out.

    Examples
    --------
    >>> make_table(("run", "mass", "speed"), [("v1", "", "2.0")], numeric=(1, 2))
    TextTable(heads=('run', 'speed'), rows=(('v1', '2.0'),), numeric=frozenset({1}))

    """
    kept = [k for k in range(len(heads)) if not rows or any(row[k] not in ("", DASH) for row in rows)]
    new_index = {old: new for new, old in enumerate(kept)}
    return TextTable(
        tuple(heads[k] for k in kept),
        tuple(tuple(row[k] for k in kept) for row in rows),
        frozenset(new_index[k] for k in numeric if k in new_index),
    )


def code_cell(text: str) -> Markup:
    """Set a name of the study file or the command line as code."""
    return Markup("<code>{}</code>").format(text)
