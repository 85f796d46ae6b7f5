"""Fixed values, bounds, priors, ties and per-run parameters, held against simulated truth and closed forms."""

from __future__ import annotations

import re
from importlib.resources import files

import numpy as np
import pytest
from runs import BASE, MASS, Spec, measured, study

import frictrack as ft
from frictrack.base.errors import FrictrackError
from frictrack.effects import catalogue, models, settings
from frictrack.fit import restore, state
from frictrack.flow import Session, open_study, user_effects

WIDER = 0.02  # as far as a stated deviation is wider than a known noise would make it
TWO = (Spec(4.0), Spec(5.0))
LINE = {"amplitude": 0.8, "frequency": 61.3, "phase": 0.7}
OVERTONE = {"amplitude": 0.6, "frequency": 122.6, "phase": 0.2}


def told(effect, **keys):
    return settings.read_settings({"effect": effect} | keys)


def model(names, *tables):
    law = models.parse(names, settings.definitions(tables)).adjusted(tables)
    settings.check_ties(law.effects)
    return law


@pytest.fixture(scope="module")
def lines():
    """Two runs with a vibration and its overtone."""
    law = models.tustin() + "vibration" + "vibration:2"
    return study(law, BASE | {"vibration": LINE, "vibration:2": OVERTONE}, specs=TWO, sigma=2e-6)[0]


@pytest.fixture(scope="module")
def plain():
    """Three runs of Tustin's law, one of double mass."""
    return study("tustin", specs=(Spec(2.2, 1, 0.075), Spec(4.0), Spec(4.5, 2)), sigma=5e-6)[0]


# --- a model that is linear in the motion: constant deceleration, its estimates in closed form


def parabola(a=6.0, sigma=1e-5, n=400, seed=3):
    t = np.arange(n) / 4000.0
    return measured(t, 0.01 + 2.5 * t - a * t**2 / 2, sigma=sigma, rng=np.random.default_rng(seed))


def least_squares(run, known=()):
    """F, its deviation: y = x0 + v0 t - F t^2/2m by least squares, each prior of F (mean, std) one more row."""
    t = run.displacement.t
    sigma = float(ft.fit("coulomb", [run]).solution.problem.pieces[0].sigma[0])  # the noise that the fit reckons with
    rows = np.column_stack([np.ones_like(t), t, -(t**2) / 2 / MASS]) / sigma
    right = run.displacement.x / sigma
    for mean, std in known:
        rows = np.vstack([rows, [0, 0, 1 / std]])
        right = np.append(right, mean / std)
    inverse = np.linalg.inv(rows.T @ rows)
    return float((inverse @ rows.T @ right)[2]), float(np.sqrt(inverse[2, 2]))


@pytest.mark.parametrize("std", [1e-4, 1e-3, 1e-1])
def test_a_prior_is_one_more_row_of_least_squares(std):
    run = parabola()
    bare = least_squares(run)
    mean = bare[0] + 2 * bare[1]
    value, deviation = least_squares(run, [(mean, std)])
    found = ft.fit(model("coulomb", told("coulomb", prior={"F_c": [mean, std]})), [run]).parameters["coulomb.F_c"]
    assert found.value == pytest.approx(value, abs=1e-3 * deviation)
    assert found.std == pytest.approx(deviation, rel=WIDER)
    assert found.reason is None


def test_what_is_fixed_is_subtracted_and_told():
    run = parabola()
    whole, deviation = least_squares(run)
    fitted = ft.fit(model("coulomb,slope", told("slope", fix={"F": 0.5})), [run]).parameters
    assert fitted["slope.F"].value == 0.5
    assert fitted["slope.F"].std == 0.0
    assert fitted["slope.F"].reason == "fixed"
    assert fitted["coulomb.F_c"].value == pytest.approx(whole - 0.5, abs=1e-3 * deviation)
    assert fitted["coulomb.F_c"].std == pytest.approx(deviation, rel=WIDER)


def test_a_tie_is_as_well_known_as_what_it_follows():
    # F_c s + F, F = 0.25 F_c: the data give 1.25 F_c
    run = parabola()
    whole, deviation = least_squares(run)
    fitted = ft.fit(model("coulomb,slope", told("slope", tie={"F": "0.25*coulomb.F_c"})), [run]).parameters
    assert fitted["coulomb.F_c"].value == pytest.approx(whole / 1.25, abs=1e-3 * deviation)
    assert fitted["coulomb.F_c"].std == pytest.approx(deviation / 1.25, rel=WIDER)
    assert fitted["slope.F"].value == pytest.approx(whole / 5, abs=1e-3 * deviation)
    assert fitted["slope.F"].std == pytest.approx(deviation / 5, rel=WIDER)
    assert fitted["slope.F"].reason == "tied to 0.25*coulomb.F_c"


def test_a_bound_holds_and_is_told():
    run = parabola()
    whole, _ = least_squares(run)
    found = ft.fit(model("coulomb", told("coulomb", bounds={"F_c": [whole + 0.5, whole + 2]})), [run])
    assert found.parameters["coulomb.F_c"].value == pytest.approx(whole + 0.5, abs=1e-9)
    assert found.parameters["coulomb.F_c"].at_bound


def test_a_prior_settles_what_one_direction_cannot():
    # A slope and Coulomb friction are one in one direction; a level that was measured parts them.
    run = parabola()
    whole, deviation = least_squares(run)
    fitted = ft.fit(model("coulomb,slope", told("slope", prior={"F": [0.3, 0.05]})), [run]).parameters
    assert fitted["slope.F"].value == pytest.approx(0.3, abs=1e-3)
    assert fitted["slope.F"].std == pytest.approx(0.05, rel=WIDER)
    assert fitted["coulomb.F_c"].value == pytest.approx(whole - 0.3, abs=1e-3)
    assert fitted["coulomb.F_c"].std == pytest.approx(np.hypot(deviation, 0.05), rel=WIDER)


# --- values as they are quoted


def test_a_fixed_static_level_is_the_level_itself(plain):
    fitted = ft.fit(model("tustin", told("stribeck", fix={"F_s": 14.0})), plain)
    assert fitted.parameters["stribeck.F_s"].value == 14.0
    values, _ = fitted.solution.problem.layout.values(fitted.solution.p, 0)
    assert values["stribeck"]["F_s"] + values["coulomb"]["F_c"] == pytest.approx(14.0, abs=1e-12)
    _true(fitted, {"coulomb.F_c": 8.0, "stribeck.v_s": 0.4, "viscous.F_v": 1.2})


def test_a_prior_of_the_static_level_is_of_the_level_itself(plain):
    bare = ft.fit("tustin", plain).parameters["stribeck.F_s"]
    found = ft.fit(model("tustin", told("stribeck", prior={"F_s": [bare.value + 0.1, bare.std]})), plain)
    there = found.parameters["stribeck.F_s"]
    assert there.std == pytest.approx(bare.std / np.sqrt(2), rel=0.1)
    assert there.value == pytest.approx(bare.value + 0.05, abs=0.1 * bare.std + 5e-3)


def test_a_static_level_tied_to_the_kinetic_one(plain):
    fitted = ft.fit(model("tustin", told("stribeck", tie={"F_s": "1.75*coulomb.F_c"})), plain)
    known = fitted.parameters
    assert known["stribeck.F_s"].value == pytest.approx(1.75 * known["coulomb.F_c"].value, rel=1e-12)
    assert known["stribeck.F_s"].std == pytest.approx(1.75 * known["coulomb.F_c"].std, rel=1e-4)
    _true(fitted, {"coulomb.F_c": 8.0, "stribeck.v_s": 0.4, "viscous.F_v": 1.2, "stribeck.F_s": 14.0})


def _true(fitted, truth):
    for address, value in truth.items():
        found = fitted.parameters[address]
        assert abs(found.value - value) < 4 * found.std, address


# --- any delta


@pytest.mark.parametrize("delta", [0.7, 1.6])
def test_any_exponent_may_be_held_or_freed(delta):
    values = BASE | {"stribeck": BASE["stribeck"] | {"delta": delta}}
    runs, _ = study("tustin", values, specs=(Spec(2.2, 1, 0.072), Spec(4.0)), sigma=1e-6)
    held = ft.fit(model("tustin", told("stribeck", fix={"delta": delta})), runs)
    _true(held, {"stribeck.F_s": 14.0, "stribeck.v_s": 0.4})
    assert held.parameters["stribeck.delta"].value == delta
    free = ft.fit(model("tustin", told("stribeck", fix={"delta": False})), runs)
    assert free.model == models.stribeck_model()
    _true(free, {"stribeck.delta": delta, "stribeck.v_s": 0.4})


# --- lines: fixed, tied, known, within bounds, shared or per run


def test_an_overtone_is_tied_to_its_line(lines):
    loose = ft.fit("coulomb,stribeck,viscous,vibration,vibration:2", lines).parameters
    fitted = ft.fit(
        model(
            "coulomb,stribeck,viscous,vibration,vibration:2",
            told("vibration:2", tie={"frequency": "2*vibration.frequency"}),
        ),
        lines,
    )
    known = fitted.parameters
    assert known["vibration:2.frequency"].value == 2 * known["vibration.frequency"].value
    assert known["vibration:2.frequency"].std == pytest.approx(2 * known["vibration.frequency"].std, rel=1e-3)
    assert known["vibration.frequency"].std < loose["vibration.frequency"].std
    _true(fitted, {"vibration.frequency": 61.3, "vibration:2.frequency": 122.6, "vibration.amplitude": 0.8})


def test_the_leader_may_stand_behind_the_one_that_follows(lines):
    forward = model(
        "coulomb,stribeck,viscous,vibration,vibration:2",
        told("vibration:2", tie={"frequency": "2*vibration.frequency"}),
    )
    backward = model(
        "coulomb,stribeck,viscous,vibration,vibration:2",
        told("vibration", tie={"frequency": "0.5*vibration:2.frequency"}),
    )
    one, two = (ft.fit(law, lines).parameters["vibration.frequency"] for law in (forward, backward))
    assert two.value == pytest.approx(one.value, abs=0.02 * one.std)
    assert two.std == pytest.approx(one.std, rel=1e-3)


def test_bounds_and_priors_say_where_a_line_is_looked_for(lines):
    names = "coulomb,stribeck,viscous,vibration"
    strongest = ft.fit(names, lines).parameters["vibration.frequency"].value
    within = ft.fit(model(names, told("vibration", bounds={"frequency": [100.0, 150.0]})), lines)
    near = ft.fit(model(names, told("vibration", prior={"frequency": [122.5, 0.1]})), lines)
    assert strongest == pytest.approx(61.3, abs=1.5)
    assert within.parameters["vibration.frequency"].value == pytest.approx(122.6, abs=3)
    assert near.parameters["vibration.frequency"].value == pytest.approx(122.6, abs=3)


def test_a_fixed_line_has_a_phase_in_every_run_and_an_amplitude_if_asked(lines):
    tables = (
        told("vibration", fix={"frequency": 61.3}, per_run=["amplitude"]),
        told("vibration:2", fix={"amplitude": 0.6}),
    )
    fitted = ft.fit(model("coulomb,stribeck,viscous,vibration,vibration:2", *tables), lines)
    known = fitted.parameters
    assert known["vibration.frequency"].reason == "fixed"
    assert {"vibration.amplitude[r0]", "vibration.amplitude[r1]", "vibration.phase[r0]"} <= known.keys()
    _true(fitted, {"vibration.amplitude[r0]": 0.8, "vibration.amplitude[r1]": 0.8, "vibration:2.frequency": 122.6})


def test_a_phase_that_all_runs_share():
    t = np.arange(480) / 4000.0
    law, values = model("coulomb,viscous,vibration", told("vibration", per_run={"phase": False})), {}
    values = {"coulomb": BASE["coulomb"], "viscous": BASE["viscous"], "vibration": LINE}
    runs = []
    for i, speed in enumerate((4.0, 5.0)):
        held = ft.simulate.Conditions(MASS)
        slide = ft.simulate.simulate(law, values, held, t, (0.0, speed))
        runs.append(measured(t, slide.x, sigma=2e-6, name=f"r{i}", rng=np.random.default_rng(i)))
    fitted = ft.fit(law, runs)
    _true(fitted, {"vibration.phase": 0.7, "vibration.amplitude": 0.8, "vibration.frequency": 61.3})


def test_a_level_of_its_own_in_every_run(plain):
    fitted = ft.fit(model("tustin", told("coulomb", per_run=["F_c"])), plain)
    _true(fitted, {f"coulomb.F_c[r{i}]": 8.0 for i in range(3)})
    assert not fitted.solution.problem.layout.levels  # the level is what F_c says
    assert "coulomb.F_c" not in fitted.parameters


# --- the other ways to a law, and a mass that is fitted too


TIED = (
    told("vibration:2", tie={"frequency": "2*vibration.frequency"}),
    told("viscous", fix={"F_v": 1.2}),
    told("coulomb", prior={"F_c": [8.0, 0.001]}),
)


@pytest.mark.few(1)
@pytest.mark.parametrize(("domain", "search"), [("force", "varpro"), ("displacement", "ga"), ("force", "sga")])
@pytest.mark.usefixtures("few_evaluations")
def test_settings_hold_in_every_domain_and_search(lines, domain, search):
    law = model("coulomb,stribeck,viscous,vibration,vibration:2", *TIED)
    fitted = ft.fit(law, lines, domain=domain, search=search)
    known = fitted.parameters
    assert known["viscous.F_v"].value == 1.2
    assert known["vibration:2.frequency"].value == pytest.approx(2 * known["vibration.frequency"].value, rel=1e-12)
    assert known["coulomb.F_c"].value == pytest.approx(8.0, abs=0.01)
    assert np.isfinite(fitted.heldout[0])
    back = restore(lines, state(fitted))
    assert back.model == fitted.model
    assert {k: e.value for k, e in back.parameters.items()} == pytest.approx({k: e.value for k, e in known.items()})


def driven(sigma=2e-6, **known):
    """A slider that a measured drive pushes to and fro through its speeds, one direction, mass not given."""
    t = np.arange(1600) / 4000.0
    push = lambda time: 9.0 + 4.0 * np.sin(2 * np.pi * 9.0 * time)  # noqa: E731
    held = ft.simulate.Conditions(MASS, drive=push)
    values = {"coulomb": {"F_c": 8.0}, "viscous": {"F_v": 1.2}}
    slide = ft.simulate.simulate(models.parse("coulomb,viscous"), values, held, t, (0.0, 1.0))
    return measured(t, slide.x, sigma=sigma, mass=None, drive=push(t), **known)


@pytest.mark.parametrize(
    "table",
    [
        told("coulomb", fix={"F_c": 8.0}),
        told("coulomb", prior={"F_c": [8.0, 1e-4]}),
        told("viscous", fix={"F_v": 1.2}),
    ],
    ids=["fixed level", "known level", "fixed viscous"],
)
def test_newtons_that_are_fixed_or_known_stay_newtons_beside_an_unknown_mass(table):
    run = driven()
    bare = ft.fit("coulomb,viscous", [run]).parameters
    fitted = ft.fit(model("coulomb,viscous", table), [run])
    _true(fitted, {"mass.m": MASS})
    assert fitted.parameters["mass.m"].std < bare["mass.m"].std
    for address, truth in (("coulomb.F_c", 8.0), ("viscous.F_v", 1.2)):
        found = fitted.parameters[address]
        assert abs(found.value - truth) <= max(4 * found.std, 1e-12)


# --- what does not go together


@pytest.mark.parametrize(
    ("names", "tables", "said"),
    [
        ("coulomb", [told("coulomb", fix={"F": 1.0})], '[[effect]] "coulomb": unknown parameter "F"; known are F_c'),
        (
            "coulomb",
            [told("colomb", fix={"F": 1.0})],
            '[[effect]] "colomb": expected the name of an effect but got "colomb',
        ),
        ("coulomb", [told("coulomb", fix={"F_c": -1.0})], "fix: expected F_c between 0 and inf N but got -1"),
        (
            "coulomb",
            [told("coulomb", fix={"F_c": 5.0}, bounds={"F_c": [6, 9]})],
            "expected F_c between 6 and 9 N but got 5",
        ),
        (
            "coulomb",
            [told("coulomb", bounds={"F_c": [9, 6]})],
            "expected the lower bound of F_c below the upper one but",
        ),
        (
            "coulomb",
            [told("coulomb", prior={"F_c": [9, 0]})],
            "prior: expected [mean, standard deviation above 0] of F_c",
        ),
        (
            "coulomb",
            [told("coulomb", prior={"F_c": [-9, 1]})],
            "prior: expected a mean of F_c between 0 and inf N but got -9",
        ),
        (
            "coulomb",
            [told("coulomb", fix={"F_c": 8}, prior={"F_c": [8, 1]})],
            "expected no prior of F_c, which is fixed and",
        ),
        (
            "coulomb",
            [told("coulomb", fix={"F_c": 8}, tie={"F_c": "slope.F"})],
            "expected F_c to be either fixed or tied",
        ),
        (
            "coulomb",
            [told("coulomb", tie={"F_c": "slope"})],
            'tie: expected another parameter for F_c, as in "vibration.fr',
        ),
        (
            "coulomb",
            [told("coulomb", tie={"F_c": "slope.F"})],
            "F_c follows slope.F but the model is coulomb; add slope, or",
        ),
        ("coulomb,slope", [told("coulomb", tie={"F_c": "slope.G"})], 'unknown parameter "G" of slope; known are F'),
        ("coulomb,viscous", [told("coulomb", tie={"F_c": "viscous.F_v"})], "F_c is in N but viscous.F_v is in N s/m"),
        ("coulomb", [told("coulomb", tie={"F_c": "coulomb.F_c"})], "a free parameter but F_c leads back in a circle"),
        (
            "coulomb,slope",
            [told("coulomb", tie={"F_c": "slope.F"}), told("slope", tie={"F": "coulomb.F_c"})],
            '[[effect]] "coulomb": tie: expected a tie that ends at a free parameter but F_c leads back in a circle',
        ),
        (
            "tustin",
            [told("coulomb", tie={"F_c": "stribeck.F_s"})],
            "stribeck.F_s is fitted relative to another parameter",
        ),
        (
            "tustin",
            [told("stribeck", bounds={"F_s": [9, 12]})],
            "cannot be held between bounds; give prior = {F_s = [mean",
        ),
        ("coulomb", [told("coulomb"), told("coulomb")], "expected one table for each effect but got two"),
        ("coulomb", [told("coulomb", formula="F*x")], "expected a name of its own for a formula"),
        ("coulomb", [told("coulomb", units={"F_c": "N"})], "expected units only beside a formula"),
    ],
)
def test_settings_that_do_not_go_together_are_refused_in_one_sentence(names, tables, said):
    with pytest.raises(FrictrackError) as caught:
        model(names, *tables)
    assert said in str(caught.value)
    assert caught.value.usage


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"fix": {"F": 1}}, "[[effect]]: expected the key effect but it is missing"),
        ({"effect": "coulomb", "fixed": {"F": 1}}, '[[effect]] "coulomb": unknown key "fixed"'),
        ({"effect": "coulomb", "fix": 3}, "expected fix as a table {name = value} but got 3"),
        ({"effect": "coulomb", "fix": {"F_c": True}}, "expected F_c of fix as a number but got true"),
        ({"effect": "coulomb", "prior": {"F_c": [1]}}, "expected F_c of prior as a list of 2 or more values but got"),
        ({"effect": "coulomb", "tie": {"F_c": 3}}, "expected F_c of tie as a text in quotes but got 3"),
        ({"effect": "coulomb", "formula": 3}, "expected formula as a text in quotes but got 3"),
    ],
)
def test_a_table_of_the_wrong_kind_is_told(table, said):
    with pytest.raises(FrictrackError) as caught:
        settings.read_settings(table)
    assert said in str(caught.value)


def test_settings_of_an_effect_that_is_not_there_wait():
    table = told("texture", fix={"period": 0.03})
    law = model("tustin", table)
    assert law == models.tustin()
    assert (law + "texture").adjusted([table]).effects[-1].parameter("period").fixed == 0.03


def test_removing_a_leader_is_told(lines):
    law = model("coulomb,vibration,vibration:2", told("vibration:2", tie={"frequency": "2*vibration.frequency"}))
    with pytest.raises(
        FrictrackError, match=r"frequency follows vibration.frequency but the model is coulomb, vibration:2"
    ):
        ft.fit(law - "vibration", lines)


# --- a study file


STUDY = """
[[effect]]
effect = "magnet"
formula = "L * s * F * exp(-((x - x_c)/w)^2 / 2)"
units = {F = "N", x_c = "m", w = "m"}
bounds = {w = [0.002, 0.05]}
fix = {x_c = 0.12}

[[effect]]
effect = "viscous"
prior = {F_v = [0.4, 0.001]}

[[effect]]
effect = "drag"
fix = {c = 0.0}
"""


@pytest.fixture
def study_of_its_own(study_file):
    with study_file.open("a") as f:
        f.write(STUDY)
    return study_file


def test_a_study_files_effects_are_fitted_kept_and_brought_back(study_of_its_own):
    work = Session(open_study(study_of_its_own))
    first = work.fit()
    assert first["parameters"]["viscous.F_v"]["std"] < 0.0011
    added = work.add("magnet")
    assert added["parameters"]["magnet.x_c"] == {"value": 0.12, "std": 0.0, "unit": "m", "at_bound": False} | {
        "reason": "fixed"
    }
    assert abs(added["parameters"]["magnet.F"]["value"]) < 4 * added["parameters"]["magnet.F"]["std"]
    told = Session(open_study(study_of_its_own)).history()["models"]
    assert [m["name"] for m in told] == ["1_coulomb+viscous", "2_coulomb+viscous+magnet"]
    assert told[0]["settings"] == ["viscous.F_v known as 0.4 ± 0.001 N s/m"]
    assert "magnet.x_c = 0.12 m" in told[1]["settings"]
    back = Session(open_study(study_of_its_own)).models
    assert back.fit("2_coulomb+viscous+magnet").parameters["magnet.F"].value == pytest.approx(
        added["parameters"]["magnet.F"]["value"], rel=1e-12
    )


@pytest.mark.parametrize(("written", "fixed"), [("0", 0.0), ("0.0", 0.0), ("1", 1.0), ("false", False)])
def test_a_parameter_may_be_fixed_at_zero(study_file, written, fixed):
    """Zero is a value and frees nothing, although it equals false in Python."""
    study_file.write_text(f'{study_file.read_text()}\n[[effect]]\neffect = "viscous"\nfix = {{F_v = {written}}}\n')
    found = open_study(study_file).effects[0].fix["F_v"]
    assert (found, type(found)) == (fixed, type(fixed))


def test_a_study_files_own_effects_are_listed_and_its_model_is_read_alone(study_of_its_own):
    listed = catalogue(user_effects(open_study(study_of_its_own).effects))
    entry = next(e for e in listed if e["name"] == "magnet")
    assert [p["name"] for p in entry["parameters"]] == ["F", "x_c", "w"]
    assert entry["equation"] == "L * s * F * exp(-((x - x_c)/w)^2 / 2)"
    law = models.from_toml(study_of_its_own)
    assert law.names == ["coulomb", "viscous"]
    assert law.effects[1].parameter("F_v").prior == (0.4, 0.001)


def test_the_effects_that_a_new_study_file_shows_can_be_switched_on(study_file):
    """Each key of the commented example by itself: together they would contradict each other."""
    text = files("frictrack").joinpath("study", "optional_keys.toml").read_text(encoding="utf-8")
    said = text[text.index("# Settings of an effect") :].replace("# ", "").splitlines()
    lines = [line for line in said if re.match(r"\[\[effect|\w+ = ", line)]
    cut = [i for i, line in enumerate(lines) if line == "[[effect]]"]
    bare = study_file.read_text()
    keys = [re.split(r"\s{3,}", line)[0] for line in lines]
    assert len(cut) == 3
    for key in keys[2 : cut[1]]:
        study_file.write_text(f"{bare}\n{keys[0]}\n{keys[1]}\n{key}\n")
        assert open_study(study_file).effects[0].effect == "vibration"
    study_file.write_text(bare + "\n" + "\n".join(keys[cut[1] :]))
    assert [e.name for e in user_effects(open_study(study_file).effects)] == ["magnet"]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('formula = "L * s', 'formula = "L * s * open(x)', '[[effect]] "magnet": expected a function among sin, cos'),
        (
            "fix = {x_c = 0.12}",
            "fix = {x_k = 0.12}",
            '[[effect]] "magnet": unknown parameter "x_k"; did you mean "x_c"?',
        ),
        ('w = "m"}', 'w = "mm"}', '[[effect]] "magnet": units: expected an SI unit of w, such as "m"'),
        (
            'effect = "drag"',
            'effect = "drog"',
            '[[effect]] "drog": expected the name of an effect but got "drog"; did you',
        ),
        (
            "prior = {F_v = [0.4, 0.001]}",
            'prior = {F_v = "0.4"}',
            '"viscous", line 28: expected F_v of prior as a list',
        ),
        (
            "prior = {F_v = [0.4, 0.001]}",
            "fix = {F_v = true}",
            '[[effect]] "viscous", line 28: expected F_v of fix as a number but got true',
        ),
        (
            "prior = {F_v = [0.4, 0.001]}",
            "per_run = {F_v = 3}",
            '[[effect]] "viscous", line 28: per_run: expected [param',
        ),
        (
            "prior = {F_v = [0.4, 0.001]}",
            'tie = {F_v = "drag.c"}',
            '[[effect]] "viscous": tie: F_v follows drag.c but the',
        ),
    ],
)
def test_a_fault_in_a_study_file_names_its_table(study_of_its_own, old, new, said):
    text = study_of_its_own.read_text()
    assert old in text
    study_of_its_own.write_text(text.replace(old, new))
    with pytest.raises(FrictrackError) as caught:
        open_study(study_of_its_own)
    assert said in str(caught.value)
    assert caught.value.usage


def test_newtons_say_nothing_before_an_unknown_mass_is_known():
    with pytest.raises(
        FrictrackError, match=r"no bounds of coulomb.F_c where the mass is fitted too.*give prior = {F_c"
    ):
        ft.fit(model("coulomb,viscous", told("coulomb", bounds={"F_c": [6, 9]})), [driven()])
    weight = told("weight", formula="mu * mass * g", units={"mu": "1"})
    with pytest.raises(FrictrackError, match="expected the mass of every run, which the formula uses; give mass"):
        ft.fit(model("coulomb,viscous,weight", weight), [driven()])
