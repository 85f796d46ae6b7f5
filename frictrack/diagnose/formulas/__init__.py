"""Search formulas of one variable, with few numbers, that describe a force which no library effect explains."""

from frictrack.diagnose.formulas.formula_search import EQUAL, formulas
from frictrack.diagnose.formulas.shapes import SHAPES, Shape
from frictrack.diagnose.formulas.terms import LETTERS

__all__ = ["EQUAL", "LETTERS", "SHAPES", "Shape", "formulas"]
