"""The glossary: one file for the documentation, the page, the report and the terminal."""

import re
from pathlib import Path

import pytest

from frictrack import effects
from frictrack.base.glossary import find_terms, hover_pattern, meaning_of, near_words, symbols_in, terms
from frictrack.cli import main
from frictrack.effects import models
from frictrack.present.report.tables import explain_words


@pytest.mark.parametrize(
    "word", ["held out", "delta BIC", "reduced chi-squared", "free run", "peak locking", "p-value", "misfit", "Tustin"]
)
def test_words_that_a_student_does_not_know_are_explained(word):
    assert len(find_terms(word)) == 1
    assert hover_pattern().fullmatch(word)
    assert len(meaning_of(word.upper())) > 20


def test_case_hyphens_and_plurals_do_not_matter():
    assert find_terms("Held-out  errors") == find_terms("held out")
    assert hover_pattern().findall("Free runs and misfits, but no freerunner") == ["Free run", "misfit"]


def test_no_word_stands_twice():
    words = [word.lower() for term in terms() for word in term.words if len(word) > 1]
    assert sorted(words) == sorted(set(words))


def test_the_documentation_shows_the_same_file():
    page = Path(__file__).parent.parent / "docs" / "glossary.md"
    assert "{include} ../frictrack/base/glossary.md" in page.read_text(encoding="utf-8")


def test_the_terminal_explains_words_and_effects_and_offers_near_ones(capsys):
    for word in ("Held-Out", "patch"):
        with pytest.raises(SystemExit):
            main(["explain", word])
    told = capsys.readouterr().out
    assert "held-out error" in told
    assert "frictrack effects patch" in told
    assert near_words("patsh", ["patch"]) == ["patch"]
    assert near_words("locking") == ["peak locking"]
    assert near_words("") == near_words("?!") == []


def test_a_word_is_explained_once_in_a_section_and_never_in_a_figure_or_a_tag():
    html = (
        '<h1>misfit</h1><p title="a misfit">misfit, misfit</p><svg><text>misfit</text></svg><section>misfit</section>'
    )
    told = explain_words(html)
    assert told.count("<abbr") == 2
    assert re.sub(r"<abbr[^>]*>|</abbr>", "", told) == html


def test_every_single_letter_of_every_equation_that_is_no_parameter_is_explained():
    for effect in (effects.get(name) for name in ("coulomb", "patch", "drift", "drag", "slope", "run_in")):
        text = models.of([effect.name]).equation()
        legend = symbols_in(text)
        own = {p.name for p in effect.parameters}
        letters = set(re.findall(r"(?<![\w,])[A-Za-z](?![\w,])", text)) - own - {"m"}
        assert all(f"{one}: " in legend for one in letters), (effect.name, letters, legend)
