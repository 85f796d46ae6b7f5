"""Define the formulas: shapes over one variable, terms with parameters, the user effects that they make, their text.

Shapes are powers, functions of a dimensionless argument, and waves. A shape is written with `u` for the variable and
letters for its parameters. The same text is evaluated here, printed and written to a study file, so that the three
agree.
"""

from __future__ import annotations

import ast
import operator
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import product
from typing import Any

import numpy as np

from frictrack import effects
from frictrack.base.errors import FrictrackError, UsageError
from frictrack.diagnose.compressed import MIN_LOAD_RATIO, Axis, CompressedResidual, candidate_axes
from frictrack.effects import CONSTANTS, FUNCTIONS, OPERATORS, Effect, Path
from frictrack.fit.least_squares import Solution
from frictrack.records import Array, Mask
from frictrack.results.candidates import AXES

WIDTH_RATIOS = (0.3, 0.1, 0.04, 0.015)  # of the axis, for bumps and steps
MAX_PERIODS = 45.0  # on an axis
PERIOD_STEP = 0.25  # difference of periods over the axis between two waves of the grid
RINGING_RATIOS = (0.1, 0.25, 1.0)  # of the axis, decay lengths of a wave
KIND_POWERS = {  # powers of the unit of the axis that parameters have, by kind
    "place": 1, "offset": 1, "width": 1, "period": 1, "scale": 1, "rate": -1, "sweep": -2, "share": 0,
}  # fmt: skip
AXIS_SYMBOLS = {"x": ("x", "x"), "t": ("t", "t"), "v": ("abs(v)", "|v|")}  # in a study file, and to read
EFFECT_NAME = "unexplained"  # in the study file
LOAD_POWERS = ("mass", "mass^(-1/2)", "mass^(-1/3)")  # times L: powers 2, 1/2 and 2/3, where loads are masses
FACTOR_VARIABLES = {symbol: name for name, (symbol, _) in AXIS_SYMBOLS.items()}  # factors that vary along a motion
MAX_UNKNOWNS_MULTIPLIED = 3  # of a shape that is multiplied with another variable
MIN_WIDTH_RATIO, MAX_WIDTH_RATIO = 3e-3, 3.0  # times the axis; a wider shape is flat
MIN_SHARE, MAX_SHARE = 0.3, 0.995
DIMENSIONS = {  # powers of m, s and kg of the axes, and of factors with a unit
    "x": (1, 0, 0), "t": (0, 1, 0), "v": (1, -1, 0), "abs(v)": (1, -1, 0),
    "mass": (0, 0, 1), "mass^(-1/2)": (0, 0, -1 / 2), "mass^(-1/3)": (0, 0, -1 / 3),
}  # fmt: skip
INVERSE_UNITS = {"m": ("1/m", "1/m^2"), "s": ("Hz", "1/s^2"), "m/s": ("s/m", "s^2/m^2")}
POWER_TOLERANCE = 1e-9
LOGARITHMIC_KINDS = ("width", "scale", "period")


@dataclass(frozen=True, eq=False)
class Shape:
    """A sum of columns in a variable `u`, each with its own coefficient.

    Parameters
    ----------
    name
        Name of the shape.
    columns
        Text of each column.
    parameters
        Letters of its non-linear parameters.
    kinds
        Kind of each: "place", "offset" (of a wave), "width", "period", "scale" (of either sign), "rate", "sweep" or
        "share"; see `KIND_POWERS`.
    grid
        Settings to try on an axis from 0 to 1, (G, q).
    axes
        Axes on which the shape makes sense.

    """

    name: str
    columns: tuple[str, ...]
    parameters: tuple[str, ...]
    kinds: tuple[str, ...]
    grid: Array
    axes: str = "xtv"

    def columns_at(self, u: Array, parameters: Sequence[float | Array] | Array) -> Array:
        """Evaluate the k columns (..., k) for values of the variable and of the parameters, which are broadcast.

        Examples
        --------
        >>> SHAPES[0].columns_at(np.array([1.0, 2.0]), ())[:, 0].tolist()
        [1.0, 2.0]

        """
        names = {"u": u, **CONSTANTS, **dict(zip(self.parameters, parameters, strict=True))}
        shape = np.broadcast_shapes(np.shape(u), *map(np.shape, parameters))
        with np.errstate(all="ignore"):
            return np.stack([np.broadcast_to(_evaluate(_tree(text), names), shape) for text in self.columns], axis=-1)

    def settings(self, low: float, high: float) -> Array:
        """Settings to try (G, q) on an axis between two ends."""
        scales = np.array([(high - low) ** KIND_POWERS[kind] for kind in self.kinds])
        return self.grid * scales + np.array([low * (kind == "place") for kind in self.kinds])

    def degree(self, column: str) -> float:
        """Power of the unit of the axis that one of the columns has, from its value in two units."""
        powers, k = np.array([KIND_POWERS[kind] for kind in self.kinds]), self.columns.index(column)
        parameters = np.array([0.3, 0.7, 0.6])[: len(powers)]
        once, twice = (self.columns_at(np.array(0.9 * f), parameters * f**powers)[k] for f in (1.0, 2.0))
        return round(float(np.log2(twice / once)), 9) if once * twice > 0 else 0.0


@cache
def _tree(text: str) -> ast.expr:
    return ast.parse(text.replace("^", "**"), mode="eval").body


def _evaluate(node: ast.expr, names: Mapping[str, Any]) -> Any:
    """Evaluate a formula, ^ read as a power; a user's was checked by `effects.formula`."""
    match node:
        case ast.BinOp(left, ast.Pow(), right):
            return operator.pow(_evaluate(left, names), _evaluate(right, names))  # a square is much faster than a power
        case ast.BinOp(left, do, right):
            return OPERATORS[type(do)](_evaluate(left, names), _evaluate(right, names))
        case ast.UnaryOp(do, inner):
            return OPERATORS[type(do)](_evaluate(inner, names))
        case ast.Call(ast.Name(function), arguments):
            return FUNCTIONS[function](*(_evaluate(one, names) for one in arguments))
        case ast.Name(name):
            return names[name]
        case ast.Constant(int() | float() as value):
            return np.float64(value)  # of which a large power is infinite, and does not hang
    raise AssertionError(ast.dump(node))


# Functions of a dimensionless z: those of a scale w, z = u/w, and those of a place c and a width w, z = (u - c)/w.
OF_SCALE = {
    "logarithm": ("log(1 + z)", "tv"),
    "decay": ("exp(-z)", "xtv"),
    "fraction": ("1/(1 + z)", "tv"),
    "saturation": ("tanh(z)", "tv"),
    "hump": ("z*exp(-z)", "tv"),
    "brake": ("z/(1 + (z)^2)", "v"),
    "fall": ("1/(1 + (z)^2)", "tv"),
}
OF_PLACE = {"bump": "exp(-z^2/2)", "step": "tanh(z)", "peak": "1/(1 + z^2)", "pair": "z/(1 + z^2)^2",
            "pull": "z*exp(-z^2/2)"}  # fmt: skip
POWERS = {"linear": ("u", "xtv"), "constant": ("1", "xtv"), "square": ("u^2", "xtv"), "root": ("sqrt(u)", "tv"),
          "cube": ("u^3", "xtv")}  # fmt: skip
WAVE = ("sin(2*pi*f*u)", "cos(2*pi*f*u)")
TEETH = "atan(r*sin(2*pi*(u - c)/p)/(1 - r*cos(2*pi*(u - c)/p)))"

# Settings to try on an axis from 0 to 1.
SCALES = np.geomspace(3e-3, 3.0, 13)[:, None]
PLACES = np.array(  # one width apart, at several widths
    [(c, w) for w in WIDTH_RATIOS for c in (np.arange(np.ceil(1 / w)) + 0.5) / np.ceil(1 / w)]
)
FREQUENCIES = np.arange(0.5, MAX_PERIODS, PERIOD_STEP)[:, None]
OFFSETS = np.array(  # of sawtooth waves whose steep side takes a tenth of the period
    [(p / n, 1 / n, 0.9) for n in np.arange(1.0, MAX_PERIODS / 2, 2 * PERIOD_STEP) for p in np.arange(6) / 6]
)
DECAYS = np.array([(share, f) for share in RINGING_RATIOS for f in FREQUENCIES[:, 0] if f > 1])
ENDS = np.arange(0.75, 32.0, 0.75)  # frequencies at the ends of a chirp
CHIRPS = np.array([(a, (b - a) / 2) for a, b in product(ENDS, ENDS) if abs(b - a) > 1])


def scaled_shape(name: str, text: str, axes: str = "xtv") -> Shape:
    """Make the shape of a function, with `z` for its argument u/w, on the axes where it makes sense.

    Examples
    --------
    >>> scaled_shape("hump", "z*exp(-z)", "v").columns
    ('u/w*exp(-u/w)',)

    """
    signed = text == OF_SCALE["decay"][0]  # it may grow too
    grid = np.concatenate([SCALES, -SCALES]) if signed else SCALES
    return Shape(name, (_substitute(text, "u/w"),), ("w",), ("scale" if signed else "width",), grid, axes)


def placed_shape(name: str, text: str) -> Shape:
    """Make the shape of a function of z = (u - c)/w; see `scaled_shape`."""
    return Shape(name, (_substitute(text, "((u - c)/w)"),), ("c", "w"), ("place", "width"), PLACES)


def _substitute(text: str, argument: str) -> str:
    return re.sub(r"\bz\b", argument, text)


def shapes_of_functions(functions: Sequence[str]) -> tuple[Shape, ...]:
    """Make the shapes of a user's functions of a dimensionless z: with z = u/w, and with z = (u - c)/w.

    Parameters
    ----------
    functions
        Texts such as "z^2*exp(-z)".

    Raises
    ------
    FrictrackError
        (usage) If a text is no formula, or has another name than z.

    Examples
    --------
    >>> [shape.columns for shape in shapes_of_functions(["exp(-sqrt(z))"])]
    [('exp(-sqrt((u/w)))',), ('exp(-sqrt((((u - c)/w))))',)]

    """
    out = []
    for text in functions:
        if unknown := sorted(set(re.findall(r"[A-Za-z_]\w*", text)) - {"z", "pi", *FUNCTIONS}):
            raise UsageError(f'functions: expected functions of z but got "{unknown[0]}" in "{text}"')
        if not re.search(r"\bz\b", text):
            raise UsageError(f'functions: expected a function of z but got "{text}"')
        effects.formula("functions", f"F * ({_substitute(text, ' x ')})")  # the text is read as that of an effect
        for argument, make in (("u/w", scaled_shape), ("(u - c)/w", placed_shape)):
            out.append(make(f"{text}, z = {argument}", _substitute(text, "(z)")))
    return tuple(out)


# Simplest first: of two formulas that explain the same, the earlier one stands first.
SHAPES = (
    *(Shape(name, (text,), (), (), np.empty((1, 0)), axes) for name, (text, axes) in POWERS.items()),
    *(scaled_shape(name, *of) for name, of in OF_SCALE.items()),
    Shape("wave", WAVE, ("f",), ("rate",), FREQUENCIES),
    *(placed_shape(name, text) for name, text in OF_PLACE.items()),
    Shape("teeth", (TEETH,), ("c", "p", "r"), ("offset", "period", "share"), OFFSETS, "xt"),
    Shape("ringing", tuple(f"exp(-u/w)*{one}" for one in WAVE), ("w", "f"), ("width", "rate"), DECAYS, "t"),
    Shape("swelling wave", (*WAVE, *(f"u*{one}" for one in WAVE)), ("f",), ("rate",), FREQUENCIES, "xt"),
    Shape("chirp", tuple(one.replace("f", "(f + k*u)") for one in WAVE), ("f", "k"), ("rate", "sweep"), CHIRPS, "t"),
)


@dataclass(frozen=True)
class Term:
    """One shape over one variable between its ends; what it gains, and what the data leave of its prior range."""

    shape: Shape
    variable: Axis
    parameters: tuple[float, ...]
    ends: tuple[float, float]  # of the variable
    gain: float = 0.0  # fall of chi-squared
    coefficients: tuple[float, ...] = ()  # of the columns, N
    log_volume: float = 0.0  # logarithm of the share of the prior range of its parameters that the data leave

    @property
    def unknowns(self) -> int:
        """Number of coefficients and parameters."""
        return len(self.shape.columns) + len(self.shape.parameters)

    @property
    def axis(self) -> str:
        """Name of the axis."""
        return self.variable.name

    @property
    def multipliers(self) -> tuple[str, ...]:
        """Factors with a unit: variables of the motion, and powers of the mass."""
        return tuple(one for one in self.variable.factor.split(" * ") if one in (*FACTOR_VARIABLES, *LOAD_POWERS))

    @property
    def size(self) -> int:
        """Number of unknowns and of operators of the multipliers: a product, and a power."""
        return self.unknowns + sum(2 if "^" in one else 1 for one in self.multipliers)

    @property
    def form(self) -> str:
        """The form without values, as in a study file."""
        return study_file_text(self)

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of the axes on which it depends, its own first; none of its own for a constant shape."""
        own = () if self.shape.columns == ("1",) and self.multipliers else (self.axis,)
        return (*own, *(FACTOR_VARIABLES[one] for one in self.multipliers if one in FACTOR_VARIABLES))

    @property
    def is_excluded(self) -> bool:
        """Whether it has too many operators, or is another form: a constant over any axis, and x v as v x."""
        if self.multipliers and self.unknowns > MAX_UNKNOWNS_MULTIPLIED:
            return True
        others = [FACTOR_VARIABLES[one] for one in self.multipliers if one in FACTOR_VARIABLES]
        if self.shape.columns == ("1",):
            return bool(others) or self.axis != "x"
        order = list(AXIS_SYMBOLS)
        return self.shape.columns == ("u",) and any(order.index(one) < order.index(self.axis) for one in others)


@dataclass(frozen=True)
class FittedFormula:
    """A sum of terms added to a model and fitted."""

    terms: tuple[Term, ...]
    solution: Solution
    delta_bic: float  # fall of BIC
    share: float  # of the excess chi-squared
    entry: dict[str, Any] = field(default_factory=dict)  # of the JSON of a diagnosis

    @property
    def form(self) -> str:
        """The form without values, as in a study file."""
        return " + ".join(study_file_text(*pair) for pair in with_suffixes(self.terms))


def formula_axes(compressed: CompressedResidual) -> list[Axis]:
    """List the variables of formulas that these runs can distinguish.

    Every axis without a multiplier comes first; then times another axis, and times a power of the mass where masses
    are known and differ, in proportion to the load.
    """
    plain = [axis for axis in candidate_axes(compressed) if axis.name in AXIS_SYMBOLS]
    masses = [float(np.mean(path.mass)) for path in compressed.paths if path.mass is not None]
    differ = len(masses) == len(compressed.paths) and max(masses) > MIN_LOAD_RATIO * min(masses)
    other = [(axis, symbol) for axis in plain for symbol, name in FACTOR_VARIABLES.items() if name != axis.name]
    heavy = [(axis, power) for axis in plain for power in LOAD_POWERS if differ and axis.factor == "L * s"]
    return plain + [
        replace(axis, factor=" * ".join(one for one in (axis.factor, multiplier) if one))
        for axis, multiplier in other + heavy
    ]


def build_effect(name: str, term: Term) -> Effect:
    """Make a user effect of a term, to be fitted from where it was found."""

    def columns(path: Path, nonlinear: Mapping[str, float]) -> Array:
        made = term.shape.columns_at(term.variable.of(path), [nonlinear[q] for q in term.shape.parameters])
        made = made * term.variable.times(path)[:, None]
        if not np.all(np.isfinite(made)):
            raise FrictrackError(f"{term.shape.name} is no number along every run")
        return made

    effect = effects.formula(name, study_file_text(term), bounds=parameter_bounds(term, 10.0, 3.0))
    scans = {
        q: {"scan": lambda span, value=value: np.array([value])}
        for q, value in zip(term.shape.parameters, term.parameters, strict=True)
    }
    return replace(effect, columns=columns).adjusted(**scans)


def parameter_bounds(term: Term, factor: float, cells: float, suffix: str = "") -> dict[str, tuple[float, float]]:
    """Bounds of the parameters by name: a width within a factor, a place or frequency within some resolution cells."""
    low, high = term.ends
    out = {}
    for q, kind, value in zip(term.shape.parameters, term.shape.kinds, term.parameters, strict=True):
        cell, _ = _cell_and_range(term, kind)
        a, b = value - cells * cell, value + cells * cell
        if kind in ("width", "scale"):
            least, most = MIN_WIDTH_RATIO * (high - low), MAX_WIDTH_RATIO * (high - low)
            sizes = np.clip([abs(value) / factor, abs(value) * factor], least, most)
            a, b = sorted((np.sign(value) * sizes).tolist())
        elif kind == "share":
            a, b = MIN_SHARE, MAX_SHARE
        out[q + suffix] = (max(a, low), min(b, high)) if kind == "place" else (a, b)
    return out


def parameter_ranges(term: Term) -> tuple[Array, Mask]:
    """Widths (q,) of the constant priors of the parameters, and whether they are those of the logarithm."""
    ranges = [_cell_and_range(term, kind)[1] for kind in term.shape.kinds]
    return np.array(ranges), np.array([kind in LOGARITHMIC_KINDS for kind in term.shape.kinds], dtype=bool)


def _cell_and_range(term: Term, kind: str) -> tuple[float, float]:
    """Resolution cell of a kind of parameter, and width of its prior; of the logarithm for `LOGARITHMIC_KINDS`."""
    span, kinds = term.ends[1] - term.ends[0], term.shape.kinds
    period = term.parameters[kinds.index("period")] if "period" in kinds else span
    widths = float(np.log(MAX_WIDTH_RATIO / MIN_WIDTH_RATIO))
    return {
        "place": (0.05 * span, span),
        "offset": (0.25 * period, period),
        "period": (0.5 * period**2 / span, float(np.log(MAX_PERIODS))),
        "rate": (0.5 / span, MAX_PERIODS / span),
        "sweep": (0.5 / span**2, MAX_PERIODS / span**2),
        "share": (0.0, MAX_SHARE - MIN_SHARE),
        "width": (0.0, widths),
        "scale": (0.0, widths + float(np.log(2.0))),  # either sign
    }[kind]


def coefficient_names(term: Term, suffix: str = "") -> list[str]:
    """Names of its coefficients."""
    count = len(term.shape.columns)
    return [f"F_{i}{suffix}" for i in range(1, count + 1)] if count > 1 else [f"F{suffix}"]


def with_suffixes(terms: Sequence[Term]) -> list[tuple[Term, str]]:
    """Terms of a sum with the suffixes of the names of their parameters in a study file."""
    return list(zip(terms, ["_a", "_b"] if len(terms) > 1 else [""], strict=True))


def study_file_text(term: Term, suffix: str = "") -> str:
    """The term as written in a study file."""
    return " + ".join(
        " * ".join(part for part in (name, term.variable.factor, _column_with_names(column, term, suffix)) if part)
        for name, column in zip(coefficient_names(term, suffix), term.shape.columns, strict=True)
    )


def _column_with_names(column: str, term: Term, suffix: str) -> str:
    """A column with the names of axis and parameters; empty for a constant."""
    text = "" if column == "1" else re.sub(r"\bu\b", AXIS_SYMBOLS[term.axis][0], column)
    for q in term.shape.parameters:
        text = re.sub(rf"\b{q}\b", q + suffix, text)
    return text


def coefficient_unit(column: str, term: Term) -> str:
    """Unit of the coefficient of a column: newton over the units of the column and of its factors.

    Examples
    --------
    >>> from frictrack.diagnose.compressed import Axis
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
    loads = np.concatenate([np.ravel(p.path.load) for p in bare.problem.pieces])
    added = [n for n in solution.problem.model.names if n not in bare.problem.model and not n.startswith(EFFECT_NAME)]
    return {
        "form": found.form,
        "formula": _formula_text(terms, with_load=bool(np.max(loads) > MIN_LOAD_RATIO * np.min(loads))),
        "axis": terms[0].axis,
        "variables": list(dict.fromkeys(name for term in terms for name in term.variables)),
        "share": found.share,
        "delta_bic": float(found.delta_bic),
        "unknowns": sum(t.unknowns for t in terms),
        "reduced_chi2": solution.chi2 / max(solution.problem.n_frames - len(solution.p), 1),
        "beside": added,
        "toml": _toml(terms, next(e for e in solution.problem.model.effects if e.name == EFFECT_NAME)),
    }


def _formula_text(terms: Sequence[Term], *, with_load: bool) -> str:
    """The formula with its values, to read; the load is left out if all runs have the same."""
    out = ""
    for term in terms:
        factors = [one for one in term.variable.factor.split(" * ") if one and (with_load or one != "L")]
        factor = "".join(f"{one} " for one in factors).replace("abs(v)", "|v|").replace("mass", "m")
        for one, column, value in _merge_sine_pairs(term):
            sign = ("-" if value < 0 else "") if not out else (" - " if value < 0 else " + ")
            text = f"{abs(value):.3g} {coefficient_unit(one, term)} {factor}{_column_with_values(column, term)}"
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


def _column_with_values(column: str, term: Term) -> str:
    """A column with its parameters and their units."""
    text = "" if column == "1" else re.sub(r"\bu\b", AXIS_SYMBOLS[term.axis][1], column)
    for q, kind, number in zip(term.shape.parameters, term.shape.kinds, term.parameters, strict=True):
        digits = 3 if kind in ("width", "scale", "share") else 4
        text = re.sub(rf"\b{q}\b", f"{number:.{digits}g} {_parameter_unit(kind, term.axis)}".removesuffix(" 1"), text)
    return text.replace("2*pi*", "2 pi ").replace("*", " ").replace("- -", "+ ").replace("+ -", "- ")


def _toml(terms: Sequence[Term], first: Effect) -> str:
    """The formula, of which `first` is the first term as fitted, as a user effect for a study file."""
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
    if first.level_is_chosen:
        lines.append(f"follows_level = {str(first.linear[0].loaded).lower()}")
    return "\n".join(lines) + "\n"
