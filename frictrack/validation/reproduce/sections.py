"""The result of one section of the reproduction: tables, figures, and claims of the papers with our verdicts."""

from __future__ import annotations

import math
import tomllib
from collections import ChainMap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from frictrack.validation.reproduce.printed import RUNS

Progress = Callable[[int, int, str], None]
Cell = str | float | None
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
        Caption and figure by file name; a figure that was drawn before is its SVG.
    claims
        Claims that the section tests.

    """

    name: str
    title: str
    text: tuple[str, ...] = ()
    tables: tuple[ResultTable, ...] = ()
    figures: dict[str, tuple[str, Figure | str]] = field(default_factory=dict)
    claims: tuple[Claim, ...] = ()

    def summary(self) -> dict[str, Any]:
        """JSON of the section, with figures by file name."""
        return {
            "name": self.name,
            "title": self.title,
            "text": list(self.text),
            "tables": [vars(t) | {"heads": list(t.heads)} for t in self.tables],
            "figures": list(self.figures),
            "claims": [vars(c) for c in self.claims],
        }


@dataclass(frozen=True)
class Effort:
    """Computational effort.

    Attributes
    ----------
    seeds
        Seeds of the statistics in Tables 5, 6 and 7.
    identified
        Seeds of each identification by a search of the papers.
    budget
        Evaluations of each search: 40 + 1000 generations of 36 children (40 individuals, gap 0.9).
    lowest
        Evaluations spent on finding the lowest error.

    """

    seeds: int = 200
    identified: int = 6
    budget: int = 36_040
    lowest: int = 20_000


FULL, QUICK = Effort(), Effort(seeds=4, identified=1, budget=2000, lowest=450)


@cache
def _texts() -> dict[str, dict[str, dict[str, Any]]]:
    """The texts of all sections, tables, figures and claims by name."""
    return tomllib.loads((Path(__file__).parent / "texts.toml").read_text(encoding="utf-8"))


def claim(name: str, verdict: str, ours: str, **values: Any) -> Claim:
    """Build a claim: its texts from ``texts.toml``, filled in with values, and what came out here."""
    texts = _texts()["claims"][name]
    printed, why = (texts[key].format(**values) for key in ("printed", "why"))
    return Claim(texts["where"], texts["claim"], printed, ours, verdict, why)


def table(name: str, rows: Sequence[Sequence[Cell]], **values: Any) -> ResultTable:
    """Build a table: its title, heads and note from ``texts.toml``, filled in with values."""
    texts = _texts()["tables"][name]
    title, note = (texts[key].format(**values) for key in ("title", "note"))
    return ResultTable(name, title, tuple(texts["heads"].split(" | ")), [list(row) for row in rows], note)


def figure(name: str, draw: Callable[..., Figure], *arguments: Any) -> dict[str, tuple[str, Figure | str]]:
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


def decided(verdict: str, seeds: int) -> str:
    """The verdict, or `OPEN` with fewer seeds than the 50 runs of the papers."""
    return verdict if seeds >= RUNS else OPEN


def verdict(holds: bool, fails: bool = True) -> str:
    """The verdict on a claim: `OPEN` where it neither holds nor fails."""
    return HOLDS if holds else FAILS if fails else OPEN


def silent(done: int, total: int, what: str) -> None:
    """Report no progress."""
