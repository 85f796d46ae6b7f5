"""Trends of laws over conditions, on campaigns of known truth."""

from __future__ import annotations

import numpy as np
import pytest

import frictrack as ft
from frictrack.base.errors import FrictrackError
from frictrack.flow.batch import batch, condition_trends, read_condition
from frictrack.flow.batch.tasks import StudyOutcome
from frictrack.study import load

NAMES, UNITS = ("coulomb.F_c", "viscous.F_v"), ("N", "N s/m")
AT_0, SLOPE = np.array([1.0, 0.5]), np.array([0.004, -0.002])
N_CAMPAIGNS, N_STUDIES = 200, 8


def law(values, covariance, load=3.0):
    return ft.Prior(NAMES, tuple(values), tuple(map(tuple, covariance)), UNITS, (True, False), load, model=("a",))


def campaign(rng, tau, at, mean):
    """Laws of one study per condition: true parameters scatter by tau, estimates by a correlated covariance."""
    laws = []
    for c in at:
        std = np.array([0.02, 0.015]) * rng.uniform(0.5, 1.5)
        covariance = np.outer(std, std) * np.array([[1, -0.9], [-0.9, 1]])
        laws.append(law(rng.multivariate_normal(mean(c) + tau * rng.normal(size=2), covariance), covariance))
    return laws


@pytest.mark.slow
@pytest.mark.parametrize("tau", [0.0, 0.02, 0.1])
def test_intervals_hold_the_truth_as_often_as_they_say(tau):
    rng, at = np.random.default_rng(7), np.linspace(20, 90, N_STUDIES)
    inside = {"at 0": [], "slope": [], "scatter": [], "new study": []}
    for _ in range(N_CAMPAIGNS):
        found = ft.trend(campaign(rng, tau, at, lambda c: AT_0 + SLOPE * c), list(at), "temperature")
        for k, name in enumerate(NAMES):
            one = found[name]
            for term, truth, (low, high) in zip(one.terms, (AT_0[k], SLOPE[k]), one.intervals, strict=True):
                inside[term].append(low <= truth <= high)
            inside["scatter"].append(one.scatter_interval[0] <= tau <= one.scatter_interval[1])
            low, high = one.predict(60.0).interval
            inside["new study"].append(low <= AT_0[k] + 60 * SLOPE[k] + tau * rng.normal() <= high)
    shares = {term: np.mean(hits) for term, hits in inside.items()}
    assert 0.92 <= shares["at 0"] <= 0.98
    assert 0.92 <= shares["slope"] <= 0.98
    assert shares["scatter"] >= 0.92
    assert shares["new study"] >= 0.92  # above 0.98 where tau is far below the noise, which cannot be known


@pytest.mark.slow
def test_categories_are_compared_and_the_p_value_is_fair():
    rng, at = np.random.default_rng(3), ["steel", "brass"] * 4
    true = {"steel": np.array([1.0, 0.5]), "brass": np.array([1.2, 0.5])}
    inside, rejected = [], []
    for _ in range(2 * N_CAMPAIGNS):
        found = ft.trend(campaign(rng, 0.02, at, true.__getitem__), at, "material")
        for term, (low, high) in zip(found[NAMES[0]].terms, found[NAMES[0]].intervals, strict=True):
            inside.append(low <= true[term][0] <= high)
        rejected.append(found[NAMES[1]].p < 0.05)
    assert 0.92 <= np.mean(inside) <= 0.98
    assert np.mean(rejected) <= 0.05 + 2.6 * np.sqrt(0.05 * 0.95 / (2 * N_CAMPAIGNS))
    assert found[NAMES[0]].p < 0.01
    assert found[NAMES[0]].predict("brass").value == found[NAMES[0]].coefficients[1]
    with pytest.raises(FrictrackError, match='expected one of steel, brass but got "gold"'):
        found[NAMES[0]].predict("gold")


def test_without_scatter_it_is_weighted_least_squares():
    at, std = np.array([1.0, 2.0, 4.0, 5.0, 7.0]), np.array([0.1, 0.2, 0.1, 0.3, 0.1])
    y = 2.0 + 0.5 * at + 0.01 * np.array([1, -1, 0, 1, -1])
    laws = [ft.Prior(("drag.c",), (v,), ((s**2,),), ("N s^2/m^2",), (False,)) for v, s in zip(y, std, strict=True)]
    found = ft.trend(laws, list(at))["drag.c"]
    np.testing.assert_allclose(found.coefficients, np.polyfit(at, y, 1, w=1 / std)[::-1], rtol=1e-6)
    assert found.scatter == pytest.approx(0, abs=1e-3)
    assert found.scatter_interval[0] == 0.0


def test_scatter_and_its_deviation_are_those_of_the_closed_form_for_equal_deviations():
    """REML of a line with equal s: s^2 + tau^2 = sum of squares / (n - 2), known to sqrt(2 / (n - 2)) of itself."""
    at, s, n = np.arange(9.0), 0.05, 9
    y = 2.0 + 0.5 * at + 0.2 * np.random.default_rng(0).standard_normal(n)
    laws = [ft.Prior(("drag.c",), (v,), ((s**2,),), ("N s^2/m^2",), (False,)) for v in y]
    found = ft.trend(laws, list(at))["drag.c"]
    variance = np.sum((y - np.polyval(np.polyfit(at, y, 1), at)) ** 2) / (n - 2)
    tau = np.sqrt(variance - s**2)
    assert found.scatter == pytest.approx(tau, rel=1e-3)
    assert found.scatter_std == pytest.approx(np.sqrt(2 / (n - 2)) * variance / (2 * tau), rel=1e-3)


def test_forces_are_converted_to_one_load():
    laws = [law([0.3 * w + 0.0001 * i, 0.5 + 0.001 * i], np.diag([1e-4, 1e-4]), w) for i, w in enumerate((2, 3, 4, 6))]
    found = ft.trend(laws, [2.0, 3.0, 4.0, 6.0], "load")
    assert found.load == 2
    np.testing.assert_allclose(found[NAMES[0]].coefficients, [0.6, 0.0], atol=2e-3)


def test_a_parameter_of_too_few_studies_is_left_out():
    rng, at = np.random.default_rng(0), [1.0, 2.0, 3.0, 4.0, 5.0]
    laws = campaign(rng, 0.0, at, lambda c: AT_0 + SLOPE * c)
    short = [ft.Prior(("coulomb.F_c",), p.values[:1], ((p.covariance[0][0],),), ("N",), (True,), 3.0) for p in laws[2:]]
    found = ft.trend([*laws[:2], *short], at)
    assert list(found.trends) == ["coulomb.F_c"]
    assert found.left_out == {"viscous.F_v": "only 2 studies determine it; 4 are needed"}
    assert list(found.to_dataframe().loc["coulomb.F_c"].index) == ["at 0", "slope", "scatter"]


@pytest.mark.parametrize("at", [[1.0, 1.0, 1.0, 1.0], [1.0, "a", 2.0, 3.0], [1.0, np.nan, 2.0, 3.0], ["a"] * 4, [1, 2]])
def test_conditions_that_make_no_trend_are_refused(at):
    laws = campaign(np.random.default_rng(0), 0.0, [1, 2, 3, 4], lambda c: AT_0 + SLOPE * c)
    with pytest.raises(FrictrackError, match="expected"):
        ft.trend(laws, at)


# --- study files and batches


def outcome(i, conditions, model=("a",), text=None):
    made = law([1.0 + 0.1 * i, 0.5 + 0.001 * i**2], np.diag([1e-4, 1e-4]))
    made = ft.Prior(made.names, made.values, made.covariance, made.units, made.loaded, made.load, model=model)
    return StudyOutcome(f"s{i}", {}, [], conditions=conditions, law=made.to_toml() if text is None else text)


def test_studies_of_another_model_unit_or_with_a_prior_are_left_out():
    studies = [outcome(i, {"temperature": f"{10 * i} degC"}) for i in range(5)]
    studies += [outcome(5, {"temperature": "50 degC"}, model=("b",)), outcome(6, {"temperature": "60 degC"}, text="")]
    (found,) = condition_trends(studies)
    assert (found["unit"], found["left_out"]) == ("degC", ["s5", "s6"])
    assert found["trends"][0]["coefficients"]["slope"]["value"] == pytest.approx(0.01)
    assert found["trends"][0]["holds"]
    assert "coulomb.F_c changes by 0.01" in found["words"][0]
    (mixed,) = condition_trends([*studies[:4], outcome(4, {"temperature": "313 K"})])
    assert mixed["reason"] == "expected one unit of temperature but got K, degC"
    (few,) = condition_trends(studies[:2])
    assert few["trends"] == []
    assert condition_trends([outcome(0, {})]) == []
    assert read_condition("-1.5e2 mm") == (-150.0, "mm")


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ("3", "expected conditions as a table"),
        ('{"a b" = 1}', "expected a b of conditions as"),
        ("{a = [1]}", "expected a of conditions as a number"),
    ],
)
def test_wrong_conditions_are_told(tmp_path, value, said):
    (tmp_path / "r.csv").write_text("t_s,x_m\n")
    (tmp_path / "study.toml").write_text(f'[study]\nmass = 1\nconditions = {value}\n[[run]]\ntable = "r.csv"\n')
    with pytest.raises(FrictrackError, match=said):
        load(tmp_path)


@pytest.mark.slow
def test_a_campaign_over_temperatures_end_to_end(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    t, rng = np.arange(240) / 1000.0, np.random.default_rng(5)
    for i, temperature in enumerate((20, 35, 50, 65, 80)):
        folder = tmp_path / f"s{i}"
        folder.mkdir()
        force = 0.5 + 0.004 * temperature + 0.003 * rng.normal()
        x = 2.0 * t - 0.5 * force / 0.5 * t**2 + 5e-6 * rng.standard_normal(len(t))
        np.savetxt(folder / "r.csv", np.column_stack([t, x]), delimiter=",", header="t_s,x_m", comments="")
        (folder / "study.toml").write_text(
            f'[study]\nmass = 0.5\nmodel = ["coulomb"]\nconditions = {{temperature = "{temperature} degC"}}\n'
            '[[run]]\ntable = "r.csv"\n'
        )
    result = batch([str(tmp_path)], tmp_path / "all", workers=1)
    (found,) = result["conditions"]
    slope = found["trends"][0]["coefficients"]["slope"]
    assert slope["interval"][0] <= 0.004 <= slope["interval"][1]
    assert found["trends"][0]["p"] < 0.001
    assert "over temperature, coulomb.F_c changes by" in (tmp_path / "all.html").read_text()
    assert "condition temperature" in (tmp_path / "all.csv").read_text().splitlines()[0]
    again = batch([str(tmp_path)], tmp_path / "all", workers=1)
    assert (again["kept"], again["conditions"]) == (5, result["conditions"])
