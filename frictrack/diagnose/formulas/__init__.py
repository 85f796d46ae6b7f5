"""Search formulas of few variables and numbers that describe a force which no library effect explains."""

from frictrack.diagnose.formulas.formula_search import FoundFormulas, is_noise, least_misfit, search_formulas
from frictrack.diagnose.formulas.shapes import SHAPES, Shape, shapes_of_functions
from frictrack.diagnose.formulas.terms import AXIS_SYMBOLS, EFFECT_NAME
from frictrack.diagnose.formulas.variables import formula_axes

__all__ = [
    "AXIS_SYMBOLS",
    "EFFECT_NAME",
    "SHAPES",
    "FoundFormulas",
    "Shape",
    "formula_axes",
    "is_noise",
    "least_misfit",
    "search_formulas",
    "shapes_of_functions",
]
