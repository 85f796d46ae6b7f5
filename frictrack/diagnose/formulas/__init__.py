"""Search formulas of few variables and numbers that describe a force which no library effect explains."""

# ruff: noqa: F401 - the imports are the interface

from frictrack.diagnose.formulas.formula_search import FormulaSearch, is_noise
from frictrack.diagnose.formulas.shapes import SHAPES, Shape, shapes_of_functions
from frictrack.diagnose.formulas.terms import AXIS_SYMBOLS, EFFECT_NAME, FittedFormula, formula_axes
