"""Derive the units of formulas: a text is read with the dimension of each name, and must be consistent.

A dimension is the tuple of the powers of metre, second and kilogram; newton is written apart, as the unit of forces.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping
from typing import NoReturn

from frictrack.errors import FrictrackError

Dimension = tuple[float, float, float]  # powers of m, s, kg
NONE: Dimension = (0.0, 0.0, 0.0)
SYMBOLS = ("m", "s", "kg")
AXIS_DIMENSIONS: dict[str, Dimension] = {"x": (1.0, 0.0, 0.0), "t": (0.0, 1.0, 0.0), "v": (1.0, -1.0, 0.0)}
KIND_POWERS = {
    "place": 1, "offset": 1, "width": 1, "period": 1, "scale": 1, "rate": -1, "sweep": -2, "share": 0,
}  # fmt: skip
POWER_TOLERANCE = 1e-9


def scaled(dimension: Dimension, power: float) -> Dimension:
    """Dimension of a power of a quantity.

    Examples
    --------
    >>> scaled(AXIS_DIMENSIONS["v"], 2)
    (2.0, -2.0, 0.0)

    """
    return dimension[0] * power, dimension[1] * power, dimension[2] * power


def product(first: Dimension, second: Dimension) -> Dimension:
    """Dimension of a product of two quantities."""
    return first[0] + second[0], first[1] + second[1], first[2] + second[2]


def dimension_of(text: str, names: Mapping[str, Dimension]) -> Dimension:
    """Dimension of a formula.

    Parameters
    ----------
    text
        The formula; ^ is a power.
    names
        Dimension of every name in it. Numbers have none.

    Returns
    -------
    tuple
        Powers of m, s and kg.

    Raises
    ------
    FrictrackError
        (usage) If the formula adds unlike quantities, or has a function or a free power of a quantity with a unit.

    Examples
    --------
    >>> dimension_of("u^2/w", {"u": AXIS_DIMENSIONS["v"], "w": AXIS_DIMENSIONS["v"]})
    (1.0, -1.0, 0.0)

    """
    return _read(ast.parse(text.replace("^", "**"), mode="eval").body, text, names)


def coefficient_unit(dimension: Dimension) -> str:
    """Unit of the coefficient, in N, that multiplies a quantity of a dimension.

    Examples
    --------
    >>> coefficient_unit((1.0, -1.0, 0.0)), coefficient_unit((2.0, 0.0, 0.0)), coefficient_unit((1.0, 1.0, 0.0))
    ('N s/m', 'N/m^2', 'N/m/s')

    """
    powers = [(symbol, -p) for symbol, p in zip(SYMBOLS, dimension, strict=True) if abs(p) > POWER_TOLERANCE]
    over = "".join(f" {_power(symbol, p)}" for symbol, p in powers if p > 0)
    under = "".join(f"/{_power(symbol, -p)}" for symbol, p in powers if p < 0)
    return f"N{over}{under}"


def _power(symbol: str, power: float) -> str:
    return symbol if abs(power - 1) < POWER_TOLERANCE else f"{symbol}^{power:.3g}"


def _refuse(text: str, what: str) -> NoReturn:
    raise FrictrackError(f'expected {what} but got "{text}"; divide by a parameter of the same unit', usage=True)


def _read(node: ast.expr, text: str, names: Mapping[str, Dimension]) -> Dimension:
    if isinstance(node, ast.Name):
        return names.get(node.id, NONE)
    if isinstance(node, ast.UnaryOp):
        return _read(node.operand, text, names)
    if isinstance(node, ast.Call):
        return _of_call(node, text, names)
    return _of_operation(node, text, names) if isinstance(node, ast.BinOp) else NONE


def _of_call(node: ast.Call, text: str, names: Mapping[str, Dimension]) -> Dimension:
    inner = _read(node.args[0], text, names)
    name = node.func.id if isinstance(node.func, ast.Name) else ""
    if name == "sqrt":
        return scaled(inner, 0.5)
    if name != "abs" and not _is_same(inner, NONE):
        _refuse(text, f"an argument of {name} without a unit")
    return inner


def _of_operation(node: ast.BinOp, text: str, names: Mapping[str, Dimension]) -> Dimension:
    left = _read(node.left, text, names)
    if isinstance(node.op, ast.Pow):
        if isinstance(node.right, ast.Constant):
            return scaled(left, float(str(node.right.value)))
        if not _is_same(left, NONE):
            _refuse(text, "a power of a quantity without a unit")
        return NONE
    right = _read(node.right, text, names)
    if isinstance(node.op, ast.Mult):
        return product(left, right)
    if isinstance(node.op, ast.Div):
        return product(left, scaled(right, -1.0))
    if not _is_same(left, right):
        _refuse(text, "a sum of quantities of one unit")
    return left


def _is_same(first: Dimension, second: Dimension) -> bool:
    return all(abs(a - b) < POWER_TOLERANCE for a, b in zip(first, second, strict=True))
