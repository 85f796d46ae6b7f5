"""What changes a study: undone, done again, refused where somebody else was quicker, safe where the power fails."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import numpy as np
import pytest
from conftest import slide

from frictrack.base.errors import FrictrackError
from frictrack.flow import CommandHistory, Session, open_study, read_results, store
from frictrack.flow.store import GroupContent

TEXT = """# our course
[study]
mass = "0.35 kg"   # weighed on Monday
model = ["coulomb", "viscous"]

[[run]]
name = "fast"
table = "fast.csv"

[[run]]
name = "slow"
table = "slow.csv"
"""


def recorded(path: Path, v0: float) -> None:
    t = np.arange(400) / 4000
    x = slide(t, v0) + 1e-5 * np.random.default_rng(int(10 * v0)).normal(size=len(t))
    np.savetxt(path, np.c_[t, x], delimiter=",", header="t_s,x_m", comments="")


@pytest.fixture
def study_file(tmp_path: Path) -> Path:
    recorded(tmp_path / "fast.csv", 4.0)
    recorded(tmp_path / "slow.csv", 2.5)
    (tmp_path / "study.toml").write_text(TEXT, encoding="utf-8")
    return tmp_path / "study.toml"


def at_work(path: Path, **how: object) -> Session:
    return Session(open_study(path), **how)  # type: ignore[arg-type]


def test_a_key_is_set_with_its_comments_kept_and_undone_to_the_byte(study_file: Path) -> None:
    session = at_work(study_file)
    session.apply("edit", table="run", which="slow", key="free", value=["0.01 s", "0.2 s"])
    text = study_file.read_text(encoding="utf-8")
    assert "# weighed on Monday" in text
    assert 'free = ["0.01 s", "0.2 s"]' in text
    assert session.study.runs[1].free == (0.01, 0.2)
    session.apply("undo")
    assert study_file.read_text(encoding="utf-8") == TEXT
    session.apply("redo")
    assert study_file.read_text(encoding="utf-8") == text


def test_a_key_that_makes_the_file_unsound_is_refused_and_nothing_is_written(study_file: Path) -> None:
    session = at_work(study_file)
    with pytest.raises(FrictrackError, match="mass"):
        session.apply("edit", table="study", key="mass", value="3 m")
    assert study_file.read_text(encoding="utf-8") == TEXT
    assert session.commands.revision == 0


def test_an_effect_gets_a_table_of_its_own(study_file: Path) -> None:
    session = at_work(study_file)
    session.apply("edit", table="effect", which="viscous", key="fix", value={"F_v": 0.5})
    assert '[[effect]]\neffect = "viscous"\nfix = {F_v = 0.5}' in study_file.read_text(encoding="utf-8")
    assert session.fit()["parameters"]["viscous.F_v"]["value"] == 0.5


def test_models_are_undone_and_the_history_keeps_them(study_file: Path) -> None:
    session = at_work(study_file)
    session.fit()
    session.add("drag")
    assert session.models.current_group == "2_coulomb+viscous+drag"
    session.apply("undo")
    assert session.models.current_group == "1_coulomb+viscous"
    assert [m["name"] for m in session.history()["models"]] == ["1_coulomb+viscous", "2_coulomb+viscous+drag"]
    assert at_work(study_file).fit()["model"] == ["coulomb", "viscous"]
    session.apply("redo")
    assert at_work(study_file).fit()["model"] == ["coulomb", "viscous", "drag"]
    session.apply("use", model="1_coulomb+viscous")
    session.add("slope")
    assert session.models.current_group == "3_coulomb+viscous+slope"


def test_what_is_undone_is_gone_once_something_else_is_done(study_file: Path) -> None:
    session = at_work(study_file)
    session.apply("edit", table="study", key="mass", value="0.4 kg")
    session.apply("undo")
    session.apply("edit", table="study", key="mass", value="0.5 kg")
    with pytest.raises(FrictrackError, match="nothing to redo"):
        session.apply("redo")
    session.apply("undo")
    with pytest.raises(FrictrackError, match="nothing to undo"):
        session.apply("undo")


def test_a_file_that_was_changed_by_hand_is_not_undone_over(study_file: Path) -> None:
    session = at_work(study_file)
    session.apply("edit", table="study", key="mass", value="0.4 kg")
    study_file.write_text(study_file.read_text(encoding="utf-8") + "# by hand\n", encoding="utf-8")
    with pytest.raises(FrictrackError, match="by hand"):
        session.apply("undo")
    assert study_file.read_text(encoding="utf-8").endswith("# by hand\n")


def test_who_saw_an_older_study_is_refused(study_file: Path) -> None:
    one, other = at_work(study_file, expected_revision=0), at_work(study_file, expected_revision=0, author="page")
    other.apply("edit", table="study", key="mass", value="0.4 kg")
    with pytest.raises(FrictrackError, match=r"changed meanwhile .page: edit study mass 0\.4 kg\)"):
        one.apply("edit", table="study", key="mass", value="0.5 kg")
    other.apply("edit", table="study", key="mass", value="0.6 kg")  # its own change is no surprise
    assert at_work(study_file).study.mass == (0.6, 0.0)


def test_a_fit_that_was_overtaken_is_not_kept(study_file: Path) -> None:
    session = at_work(study_file)
    session.fit()
    late = at_work(study_file, expected_revision=1)
    fitted = late.models._fitted

    def overtaken(spec: object, **how: object) -> object:
        at_work(study_file).apply("edit", table="run", which="fast", key="note", value="first")
        return fitted(spec, **how)

    late.models._fitted = overtaken  # type: ignore[method-assign]
    with pytest.raises(FrictrackError, match="changed meanwhile"):
        late.apply("add", effect="drag")
    assert session.models.groups == ["1_coulomb+viscous"]


def test_recordings_are_taken_in_and_left_out(study_file: Path) -> None:
    recorded(study_file.parent / "third.csv", 3.0)
    session = at_work(study_file)
    session.apply("take_in", recordings=["third.csv"])
    assert [run.name for run in session.study.runs] == ["fast", "slow", "third"]
    session.apply("leave_out", run="fast")
    assert [run.name for run in session.study.runs] == ["slow", "third"]
    with pytest.raises(FrictrackError, match='expected a run of the study file but got "none"'):
        session.apply("leave_out", run="none")
    with pytest.raises(FrictrackError, match="no such file"):
        session.apply("take_in", recordings=["fourth.csv"])


def test_an_effect_of_ones_own_is_defined_and_undone(study_file: Path) -> None:
    magnet = {
        "effect": "magnet",
        "formula": "F * exp(-((x - c)/w)^2)",
        "units": {"F": "N", "c": "m", "w": "m"},
        "bounds": {"c": [0.0, 0.5], "w": [0.005, 0.1]},
    }
    session = at_work(study_file)
    session.apply("define", effect=magnet)
    assert "# weighed on Monday" in study_file.read_text(encoding="utf-8")
    assert "magnet" in session.add("magnet")["effect"]
    session.apply("define", effect=magnet | {"formula": "F * (x - c)/w * exp(-((x - c)/w)^2)"})
    assert study_file.read_text(encoding="utf-8").count("[[effect]]") == 1
    assert session.study.effects[0].formula.startswith("F * (x - c)/w")
    with pytest.raises(FrictrackError, match="formula"):
        session.apply("define", effect=magnet | {"formula": "F * __import__('os')"})
    for _ in range(3):
        session.apply("undo")
    assert study_file.read_text(encoding="utf-8") == TEXT


@pytest.mark.slow
def test_what_was_changed_since_the_results_were_made_is_told(study_file: Path) -> None:
    def told() -> tuple[str, ...]:
        return read_results(open_study(study_file)).outdated

    session = at_work(study_file)
    assert told() == ()  # nothing is there that could be out of date
    session.fit()
    assert told() == ()
    session.apply("edit", table="run", which="slow", key="free", value=["0.01 s", "0.09 s"])
    session.apply("edit", table="effect", which="coulomb", key="fix", value={"F_c": 2.0})
    session.apply("edit", table="study", key="mass", value="0.4 kg")
    mass, slow, model = told()
    assert mass == "mass was changed from 0.350 kg to 0.400 kg"
    assert slow == f"{mass}; free was added"
    assert model == f"{mass} (fast); {slow} (slow)"
    at_work(study_file).fit()
    assert told() == ()
    study_file.write_text(study_file.read_text().replace('"viscous"', '"drag"'))
    assert told() == ("the study file names another model",)


def test_an_unknown_command_names_the_nearest(study_file: Path) -> None:
    with pytest.raises(FrictrackError, match='did you mean "undo"'):
        at_work(study_file).apply("undoo")


def test_a_log_that_was_cut_in_a_line_goes_on(tmp_path: Path) -> None:
    history = CommandHistory(tmp_path)
    with history.record("edit", key="mass") as change:
        change.before, change.after = {"toml": "a"}, {"toml": "b"}
    with history.path.open("ab") as log:
        log.write(b'{"rev": 2, "at"')
    assert history.revision == 1
    with history.record("undo"):
        pass
    assert [c.command for c in history.changes] == ["edit", "undo"]
    assert all(json.loads(line) for line in history.path.read_text(encoding="utf-8").splitlines())


def test_a_change_that_fails_is_not_logged(tmp_path: Path) -> None:
    history = CommandHistory(tmp_path)
    with pytest.raises(RuntimeError), history.record("edit"):
        raise RuntimeError
    assert history.revision == 0


def test_many_who_change_at_once_all_stand_in_the_log(tmp_path: Path) -> None:
    def work(k: int) -> None:
        for _ in range(20):
            with CommandHistory(tmp_path, author=str(k)).record("edit") as change:
                change.before = {"toml": ""}

    crowd = [threading.Thread(target=work, args=(k,)) for k in range(5)]
    for one in crowd:
        one.start()
    for one in crowd:
        one.join()
    changes = CommandHistory(tmp_path).changes
    assert [c.revision for c in changes] == list(range(1, 101))
    assert {c.author for c in changes} == set("01234")


def test_the_folder_of_results_shows_only_what_a_user_opens(study_file: Path) -> None:
    """Locks and logs lie in one hidden folder."""
    session = Session(open_study(study_file))
    session.fit()
    output = session.study.output
    assert [p.name for p in output.iterdir() if p.name.startswith(".")] == [".frictrack"]
    assert not list(output.glob("*.jsonl"))
    assert (output / ".frictrack" / "log.jsonl").exists()


def test_a_formula_of_the_last_diagnosis_is_written_and_added(study_file: Path) -> None:
    table = '[[effect]]\neffect = "unexplained"\nformula = "F * x"\nunits = {F = "N/m"}\n'
    session = at_work(study_file)
    with pytest.raises(FrictrackError, match="has none"):
        session.add("formula:1")
    session.fit()
    group, _ = session.models.current()
    summary = {"unexplained": {"formulas": [{"toml": table, "beside": []}]}}
    provenance = session.models.provenance("key", "{}")
    content = GroupContent({"summary": json.dumps(summary)}, provenance)
    store.write(session.path, {f"models/{group}/diagnosis": content})
    assert session.add("formula:1")["effect"] == "unexplained"
    assert session.study.effects[0].formula == "F * x"
    study_file.write_text(TEXT, encoding="utf-8")  # the user deletes its table
    without = at_work(study_file)
    with pytest.raises(FrictrackError, match=r'has an effect "unexplained" that the study file no longer defines'):
        without.add("drag")
    assert [one["name"] for one in without.history()["models"]][-1].endswith("+unexplained")
    assert without.remove("unexplained")["effect"] == "unexplained"
    assert without.models.current()[1].edits == ()
    without.apply("undo")
    study_file.write_text(f"{TEXT}\n{table}", encoding="utf-8")
    session = at_work(study_file)
    session.apply("undo")
    session.apply("undo")
    assert study_file.read_text(encoding="utf-8") == TEXT
