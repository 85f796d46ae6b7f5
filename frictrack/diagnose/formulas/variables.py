"""Generate the variables of formulas: each axis with the factors that may multiply a force over it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from frictrack.diagnose.compressed import CompressedResidual
from frictrack.diagnose.formulas.shapes import Shape
from frictrack.diagnose.formulas.terms import AXIS_SYMBOLS
from frictrack.diagnose.smooth_forces import MIN_LOAD_RATIO, Axis, candidate_axes

LOAD_POWERS = ("mass", "mass^(-1/2)", "mass^(-1/3)")  # times L: powers 2, 1/2 and 2/3, where loads are masses

MAX_UNKNOWNS_MULTIPLIED = 3  # of a shape that is multiplied with another variable


def formula_axes(compressed: CompressedResidual) -> list[Axis]:
    """List the variables of formulas that these runs can distinguish.

    Parameters
    ----------
    compressed
        The compressed residual.

    Returns
    -------
    list of Axis
        Every axis without a multiplier first; then times another axis, and times a power of the mass.

    """
    plain = [axis for axis in candidate_axes(compressed) if axis.name in AXIS_SYMBOLS]
    other = [
        Axis(axis.name, axis.of, _times(axis.factor, symbol))
        for axis in plain
        for name, (symbol, _) in AXIS_SYMBOLS.items()
        if name != axis.name
    ]
    heavy = [
        Axis(axis.name, axis.of, _times(axis.factor, power))
        for axis in plain
        for power in LOAD_POWERS
        if axis.factor == "L * s" and _masses_differ(compressed)
    ]
    return [*plain, *other, *heavy]


def _times(factor: str, multiplier: str) -> str:
    return f"{factor} * {multiplier}" if factor else multiplier


def _masses_differ(compressed: CompressedResidual) -> bool:
    """Whether masses are known and differ, in proportion to the load."""
    masses: Sequence[float] = [float(np.mean(p.mass)) for p in compressed.paths if p.mass is not None]
    return len(masses) == len(compressed.paths) and max(masses) > MIN_LOAD_RATIO * min(masses)


def is_excluded(shape: Shape, axis: Axis) -> bool:
    """Whether a form has too many operators, or is another one: a constant over any axis, and x v as v x."""
    multiplier = axis.factor.split(" * ")[-1]
    if multiplier not in ("", "L", "s") and len(shape.columns) + len(shape.parameters) > MAX_UNKNOWNS_MULTIPLIED:
        return True
    symbols = [symbol for symbol, _ in AXIS_SYMBOLS.values()]
    if shape.columns == ("1",):
        return multiplier in symbols or axis.name != "x"
    return (
        shape.columns == ("u",)
        and multiplier in symbols
        and symbols.index(multiplier) < list(AXIS_SYMBOLS).index(axis.name)
    )
