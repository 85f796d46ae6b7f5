"""Write formulas as text: with values and units to read, and as a table to paste into a study file."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from frictrack.axes import AXES
from frictrack.diagnose.formulas.terms import (
    AXIS_SYMBOLS,
    EFFECT_NAME,
    FittedFormula,
    Term,
    coefficient_names,
    parameter_bounds,
    study_file_text,
    with_suffixes,
)
from frictrack.diagnose.smooth_forces import MIN_LOAD_RATIO
from frictrack.fit.least_squares import Solution

DIMENSIONS = {  # powers of m, s and kg of the axes, and of factors with a unit
    "x": (1, 0, 0), "t": (0, 1, 0), "v": (1, -1, 0), "abs(v)": (1, -1, 0),
    "mass": (0, 0, 1), "mass^(-1/2)": (0, 0, -1 / 2), "mass^(-1/3)": (0, 0, -1 / 3),
}  # fmt: skip
INVERSE_UNITS = {"m": ("1/m", "1/m^2"), "s": ("Hz", "1/s^2"), "m/s": ("s/m", "s^2/m^2")}
POWER_TOLERANCE = 1e-9


def coefficient_unit(column: str, term: Term) -> str:
    """Unit of the coefficient of a column: newton over the units of the column and of its factors.

    Examples
    --------
    >>> from frictrack.diagnose.formulas import SHAPES
    >>> from frictrack.diagnose.smooth_forces import Axis
    >>> coefficient_unit("u", Term(SHAPES[0], Axis("v", lambda path: path.speed, "s * t"), (), (0.0, 1.0)))
    'N/m'

    """
    powers = term.shape.degree(column) * np.array(DIMENSIONS[term.axis])
    powers = powers + sum(np.array(DIMENSIONS[one]) for one in term.multipliers)
    signed = [
        (symbol, float(p)) for symbol, p in zip(["m", "s", "kg"], powers, strict=True) if abs(p) > POWER_TOLERANCE
    ]
    over = "".join(f" {_power(symbol, -p)}" for symbol, p in signed if p < 0)
    return f"N{over}" + "".join(f"/{_power(symbol, p)}" for symbol, p in signed if p > 0)


def _power(symbol: str, power: float) -> str:
    return symbol if abs(power - 1) < POWER_TOLERANCE else f"{symbol}^{power:.3g}"


def _parameter_unit(kind: str, axis: str) -> str:
    unit = AXES[axis].unit
    return {"rate": INVERSE_UNITS[unit][0], "sweep": INVERSE_UNITS[unit][1], "share": "1"}.get(kind, unit)


def describe_formula(found: FittedFormula, bare: Solution) -> dict[str, Any]:
    """Return the JSON entry of a formula that was added to a model."""
    solution = found.solution
    values = solution.problem.layout.values(solution.p, 0)[0]
    terms = []
    for i, term in enumerate(found.terms):
        own = values[EFFECT_NAME if i == 0 else f"{EFFECT_NAME}_{i + 1}"]
        terms.append(
            replace(
                term,
                parameters=tuple(own[q] for q in term.shape.parameters),
                coefficients=tuple(own[c] for c in coefficient_names(term)),
            )
        )
    loads = [float(p.path.load) for p in bare.problem.pieces]
    added = [n for n in solution.problem.model.names if n not in bare.problem.model and not n.startswith(EFFECT_NAME)]
    return {
        "form": found.form,
        "formula": _formula_text(terms, with_load=max(loads) > MIN_LOAD_RATIO * min(loads)),
        "axis": terms[0].axis,
        "variables": list(dict.fromkeys(name for term in terms for name in term.variables)),
        "share": found.share,
        "delta_bic": float(found.delta_bic),
        "unknowns": sum(t.unknowns for t in terms),
        "reduced_chi2": solution.chi2 / max(solution.problem.n_frames - len(solution.p), 1),
        "beside": added,
        "toml": _toml(terms),
    }


def _formula_text(terms: Sequence[Term], *, with_load: bool) -> str:
    """The formula with its values, to read; the load is left out if all runs have the same."""
    out = ""
    for term in terms:
        factors = [one for one in term.variable.factor.split(" * ") if one and (with_load or one != "L")]
        factor = "".join(f"{one} " for one in factors).replace("abs(v)", "|v|").replace("mass", "m")
        for one, column, value in _merge_sine_pairs(term):
            sign = ("-" if value < 0 else "") if not out else (" - " if value < 0 else " + ")
            text = f"{abs(value):.3g} {coefficient_unit(one, term)} {factor}{_column_text(column, term)}"
            out += sign + text.strip()
    return out


def _merge_sine_pairs(term: Term) -> Iterator[tuple[str, str, float]]:
    """Columns with their text and coefficients; sine and cosine merged to one with a phase."""
    pairs = list(zip(term.shape.columns, term.coefficients, strict=True))
    while pairs:
        column, value = pairs.pop(0)
        if "sin(" in column and pairs and pairs[0][0] == column.replace("sin(", "cos("):
            other = pairs.pop(0)[1]
            yield column, f"{column[:-1]} + {np.arctan2(other, value):.3g} rad)", float(np.hypot(value, other))
        else:
            yield column, column, value


def _column_text(column: str, term: Term) -> str:
    """A column with its parameters and their units."""
    text = "" if column == "1" else re.sub(r"\bu\b", AXIS_SYMBOLS[term.axis][1], column)
    for q, kind, number in zip(term.shape.parameters, term.shape.kinds, term.parameters, strict=True):
        digits = 3 if kind in ("width", "scale", "share") else 4
        text = re.sub(rf"\b{q}\b", f"{number:.{digits}g} {_parameter_unit(kind, term.axis)}".removesuffix(" 1"), text)
    return text.replace("2*pi*", "2 pi ").replace("*", " ").replace("- -", "+ ").replace("+ -", "- ")


def _toml(terms: Sequence[Term]) -> str:
    """The formula as a user effect for a study file."""
    units: dict[str, str] = {}
    bounds: dict[str, tuple[float, float]] = {}
    for term, suffix in with_suffixes(terms):
        columns = zip(coefficient_names(term, suffix), term.shape.columns, strict=True)
        units |= {name: coefficient_unit(column, term) for name, column in columns}
        kinds = zip(term.shape.parameters, term.shape.kinds, strict=True)
        units |= {q + suffix: _parameter_unit(kind, term.axis) for q, kind in kinds}
        bounds |= parameter_bounds(term, 3.0, 1.0, suffix)
    text = " + ".join(study_file_text(*pair) for pair in with_suffixes(terms))
    lines = [
        "[[effect]]",
        f'effect = "{EFFECT_NAME}"',
        f'formula = "{text}"',
        "units = {" + ", ".join(f'{k} = "{u}"' for k, u in units.items()) + "}",
    ]
    if bounds:
        lines.append("bounds = {" + ", ".join(f"{k} = [{a:.4g}, {b:.4g}]" for k, (a, b) in bounds.items()) + "}")
    return "\n".join(lines) + "\n"
