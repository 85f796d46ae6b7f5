"""Models are sums of effects: they add, subtract, replace, read their names and print their equation."""

from __future__ import annotations

import numpy as np
import pytest
from runs import BASE, HIDDEN, LAWS, PITCH, SHIFTS, Slider, force

from frictrack import effects, models
from frictrack.effects import Path
from frictrack.errors import FrictrackError

TUSTIN = ["coulomb", "stribeck", "viscous"]


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("tustin", TUSTIN),
        ("stribeck-model", TUSTIN),
        ("atm1:1", [*TUSTIN, "vibration"]),
        ("atm1:3", [*TUSTIN, "vibration", "vibration:2", "vibration:3"]),
        ("atm2:2", ["atm2:2"]),
        ("coulomb", ["coulomb"]),
        ("coulomb,viscous", ["coulomb", "viscous"]),
        (" coulomb , texture ", ["coulomb", "texture"]),
        (["coulomb", "texture"], ["coulomb", "texture"]),
        (("coulomb", "vibration", "vibration:2"), ["coulomb", "vibration", "vibration:2"]),
    ],
)
def test_parse_reads_named_models_and_lists_of_effects(text, names):
    assert models.parse(text).names == names


def test_tustin_holds_the_exponent_that_the_stribeck_model_frees():
    (held,) = (e for e in models.tustin().effects if e.name == "stribeck")
    (free,) = (e for e in models.stribeck_model().effects if e.name == "stribeck")
    assert held.parameter("delta").fixed == 1.0
    assert free.parameter("delta").fixed is None
    assert free.parameter("delta").scan is not None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("tustn", 'expected the name of a model but got "tustn"'),
        ("coulomb,viscos", 'did you mean "viscous"?'),
        ("atm1", 'expected an order after the colon, as in "atm1:2", but got "atm1"'),
        ("atm1:0", "expected an order after the colon"),
        ("atm2:x", "expected an order after the colon"),
        ("coulomb,coulomb", "expected every effect once but got coulomb twice; write coulomb:2 for a second one"),
        ("", "expected at least one effect but got an empty model"),
        ([], "expected at least one effect but got an empty model"),
    ],
)
def test_a_model_that_cannot_be_read_is_wrong_usage_in_one_sentence(text, said):
    with pytest.raises(FrictrackError) as caught:
        models.parse(text)
    assert said in str(caught.value)
    assert caught.value.usage


def test_effects_are_added_and_taken_away():
    grown = models.tustin() + "texture"
    assert grown.names == [*TUSTIN, "texture"]
    assert (grown - "viscous").names == ["coulomb", "stribeck", "texture"]
    assert models.tustin().names == TUSTIN
    assert "texture" in grown
    assert "texture" not in models.tustin()
    assert (models.tustin() + effects.get("drag")).names[-1] == "drag"


def test_what_is_not_there_cannot_be_taken_away_nor_the_last_effect():
    with pytest.raises(
        FrictrackError, match=r"expected an effect of the model \(coulomb, stribeck, viscous\) to remove"
    ):
        models.tustin() - "texture"
    with pytest.raises(FrictrackError, match="empty model"):
        models.of(["coulomb"]) - "coulomb"
    with pytest.raises(FrictrackError, match="got texture twice"):
        models.of(["coulomb", "texture"]) + "texture"


def test_next_instance_counts_on():
    model = models.parse("coulomb,vibration")
    assert model.next_instance("texture") == "texture"
    assert model.next_instance("vibration") == "vibration:2"
    assert (model + "vibration:2").next_instance("vibration") == "vibration:3"
    assert (model + "vibration:2" - "vibration").next_instance("vibration") == "vibration"


def test_atm2_replaces_the_tustin_terms_and_nothing_else():
    assert (models.tustin() + "texture" + "atm2:2").names == ["texture", "atm2:2"]


def test_the_printed_model_is_the_sum_of_its_equations():
    assert str(models.parse("coulomb,viscous,lens")) == "F = F_c L s + F_v v; y: k (x - x_c)^3"
    text = str(models.parse("atm1:2"))
    assert text.startswith("F = F_c L s + (F_s - F_c) L s exp(-(|v|/v_s)^delta) + F_v v + amplitude sin(2 pi")
    assert text.count("amplitude sin(2 pi frequency t + phase)") == 2


def path_of(s=1.0, load=1.2, mass_ratio=1.5):
    t = np.linspace(0, 0.12, 50)
    return Path(t, 4 * t, s * (4 - 30 * t), np.full(50, s), load, mass_ratio, PITCH)


@pytest.mark.parametrize("s", [1.0, -1.0])
def test_force_is_the_sum_of_the_laws_with_modifiers_applied_once(s):
    values = BASE | {k: v for k, v in HIDDEN.items() if k not in SHIFTS}
    model = models.of(values)
    path = path_of(s)
    truth = force(values, path.x, path.v, path.t, s, Slider(load=1.2, mass_ratio=1.5))
    np.testing.assert_allclose(model.force(path, values), truth, rtol=1e-12)
    # Modified columns replace, never double: coulomb carries its swing, viscous does not.
    columns = model.force_columns(path, values)
    assert "load_modulation" not in columns
    swing = 1 + 0.1 * np.sin(2 * np.pi * 47.0 * path.t - 0.4)
    np.testing.assert_allclose(columns["coulomb"][:, 0], 1.2 * s * swing, rtol=1e-12)
    np.testing.assert_allclose(columns["viscous"][:, 0], path.v, rtol=1e-12)


def test_two_modulations_of_one_load_multiply():
    values = {"coulomb": {"F_c": 2.0}, "load_modulation": HIDDEN["load_modulation"]}
    values["load_modulation:2"] = {"depth": 0.3, "frequency": 90.0, "phase": 1.0}
    path = path_of()
    swings = (1 + 0.1 * np.sin(2 * np.pi * 47.0 * path.t - 0.4)) * (1 + 0.3 * np.sin(2 * np.pi * 90.0 * path.t + 1.0))
    np.testing.assert_allclose(models.of(values).force(path, values), 2.4 * swings, rtol=1e-12)


def test_instances_add_up():
    values = {"vibration": HIDDEN["vibration"], "vibration:2": {"amplitude": 0.2, "frequency": 33.0, "phase": 0.0}}
    path = path_of()
    truth = LAWS["vibration"](values["vibration"], 0, 0, path.t, 1, None)
    truth = truth + 0.2 * np.sin(2 * np.pi * 33.0 * path.t)
    np.testing.assert_allclose(models.of(values).force(path, values), truth, rtol=1e-12)


def test_picture_effects_shift_the_picture_and_add_no_force():
    model = models.of(["coulomb", *SHIFTS])
    values = {"coulomb": {"F_c": 3.0}} | {k: HIDDEN[k] for k in SHIFTS}
    path = path_of()
    np.testing.assert_allclose(model.force(path, values), 3.6, rtol=1e-12)
    assert set(model.measurement_columns(path, values)) == set(SHIFTS)
