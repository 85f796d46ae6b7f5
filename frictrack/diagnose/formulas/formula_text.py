"""Write formulas as text: with values and units to read, and as a table to paste into a study file."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from frictrack.axes import AXES
from frictrack.diagnose.formulas.dimensions import coefficient_unit, product
from frictrack.diagnose.formulas.terms import (
    AXIS_SYMBOLS,
    EFFECT_NAME,
    FittedFormula,
    Term,
    coefficient_names,
    factor_dimension,
    parameter_bounds,
    parameter_names,
    study_file_text,
)
from frictrack.diagnose.smooth_forces import MIN_LOAD_RATIO
from frictrack.fit.least_squares import Solution

FACTOR_TEXTS = {"L": "L", "s": "s", "x": "x", "t": "t", "abs(v)": "|v|", "mass": "m", "mass^(-1/2)": "m^(-1/2)",
                "mass^(-1/3)": "m^(-1/3)"}  # fmt: skip
INVERSE_UNITS = {"m": ("1/m", "1/m^2"), "s": ("Hz", "1/s^2"), "m/s": ("s/m", "s^2/m^2")}


def _unit(kind: str, axis: str) -> str:
    unit = AXES[axis].unit
    return {"rate": INVERSE_UNITS[unit][0], "sweep": INVERSE_UNITS[unit][1], "share": "1"}.get(kind, unit)


def _coefficient_unit(column: str, term: Term) -> str:
    """Unit of the coefficient of a column, derived from its text."""
    return coefficient_unit(product(factor_dimension(term.factor), term.shape.dimension(column, term.axis)))


def _factor_text(factor: str, *, with_load: bool) -> str:
    """A factor to read; the load is left out if all runs have the same."""
    parts = factor.split(" * ") if factor else []
    return "".join(f"{FACTOR_TEXTS[one]} " for one in parts if with_load or one != "L")


def describe_formula(found: FittedFormula, solution: Solution) -> dict[str, Any]:
    """Return the JSON entry of a formula.

    Parameters
    ----------
    found
        The fitted formula.
    solution
        The model without it.

    Returns
    -------
    dict

    """
    values = found.solution.problem.layout.values(found.solution.p, 0)[0]
    terms = []
    for i, term in enumerate(found.terms):
        own = values[EFFECT_NAME if i == 0 else f"{EFFECT_NAME}_{i + 1}"]
        terms.append(
            (
                replace(term, parameters=tuple(own[q] for q in parameter_names(term))),
                [own[c] for c in coefficient_names(term)],
            )
        )
    loads = [float(p.path.load) for p in solution.problem.pieces]
    added = [
        n
        for n in found.solution.problem.model.names
        if n not in solution.problem.model and not n.startswith(EFFECT_NAME)
    ]
    return {
        "form": found.form,
        "formula": _formula_text(terms, with_load=max(loads) > MIN_LOAD_RATIO * min(loads)),
        "axis": found.terms[0].axis,
        "variables": list(dict.fromkeys(name for term in found.terms for name in term.variables)),
        "share": found.share,
        "delta_bic": float(found.delta_bic),
        "unknowns": sum(t.unknowns for t in found.terms),
        "reduced_chi2": found.solution.chi2 / max(found.solution.problem.n_frames - len(found.solution.p), 1),
        "beside": added,
        "toml": _toml([t for t, _ in terms]),
    }


def _formula_text(terms: Sequence[tuple[Term, list[float]]], *, with_load: bool) -> str:
    """The formula with its values, to read."""
    out = ""
    for term, coefficients in terms:
        factor = _factor_text(term.factor, with_load=with_load)
        for one, column, value in _merge_sine_pairs(term.shape.columns, coefficients):
            size = f"{abs(value):.3g} {_coefficient_unit(one, term)}"
            sign = ("-" if value < 0 else "") if not out else (" - " if value < 0 else " + ")
            out += sign + f"{size} {factor}{_column_text(column, term)}".strip()
    return out


def _merge_sine_pairs(columns: Sequence[str], coefficients: Sequence[float]) -> Iterator[tuple[str, str, float]]:
    """Columns with their text and coefficients; sine and cosine merged to one with a phase."""
    pairs = list(zip(columns, coefficients, strict=True))
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
        text = re.sub(rf"\b{q}\b", f"{number:.{digits}g} {_unit(kind, term.axis)}".removesuffix(" 1"), text)
    return text.replace("2*pi*", "2 pi ").replace("*", " ").replace("- -", "+ ").replace("+ -", "- ")


def _toml(terms: Sequence[Term]) -> str:
    """The formula as a user effect for a study file."""
    suffixes = [""] if len(terms) == 1 else [f"_{i}" for i in "ab"]
    pairs = list(zip(terms, suffixes, strict=True))
    units: dict[str, str] = {}
    bounds: dict[str, tuple[float, float]] = {}
    for term, suffix in pairs:
        columns = zip(coefficient_names(term, suffix), term.shape.columns, strict=True)
        units |= {c: _coefficient_unit(column, term) for c, column in columns}
        units |= {
            q: _unit(kind, term.axis) for q, kind in zip(parameter_names(term, suffix), term.shape.kinds, strict=True)
        }
        bounds |= parameter_bounds(term, 3.0, 1.0, suffix)
    lines = [
        "[[effect]]",
        f'effect = "{EFFECT_NAME}"',
        f'formula = "{" + ".join(study_file_text(*pair) for pair in pairs)}"',
        "units = {" + ", ".join(f'{k} = "{u}"' for k, u in units.items()) + "}",
    ]
    if bounds:
        lines.append("bounds = {" + ", ".join(f"{k} = [{a:.4g}, {b:.4g}]" for k, (a, b) in bounds.items()) + "}")
    return "\n".join(lines) + "\n"
