"""What a command says of its result is a finding about this result."""

import pytest

from frictrack.cli.common import after_diagnosis, after_fit


@pytest.mark.parametrize(("chi2", "said"), [(563.0, "misses the data by 23.7 times"), (1.03, "as large as the noise")])
def test_a_fit_is_judged_by_what_it_leaves(chi2, said):
    assert said in after_fit({"errors": {"reduced_chi2": chi2}}, "study.toml")


def test_fits_of_groups_are_not_judged_as_one():
    assert "by group" in after_fit({"groups": {}}, "study.toml")


def test_leads_are_not_proposed_as_causes():
    formula = {"formula": "0.1 N tanh(x)", "toml": "[[effect]]", "share": 0.999, "delta_bic": 4000.0}
    found = {"verdict": "unexplained", "missing": [], "leads": ["patch"], "unexplained": {"formulas": [formula]}}
    assert "add study.toml formula:1 adds its first formula" in after_diagnosis(found, "study.toml")
    assert "patch" not in after_diagnosis(found | {"unexplained": None}, "study.toml")


def test_other_levels_are_no_next_step_while_a_mass_is_open():
    found = {"verdict": "complete", "missing": [], "levels": ["viscous.level"]}
    assert "add study.toml viscous.level" in after_diagnosis(found, "study.toml")
    gap = {"what": "the mass of v5", "why": "", "settled_by": "weigh it again"}
    assert "level" not in after_diagnosis(found | {"verdict": "undetermined", "undetermined": [gap]}, "study.toml")
