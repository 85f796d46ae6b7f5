"""The benchmark of formulas: judging an expression beside the law, calibration, and a comparison that is skipped."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "pipelines" / "benchmarks"))

from formulas import __main__ as command
from formulas.causes import CAUSES
from formulas.comparison import _force, _judged
from formulas.run import calibration

RUNS, FRAMES = 4, 200


@pytest.fixture(scope="module")
def along():
    """Decelerating runs from four speeds."""
    t = np.tile(np.linspace(0.0, 0.1, FRAMES), RUNS)
    run = np.repeat(np.arange(RUNS), FRAMES)
    v = (3.0 + run) - 20.0 * t
    x = (3.0 + run) * t - 10.0 * t**2
    one = np.ones_like(t)
    law = np.column_stack([*((run == k) * one for k in range(RUNS)), v])
    return {"x": x, "v": v, "t": t, "s": one, "L": one, "law": law}


@pytest.mark.parametrize("name", ["magnet", "resonance in speed"])
def test_an_expression_is_right_if_it_is_the_cause_beside_the_law(along, name):
    cause, basis = CAUSES[name], np.linalg.qr(along["law"])[0]
    u = np.abs(along["v"]) if cause.axis == "v" else along["x"]
    values = {"F": 0.3, "c": float(np.mean(u)), "w": 0.1 * float(np.ptp(u))}
    truth = 0.3 * _force(cause, along, values)
    same = _judged(-5.0 * truth + 2.0 + 0.7 * along["v"], truth, cause, along, basis)
    assert same["form"]
    assert same["values"]
    other = _judged(np.sin(60.0 * u), truth, cause, along, basis)
    assert not other["form"]
    assert not other["values"]
    nothing = _judged(1.0 + 3.0 * along["v"], truth, cause, along, basis)
    assert nothing["form_error"] is None


def test_the_first_formulas_are_calibrated_for_themselves():
    studies = [
        {"formulas": [{"probability": 0.8, "right": True}, {"probability": 0.1, "right": False}]},
        {"formulas": [{"probability": 0.8, "right": False}]},
        {"formulas": []},
    ]
    (row,) = calibration(studies, first=True)
    assert (row["n"], row["stated"], row["right"]) == (2, pytest.approx(0.8), pytest.approx(0.5))
    assert sum(one["n"] for one in calibration(studies)) == 3


def test_the_comparison_is_skipped_with_a_sentence_without_gplearn(monkeypatch, capsys):
    monkeypatch.setattr(command, "has_gplearn", lambda python: False)
    monkeypatch.setattr(sys, "argv", ["formulas", "--n", "0", "--empty", "0", "--gplearn", "some-python"])
    command.main()
    assert "some-python has no gplearn" in capsys.readouterr().out
