"""The shapes of which formulas are made: columns of one variable with few numbers inside, and how they are written.

A shape is written with `u` for the variable and letters for its numbers; the same text is evaluated here, printed for
a person and pasted into a study file, so that the three cannot differ.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

import numpy as np

from frictrack.effects import CONSTANTS, FUNCTIONS, OPERATORS
from frictrack.records import Array

WIDTHS = (0.3, 0.1, 0.04, 0.015)  # of the axis, for places
PERIODS = 45.0  # on an axis, most
QUARTER = 0.25  # of a period by which two waves differ over the axis
Grid = Callable[[float, float], list[tuple[float, ...]]]  # ends of the axis -> numbers to try


@dataclass(frozen=True)
class Shape:
    """A sum of columns in a variable `u` and `numbers`, each with a coefficient of its own.

    `kinds` say what each number is: "place", "offset" (of a wave), "width", "period" and "scale" (of either sign) are
    in the unit of the axis, "rate" is one over it, "sweep" one over its square, "share" none. `axes` are those on
    which the shape makes sense.
    """

    name: str
    columns: tuple[str, ...]
    numbers: tuple[str, ...]
    kinds: tuple[str, ...]
    grid: Grid
    axes: str = "xtv"

    def evaluated(self, u: Array, numbers: Sequence[float | Array]) -> list[Array]:
        """Its columns along u, each of the shape of u; a number may be one for all or one for each of u."""
        names = {"u": u, **CONSTANTS, **dict(zip(self.numbers, numbers, strict=True))}
        with np.errstate(all="ignore"):
            made = [_made(text)(names) for text in self.columns]
        return [np.broadcast_to(column, np.shape(u)) for column in made]

    def on_grid(self, u: Array, points: Sequence[tuple[float, ...]]) -> list[Array]:
        """Its columns along u (n,) at many settings, each (n, G)."""
        along = np.broadcast_to(u[:, None], (len(u), len(points)))
        return self.evaluated(along, [np.array(q) for q in zip(*points, strict=True)])


@cache
def _made(text: str) -> Callable[[Mapping[str, Any]], Any]:
    """A text of this file as a function of its names, ^ read as a power."""
    return _function(ast.parse(text.replace("^", "**"), mode="eval").body)


def _function(node: ast.expr) -> Callable[[Mapping[str, Any]], Any]:
    if isinstance(node, ast.BinOp):
        do, left, right = OPERATORS[type(node.op)], _function(node.left), _function(node.right)
        return lambda names: do(left(names), right(names))
    if isinstance(node, ast.UnaryOp):
        change, one = OPERATORS[type(node.op)], _function(node.operand)
        return lambda names: change(one(names))
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        of, inner = FUNCTIONS[node.func.id], _function(node.args[0])
        return lambda names: of(inner(names))
    if isinstance(node, ast.Name):
        name = node.id
        return lambda names: names[name]
    assert isinstance(node, ast.Constant)
    value = float(str(node.value))
    return lambda names: value


def _none(low: float, high: float) -> list[tuple[float, ...]]:
    return [()]


def _scales(low: float, high: float) -> list[tuple[float, ...]]:
    return [(float(w),) for w in np.geomspace(3e-3, 3.0, 13) * (high - low)]


def _both_ways(low: float, high: float) -> list[tuple[float, ...]]:
    return [(sign * w,) for (w,) in _scales(low, high) for sign in (1.0, -1.0)]


def _places(low: float, high: float) -> list[tuple[float, ...]]:
    """Places as far apart as the width."""
    span = high - low
    return [
        (float(c), w * span)
        for w in WIDTHS
        for c in low + span * (np.arange(int(np.ceil(1 / w))) + 0.5) / np.ceil(1 / w)
    ]


def _waves(low: float, high: float) -> list[tuple[float, ...]]:
    return [(float(f) / (high - low),) for f in np.arange(0.5, PERIODS, QUARTER)]


def _teeth(low: float, high: float) -> list[tuple[float, ...]]:
    """Teeth of a saw whose steep side takes a tenth of them."""
    periods = np.arange(1.0, PERIODS / 2, 2 * QUARTER)
    return [(float(p * (high - low) / n), (high - low) / n, 0.9) for n in periods for p in np.arange(6) / 6]


def _sweeps(low: float, high: float) -> list[tuple[float, ...]]:
    """Waves whose frequency runs evenly from one value to another."""
    span, ends = high - low, np.arange(0.75, 32.0, 0.75)
    return [
        (float(a / span), float((b - a) / (2 * span**2))) for a, b in product(ends, ends) if abs(b - a) > 1 and low >= 0
    ]


# Simplest first: of two formulas that explain the same, the earlier one stands first.
SHAPES = (
    Shape("linear", ("u",), (), (), _none),
    Shape("constant", ("1",), (), (), _none),
    Shape("square", ("u^2",), (), (), _none),
    Shape("root", ("sqrt(u)",), (), (), _none, "tv"),
    Shape("cube", ("u^3",), (), (), _none),
    Shape("logarithm", ("log(1 + u/w)",), ("w",), ("width",), _scales, "tv"),
    Shape("decay", ("exp(-u/w)",), ("w",), ("scale",), _both_ways),
    Shape("fraction", ("1/(1 + u/w)",), ("w",), ("width",), _scales, "tv"),
    Shape("wave", ("sin(2*pi*f*u)", "cos(2*pi*f*u)"), ("f",), ("rate",), _waves),
    Shape("bump", ("exp(-((u - c)/w)^2/2)",), ("c", "w"), ("place", "width"), _places),
    Shape("step", ("tanh((u - c)/w)",), ("c", "w"), ("place", "width"), _places),
    Shape("peak", ("1/(1 + ((u - c)/w)^2)",), ("c", "w"), ("place", "width"), _places),
    Shape("pair", ("(u - c)/w/(1 + ((u - c)/w)^2)^2",), ("c", "w"), ("place", "width"), _places),
    Shape(
        "teeth",
        ("atan(r*sin(2*pi*(u - c)/p)/(1 - r*cos(2*pi*(u - c)/p)))",),
        ("c", "p", "r"),
        ("offset", "period", "share"),
        _teeth,
        "xt",
    ),
    Shape(
        "swelling wave",
        ("sin(2*pi*f*u)", "cos(2*pi*f*u)", "u*sin(2*pi*f*u)", "u*cos(2*pi*f*u)"),
        ("f",),
        ("rate",),
        _waves,
        "xt",
    ),
    Shape("chirp", ("sin(2*pi*(f + k*u)*u)", "cos(2*pi*(f + k*u)*u)"), ("f", "k"), ("rate", "sweep"), _sweeps, "t"),
)  # fmt: skip
