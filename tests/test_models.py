"""Models are sums of effects: they add, subtract, replace, read their names and print their equation."""

from __future__ import annotations

import tomllib
from types import SimpleNamespace

import numpy as np
import pytest
from runs import BASE, HIDDEN, LAWS, PITCH, SHIFTS, TOLD, Slider, force

from frictrack import effects
from frictrack.base.errors import FrictrackError
from frictrack.effects import Path, models
from frictrack.fit import fit
from frictrack.records import Run
from frictrack.simulate import Conditions, simulate

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
        ("tustin, texture", [*TUSTIN, "texture"]),
        (["tustin", "texture"], [*TUSTIN, "texture"]),
        ("lugre", ["lugre", "viscous"]),
        (["lugre"], ["lugre"]),
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
        ("tustn", 'expected names of models or effects but got "tustn"; did you mean "tustin"?'),
        ("coulomb,viscos", 'but got "viscos" (name 2 of 2); did you mean "viscous"?'),
        ("tustin,foo", 'but got "foo" (name 2 of 2); known are tustin'),
        ("tustin,texure,patsh", 'got "texure" (name 2 of 3) and "patsh" (name 3 of 3); did you mean "texture"'),
        (["tustin", "foo"], 'but got "foo" (name 2 of 2)'),
        (None, 'expected the name of a model, such as "tustin", or a list of effects but got NoneType'),
        (["coulomb", 3], 'expected the name of a model, such as "tustin", or a list of effects but got int'),
        ("atm1", 'expected an order from 1 to 20 after the colon, as in "atm1:2", but got "atm1"'),
        ("atm1:0", "expected an order from 1 to 20 after the colon"),
        ("atm2:x", "expected an order from 1 to 20 after the colon"),
        ("atm1:999999999", 'as in "atm1:2", but got "atm1:999999999"'),
        ("atm2:21", 'as in "atm2:2", but got "atm2:21"'),
        (["coulomb", "atm2:999999999"], "expected an order from 1 to 20 after the colon"),
        (["coulomb", "atm2:"], "expected an order from 1 to 20 after the colon"),
        ("atm1:" + "9" * 5000, "expected an order from 1 to 20 after the colon"),
        ("atm1:\N{SUPERSCRIPT TWO}", "expected an order from 1 to 20 after the colon"),
        ("coulomb,vibration:\N{SUPERSCRIPT TWO}", "expected a number up to 99 after the colon"),
        ("coulomb,vibration:100", 'expected a number up to 99 after the colon but got "vibration:100"'),
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
    assert text.endswith("amplitude sin(2 pi frequency t + phase) + amplitude_2 sin(2 pi frequency_2 t + phase_2)")


def known(**values):
    return {k.replace("__", "."): SimpleNamespace(value=v, std=std) for k, (v, std) in values.items()}


def test_the_printed_model_takes_its_numbers():
    law = models.parse("coulomb,stribeck,viscous,vibration,vibration:2")
    told = known(
        coulomb__F_c=(8.0123, 0.0213),
        stribeck__F_s=(12.1, 0.0),
        stribeck__delta=(1.0, 0.0),
        viscous__F_v=(-1.234, 0.11),
    )
    told |= known(vibration__amplitude=(0.5, 1.2), stribeck__v_s=(None, None))
    told["vibration:2.frequency"] = SimpleNamespace(value=122.6, std=0.01)
    told["vibration.phase[v3]"] = SimpleNamespace(value=1.0, std=0.1)
    assert law.equation(told) == (
        "F = (8.012 ± 0.021) L s + (12.1 - (8.012 ± 0.021)) L s exp(-(|v|/v_s)^1) + (-1.23 ± 0.11) v"
        " + (0.5 ± 1.2) sin(2 pi frequency t + phase) + amplitude_2 sin(2 pi (122.600 ± 0.010) t + phase_2)"
    )


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (8.0123, 0.0213, "(8.012 ± 0.021)"),
        (8.0123, 0.0013, "(8.0123 ± 0.0013)"),
        (0.35, 0.002, "(0.3500 ± 0.0020)"),
        (1234.5, 3.2, "(1234.5 ± 3.2)"),
        (120.4, 12.0, "(120 ± 12)"),
        (1.1e-5, 2.6e-7, "(1.1e-05 ± 2.6e-07)"),
        (2.5e7, 4e5, "(2.5e+07 ± 4e+05)"),
        (0.0, 0.3, "(0.00 ± 0.30)"),
        (8.0, 0.0, "8"),
        (8.0, None, "8"),
        (8.0, np.inf, "8"),
    ],
)
def test_a_number_stands_with_its_deviation_in_brackets(value, std, text):
    printed = models.of(["coulomb"]).equation(known(coulomb__F_c=(value, std)))
    assert printed == f"F = {text} L s"


def test_no_symbol_of_an_equation_means_two_things():
    text = str(models.parse("coulomb,patch,drift,spring,stribeck,hydrodynamic_hump,vibration,vibration:2"))
    assert "F_patch L s exp(" in text  # F is the whole force
    assert "k_drift L s t + k_spring (x + x_0)" in text
    assert "(|v|/v_s,stribeck)^delta" in text
    assert "F_hydrodynamic_hump L s (|v|/v_s,hydrodynamic_hump)" in text
    assert "+ amplitude sin(2 pi frequency t + phase) + amplitude_2 sin(2 pi frequency_2 t + phase_2)" in text


# --- equality, settings in words, TOML


def test_equal_models_are_equal_and_have_one_hash():
    for make in (models.tustin, models.stribeck_model, lambda: models.atm1(3), lambda: models.atm2(2), models.lugre):
        assert make() == make()
        assert hash(make()) == hash(make())
    assert models.tustin() != models.stribeck_model()
    assert models.atm2(2) != models.atm2(3)
    line = effects.get("vibration")
    fixed = [line.adjusted(frequency={"fixed": f}) for f in (60.0, 60.0, 61.0)]
    assert models.of([fixed[0]]) == models.of([fixed[1]])
    assert models.of([fixed[0]]) != models.of([fixed[2]])


SET = """
model = ["coulomb", "stribeck", "vibration", "vibration:2", "magnet"]

[[effect]]
effect = "coulomb"
per_run = ["F_c"]

[[effect]]
effect = "stribeck"
fix = {delta = false}
prior = {F_s = [9, 0.1]}

[[effect]]
effect = "vibration"
bounds = {frequency = [50, 70]}
per_run = {phase = false}

[[effect]]
effect = "vibration:2"
tie = {frequency = "2*vibration.frequency"}
fix = {amplitude = 0.5}

[[effect]]
effect = "magnet"
formula = "F * exp(-((x - x_c)/w)^2)"
units = {F = "N", x_c = "m", w = "m"}
bounds = {w = [0.001, 0.1]}
fix = {x_c = 0.2}

[[effect]]
effect = "texture"
fix = {period = 0.03}
"""


def test_a_model_is_read_from_toml_and_written_to_it():
    law = models.from_toml(SET)
    assert law.settings == [
        "coulomb.F_c per run",
        "stribeck.F_s known as 9 ± 0.1 N",
        "stribeck.delta free",
        "vibration.frequency in [50, 70] Hz",
        "vibration.phase shared",
        "vibration:2.amplitude = 0.5 N",
        "vibration:2.frequency = 2*vibration.frequency",
        "magnet.x_c = 0.2 m",
    ]
    again = models.from_toml(law.to_toml())
    assert again == law
    assert again.to_toml() == law.to_toml()
    assert tomllib.loads(law.to_toml())["model"] == law.names


@pytest.mark.parametrize("name", [*models.NAMED, "coulomb,viscous,lens,camera_shake:3"])
def test_every_named_model_survives_toml(name):
    law = models.parse(f"{name}:3" if name.startswith("atm") else name)
    assert models.from_toml(law.to_toml()) == law


@pytest.mark.few(12)
@pytest.mark.parametrize("name", list(effects.LIBRARY))
def test_every_effect_survives_toml_fixed_and_per_run(name):
    base = effects.get(name)
    one = base.parameters[0]
    changed = base.adjusted(**{one.name: {"fixed": 0.5}}, **{p.name: {"per_run": True} for p in base.parameters[1:]})
    law = models.of([*(n if n in effects.LIBRARY else "coulomb" for n in sorted(base.modifies)[:1]), changed])
    assert models.from_toml(law.to_toml()) == law


def test_a_model_file_is_read_by_its_path(tmp_path):
    path = tmp_path / "law.toml"
    path.write_text(models.atm1(2).to_toml())
    assert models.from_toml(path) == models.from_toml(str(path)) == models.atm1(2)
    path.write_text('[study]\nmodel = "tustin"\n')
    assert models.from_toml(path) == models.tustin()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("model = [", "model is not valid TOML"),
        ("gone.toml", "expected a model in the file gone.toml but cannot read it (No such file or directory)"),
        ("name = 1", 'expected model = a name or a list of effects, as in model = ["coulomb", "viscous"]'),
        ('model = ["colomb"]', 'expected names of models or effects but got "colomb"; did you mean "coulomb"?'),
        (
            'model = "tustin"\n[[effect]]\nfix = {a = 1}',
            "[[effect]]: expected the key effect but it is missing",
        ),
    ],
)
def test_toml_that_is_no_model_is_told_in_one_sentence(text, said):
    with pytest.raises(FrictrackError) as caught:
        models.from_toml(text)
    assert said in str(caught.value)
    assert caught.value.usage


def test_a_model_file_that_is_no_text_is_told(tmp_path):
    (tmp_path / "model.toml").write_bytes(b'model = "\xff"')
    with pytest.raises(FrictrackError, match=r"model\.toml is not a text in UTF-8"):
        models.from_toml(tmp_path / "model.toml")


def test_an_effect_made_by_hand_cannot_be_written():
    law = models.of(["coulomb", effects.get("drag").called("drog")])
    with pytest.raises(
        FrictrackError, match="expected an effect of the library or a formula but got drog; declare it with @frictrack"
    ):
        law.to_toml()
    assert law.settings == []


# --- the papers' equations, written out


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("s", [1.0, -1.0])
def test_atm1_is_the_papers_equation_3(n, s):
    path, rng = path_of(s, load=1.0), np.random.default_rng(n)
    names = ["vibration", *(f"vibration:{i}" for i in range(2, n + 1))]
    waves = rng.uniform([0.1, 10, -3], [1, 300, 3], (n, 3))
    values = {k: dict(v) for k, v in BASE.items()} | {
        name: dict(zip(("amplitude", "frequency", "phase"), wave, strict=True))
        for name, wave in zip(names, waves, strict=True)
    }
    f_c, rise, v_s, f_v = 8.0, 6.0, 0.4, 1.2  # F_s - F_c is the rise
    truth = s * (f_c + rise * np.exp(-np.abs(path.v) / v_s)) + f_v * path.v
    truth += sum(a * np.sin(2 * np.pi * f * path.t + phi) for a, f, phi in waves)
    law = models.atm1(n)
    np.testing.assert_allclose(law.force(path, values), truth, rtol=1e-12)
    free = [p for e in law.effects for p in e.parameters if p.fixed is None]
    assert len(free) == 4 + 3 * n  # ten at n = 2, as the paper counts


@pytest.mark.parametrize("n", [1, 2, 3])
def test_atm2_is_the_papers_equation_4_with_its_count_of_parameters(n):
    path, rng = path_of(load=1.0), np.random.default_rng(n)
    pairs = rng.uniform([10, -3], [300, 3], (2 * n, 2))
    own = {"f_c": 2.0, "f_s": 5.0, "f_v": 0.7, "v_s": 0.4}
    for kind, some in (("sliding", pairs[:n]), ("viscous", pairs[n:])):
        for i, (f, phi) in enumerate(some, 1):
            own |= {f"{kind}_frequency_{i}": f, f"{kind}_phase_{i}": phi}
    s_c = sum(np.sin(2 * np.pi * f * path.t + phi) for f, phi in pairs[:n])
    s_v = sum(np.sin(2 * np.pi * f * path.t + phi) for f, phi in pairs[n:])
    truth = s_c * 2.0 + (5.0 - s_c * 2.0) * np.exp(-path.v / 0.4) + s_v * 0.7 * path.v
    law = models.atm2(n)
    np.testing.assert_allclose(law.force(path, {f"atm2:{n}": own}), truth, rtol=1e-12, atol=1e-12)
    assert len(law.effects[0].parameters) == 4 + 4 * n  # twelve at n = 2


@pytest.mark.parametrize("s", [1.0, -1.0])
def test_equation_4_as_printed_has_no_t_in_two_of_its_sums(s):
    """omega in rad per millisecond: the sine without t is that of omega + phi."""
    path = path_of(s, load=1.0)
    omega, phi = np.array([0.31, 0.07]), np.array([0.6, -0.8])
    own = {"f_c": 2.0, "f_s": 5.0, "f_v": 0.7, "v_s": 0.4}
    for i in (0, 1):
        own |= {f"sliding_frequency_{i + 1}": omega[i] * 1e3 / (2 * np.pi), f"sliding_phase_{i + 1}": phi[i]}
    with_t = sum(np.sin(w * 1e3 * path.t + p) for w, p in zip(omega, phi, strict=True))
    dry = with_t * 2.0 + (5.0 - np.sin(omega + phi).sum() * 2.0) * np.exp(-np.abs(path.v) / 0.4)
    law = models.parse("atm2_printed:2")
    np.testing.assert_allclose(law.force(path, {"atm2_printed:2": own}), s * dry + 0.7 * path.v, rtol=1e-12, atol=1e-12)
    assert (models.tustin() + "atm2_printed:2").names == ["atm2_printed:2"]


def test_equation_4_as_printed_is_fitted_by_variable_projection():
    t = np.arange(280) / 2000
    values = {"f_c": 8.0, "f_s": 13.0, "f_v": 1.3, "v_s": 0.7, "sliding_frequency_1": 40.0, "sliding_phase_1": 0.6}
    truth = simulate(models.parse("atm2_printed:1"), {"atm2_printed:1": values}, Conditions(0.35), t, (0.0, 5.0))
    run = Run.from_arrays(t, truth.x + 1e-5 * np.random.default_rng(3).standard_normal(len(t)), mass=0.35, name="r")
    found = fit("atm2_printed:1", [run])
    assert found.reduced_chi2 == pytest.approx(1.0, abs=0.2)
    for name in ("f_c", "f_v", "sliding_frequency_1"):
        estimate = found.parameters[f"atm2_printed:1.{name}"]
        assert estimate.value == pytest.approx(values[name], abs=4 * estimate.std)


def test_the_freer_physical_forms_modulate_load_and_viscosity():
    law = models.tustin() + "load_modulation" + "viscous_modulation"
    line = {"depth": 0.2, "frequency": 40.0, "phase": 0.3}
    other = {"depth": 0.4, "frequency": 90.0, "phase": -1.0}
    path = path_of(load=1.0)
    wave = [1 + q["depth"] * np.sin(2 * np.pi * q["frequency"] * path.t + q["phase"]) for q in (line, other)]
    dry = 8.0 + 6.0 * np.exp(-path.v / 0.4)
    values = BASE | {"load_modulation": line, "viscous_modulation": other}
    np.testing.assert_allclose(law.force(path, values), dry * wave[0] + 1.2 * path.v * wave[1], rtol=1e-12)


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
    values = {"coulomb": {"F_c": 3.0}} | {k: (HIDDEN | TOLD)[k] for k in SHIFTS}
    path = path_of()
    np.testing.assert_allclose(model.force(path, values), 3.6, rtol=1e-12)
    assert set(model.measurement_columns(path, values)) == set(SHIFTS)


def test_effects_may_be_separated_as_they_are_printed():
    assert models.parse("coulomb + viscous").names == models.parse("coulomb,viscous").names
