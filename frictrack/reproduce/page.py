"""Write the reproduction: a self-contained page, figures as SVG, tables as CSV, and JSON."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from frictrack import plots
from frictrack.errors import FrictrackError
from frictrack.number_format import format_number
from frictrack.report import SvgEmbedder, page_template
from frictrack.reproduce.sections import FAILS, HOLDS, OPEN, Cell, Claim, ResultTable, Section

VERDICT_CLASSES = {HOLDS: "holds", FAILS: "fails", OPEN: "open"}


@dataclass(frozen=True)
class Reproduction:
    """All sections of a reproduction, with the seed of its recordings and whether it was quick."""

    parts: tuple[Section, ...]
    seed: int
    quick: bool

    @property
    def claims(self) -> list[Claim]:
        """All claims in order of the sections."""
        return [claim for part in self.parts for claim in part.claims]

    @property
    def counts(self) -> dict[str, int]:
        """Number of claims that hold, fail and cannot be decided."""
        verdicts = [claim.verdict for claim in self.claims]
        return {kind: verdicts.count(verdict) for verdict, kind in VERDICT_CLASSES.items()}

    def summary(self) -> dict[str, Any]:
        """JSON of `reproduce`."""
        return {
            "seed": self.seed,
            "quick": self.quick,
            "counts": self.counts,
            "parts": [part.summary() for part in self.parts],
        }


def write_reproduction(reproduction: Reproduction, folder: Path) -> dict[str, Any]:
    """Write page, figures, tables and JSON.

    Parameters
    ----------
    reproduction
        What to write.
    folder
        Where to write; created if it does not exist.

    Returns
    -------
    dict
        JSON with the paths of page and folder.

    Raises
    ------
    FrictrackError
        If the folder cannot be written.

    """
    try:
        for sub in ("figures", "tables"):
            (folder / sub).mkdir(parents=True, exist_ok=True)
        for part in reproduction.parts:
            for name, (_, figure) in part.figures.items():
                (folder / "figures" / f"{name}.svg").write_text(plots.svg(figure), encoding="utf-8")
            for table in part.tables:
                _write_csv(table, folder / "tables" / f"{table.name}.csv")
        page = folder / "reproduce.html"
        page.write_text(render_page(reproduction), encoding="utf-8")
        result = reproduction.summary() | {"page": str(page), "output": str(folder)}
        (folder / "reproduce.json").write_text(json.dumps(result, indent=1, ensure_ascii=False), encoding="utf-8")
    except OSError as e:
        raise FrictrackError(
            f"cannot write {e.filename or folder}: {e.strerror or e}; choose another folder with -o"
        ) from e
    return result


def render_page(reproduction: Reproduction) -> str:
    """Render the page as HTML.

    Parameters
    ----------
    reproduction
        What to show.

    Returns
    -------
    str
        A page that needs no other file.

    """
    draw = SvgEmbedder()
    return page_template("page.html.j2", "reproduce").render(
        parts=reproduction.parts,
        claims=reproduction.claims,
        counts=reproduction.counts,
        quick=reproduction.quick,
        kinds=VERDICT_CLASSES,
        pictures={
            p.name: [(caption, draw(figure)) for caption, figure in p.figures.values()] for p in reproduction.parts
        },
        numeric_columns=numeric_columns,
        format_cell=format_cell,
    )


def numeric_columns(table: ResultTable) -> set[int]:
    """Indices of the columns with numbers."""
    return {i for i, _ in enumerate(table.heads) if any(isinstance(row[i], float) for row in table.rows)}


def format_cell(cell: Cell) -> str:
    """Format a cell; numbers get four digits.

    Parameters
    ----------
    cell
        Number, text or None.

    Returns
    -------
    str
        Text of the cell.

    Examples
    --------
    >>> format_cell(12.0), format_cell("a")
    ('12', 'a')

    """
    if cell is None:
        return "\N{EN DASH}"
    if isinstance(cell, str):
        return cell
    whole = cell == round(cell) and abs(cell) < 1e6
    return f"{cell:.0f}".replace("-", "\N{MINUS SIGN}") if whole else format_number(cell, 4)


def _write_csv(table: ResultTable, path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(table.heads)
        writer.writerows(table.rows)


def tables_html(tables: Sequence[ResultTable]) -> Markup:
    """Render tables as HTML, for a notebook.

    Parameters
    ----------
    tables
        Tables of a section.

    Returns
    -------
    Markup
        HTML.

    """
    out = Markup("")
    for t in tables:
        right = numeric_columns(t)
        heads = Markup("").join(Markup("<th>{}</th>").format(h) for h in t.heads)
        cells = Markup("").join(
            Markup("<tr>{}</tr>").format(
                Markup("").join(
                    Markup('<td style="text-align:{}">{}</td>').format(
                        "right" if i in right else "left", format_cell(c)
                    )
                    for i, c in enumerate(row)
                )
            )
            for row in t.rows
        )
        body = Markup("<h4>{}</h4><table><tr>{}</tr>{}</table><p>{}</p>").format(t.title, heads, cells, t.note)
        out += body
    return out
