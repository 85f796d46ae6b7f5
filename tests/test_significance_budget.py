"""The probability that any effect named in the whole work on a study is false is bounded and said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from frictrack.base.errors import FrictrackError
from frictrack.cli import main
from frictrack.flow import Session, SignificanceBudget, open_study
from frictrack.flow.command_history import (
    ALPHA_FIRST,
    CompletenessTest,
    alpha_spent,
    named_effects,
    plan_test,
    sequence_alpha,
)

BASE = ("coulomb", "viscous")


def finding(model: tuple[str, ...], *named: str, sequence: int = 1, data: str = "d") -> CompletenessTest:
    key = f"{data} {' '.join(model)} {sequence}"
    return CompletenessTest(
        key, data, model, sequence, sequence_alpha(sequence), named, "missing" if named else "complete"
    )


class TestSequences:
    def test_an_effect_that_was_named_is_tested_at_the_same_level(self):
        made = [finding(BASE, "texture", "drag")]
        for added in (("texture",), ("drag",), ("texture", "drag")):
            test = plan_test(made, "new", "d", (*BASE, *added))
            assert (test.sequence, test.alpha) == (1, ALPHA_FIRST)

    @pytest.mark.parametrize(
        ("data", "model"),
        [
            ("d", (*BASE, "spring")),  # not named
            ("d", ("coulomb", "texture")),  # not an extension
            ("other", (*BASE, "texture")),  # other data
            ("d", BASE),  # the same again with another seed
        ],
    )
    def test_any_other_model_is_an_alternative(self, data, model):
        test = plan_test([finding(BASE, "texture")], "new", data, model)
        assert (test.sequence, test.alpha) == (2, ALPHA_FIRST / 2)

    def test_only_one_extension_of_a_model_continues_its_sequence(self):
        made = [finding(BASE, "texture", "drag"), finding((*BASE, "texture"))]
        assert plan_test(made, "new", "d", (*BASE, "drag")).sequence == 2

    def test_a_complete_model_is_not_continued(self):
        assert plan_test([finding(BASE)], "new", "d", (*BASE, "texture")).sequence == 2

    def test_the_same_diagnosis_again_spends_nothing(self):
        made = [finding(BASE, "texture"), finding(("coulomb",), sequence=2)]
        again = plan_test(made, made[0].key, "d", BASE)
        assert again is made[0]
        assert alpha_spent([*made, again]) == pytest.approx(1.5 * ALPHA_FIRST)

    def test_six_sequences_spend_less_than_two_per_cent(self):
        assert sum(map(sequence_alpha, range(1, 7))) < 0.02


@pytest.mark.slow
def test_errors_of_a_session_stay_below_what_is_said():
    """Uniform p-values of complete models; a user who adds what is named, and tries other models until one is named."""
    rng, false_sessions, sessions, spent = np.random.default_rng(5), 0, 20_000, 0.0
    for _ in range(sessions):
        tests: list[CompletenessTest] = []
        model, wrong = ("true",), False
        for step in range(6):
            test = plan_test(tests, str(step), "d", model)
            named = (f"effect{step}",) if rng.uniform() < test.alpha else ()
            tests.append(CompletenessTest(test.key, "d", model, test.sequence, test.alpha, named))
            wrong |= bool(named)
            model = (*model, *named) if named else (*model[: rng.integers(1, 1 + len(model))], f"other{step}")
        false_sessions += wrong
        spent = max(spent, alpha_spent(tests))
    assert spent < 0.02
    bound = spent * sessions
    assert false_sessions < bound + 3 * np.sqrt(bound)
    assert false_sessions > 0.5 * bound  # the bound is not far from what happens


def test_effects_are_named_by_their_significance():
    candidates = [{"effect": "texture", "p": 0.001}, {"effect": "drag", "p": 0.2}, {"effect": "lens", "p": None}]
    diagnosis = {"alpha": 0.01, "candidates": candidates, "missing": ["patch"], "unexplained": {"formulas": [{}]}}
    assert named_effects(diagnosis) == ("patch", "texture", "unexplained")


class TestStudy:
    @pytest.fixture
    def session(self, study_file: Path) -> Session:
        return Session(open_study(study_file))

    @pytest.mark.slow
    def test_what_is_spent_is_kept_and_said(self, session: Session, capsys: pytest.CaptureFixture[str]):
        assert session.history()["tests"] == []
        first = session.diagnose(quick=True)
        assert (first["alpha"], first["alpha_spent"]) == (ALPHA_FIRST, ALPHA_FIRST)
        session.fit("coulomb")
        second = session.diagnose(quick=True)
        assert second["verdict"] != "complete"
        assert second["alpha"] == pytest.approx(ALPHA_FIRST / 2)
        session.add("viscous")  # it was named: the sequence goes on
        third = session.diagnose(quick=True)
        assert third["alpha"] == pytest.approx(ALPHA_FIRST / 2)
        assert third["alpha_spent"] == pytest.approx(1.5 * ALPHA_FIRST)
        history = Session(open_study(session.study.path)).history()
        assert [test["sequence"] for test in history["tests"]] == [1, 2, 2]
        assert history["alpha_spent"] == pytest.approx(1.5 * ALPHA_FIRST)
        with pytest.raises(SystemExit):
            main(["history", str(session.study.path)])
        printed = " ".join(capsys.readouterr().out.split())
        assert "3 diagnoses so far in 2 sequences" in printed
        assert "at most 1.5 %" in printed

    def test_a_damaged_file_is_said(self, session: Session):
        budget = SignificanceBudget(session.study.output)
        budget.path.parent.mkdir(parents=True, exist_ok=True)
        for text in ("{", '[{"key": 1}]', "[1]", '[{"key": 1, "data": "", "model": [], "sequence": 1, "alpha": 1}]'):
            budget.path.write_text(text)
            with pytest.raises(FrictrackError, match=r"tests\.json is damaged; delete it"):
                _ = budget.rows
