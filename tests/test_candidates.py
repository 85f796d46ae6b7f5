"""The one list of candidates, and that terminal, report, page and figure show it alike."""

import io
from dataclasses import replace

import pytest
from rich.console import Console
from test_plots import bars, candidate, diagnosis, results

from frictrack.cli.output import verdict
from frictrack.present import plots, report
from frictrack.present.report import tables
from frictrack.results.candidates import STANDINGS, candidate_rows, not_passing
from frictrack.results.verdicts import VERDICTS
from frictrack.workbench.summaries.models import verdict_of


@pytest.fixture
def found():
    """Two effects found one after the other, a rival of the second, and others alone."""
    return diagnosis(
        "ambiguous",
        [
            candidate("patch", 0.001, 44000.0),
            candidate("asymmetry", 0.001, 300.0, ["slope"]) | {"heldout_rms_after_um": 7.0},
            candidate("drag", 0.4, 3.0) | {"passes": False},
            candidate("spring", 0.001, 200.0) | {"passes": False},
            candidate("presliding", 0.001, 41000.0),
            candidate("slope", 0.012, 419.0) | {"passes": False},
            candidate("lens", 0.001, -560.0) | {"passes": False},
            candidate("texture", 0.001, 90.0) | {"passes": False, "implausible": "1.1 periods"},
        ],
        ["patch", "asymmetry"],
    )


def test_order_and_words_of_the_list(found):
    told = [(row.effect, row.kind, row.standing) for row in candidate_rows(found)]
    assert told == [
        ("patch", "named", "found"),
        ("asymmetry", "named", "found in addition to patch"),
        ("slope", "rival", "predicts the same data as asymmetry"),
        ("presliding", "weaker", "passes alone, 3000 behind the best"),
        ("spring", "fails", "explains less than patch"),
        ("drag", "fails", "not significant"),
        ("texture", "implausible", "not plausible: 1.1 periods"),
    ]  # lens has no positive evidence


def test_error_without_an_effect_is_that_with_the_effects_before_it(found):
    rows = candidate_rows(found)
    assert rows[0].held_out == "21.2 to 10.2 µm"
    assert rows[1].held_out == "10.2 to 7.00 µm"


def test_no_p_value_is_smaller_than_the_simulated_studies_allow(found):
    rows = candidate_rows(found)
    assert rows[0].evidence.startswith("p at most 1/1000, delta BIC +44")
    assert next(row for row in rows if row.effect == "slope").p == "0.012"


def test_leads_are_no_finds():
    found = diagnosis("unexplained", [candidate("patch", 0.001, 300.0)]) | {"leads": ["patch"]}
    assert [(row.kind, row.standing) for row in candidate_rows(found)] == [("lead", "explains a part")]


def test_every_surface_shows_the_same_order_and_words(found):
    rows = candidate_rows(found)
    names = [row.effect for row in rows]
    assert list(bars(plots.candidates(found))) == names
    report = [row for table in tables.candidate_table(rows) for row in table.rows]
    assert [str(row[0]).rpartition("<code>")[2].removesuffix("</code>") for row in report] == names
    assert [row[1] for row in report] == [row.standing for row in rows]
    out = Console(file=io.StringIO(), width=200)
    verdict(out, found)
    text = out.file.getvalue()
    at = [text.index(f"\n{name}: ") for name in names[:4]]
    assert at == sorted(at)
    for row in rows[:4]:
        assert row.standing in text
    assert (
        not_passing(rows)
        == "Of the others with some evidence, 2 explain less or are not significant and 1 is not plausible."
    )
    assert not_passing(rows) in text


def test_words_changed_in_one_place_change_everywhere(found, monkeypatch):
    monkeypatch.setitem(VERDICTS, "ambiguous", "{model} wants {what}")
    monkeypatch.setitem(STANDINGS, "named", "was seen")
    seen, words, standing = (
        results(),
        "Coulomb + viscous wants patch, and asymmetry or slope",
        "was seen in addition to patch",
    )
    current = replace(seen.models[0], name="1_coulomb+viscous", diagnosis=found, current=True)
    seen = replace(seen, models=(current,), diagnosis=found)
    out = Console(file=io.StringIO(), width=200)
    verdict(out, found)  # of the JSON
    page = verdict_of(seen, current)
    cards = [row.standing for row in candidate_rows(found)]
    assert (page["title"], cards[1]) == (words, standing)
    assert plots.verdict(seen).get_suptitle() == words  # the figure of a diagnosis in a notebook
    for shown in (out.file.getvalue(), report.render(seen)):
        assert words in shown
        assert standing in shown


def test_no_standing_is_broken_on_a_narrow_terminal(found):
    out = Console(file=io.StringIO(), width=60)
    verdict(out, found)
    lines = out.file.getvalue().splitlines()
    assert "asymmetry: found in addition to patch" in lines
    assert max(map(len, lines)) <= 60


def test_an_effect_that_lowers_the_error_only_with_a_later_one_says_so():
    errors = {"patch": (0.164, 0.304), "asymmetry": (0.164, 0.113)}
    some = {"p": 0.001, "delta_bic": 300.0, "passes": True, "indistinguishable_from": [], "acts_on": "force"}
    candidates = [
        some | {"effect": name, "heldout_rms_before_N": before, "heldout_rms_after_N": after}
        for name, (before, after) in errors.items()
    ]
    patch, asymmetry = candidate_rows({"candidates": candidates, "missing": ["patch", "asymmetry"]})
    assert patch.error == "held-out error 0.164 to 0.304 N alone, but 0.113 N with asymmetry as well"
    assert asymmetry.error == "held-out error 0.304 to 0.113 N"
