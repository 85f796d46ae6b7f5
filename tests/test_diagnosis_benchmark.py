"""The benchmark of the detection limits: its ways see what they claim to see."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "pipelines" / "benchmarks"))

from diagnosis import force, ours, sparse, studies

from frictrack.validation.blind.ideal_detector import ideal_detection_limit, unit_values
from frictrack.validation.blind.outcome import Outcome, tally
from frictrack.validation.blind.truth import effect_named

NOTEBOOK = Path(__file__).parents[1] / "notebooks" / "blind.ipynb"


def test_every_effect_that_such_runs_can_tell_has_a_row():
    assert {"drag", "vibration", "texture", "patch", "lens", "peak_locking", "camera_shake"} <= set(studies.EFFECTS)
    assert not {"collision", "drive_error", "presliding", "measured_load", "lugre"} & set(studies.EFFECTS)


def test_a_repeat_holds_the_effect_at_its_size():
    truth = studies.holding("texture", {"period": 0.03}, 0.2, np.random.default_rng(1))
    own = [run.values["texture"] for run in truth.runs]
    assert {(o["amplitude"], o["period"]) for o in own} == {(0.2, 0.03)}
    assert len({o["phase"] for o in own}) == 1  # it is the course's
    assert len({run.level for run in truth.runs}) == len(truth.runs)
    shaken = studies.holding("camera_shake", {"frequency": 60.0}, 1e-5, np.random.default_rng(1))
    assert len({run.values["camera_shake"]["phase"] for run in shaken.runs}) == len(shaken.runs)


def test_the_force_domain_sees_less_than_the_ideal_detector():
    detector = studies.detector()
    for name, at in (("drag", {}), ("texture", {"period": 0.05})):
        ideal, seen = ideal_detection_limit(detector, effect_named(name), at), force.force_size(detector, name, at)
        assert ideal is not None
        assert seen is not None
        assert 1.0 < seen / ideal < 200.0


def test_the_force_of_a_chain_is_that_of_the_motion():
    t = np.arange(400) / 4000
    x = (1e-3 * np.sin(2 * np.pi * 20 * t))[:, None]
    made_of = force.chained(x, 4000.0, 0.5)
    inside = slice(100, -100)
    true = 0.5 * (2 * np.pi * 20) ** 2 * x[force.TRIM_FRAMES : -force.TRIM_FRAMES]
    assert made_of[inside] == pytest.approx(true[inside], rel=0.01, abs=0.02)


@pytest.mark.parametrize(("shares", "size"), [([0.2, 0.9, 1.0], 1.2**0.5), ([1.0, 1.0], 0.5), ([0.1, 0.4], None)])
def test_the_size_seen_lies_between_two_steps(shares: list[float], size: float | None):
    ladder = (0.5, 1.0, 1.2)
    found = ours.size_seen(ladder, shares, 1.0)
    assert found == (None if size is None else pytest.approx(size, rel=1e-9))


@pytest.mark.slow
def test_the_peer_is_given_every_effect_as_columns_of_its_own():
    forms = {"drag": {}, "texture": {"period": 0.03}}
    assert sparse.owners(forms) == ["drag", "texture", "texture"]
    truth = studies.holding("drag", {}, 0.2, np.random.default_rng(2))
    a, y = sparse.case(truth, np.random.default_rng(3), forms)
    assert a.shape == (len(y), 3 + 3)
    left = y - a[:, :4] @ np.linalg.lstsq(a[:, :4], y, rcond=None)[0]
    bare = y - a[:, :3] @ np.linalg.lstsq(a[:, :3], y, rcond=None)[0]
    assert np.sum(left**2) < np.sum(bare**2)


def test_unit_values_keep_the_setting_and_fill_in_the_rest():
    assert (
        unit_values(effect_named("patch"), {"x_c": 0.2, "w": 0.01}, {}, 2)
        == [{"patch": {"F": 1.0, "x_c": 0.2, "w": 0.01}}] * 2
    )


def run_notebook() -> None:
    """Run the notebook's code here, in this folder."""
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    exec("\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "code"), {})


def test_the_notebook_shows_stored_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    place = tmp_path / "pipelines" / "benchmarks" / "diagnosis" / "results.json"
    place.parent.mkdir(parents=True)
    kinds = ("one", ("drag",)), ("none", ()), ("two", ("drag", "lens")), ("foreign", ("joint",))
    rows = [Outcome("s", k, h, (3.0,) * len(h), verdict="missing", named=h, group=h[:1], seconds=1.0) for k, h in kinds]
    score = tally(rows) | {"seed": 0}
    row = {"at": {}, "unit": "N", "stated": 0.2, "ideal": 0.19, "force": 1.0, "measured": {"size": 0.21}, "sparse": {}}
    place.write_text(json.dumps({"machine": {"python": "3"}, "blind": {"tables": score}, "limits": {"drag": row}}))
    monkeypatch.chdir(tmp_path)
    run_notebook()
    printed = capsys.readouterr().out
    assert printed.count("<IPython.core.display.SVG object>") == 3
    assert "4 studies of tables" in printed


def test_the_notebook_says_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError, match="makes it"):
        run_notebook()
