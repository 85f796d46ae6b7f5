"""Terms of formulas: a shape over an axis with its numbers, and the effect of one's own that it makes."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from frictrack import effects
from frictrack.diagnose.formulas.shapes import SHAPES, Shape
from frictrack.diagnose.smooth_forces import Axis
from frictrack.effects import Effect, Path
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution
from frictrack.records import Array

AXIS_SYMBOLS = {"x": ("x", "x"), "t": ("t", "t"), "v": ("abs(v)", "|v|")}  # axes of formulas: in a study file, to read
EFFECT_NAME = "unexplained"  # of the effect in the study file
MAX_WIDTH_RATIO = 3.0  # times the axis: a width beyond it is no width


@dataclass(frozen=True)
class Term:
    """One shape over one axis with its numbers, and what multiplies it."""

    shape: Shape
    along: Axis
    numbers: tuple[float, ...]
    ends: tuple[float, float]  # of the axis
    gain: float = 0.0
    coefficients: tuple[float, ...] = ()

    @property
    def unknowns(self) -> int:
        """Coefficients and numbers."""
        return len(self.shape.columns) + len(self.numbers)

    @property
    def axis(self) -> str:
        """Name of the axis."""
        return self.along.name

    @property
    def factor(self) -> str:
        """What multiplies the shape, as a study file writes it."""
        return self.along.factor

    def force(self, path: Path, numbers: Sequence[float]) -> Array:
        """Its columns along a path (n, k), N per unit of each coefficient."""
        made = self.shape.evaluated(self.along.of(path), numbers)
        return np.stack(made, axis=1) * self.along.times(path)[:, None]


@dataclass(frozen=True)
class FittedFormula:
    """A sum of terms, added to a law and fitted."""

    terms: tuple[Term, ...]
    solution: Solution
    delta_bic: float
    share: float

    @property
    def complexity(self) -> tuple[int, int]:
        """Fewer unknowns are simpler, then the earlier shape."""
        return sum(t.unknowns for t in self.terms), sum(SHAPES.index(t.shape) for t in self.terms)


def build_effect(name: str, term: Term) -> Effect:
    """The term as a user's effect, looked for only where it was found."""
    made = effects.formula(name, study_file_text(term, ""), bounds=parameter_bounds(term, 10.0, 3.0))
    here = {q: {"scan": _SingleValueScan(value)} for q, value in zip(parameter_names(term), term.numbers, strict=True)}
    return replace(made, columns=_Columns(term)).adjusted(**here)


@dataclass(frozen=True)
class _Columns:
    """The columns of a term, without the checks that a user's text needs."""

    term: Term

    def __call__(self, path: Path, nonlinear: Mapping[str, float]) -> Array:
        made = self.term.force(path, [nonlinear[q] for q in self.term.shape.numbers])
        if not np.all(np.isfinite(made)):
            raise FrictrackError(f"{self.term.shape.name} is no number along every run")
        return made


@dataclass(frozen=True)
class _SingleValueScan:
    """A scan of one value."""

    value: float

    def __call__(self, span: Any) -> Array:
        return np.array([self.value])


def parameter_bounds(term: Term, times: float, cells: float, suffix: str = "") -> dict[str, tuple[float, float]]:
    """Where the numbers may go: a width by a factor, a place or a frequency by so many cells that look alike."""
    low, high = term.ends
    span = high - low
    out = {}
    for letter, kind, value in zip(parameter_names(term, suffix), term.shape.kinds, term.numbers, strict=True):
        if kind in ("width", "scale"):
            near, far = sorted((value / times, value * times), key=abs)
            ends = near, float(np.clip(far, -MAX_WIDTH_RATIO * span, MAX_WIDTH_RATIO * span))
        elif kind == "share":
            ends = 0.3, 0.995
        else:
            period = term.numbers[1] if kind in ("offset", "period") else span
            cell = {"place": 0.05 * span, "offset": 0.25 * period, "period": 0.5 * period**2 / span}
            away = cells * (cell | {"rate": 0.5 / span, "sweep": 0.5 / span**2})[kind]
            ends = value - away, value + away
            ends = (max(ends[0], low), min(ends[1], high)) if kind == "place" else ends
        out[letter] = min(ends), max(ends)
    return out


def parameter_names(term: Term, suffix: str = "") -> list[str]:
    """Names of its numbers."""
    return [q + suffix for q in term.shape.numbers]


def coefficient_names(term: Term, suffix: str = "") -> list[str]:
    """Names of its coefficients."""
    many = len(term.shape.columns) > 1
    return [f"F_{i}{suffix}" if many else f"F{suffix}" for i in range(1, len(term.shape.columns) + 1)]


def study_file_text(term: Term, suffix: str) -> str:
    """The term as a study file has it."""
    return " + ".join(
        " * ".join(part for part in (coefficient, term.factor, column_text(column, term, suffix)) if part)
        for coefficient, column in zip(coefficient_names(term, suffix), term.shape.columns, strict=True)
    )


def column_text(column: str, term: Term, suffix: str) -> str:
    """A column with the axis and its numbers under their own names; nothing for a constant."""
    if column == "1":
        return ""
    text = re.sub(r"\bu\b", AXIS_SYMBOLS[term.axis][0], column)
    for q in term.shape.numbers:
        text = re.sub(rf"\b{q}\b", q + suffix, text)
    return text
