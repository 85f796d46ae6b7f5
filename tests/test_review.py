"""A review reuses the models that the search has tested, where they led to the model under review."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from runs import BASE, HIDDEN, Spec, study

from frictrack import effects, models
from frictrack.diagnose.refined_candidates import RefinedCandidate
from frictrack.diagnose.review import _named_in_order, _without
from frictrack.diagnose.rounds import RoundOutcome
from frictrack.fit import add_effect, fit
from frictrack.fit.least_squares import Solution
from frictrack.fit.stepwise import rename_effects

LAW = ["coulomb", "viscous"]


@pytest.fixture(scope="module")
def grown() -> tuple[Solution, Solution, Solution]:
    """The fitted model without a texture, with it, and with drag as well."""
    law = {name: BASE[name] for name in LAW} | {"texture": HIDDEN["texture"]}
    specs = (Spec(3.0, 1, 0.05), Spec(5.0, 1, 0.05))
    runs, _ = study(models.of(law), law, specs=specs, sigma=1e-5, rng=np.random.default_rng(1))
    bare = fit(LAW, runs).solution
    one = add_effect(bare, effects.get("texture"))
    return bare, one, add_effect(one, effects.get("drag"))


@pytest.fixture
def tested(grown: tuple[Solution, Solution, Solution]) -> list[RoundOutcome]:
    bare, one, two = grown
    drag = RefinedCandidate(effects.get("drag"), two, 5.0, 0.001)
    return [RoundOutcome(bare, []), RoundOutcome(one, [drag])]


def test_a_model_from_which_the_effect_was_added_is_not_fitted_again(grown, tested) -> None:
    bare, one, two = grown
    assert _without(two, ["drag"], tested) is one
    assert _without(two, ["texture", "drag"], tested) is bare


def test_a_model_that_was_not_tested_or_has_moved_on_is_fitted(grown, tested) -> None:
    _, one, two = grown
    other = _without(two, ["texture"], tested)
    assert other.problem.model.names == [*LAW, "drag"]
    moved = replace(two, objective=two.objective - 100.0)  # the other effects are elsewhere by now
    again = _without(moved, ["drag"], tested)
    assert again is not one
    assert again.objective == pytest.approx(one.objective, abs=1.0)


def test_the_second_of_its_kind_is_the_first_once_that_is_removed(grown) -> None:
    _, one, two = grown
    second = rename_effects(one, {"texture": "texture:2"})
    found = RefinedCandidate(effects.get("texture:2"), second, 9.0, 0.001)
    drag = RefinedCandidate(
        effects.get("drag"),
        rename_effects(two, {"texture": "texture:2"}),
        5.0,
        0.001,
        indistinguishable_from=("texture:2",),
    )
    alone, other = _named_in_order([found, drag])
    assert alone.effect.name == "texture"
    assert alone.law.problem.model.names == one.problem.model.names
    assert alone.law.problem.layout.names == one.problem.layout.names
    np.testing.assert_array_equal(alone.law.p, one.p)
    assert other.indistinguishable_from == ("texture",)


def test_the_second_of_its_kind_stays_the_second_beside_one_of_the_model(grown) -> None:
    _, one, _ = grown
    both = add_effect(one, effects.get("texture:2"))
    found = [RefinedCandidate(effects.get("texture:2"), both, 9.0, 0.001)]
    assert _named_in_order(found) == found
