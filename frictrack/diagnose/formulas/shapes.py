"""Generate the shapes of formulas: powers, functions of a dimensionless argument, and waves of one variable.

A shape is written with `u` for the variable and letters for its parameters. The same text is evaluated here, printed
and written to a study file, so that the three agree.
"""

from __future__ import annotations

import ast
import operator
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

import numpy as np

from frictrack import effects
from frictrack.base.errors import FrictrackError
from frictrack.effects import CONSTANTS, FUNCTIONS, OPERATORS
from frictrack.records import Array

WIDTH_RATIOS = (0.3, 0.1, 0.04, 0.015)  # of the axis, for bumps and steps
MAX_PERIODS = 45.0  # on an axis
PERIOD_STEP = 0.25  # difference of periods over the axis between two waves of the grid
RINGING_RATIOS = (0.1, 0.25, 1.0)  # of the axis, decay lengths of a wave
KIND_POWERS = {  # powers of the unit of the axis that parameters have, by kind
    "place": 1, "offset": 1, "width": 1, "period": 1, "scale": 1, "rate": -1, "sweep": -2, "share": 0,
}  # fmt: skip


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
OF_PLACE = {"bump": "exp(-z^2/2)", "step": "tanh(z)", "peak": "1/(1 + z^2)", "pair": "z/(1 + z^2)^2"}
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
            raise FrictrackError(f'functions: expected functions of z but got "{unknown[0]}" in "{text}"', usage=True)
        if not re.search(r"\bz\b", text):
            raise FrictrackError(f'functions: expected a function of z but got "{text}"', usage=True)
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
