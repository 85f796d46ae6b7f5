"""What a part of the reproduction hands back: tables, figures, and the papers' claims with our verdict on each."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from matplotlib.figure import Figure

Progress = Callable[[int, int, str], None]
Cell = str | float | None
HOLDS, FAILS, OPEN = "holds", "does not hold", "cannot be decided"
NOT_SPECIFIED = "not specified by the paper"


@dataclass(frozen=True)
class Claim:
    """A claim of a paper, what is printed, what came out here, and whether it holds."""

    where: str
    claim: str
    printed: str
    ours: str
    verdict: str  # HOLDS, FAILS or OPEN
    why: str


def _finite(value: float) -> float | None:
    """A plain number, None for one that is none."""
    return float(value) if math.isfinite(value) else None


@dataclass(frozen=True)
class Table:
    """A table: heads, rows of words and numbers, and a note beneath."""

    name: str  # of its CSV file
    title: str
    heads: tuple[str, ...]
    rows: list[list[Cell]]
    note: str = ""

    def __post_init__(self) -> None:
        plain = [[c if c is None or isinstance(c, str) else _finite(c) for c in row] for row in self.rows]
        object.__setattr__(self, "rows", plain)


@dataclass(frozen=True)
class Part:
    """One part of the reproduction."""

    name: str
    title: str
    text: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    figures: dict[str, tuple[str, Figure]] = field(default_factory=dict)  # file name -> caption, figure
    claims: tuple[Claim, ...] = ()

    def summary(self) -> dict[str, Any]:
        """The part as JSON, figures by their file names."""
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
    """How much is spent: seeds of every statistic, and evaluations of the searches."""

    seeds: int = 200  # of Tables 5, 6 and 7
    identified: int = 6  # seeds of every identification by a search of the papers
    budget: int = 36_040  # evaluations of each: 1000 generations of 40 individuals with a gap of 0.9
    lowest: int = 20_000  # evaluations in search of the lowest error known


FULL, QUICK = Effort(), Effort(seeds=4, identified=1, budget=2000, lowest=450)


def silent(done: int, total: int, what: str) -> None:
    """Progress that nobody watches."""
