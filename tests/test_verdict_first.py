"""The verdict comes first: it is announced once and not revised, an interrupted diagnosis keeps it."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from few_effects import use_few_effects
from rich.console import Console
from runs import BASE, HIDDEN, Spec, study

from frictrack.cli import main, output
from frictrack.diagnose import Diagnosis, conclusion, diagnose
from frictrack.diagnose.conclusion import Conclusion
from frictrack.effects import models
from frictrack.fit import fit
from frictrack.flow import ResultsReader, Session, open_study, read_results
from frictrack.present import report
from frictrack.present.report.texts import next_steps
from frictrack.results import to_builtins
from frictrack.results.candidates import STANDINGS
from frictrack.results.verdicts import VERDICT_ONLY, VERDICTS
from frictrack.workbench.summaries import SnapshotReader, state_of

LAW = ["coulomb", "viscous"]
SPECS = (Spec(3.0, 1, 0.05), Spec(5.0, 1, 0.05), Spec(4.0, 2, 0.05))
LATER = ("fails_at", "importance", "evidence", "next_experiment")  # what follows from a verdict


@pytest.fixture(scope="module", autouse=True)
def _few_effects() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        use_few_effects(patched)
        yield


@pytest.fixture(scope="module")
def recorded() -> list[Any]:
    """Runs of Coulomb and viscous friction with a texture that the law lacks."""
    law = {name: BASE[name] for name in LAW} | {"texture": HIDDEN["texture"]}
    return list(study(models.of(law), law, specs=SPECS, sigma=1e-5, rng=np.random.default_rng(1))[0])


@pytest.fixture(scope="module")
def announced(recorded: list[Any]) -> tuple[list[Diagnosis], Diagnosis]:
    """The diagnoses that were announced, and the one that was returned."""
    seen: list[Diagnosis] = []
    return seen, diagnose(fit(LAW, recorded), on_verdict=seen.append)


@pytest.fixture
def study_file(recorded: list[Any], tmp_path: Path) -> Path:
    lines = ["[study]", "mass = 0.35", f"model = {json.dumps(LAW)}", "", "[camera]", "fps = 4000"]
    for i, run in enumerate(recorded):
        columns = np.column_stack([run.displacement.t, run.displacement.x])
        np.savetxt(tmp_path / f"r{i}.csv", columns, delimiter=",", header="t_s,x_m", comments="", fmt="%.9f")
        lines += ["", "[[run]]", f'table = "r{i}.csv"', f"mass = {run.mass}"]
    (tmp_path / "study.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return tmp_path / "study.toml"


@pytest.mark.slow
def test_formulas_are_compared_before_the_verdict_and_not_after_it(
    recorded: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []

    def compare(*given: Any, real: Any = conclusion.compare_with_formulas) -> Any:
        order.append("formulas")
        return real(*given)

    monkeypatch.setattr(conclusion, "compare_with_formulas", compare)
    diagnose(fit(LAW, recorded), on_verdict=lambda found: order.append(found.verdict))
    assert order == ["formulas", "missing"]


def test_the_verdict_is_announced_once_and_not_revised(announced: tuple[list[Diagnosis], Diagnosis]) -> None:
    (first,), whole = announced
    assert (first.verdict, first.missing, first.complete) == ("missing", ["texture"], False)
    assert whole.complete
    before, after = first.summary(), whole.summary()
    assert {key for key in after if after[key] != before[key]} <= {"complete", "repeats", "repeats_words", *LATER}
    assert all(before[key] == [] for key in LATER)
    assert after["importance"]


def test_a_quick_diagnosis_is_the_announced_one(recorded: list[Any], announced: Any) -> None:
    quick = diagnose(fit(LAW, recorded), quick=True)
    assert to_builtins(quick.summary()) == to_builtins(announced[0][0].summary())


def test_an_interrupted_diagnosis_keeps_its_verdict_and_is_completed_later(
    study_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    session = Session(open_study(study_file))
    with monkeypatch.context() as patch:
        patch.setattr(Conclusion, "completed", interrupt)
        with pytest.raises(KeyboardInterrupt):
            session.diagnose()
    results = read_results(open_study(study_file))
    assert results.diagnosis is not None
    assert (results.diagnosis["verdict"], results.diagnosis["complete"]) == ("missing", False)
    assert any("Only the verdict is known" in str(words) for words in next_steps(results))

    seen: list[dict[str, Any]] = []
    again = Session(open_study(study_file))
    assert again.diagnose(quick=True)["complete"] is False
    reader = ResultsReader()  # of the page, which reads again what has changed
    assert reader.read(again.study).models[-1].diagnosis["complete"] is False
    whole = again.diagnose(on_verdict=seen.append)
    assert [(found["verdict"], found["complete"]) for found in seen] == [("missing", False)]
    assert (whole["verdict"], whole["complete"]) == ("missing", True)
    assert again.diagnose(on_verdict=seen.append) == whole
    assert len(seen) == 1  # what is stored in full is not announced
    assert again.diagnose(quick=True) == whole
    assert reader.read(again.study).models[-1].diagnosis["complete"] is True


def test_the_command_prints_the_verdict_then_the_rest_and_each_once(
    study_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []
    for name in ("verdict", "diagnosis_rest"):
        monkeypatch.setattr(output, name, lambda out, result, name=name: order.append(f"{name} {result['complete']}"))
    for arguments in (["diagnose"], ["diagnose"], ["diagnose", "--quick"]):
        with pytest.raises(SystemExit):
            main([*arguments, str(study_file)])
    whole = ["verdict True", "diagnosis_rest True"]
    assert order == ["verdict False", "diagnosis_rest True", *whole, *whole]
    steps = [line for line in capsys.readouterr().err.splitlines() if line]
    assert steps[:2] == [f"reading {study_file}", f"study {study_file.parent.name}, 3 runs"]
    assert steps.count("diagnosing 1_coulomb+viscous") == 1
    assert len(steps) < 12


def test_json_of_a_quick_diagnosis_says_that_it_is_not_complete(
    study_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["diagnose", str(study_file), "--quick", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert (found["verdict"], found["complete"], found["next_experiment"]) == ("missing", False, [])


def test_one_sentence_is_changed_in_one_place_and_seen_on_every_surface(
    study_file: Path, announced: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(VERDICTS, "missing", "{model} wants {what}")
    monkeypatch.setitem(STANDINGS, "named", "was seen")
    shown = {}
    for surface, *options in (("JSON", "--json"), ("terminal",)):
        with pytest.raises(SystemExit):
            main(["diagnose", str(study_file), "--quick", *options])
        shown[surface] = capsys.readouterr().out
    shown["page"] = json.dumps(to_builtins(state_of(SnapshotReader(study_file).read())))
    shown["report"] = report.render(read_results(open_study(study_file)))
    shown["notebook"] = announced[1].plot().get_suptitle()
    for surface, text in shown.items():
        assert "Coulomb + viscous wants texture" in text, surface
        assert "lacks texture" not in text, surface
    assert all("was seen" in shown[surface] for surface in ("terminal", "page", "report"))


def test_verdict_and_rest_together_are_the_whole(announced: tuple[list[Diagnosis], Diagnosis]) -> None:
    first, whole = (to_builtins(found.summary()) for found in (announced[0][0], announced[1]))

    def printed(*parts: Any) -> str:
        out = Console(file=io.StringIO(), width=200)
        for show, result in parts:
            show(out, result)
        return str(out.file.getvalue())  # type: ignore[attr-defined]

    streamed = printed((output.verdict, first), (output.diagnosis_rest, whole))
    assert streamed == printed((output.verdict, whole), (output.diagnosis_rest, whole))
    assert VERDICT_ONLY[:30] in printed((output.diagnosis_rest, first))
