"""What a fit shows and answers: printed summary, notebook table, intervals, information criteria, wrong addresses."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

import frictrack as ft
from frictrack.fit import Fit, UncertaintyAnalysis, with_uncertainty


@pytest.fixture(scope="module")
def fit() -> Fit:
    """A model with a patch, which is what the sample runs contain."""
    return ft.fit(["coulomb", "viscous", "patch"], ft.samples.runs()[:2])


@pytest.mark.parametrize(
    ("asked", "nearest"), [("patch.f", "patch.F"), ("coulomb.Fc", "coulomb.F_c"), ("patch.xc", "patch.x_c")]
)
def test_a_wrong_address_lists_the_nearest_parameters(fit, asked, nearest):
    with pytest.raises(KeyError) as caught:
        fit.parameters[asked]
    assert str(caught.value).startswith(f'expected a parameter of the fit but got "{asked}"; did you mean {nearest}')
    assert isinstance(caught.value, ft.FrictrackError)


def test_printed_parameters_are_a_line_each_and_a_symbol_alone_names_its_address(fit):
    lines = repr(fit.parameters).splitlines()
    assert [line.split()[0] for line in lines] == list(fit.parameters)
    assert lines[3].endswith(f"  {fit.parameters['patch.x_c']}")
    with pytest.raises(KeyError, match=r"did you mean patch\.x_c"):
        fit.parameters["x_c"]


def test_a_prediction_without_runs_is_that_of_the_fitted_ones(fit):
    assert [(seen.run, seen.role) for seen in fit.predict()] == [(run.name, "fit") for run in fit.runs]


def test_an_address_like_no_other_lists_all_parameters(fit):
    with pytest.raises(KeyError, match=r"it has coulomb\.F_c, viscous\.F_v, patch\.F, patch\.x_c, patch\.w"):
        fit.parameters["mass"]
    assert fit.parameters.get("mass") is None
    assert "mass" not in fit.parameters


def test_intervals_are_normal_quantiles_of_the_standard_deviation(fit):
    found, estimate = fit.conf_int(0.1), fit.parameters["patch.x_c"]
    expected = norm.interval(0.9, estimate.value, estimate.reported_std)
    np.testing.assert_allclose(found.loc["patch.x_c"], expected, rtol=1e-12)
    assert list(found.index) == list(fit.parameters)
    assert list(found.columns) == ["lower", "upper"]


def test_a_profile_replaces_the_interval_of_its_level(fit):
    profile = ft.profile(fit, "patch.w")
    known = with_uncertainty(fit, UncertaintyAnalysis((profile,)))
    assert known.conf_int().loc["patch.w"].tolist() == [profile.low, profile.high]
    assert known.conf_int(0.1).equals(fit.conf_int(0.1))
    open_above = with_uncertainty(fit, UncertaintyAnalysis((replace(profile, high=None),)))
    assert open_above.conf_int().loc["patch.w", "upper"] == np.inf


def test_an_undetermined_parameter_has_no_interval():
    fit = ft.fit("stribeck-model", [ft.samples.runs()[0]])
    unknown = [name for name, e in fit.parameters.items() if e.value is None]
    assert unknown
    assert fit.conf_int().loc[unknown].isna().all(axis=None)


def test_alpha_is_checked(fit):
    with pytest.raises(ft.FrictrackError, match=r"alpha between 0 and 1, such as 0\.05, but got 95"):
        fit.conf_int(95)


def test_information_criteria_are_those_of_independent_noise(fit):
    chi2 = sum(np.sum((curve.residual / curve.sigma_x) ** 2) for curve in fit.curves)
    n = sum(len(curve) for curve in fit.curves)
    k = 5 + 1 + 2 * 2  # shared parameters; level of the second run over that of the first; x0 and v0 of both
    assert fit.aic == pytest.approx(chi2 + 2 * k, rel=1e-6)
    assert fit.bic == pytest.approx(chi2 + k * np.log(n), rel=1e-6)


def test_the_better_model_has_the_smaller_criteria(fit):
    poorer = ft.fit(["coulomb", "viscous"], fit.runs)
    assert poorer.aic > fit.aic
    assert poorer.bic > fit.bic


def test_accelerations_have_no_information_criteria(fit):
    papers = ft.fit(["coulomb", "viscous"], fit.runs, domain="force")
    with pytest.raises(ft.FrictrackError, match='fit without domain = "force"'):
        _ = papers.bic


def test_the_summary_is_json_and_prints_a_table(fit):
    summary = fit.summary()
    lines = str(summary).splitlines()
    assert json.loads(json.dumps(summary)) == summary
    assert lines[0] == "Fit of coulomb + viscous + patch (displacement domain, varpro)"
    row = next(line for line in lines if line.startswith("patch.x_c"))
    assert row.split() == ["patch.x_c", *str(fit.parameters["patch.x_c"]).split()]
    assert any(line.startswith("reduced_chi2 ") for line in lines)


def test_groups_print_and_show_all_parameters(fit):
    runs = [replace(run, group=run.name) for run in fit.runs]
    groups = ft.fit(["coulomb", "viscous"], runs, per="group")
    for text in (str(groups.summary()), groups._repr_html_()):
        assert "coulomb.F_c[fast]" in text
        assert "coulomb.F_c[slow]" in text


def test_a_notebook_shows_a_table_of_the_parameters(fit):
    page = fit._repr_html_()
    assert page.startswith("<table>")
    assert f"<th>patch.x_c</th><td>{fit.parameters['patch.x_c']}</td>" in page
    assert "±" in page


def test_a_model_prints_its_effects():
    assert repr(ft.models.tustin() + "texture") == "<Model: coulomb + stribeck + viscous + texture>"
