"""Fixed values and common places that the runs contradict: named like any effect, freed by `add`."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import frictrack as ft
from frictrack import effects
from frictrack.base.errors import FrictrackError
from frictrack.effects import models
from frictrack.flow import Session, open_study
from frictrack.results.verdicts import describe_verdict


def study(folder, head, tables, run=()):
    """A study of tables (n, k) with a header each."""
    text = ["[study]", *head]
    for name, (columns, rows) in tables.items():
        np.savetxt(folder / f"{name}.csv", rows, delimiter=",", header=columns, comments="", fmt="%.8f")
        text += ["[[run]]", f'name = "{name}"', f'table = "{name}.csv"', *run]
    (folder / "study.toml").write_text("\n".join(text) + "\n")
    return Session(open_study(folder / "study.toml"))


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Friction of a bench at 28 constant speeds whose Stribeck exponent is 2."""
    rng = np.random.default_rng(1)
    v = np.concatenate([-np.geomspace(1, 0.01, 14), np.geomspace(0.01, 1, 14)]).repeat(8)
    force = np.sign(v) * (0.6 + 1.6 * np.exp(-((v / 0.09) ** 2))) + 0.6 * v + 0.02 * rng.standard_normal(len(v))
    rows = np.column_stack([0.05 * np.arange(len(v)), np.cumsum(v * 0.05), force])
    folder = tmp_path_factory.mktemp("bench")
    table = {"bench": ("t_s,x_m,friction_N", rows)}
    return study(folder, ['model = "tustin"'], table, ['normal_load = "9.8 N"'])


@pytest.fixture(scope="module")
def swings(tmp_path_factory):
    """Two records of swings whose origins are 12 mm apart."""
    rng = np.random.default_rng(2)
    t, tables = np.arange(0, 2, 0.01), {}
    for name, start, origin in (("first", 0.08, 0.0), ("second", 0.06, 0.012)):
        x = solve_ivp(lambda t, z: [z[1], -(14.0 * z[0] + 0.1 * z[1])], (0, 2), [start, 0.0], t_eval=t, rtol=1e-10).y[0]
        tables[name] = ("t_s,x_m", np.column_stack([t, x + origin + 5e-5 * rng.standard_normal(len(t))]))
    folder = tmp_path_factory.mktemp("swings")
    return study(folder, ['mass = "1 kg"', 'model = ["spring", "viscous"]'], tables)


def test_a_fixed_exponent_that_is_wrong_is_named_before_anything_is_invented(bench):
    found = bench.diagnose(quick=True)
    named = [*found["missing"], *found["leads"]]
    assert named[0] == "stribeck.delta"
    first = found["candidates"][0]
    assert first["parameters"]["delta"]["value"] == pytest.approx(2.0, abs=0.1)
    assert "delta of stribeck is held at 1" in first["words"]["what"]


def test_adding_an_address_frees_it_and_removing_it_holds_it_again(bench):
    change = bench.add("stribeck.delta")
    assert change["parameters"]["stribeck.delta"]["value"] == pytest.approx(2.0, abs=0.1)
    assert change["error_after"]["rms_N"] < 0.5 * change["error_before"]["rms_N"]
    again = bench.remove("stribeck.delta")
    assert again["parameters"]["stribeck.delta"]["reason"] == "fixed"


def test_records_of_two_origins_need_an_origin_each(swings):
    found = swings.diagnose(quick=True)
    assert (found["verdict"], found["missing"]) == ("missing", ["spring.x_0"])
    fitted = swings.add("spring.x_0")
    x_0 = [fitted["parameters"][f"spring.x_0[{name}]"]["value"] for name in ("first", "second")]
    assert x_0[0] - x_0[1] == pytest.approx(0.012, abs=1e-4)
    assert fitted["error_after"]["reduced_chi2"] == pytest.approx(1.0, abs=0.2)


def test_an_address_is_taken_wherever_a_name_of_an_effect_is():
    freed = models.tustin() + "stribeck.delta"
    assert freed.names == models.tustin().names
    assert freed.settings == ["stribeck.delta free"]
    assert effects.get("spring.x_0").parameter("x_0").per_run
    with pytest.raises(FrictrackError, match="expected the name of an effect"):
        effects.get("stribeck.nothing")


def test_what_explains_a_part_only_is_a_lead():
    found = {"verdict": "unexplained", "missing": [], "leads": ["patch", "drag"], "candidates": []}
    assert describe_verdict(found, "Tustin").endswith("; patch and drag explain a part of it: leads, no causes")
    assert describe_verdict(found | {"leads": []}, "Tustin").endswith("no effect of the library explains")


def test_a_worn_place_just_before_a_stop_is_a_cause():
    """The patch lies at the end of the travelled span: its flank alone is felt."""
    span = ft.fit(["coulomb", "viscous"], ft.samples.runs()[:1]).solution.problem.layout.span
    check = effects.get("patch").plausible
    width = 0.01
    assert check({"F": 1.0, "x_c": span.x_max + 0.9 * width, "w": width}, span) == ""
    assert "lies off the course" in check({"F": 1.0, "x_c": span.x_max + 1.1 * width, "w": width}, span)


def test_the_json_of_a_diagnosis_holds_leads(bench):
    assert json.loads(json.dumps(bench.diagnose(quick=True)))["leads"] is not None
