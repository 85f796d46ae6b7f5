"""Define terms of formulas: a shape over an axis with its parameters, and the user effect that it makes."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from frictrack import effects
from frictrack.diagnose.formulas.dimensions import AXIS_DIMENSIONS, NONE, Dimension, product
from frictrack.diagnose.formulas.shapes import MAX_PERIODS, Shape
from frictrack.diagnose.smooth_forces import Axis
from frictrack.effects import Effect, Path
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution
from frictrack.records import Array, Mask

AXIS_SYMBOLS = {"x": ("x", "x"), "t": ("t", "t"), "v": ("abs(v)", "|v|")}  # in a study file, and to read
EFFECT_NAME = "unexplained"  # in the study file
FACTOR_VARIABLES = {"x": "x", "t": "t", "abs(v)": "v"}  # factors that are variables of the motion
FACTOR_DIMENSIONS = {  # of factors with a unit
    **{factor: AXIS_DIMENSIONS[axis] for factor, axis in FACTOR_VARIABLES.items()},
    "mass": (0.0, 0.0, 1.0),
    "mass^(-1/2)": (0.0, 0.0, -1 / 2),
    "mass^(-1/3)": (0.0, 0.0, -1 / 3),
}
MIN_WIDTH_RATIO, MAX_WIDTH_RATIO = 3e-3, 3.0  # times the axis; a wider shape is flat
LOGARITHMIC_KINDS = ("width", "scale", "period")
MIN_SHARE, MAX_SHARE = 0.3, 0.995


@dataclass(frozen=True)
class Term:
    """One shape over one axis.

    Parameters
    ----------
    shape
        The shape.
    variable
        The axis.
    parameters
        Values of its parameters.
    ends
        Ends of the axis.
    gain
        Fall of chi-squared.
    coefficients
        Coefficient of each column, N.
    log_volume
        Logarithm of the share of the prior range of its parameters that the data leave.

    """

    shape: Shape
    variable: Axis
    parameters: tuple[float, ...]
    ends: tuple[float, float]  # of the axis
    gain: float = 0.0
    coefficients: tuple[float, ...] = ()
    log_volume: float = 0.0

    @property
    def unknowns(self) -> int:
        """Number of coefficients and parameters."""
        return len(self.shape.columns) + len(self.parameters)

    @property
    def axis(self) -> str:
        """Name of the axis."""
        return self.variable.name

    @property
    def factor(self) -> str:
        """Factor on the shape, as in a study file."""
        return self.variable.factor

    @property
    def multipliers(self) -> tuple[str, ...]:
        """Factors with a unit: variables of the motion, and powers of the mass."""
        return tuple(one for one in self.factor.split(" * ") if one in FACTOR_DIMENSIONS)

    @property
    def size(self) -> int:
        """Number of unknowns and of operators of the multipliers: a product, and a power."""
        return self.unknowns + sum(2 if "^" in one else 1 for one in self.multipliers)

    @property
    def form(self) -> str:
        """The form without values, as in a study file."""
        return study_file_text(self, "")

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of the axes on which it depends, its own first; none of its own for a constant shape."""
        own = () if self.shape.columns == ("1",) and self.multipliers else (self.axis,)
        return (*own, *(FACTOR_VARIABLES[one] for one in self.multipliers if one in FACTOR_VARIABLES))

    def force(self, path: Path, parameters: Sequence[float]) -> Array:
        """Columns along a path, N per unit of each coefficient, (n, k)."""
        made = self.shape.columns_at(self.variable.of(path), parameters)
        return np.stack(made, axis=1) * self.variable.times(path)[:, None]


@dataclass(frozen=True)
class FittedFormula:
    """A sum of terms added to a model and fitted, with its fall of BIC and its share of the excess chi-squared."""

    terms: tuple[Term, ...]
    solution: Solution
    delta_bic: float
    share: float

    @property
    def form(self) -> str:
        """The form without values, as in a study file."""
        suffixes = [""] if len(self.terms) == 1 else ["_a", "_b"]
        return " + ".join(study_file_text(*pair) for pair in zip(self.terms, suffixes, strict=True))


def factor_dimension(factor: str) -> Dimension:
    """Powers of m, s and kg of a factor."""
    out = NONE
    for one in factor.split(" * "):
        out = product(out, FACTOR_DIMENSIONS.get(one, NONE))
    return out


def build_effect(name: str, term: Term) -> Effect:
    """Make a user effect of a term, to be fitted from where it was found."""
    effect = effects.formula(name, study_file_text(term, ""), bounds=parameter_bounds(term, 10.0, 3.0))
    scans = {
        q: {"scan": _SingleValueScan(value)} for q, value in zip(parameter_names(term), term.parameters, strict=True)
    }
    return replace(effect, columns=_Columns(term)).adjusted(**scans)


@dataclass(frozen=True)
class _Columns:
    """Columns of a term without the checks of a user's text."""

    term: Term

    def __call__(self, path: Path, nonlinear: Mapping[str, float]) -> Array:
        made = self.term.force(path, [nonlinear[q] for q in self.term.shape.parameters])
        if not np.all(np.isfinite(made)):
            raise FrictrackError(f"{self.term.shape.name} is no number along every run")
        return made


@dataclass(frozen=True)
class _SingleValueScan:
    """A scan of one value."""

    value: float

    def __call__(self, span: Any) -> Array:
        return np.array([self.value])


def parameter_bounds(term: Term, factor: float, cells: float, suffix: str = "") -> dict[str, tuple[float, float]]:
    """Bounds of the parameters: a width within a factor, a place or frequency within some resolution cells.

    Parameters
    ----------
    term
        The term.
    factor
        Factor for widths and scales.
    cells
        Number of resolution cells for places, periods and rates.
    suffix
        Suffix of the names.

    Returns
    -------
    dict
        Lower and upper bound by name.

    """
    low, high = term.ends
    span = high - low
    out = {}
    for letter, kind, value in zip(parameter_names(term, suffix), term.shape.kinds, term.parameters, strict=True):
        if kind in ("width", "scale"):
            least, most = MIN_WIDTH_RATIO * span, MAX_WIDTH_RATIO * span
            sign, size = (-1.0, -value) if value < 0 else (1.0, value)
            ends = sign * float(np.clip(size / factor, least, most)), sign * float(np.clip(size * factor, least, most))
        elif kind == "share":
            ends = MIN_SHARE, MAX_SHARE
        else:
            period = term.parameters[1] if kind in ("offset", "period") else span
            cell = {"place": 0.05 * span, "offset": 0.25 * period, "period": 0.5 * period**2 / span}
            reach = cells * (cell | {"rate": 0.5 / span, "sweep": 0.5 / span**2})[kind]
            ends = value - reach, value + reach
            ends = (max(ends[0], low), min(ends[1], high)) if kind == "place" else ends
        out[letter] = min(ends), max(ends)
    return out


def parameter_ranges(term: Term) -> tuple[Array, Mask]:
    """Prior ranges of the parameters, over which their prior is constant.

    Parameters
    ----------
    term
        The term.

    Returns
    -------
    ranges : ndarray, shape (q,)
        Widths of the ranges; of the logarithm for widths, scales and periods.
    logarithmic : ndarray of bool, shape (q,)
        Whether it is the logarithm.

    """
    span = term.ends[1] - term.ends[0]
    widths = float(np.log(MAX_WIDTH_RATIO / MIN_WIDTH_RATIO))
    periods = term.parameters[term.shape.kinds.index("period")] if "period" in term.shape.kinds else span
    ranges = {
        "place": span,
        "offset": periods,
        "width": widths,
        "scale": widths + float(np.log(2.0)),  # either sign
        "period": float(np.log(MAX_PERIODS)),
        "rate": MAX_PERIODS / span,
        "sweep": MAX_PERIODS / span**2,
        "share": MAX_SHARE - MIN_SHARE,
    }
    kinds = term.shape.kinds
    return np.array([ranges[k] for k in kinds]), np.array([k in LOGARITHMIC_KINDS for k in kinds], dtype=bool)


def parameter_names(term: Term, suffix: str = "") -> list[str]:
    """Names of its parameters."""
    return [q + suffix for q in term.shape.parameters]


def coefficient_names(term: Term, suffix: str = "") -> list[str]:
    """Names of its coefficients."""
    many = len(term.shape.columns) > 1
    return [f"F_{i}{suffix}" if many else f"F{suffix}" for i in range(1, len(term.shape.columns) + 1)]


def study_file_text(term: Term, suffix: str) -> str:
    """The term as written in a study file."""
    return " + ".join(
        " * ".join(part for part in (coefficient, term.factor, column_text(column, term, suffix)) if part)
        for coefficient, column in zip(coefficient_names(term, suffix), term.shape.columns, strict=True)
    )


def column_text(column: str, term: Term, suffix: str) -> str:
    """A column with the names of axis and parameters; empty for a constant."""
    if column == "1":
        return ""
    text = re.sub(r"\bu\b", AXIS_SYMBOLS[term.axis][0], column)
    for q in term.shape.parameters:
        text = re.sub(rf"\b{q}\b", q + suffix, text)
    return text
