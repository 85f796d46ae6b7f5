"""Generate the shapes of formulas: powers, functions of a dimensionless argument, and waves of one variable.

A shape is written with `u` for the variable and letters for its parameters. The same text is evaluated here, printed
and written to a study file, so that the three agree.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

import numpy as np

from frictrack import effects
from frictrack.diagnose.formulas.dimensions import AXIS_DIMENSIONS, KIND_POWERS, Dimension, dimension_of, scaled
from frictrack.effects import CONSTANTS, FUNCTIONS, OPERATORS
from frictrack.errors import FrictrackError
from frictrack.records import Array

WIDTH_RATIOS = (0.3, 0.1, 0.04, 0.015)  # of the axis, for bumps and steps
MAX_PERIODS = 45.0  # on an axis
PERIOD_STEP = 0.25  # difference of periods over the axis between two waves of the grid
RINGING_RATIOS = (0.1, 0.25, 1.0)  # of the axis, decay lengths of a wave
Grid = Callable[[float, float], list[tuple[float, ...]]]  # ends of the axis -> numbers to try


@dataclass(frozen=True)
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
        Kind of each: "place", "offset" (of a wave), "width", "period" and "scale" (of either sign) have the unit of the
        axis, "rate" one over it, "sweep" one over its square, "share" none.
    grid
        Function from the ends of the axis to the settings to try.
    axes
        Axes on which the shape makes sense.

    """

    name: str
    columns: tuple[str, ...]
    parameters: tuple[str, ...]
    kinds: tuple[str, ...]
    grid: Grid
    axes: str = "xtv"

    def columns_at(self, u: Array, parameters: Sequence[float | Array]) -> list[Array]:
        """Evaluate the columns.

        Parameters
        ----------
        u
            Values of the variable.
        parameters
            Values of the parameters, each a number or of the shape of `u`.

        Returns
        -------
        list of ndarray
            One per column, of the shape of `u`.

        Examples
        --------
        >>> SHAPES[0].columns_at(np.array([1.0, 2.0]), ())[0].tolist()
        [1.0, 2.0]

        """
        names = {"u": u, **CONSTANTS, **dict(zip(self.parameters, parameters, strict=True))}
        with np.errstate(all="ignore"):
            made = [_compile(text)(names) for text in self.columns]
        return [np.broadcast_to(column, np.shape(u)) for column in made]

    def dimension(self, column: str, axis: str) -> Dimension:
        """Powers of m, s and kg of one of the columns over an axis."""
        unit = AXIS_DIMENSIONS[axis]
        names = {q: scaled(unit, KIND_POWERS[k]) for q, k in zip(self.parameters, self.kinds, strict=True)}
        return dimension_of(column, {"u": unit, **names})

    def on_grid(self, u: Array, points: Sequence[tuple[float, ...]]) -> list[Array]:
        """Columns along u (n,) at G settings, each (n, G)."""
        repeated = np.broadcast_to(u[:, None], (len(u), len(points)))
        return self.columns_at(repeated, [np.array(q) for q in zip(*points, strict=True)])


@cache
def _compile(text: str) -> Callable[[Mapping[str, Any]], Any]:
    """Compile the text of a column to a function of its names; ^ is a power."""
    return _build_function(ast.parse(text.replace("^", "**"), mode="eval").body)


def _build_function(node: ast.expr) -> Callable[[Mapping[str, Any]], Any]:
    if isinstance(node, ast.BinOp):
        do, left, right = OPERATORS[type(node.op)], _build_function(node.left), _build_function(node.right)
        return lambda names: do(left(names), right(names))
    if isinstance(node, ast.UnaryOp):
        change, one = OPERATORS[type(node.op)], _build_function(node.operand)
        return lambda names: change(one(names))
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        of, inner = FUNCTIONS[node.func.id], [_build_function(one) for one in node.args]
        return lambda names: of(*(one(names) for one in inner))
    if isinstance(node, ast.Name):
        name = node.id
        return lambda names: names[name]
    assert isinstance(node, ast.Constant)
    value = float(str(node.value))
    return lambda names: value


def _no_parameters(low: float, high: float) -> list[tuple[float, ...]]:
    return [()]


def _scale_grid(low: float, high: float) -> list[tuple[float, ...]]:
    return [(float(w),) for w in np.geomspace(3e-3, 3.0, 13) * (high - low)]


def _signed_scale_grid(low: float, high: float) -> list[tuple[float, ...]]:
    return [(sign * w,) for (w,) in _scale_grid(low, high) for sign in (1.0, -1.0)]


def _place_grid(low: float, high: float) -> list[tuple[float, ...]]:
    """Places one width apart, at several widths."""
    span = high - low
    return [
        (float(c), w * span)
        for w in WIDTH_RATIOS
        for c in low + span * (np.arange(int(np.ceil(1 / w))) + 0.5) / np.ceil(1 / w)
    ]


def _wave_grid(low: float, high: float) -> list[tuple[float, ...]]:
    return [(float(f) / (high - low),) for f in np.arange(0.5, MAX_PERIODS, PERIOD_STEP)]


def _sawtooth_grid(low: float, high: float) -> list[tuple[float, ...]]:
    """Sawtooth waves whose steep side takes a tenth of the period."""
    periods = np.arange(1.0, MAX_PERIODS / 2, 2 * PERIOD_STEP)
    return [(float(p * (high - low) / n), (high - low) / n, 0.9) for n in periods for p in np.arange(6) / 6]


def _chirp_grid(low: float, high: float) -> list[tuple[float, ...]]:
    """Waves whose frequency changes linearly."""
    span, ends = high - low, np.arange(0.75, 32.0, 0.75)
    return [
        (float(a / span), float((b - a) / (2 * span**2))) for a, b in product(ends, ends) if abs(b - a) > 1 and low >= 0
    ]


def _ringing_grid(low: float, high: float) -> list[tuple[float, ...]]:
    """Waves that decay over a tenth, a quarter and once the axis."""
    span = high - low
    waves = [f for (f,) in _wave_grid(low, high) if f * span > 1]
    return [(share * span, f) for share in RINGING_RATIOS for f in waves]


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
OF_PLACE = {
    "bump": "exp(-z^2/2)",
    "step": "tanh(z)",
    "peak": "1/(1 + z^2)",
    "pair": "z/(1 + z^2)^2",
}
POWERS = {"linear": ("u", "xtv"), "constant": ("1", "xtv"), "square": ("u^2", "xtv"), "root": ("sqrt(u)", "tv"),
          "cube": ("u^3", "xtv")}  # fmt: skip
WAVES = ("sin(2*pi*f*u)", "cos(2*pi*f*u)")


def scaled_shape(name: str, text: str, axes: str = "xtv") -> Shape:
    """Make the shape of a function of z = u/w.

    Parameters
    ----------
    name
        Name of the shape.
    text
        The function, with `z` for its argument.
    axes
        Axes on which it makes sense.

    Examples
    --------
    >>> scaled_shape("hump", "z*exp(-z)", "v").columns
    ('u/w*exp(-u/w)',)

    """
    signed = text == OF_SCALE["decay"][0]  # it may grow too
    grid = _signed_scale_grid if signed else _scale_grid
    return Shape(name, (_substitute(text, "u/w"),), ("w",), ("scale" if signed else "width",), grid, axes)


def placed_shape(name: str, text: str, axes: str = "xtv") -> Shape:
    """Make the shape of a function of z = (u - c)/w; see `scaled_shape`."""
    return Shape(name, (_substitute(text, "((u - c)/w)"),), ("c", "w"), ("place", "width"), _place_grid, axes)


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
            raise FrictrackError(f'functions: expected functions of z but got "{unknown[0]}" in "{text}"', usage=True)
        if not re.search(r"\bz\b", text):
            raise FrictrackError(f'functions: expected a function of z but got "{text}"', usage=True)
        effects.formula("functions", f"F * ({_substitute(text, ' x ')})")  # the text is read as that of an effect
        for argument, make in (("u/w", scaled_shape), ("(u - c)/w", placed_shape)):
            out.append(make(f"{text}, z = {argument}", _substitute(text, "(z)")))
    return tuple(out)


# Simplest first: of two formulas that explain the same, the earlier one stands first.
SHAPES = (
    *(Shape(name, (text,), (), (), _no_parameters, axes) for name, (text, axes) in POWERS.items()),
    *(scaled_shape(name, *of) for name, of in OF_SCALE.items()),
    Shape("wave", WAVES, ("f",), ("rate",), _wave_grid),
    *(placed_shape(name, text) for name, text in OF_PLACE.items()),
    Shape(
        "teeth",
        ("atan(r*sin(2*pi*(u - c)/p)/(1 - r*cos(2*pi*(u - c)/p)))",),
        ("c", "p", "r"),
        ("offset", "period", "share"),
        _sawtooth_grid,
        "xt",
    ),
    Shape("ringing", tuple(f"exp(-u/w)*{wave}" for wave in WAVES), ("w", "f"), ("width", "rate"), _ringing_grid, "t"),
    Shape("swelling wave", (*WAVES, *(f"u*{wave}" for wave in WAVES)), ("f",), ("rate",), _wave_grid, "xt"),
    Shape("chirp", ("sin(2*pi*(f + k*u)*u)", "cos(2*pi*(f + k*u)*u)"), ("f", "k"), ("rate", "sweep"), _chirp_grid, "t"),
)
