"""The sections of the reproduction: tables, figures, claims with our verdicts; the page and files made of them."""

from __future__ import annotations

import csv
import json
import math
import tomllib
from collections import ChainMap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

from markupsafe import Markup
from matplotlib.figure import Figure

from frictrack.base.errors import os_errors_as
from frictrack.base.number_format import format_number
from frictrack.present import plots
from frictrack.present.report import SvgEmbedder, page_template
from frictrack.validation.reproduce.laws import RUNS

Cell = str | float | None
ANOTHER_FOLDER = "choose another folder with -o"
HOLDS, FAILS, OPEN = "holds", "does not hold", "cannot be decided"


@dataclass(frozen=True)
class Claim:
    """A claim of a paper and our verdict; its fields are JSON keys.

    Attributes
    ----------
    where, claim, printed
        Place in the paper, the claim, and what is printed.
    ours
        What came out here.
    verdict
        `HOLDS`, `FAILS` or `OPEN`.
    why
        Reason for the verdict, one or more sentences.

    """

    where: str
    claim: str
    printed: str
    ours: str
    verdict: str
    why: str


def _finite(value: float) -> float | None:
    """A finite number; None for NaN and infinity."""
    return float(value) if math.isfinite(value) else None


@dataclass(frozen=True)
class ResultTable:
    """A table with heads, rows of text and numbers, and a note; `name` is that of its CSV file."""

    name: str
    title: str
    heads: tuple[str, ...]
    rows: list[list[Cell]]
    note: str = ""

    def __post_init__(self) -> None:
        plain = [[c if c is None or isinstance(c, str) else _finite(c) for c in row] for row in self.rows]
        object.__setattr__(self, "rows", plain)


@dataclass(frozen=True)
class Section:
    """One section of the page.

    Attributes
    ----------
    name, title
        Name in JSON and in links; heading.
    text
        Paragraphs.
    tables
        Tables.
    figures
        Caption, and figure or its SVG, by file name.
    claims
        Claims that the section tests.
    key, seconds
        Hash of the settings that it was computed with, and the processor time that it took, s.

    """

    name: str
    title: str
    text: tuple[str, ...] = ()
    tables: tuple[ResultTable, ...] = ()
    figures: Mapping[str, tuple[str, Figure | str]] = field(default_factory=dict)
    claims: tuple[Claim, ...] = ()
    key: str = ""
    seconds: float = 0.0

    def with_drawn_figures(self) -> Section:
        """Return the section with its figures as SVG."""
        drawn = {n: (text, one if isinstance(one, str) else plots.svg(one)) for n, (text, one) in self.figures.items()}
        return replace(self, figures=drawn)

    def summary(self) -> dict[str, Any]:
        """JSON of the section, with figures by file name."""
        return {
            "name": self.name,
            "title": self.title,
            "text": list(self.text),
            "tables": [vars(t) | {"heads": list(t.heads)} for t in self.tables],
            "figures": list(self.figures),
            "claims": [vars(c) for c in self.claims],
            "key": self.key,
        }

    @classmethod
    def read(cls, kept: Mapping[str, Any], seconds: float, folder: Path) -> Section:
        """Read a section from its JSON and its figures."""
        texts, place = _texts()["figures"], folder / "figures"
        figures = {n: (texts[n]["caption"], (place / f"{n}.svg").read_text(encoding="utf-8")) for n in kept["figures"]}
        tables = tuple(ResultTable(**t | {"heads": tuple(t["heads"])}) for t in kept["tables"])
        claims = tuple(Claim(**c) for c in kept["claims"])
        return cls(kept["name"], kept["title"], tuple(kept["text"]), tables, figures, claims, kept["key"], seconds)


@dataclass(frozen=True)
class Effort:
    """Computational effort.

    Attributes
    ----------
    seeds
        Seeds of the statistics in Tables 5, 6 and 7.
    identified
        Seeds of each identification by a search of the papers.
    generations
        Generations of each search.

    """

    seeds: int = 200
    identified: int = 5
    generations: int = 1000

    @property
    def budget(self) -> int:
        """Evaluations of each search: 40 individuals, and 36 children in every generation (gap 0.9)."""
        return 40 + 36 * self.generations


FULL, QUICK = Effort(), Effort(seeds=4, identified=1, generations=55)


@cache
def _texts() -> dict[str, dict[str, dict[str, Any]]]:
    """The texts of all sections, tables, figures and claims by name."""
    return tomllib.loads((Path(__file__).parent / "texts.toml").read_text(encoding="utf-8"))


def claim(name: str, holds: bool | None, ours: str, *, fails: bool = True, seeds: int = RUNS, **values: Any) -> Claim:
    """Build a claim: its texts from ``texts.toml``, filled in with values, what came out here, and our verdict.

    It is open where it neither holds nor fails, or was tried with fewer seeds than the 50 runs of the papers.
    """
    texts = _texts()["claims"][name]
    printed, why = (texts[key].format(**values) for key in ("printed", "why"))
    verdict = OPEN if holds is None or seeds < RUNS else HOLDS if holds else FAILS if fails else OPEN
    return Claim(texts["where"], texts["claim"], printed, ours, verdict, why)


def table(name: str, rows: Sequence[Sequence[Cell]], **values: Any) -> ResultTable:
    """Build a table: its title, heads and note from ``texts.toml``, filled in with values."""
    texts = _texts()["tables"][name]
    title, note = (texts[key].format(**values) for key in ("title", "note"))
    return ResultTable(name, title, tuple(texts["heads"].split(" | ")), [list(row) for row in rows], note)


def figure(name: str, draw: Callable[..., Figure], *arguments: Any) -> dict[str, tuple[str, Figure]]:
    """Draw a figure with the title from ``texts.toml``; return it with its caption, by its name."""
    texts = _texts()["figures"][name]
    return {name: (texts["caption"], draw(texts["title"], *arguments))}


def section(
    name: str, tables: Sequence[ResultTable], figures: Sequence[Mapping[str, Any]], *claims: Claim, **values: Any
) -> Section:
    """Build a section: its title and text from ``texts.toml``, filled in with values."""
    texts = _texts()["sections"][name]
    text = tuple(line.format(**values) for line in texts["text"])
    return Section(name, texts["title"], text, tuple(tables), dict(ChainMap(*reversed(figures))), claims)


VERDICT_CLASSES = {HOLDS: "holds", FAILS: "fails", OPEN: "open"}


@dataclass(frozen=True)
class Reproduction:
    """The sections of a reproduction that are done, with the seed of its recordings and whether it was quick.

    `missing` is the number of the other sections.
    """

    parts: tuple[Section, ...]
    seed: int
    quick: bool
    missing: int = 0

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
            "seconds": {part.name: part.seconds for part in self.parts},
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
    with os_errors_as(f"cannot write into {folder}", ANOTHER_FOLDER):
        for sub in ("figures", "tables"):
            (folder / sub).mkdir(parents=True, exist_ok=True)
        for part in (part.with_drawn_figures() for part in reproduction.parts):
            _write_figures_and_tables(part, folder)
        page = folder / "reproduce.html"
        page.write_text(render_page(reproduction), encoding="utf-8")
        result = reproduction.summary() | {"page": str(page), "output": str(folder)}
        (folder / "reproduce.json").write_text(json.dumps(result, indent=1, ensure_ascii=False), encoding="utf-8")
    return result


def read_sections(folder: Path, keys: Mapping[str, str]) -> dict[str, Section]:
    """Read the sections in a folder that were made with the same keys, by name.

    Parameters
    ----------
    folder
        Where `write_reproduction` wrote.
    keys
        Key of each section by name.

    Returns
    -------
    dict
        Sections; none if the folder holds no reproduction, or one that was changed.

    """
    try:
        kept = json.loads((folder / "reproduce.json").read_text(encoding="utf-8"))
        mine = [part for part in kept["parts"] if part["key"] == keys.get(part["name"])]
        return {part["name"]: Section.read(part, kept["seconds"][part["name"]], folder) for part in mine}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _write_figures_and_tables(part: Section, folder: Path) -> None:
    for name, (_, svg) in part.figures.items():
        (folder / "figures" / f"{name}.svg").write_text(str(svg), encoding="utf-8")
    for table in part.tables:
        with (folder / "tables" / f"{table.name}.csv").open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([table.heads, *table.rows])


def render_page(reproduction: Reproduction) -> str:
    """Render the page as HTML."""
    return page_template("page.html.j2", "validation/reproduce").render(
        parts=[part.with_drawn_figures() for part in reproduction.parts],
        claims=reproduction.claims,
        counts=reproduction.counts,
        quick=reproduction.quick,
        missing=reproduction.missing,
        minutes=format_number(sum(part.seconds for part in reproduction.parts) / 60, 2),
        kinds=VERDICT_CLASSES,
        draw=SvgEmbedder().embed,
        as_text=as_text,
    )


def as_text(table: ResultTable) -> dict[str, Any]:
    """A table as the pages set it: text of every cell, and the columns of numbers."""
    numeric = {i for i, _ in enumerate(table.heads) if any(isinstance(row[i], float) for row in table.rows)}
    return {"heads": table.heads, "rows": [list(map(format_cell, row)) for row in table.rows], "numeric": numeric}


def format_cell(cell: Cell) -> str:
    """Format a cell; numbers get four digits.

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
    grid: Any = page_template("grid.html.j2").module
    parts = (Markup("<h4>{}</h4>{}<p>{}</p>").format(t.title, grid.grid(as_text(t)), t.note) for t in tables)
    return Markup("").join(parts)
