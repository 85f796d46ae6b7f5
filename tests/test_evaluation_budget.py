"""A search stops when its evaluations are spent, says so, and claims no more than it has compared."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from runs import BASE, HIDDEN, Spec, study

from frictrack import effects
from frictrack.cli import main
from frictrack.diagnose import Diagnosis, diagnose, search
from frictrack.diagnose.explanations import MAX_SIZE, Explanation, find_rivals
from frictrack.effects import models
from frictrack.fit import add_effect, fit, refine
from frictrack.flow import open_study, read_results
from frictrack.present.report.texts import findings_table
from frictrack.results import to_builtins
from frictrack.results.verdicts import VERDICTS
from frictrack.search import EvaluationBudget

LAW = ["coulomb", "viscous"]
SPECS = (Spec(3.0, 1, 0.05), Spec(5.0, 1, 0.05), Spec(4.0, 2, 0.05))
STOPPED = "the search stopped at its limit of"


@pytest.fixture(scope="module")
def recorded() -> list[Any]:
    """Runs of Coulomb and viscous friction with a texture that the law lacks."""
    law = {name: BASE[name] for name in LAW} | {"texture": HIDDEN["texture"]}
    return list(study(models.of(law), law, specs=SPECS, sigma=1e-5, rng=np.random.default_rng(1))[0])


@pytest.fixture
def granted(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A function that sets how many evaluations a whole search may take."""
    return lambda n: monkeypatch.setattr(search, "EVALUATIONS_PER_EFFECT", n / MAX_SIZE)


def remark(found: Diagnosis) -> str:
    return next((text for text in found.remarks if text.startswith(STOPPED)), "")


def test_a_fit_stops_at_its_budget_with_the_best_so_far(recorded: list[Any]) -> None:
    solution = fit(LAW, recorded).solution
    start = solution.p * np.array([0.5 if s.linear else 1.0 for s in solution.problem.layout.slots])

    def refined(granted: float) -> tuple[EvaluationBudget, float]:
        budget = EvaluationBudget(granted)
        found = refine(solution.problem.with_budget(budget), start, solution.starts, tau=solution.tau)
        return budget, found.objective

    (at_start, first), (few, cut), (many, whole) = (refined(n) for n in (1, 2, 1000))
    assert first > cut >= whole
    assert (at_start.used, few.used) == (1, 2)
    assert (at_start.was_cut, few.was_cut, many.was_cut) == (True, True, False)
    assert solution.problem.budget.granted == np.inf  # a fit outside a search has no limit


def test_a_normal_search_stays_far_below_its_limit(recorded: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    used: list[float] = []
    grant = EvaluationBudget.grant
    monkeypatch.setattr(
        EvaluationBudget, "grant", lambda self, n: (used.append(self.used / self.granted), grant(self, n))
    )
    found = diagnose(fit(LAW, recorded), quick=True)
    assert (found.verdict, found.missing, remark(found)) == ("missing", ["texture"], "")
    assert 0 < used[0] < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("limit", [1, 5])
def test_a_search_that_was_cut_says_so_and_claims_less(recorded: list[Any], granted: Any, limit: int) -> None:
    granted(limit)
    found = diagnose(fit(LAW, recorded))
    text = remark(found)
    assert text.startswith(f"{STOPPED} {limit} simulations of all runs, before ")
    assert text.endswith("add texture to the model and diagnose again")
    assert found.verdict in VERDICTS
    assert found.verdict != "missing" or "could be refined" not in text
    json.dumps(to_builtins(found.summary()), allow_nan=False)


def test_a_cut_search_can_be_gone_on_with(recorded: list[Any], granted: Any) -> None:
    granted(5)
    found = diagnose(fit([*LAW, "texture"], recorded), quick=True)
    assert (found.verdict, remark(found)) == ("complete", "")


def test_a_promising_effect_that_was_not_refined_counts_as_a_rival(recorded: list[Any]) -> None:
    texture, drag = effects.get("texture"), effects.get("drag")
    best = Explanation((texture,), 0.0, solution=add_effect(fit(LAW, recorded).solution, texture))
    other = Explanation((drag,), 100.0)
    assert find_rivals(best, [best, other]) == []
    unrefined = replace(other, is_unrefined=True)
    assert find_rivals(best, [best, unrefined]) == [unrefined]


def test_json_terminal_and_report_carry_the_remark(
    recorded: list[Any], tmp_path: Path, granted: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    granted(5)
    lines = ["[study]", "mass = 0.35", f"model = {json.dumps(LAW)}", "", "[camera]", "fps = 4000"]
    for i, run in enumerate(recorded):
        columns = np.column_stack([run.displacement.t, run.displacement.x])
        np.savetxt(tmp_path / f"r{i}.csv", columns, delimiter=",", header="t_s,x_m", comments="", fmt="%.9f")
        lines += ["", "[[run]]", f'table = "r{i}.csv"', f"mass = {run.mass}"]
    path = tmp_path / "study.toml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    printed = []
    for more in (["--json"], []):
        with pytest.raises(SystemExit):
            main(["diagnose", str(path), "--quick", *more])
        printed.append(capsys.readouterr().out)
    assert any(text.startswith(STOPPED) for text in json.loads(printed[0])["remarks"])
    assert STOPPED in " ".join(printed[1].split())
    assert STOPPED in str(findings_table(read_results(open_study(path))))
