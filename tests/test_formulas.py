"""Formulas of an unknown cause: units that are derived, functions of the user, and the command that adds one."""

from __future__ import annotations

import json

import numpy as np
import pytest

from frictrack import effects
from frictrack.cli.diagnosis_output import unexplained
from frictrack.cli.output import Console
from frictrack.diagnose.formulas import SHAPES, shapes_of_functions
from frictrack.diagnose.formulas.dimensions import AXIS_DIMENSIONS, coefficient_unit, dimension_of
from frictrack.diagnose.formulas.terms import Term, build_effect, factor_dimension
from frictrack.diagnose.smooth_forces import Axis
from frictrack.errors import FrictrackError
from frictrack.flow.formula_effects import choose_formula, formula_number
from frictrack.units import is_coherent

FORMULA = {
    "formula": "2 N exp(-|v|/3 m/s)",
    "form": "F * exp(-abs(v)/w)",
    "share": 0.9,
    "delta_bic": 80.0,
    "probability": 0.6,
    "equivalents": ["F * 1/(1 + abs(v)/w)"],
    "beside": [],
    "toml": '[[effect]]\neffect = "unexplained"\nformula = "F * exp(-abs(v)/w)"\nunits = {F = "N", w = "m/s"}\n'
    "bounds = {w = [1, 9]}\n",
}
DIAGNOSIS = {
    "unexplained": {"axis": "v", "formulas": [FORMULA, FORMULA | {"beside": ["drag"]}], "probability_none": 0.4}
}


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: s.name)
def test_every_form_has_units_that_agree_and_can_be_written(shape):
    for axis in shape.axes:
        for column in shape.columns:
            unit = coefficient_unit(shape.dimension(column, axis))
            assert is_coherent(unit), unit


@pytest.mark.parametrize("factor", ["L * s * x", "abs(v)", "L * s * mass", "L * s * mass^(-1/2)", "s * t"])
def test_a_factor_with_a_unit_gives_a_unit_and_an_effect(factor):
    assert is_coherent(coefficient_unit(factor_dimension(factor)))
    shape = next(s for s in SHAPES if s.name == "decay")
    term = Term(shape, Axis("v", lambda p: p.speed, factor), (2.0,), (0.5, 4.0))
    effect = build_effect("unexplained", term)
    assert [p.name for p in effect.parameters] == ["F", "w"]


def test_unlike_quantities_are_not_added():
    with pytest.raises(FrictrackError, match="sum of quantities of one unit"):
        dimension_of("1 + u", {"u": AXIS_DIMENSIONS["x"]})
    with pytest.raises(FrictrackError, match="argument of exp without a unit"):
        dimension_of("exp(u)", {"u": AXIS_DIMENSIONS["v"]})


def test_functions_of_the_user_become_shapes():
    scaled, placed = shapes_of_functions(["z^2*exp(-z)"])
    u = np.linspace(0.1, 2.0, 5)
    assert scaled.columns_at(u, [0.5])[0] == pytest.approx((u / 0.5) ** 2 * np.exp(-u / 0.5))
    assert placed.columns_at(u, [1.0, 0.5])[0] == pytest.approx(((u - 1) / 0.5) ** 2 * np.exp(-(u - 1) / 0.5))


@pytest.mark.parametrize("text", ["z*y", "1", "z z", "exp(", "__import__('os')", "z.real"])
def test_what_is_no_function_of_z_is_refused(text):
    with pytest.raises(FrictrackError, match="expected"):
        shapes_of_functions([text])


def test_a_formula_is_chosen_by_its_number():
    assert formula_number("formula:2") == 2
    assert formula_number("texture") is None
    keys = choose_formula(1, DIAGNOSIS, ["unexplained"], ["coulomb"])
    assert keys["effect"] == "unexplained_2"
    effects.formula(keys["effect"], keys["formula"], units=keys["units"], bounds=keys["bounds"])
    with pytest.raises(FrictrackError, match="add drag first"):
        choose_formula(2, DIAGNOSIS, [], ["coulomb"])
    with pytest.raises(FrictrackError, match="it has formula:1 to formula:2"):
        choose_formula(3, DIAGNOSIS, [], ["coulomb"])
    with pytest.raises(FrictrackError, match="has none"):
        choose_formula(1, None, [], ["coulomb"])


def test_the_command_line_says_how_certain_a_formula_is(capsys):
    unexplained(Console(width=200), json.loads(json.dumps(DIAGNOSIS["unexplained"])))
    said = capsys.readouterr().out
    assert "probability of this form 60 %" in said
    assert "cannot distinguish it from F * 1/(1 + abs(v)/w)" in said
    assert "Probability that none of these forms is right: 40 %." in said
    assert "frictrack add STUDY formula:1" in said
