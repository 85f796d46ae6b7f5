"""Formulas of an unknown cause: units that are derived, functions of the user, and the command that adds one."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from frictrack import effects
from frictrack.base.errors import FrictrackError
from frictrack.base.units import is_coherent
from frictrack.cli.output import Console, unexplained
from frictrack.diagnose.compressed import Axis
from frictrack.diagnose.formula_scan import log_volume, relative_evidence
from frictrack.diagnose.formula_terms import (
    KIND_POWERS,
    SHAPES,
    Term,
    build_effect,
    coefficient_unit,
    parameter_bounds,
    shapes_of_functions,
)
from frictrack.diagnose.formulas import (
    CREDIBLE_PROBABILITY,
    credible_forms,
    form_probabilities,
    log_prior,
)
from frictrack.flow.opening import choose_formula, formula_number

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


def term(shape, factor="", axis="v", parameters=None):
    variable = Axis(axis, lambda p: {"x": p.x, "t": p.t, "v": p.speed}[axis], factor)
    return Term(shape, variable, parameters or (0.5,) * len(shape.parameters), (0.5, 4.0))


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: s.name)
def test_every_form_has_units_that_agree_and_can_be_written(shape):
    for axis in shape.axes:
        for column in shape.columns:
            unit = coefficient_unit(column, term(shape, axis=axis))
            assert is_coherent(unit), unit


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: s.name)
def test_a_column_scales_with_the_unit_of_its_axis_as_its_degree_says(shape):
    """A text that adds unlike quantities, or has a function of a quantity with a unit, would not."""
    u, parameters = np.linspace(0.6, 3.0, 7), (0.3, 0.7, 0.6)[: len(shape.parameters)]
    scaled = [q * 3.0 ** KIND_POWERS[kind] for q, kind in zip(parameters, shape.kinds, strict=True)]
    degrees = np.array([shape.degree(column) for column in shape.columns])
    assert shape.columns_at(3 * u, scaled) == pytest.approx(shape.columns_at(u, parameters) * 3.0**degrees, abs=1e-9)


@pytest.mark.parametrize(
    "factor", ["L * s * x", "abs(v)", "L * s * mass", "L * s * mass^(-1/2)", "L * s * mass^(-1/3)", "s * t"]
)
def test_a_factor_with_a_unit_gives_a_unit_and_an_effect(factor):
    decay = term(next(s for s in SHAPES if s.name == "decay"), factor, parameters=(2.0,))
    assert is_coherent(coefficient_unit(*decay.shape.columns, decay))
    assert coefficient_unit(*decay.shape.columns, decay) != "N"
    effect = build_effect("unexplained", decay)
    assert [p.name for p in effect.parameters] == ["F", "w"]


def test_functions_of_the_user_become_shapes():
    scaled, placed = shapes_of_functions(["z^2*exp(-z)"])
    u = np.linspace(0.1, 2.0, 5)
    assert scaled.columns_at(u, [0.5])[:, 0] == pytest.approx((u / 0.5) ** 2 * np.exp(-u / 0.5))
    assert placed.columns_at(u, [1.0, 0.5])[:, 0] == pytest.approx(((u - 1) / 0.5) ** 2 * np.exp(-(u - 1) / 0.5))


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


def decay(gain=100.0, parameters=(2.0,)):
    shape = next(s for s in SHAPES if s.name == "decay")
    return Term(shape, Axis("v", lambda p: p.speed, "L * s"), parameters, (0.0, 4.0), gain)


def test_a_parameter_that_data_determine_costs_evidence_and_one_that_they_do_not_costs_none():
    rng = np.random.default_rng(0)
    column = rng.standard_normal((50, 1))
    assert log_volume(decay(), 0.0 * column) == pytest.approx(0.0, abs=1e-9)
    sharp, sharper = log_volume(decay(), 10.0 * column), log_volume(decay(), 20.0 * column)
    assert sharp < -3.0
    assert sharper == pytest.approx(sharp - np.log(2.0), abs=1e-2)  # half as wide
    per_logarithm = np.linalg.norm(10.0 * column) * 2.0  # of the logarithm of w = 2
    prior = np.log(2 * 3.0 / 3e-3)
    assert sharp == pytest.approx(np.log(np.sqrt(2 * np.pi) / per_logarithm / prior), abs=1e-2)


def test_of_forms_that_fit_alike_the_one_with_fewer_operators_is_more_probable():
    plain = decay()
    twice = replace(plain, variable=Axis("v", lambda p: p.speed, "L * s * mass^(-1/2)"))
    assert relative_evidence(plain, 100.0) - relative_evidence(twice, 100.0) == pytest.approx(2 * np.log(2.0))
    assert log_prior(1, [1, 2, 2]) - log_prior(2, [1, 2, 2]) == pytest.approx(np.log(2.0))
    assert sum(np.exp(log_prior(n, [1, 2, 2])) for n in (1, 2, 2)) == pytest.approx(1.0)


def test_the_group_holds_the_stated_probability_and_no_more():
    weights = {"a": 5.0, "b": 4.0, "c": 3.0, "d": -9.0}
    probabilities = form_probabilities(weights, none=4.0)
    assert list(probabilities) == ["a", "b", "c", "d"]
    assert 0.5 < sum(probabilities.values()) < 1.0
    group = credible_forms(probabilities)
    held = sum(probabilities[form] for form in group) / sum(probabilities.values())
    assert group == ["a", "b", "c"]
    assert held >= CREDIBLE_PROBABILITY
    assert sum(probabilities[form] for form in group[:-1]) / sum(probabilities.values()) < CREDIBLE_PROBABILITY


def test_a_width_is_refined_only_within_the_range_of_its_prior():
    low, high = parameter_bounds(decay(parameters=(-0.02,)), 30.0, 3.0)["w"]
    assert (low, high) == pytest.approx((-0.6, -0.012))  # a growth stays a growth; 3e-3 of the axis at least
