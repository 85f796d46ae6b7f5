"""Declared costs rate the next run, and the run that is named gives about the evidence that is predicted of it."""

from __future__ import annotations

import io
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console
from runs import FPS, MASS, PITCH
from test_next_experiment import AMBIGUOUS, LAW, explained, law_with, runs_with, take

from frictrack import effects, study
from frictrack.base.errors import FrictrackError
from frictrack.cli import output
from frictrack.diagnose import diagnose
from frictrack.diagnose.experiments import choose_runs, default_setup, next_run, selection
from frictrack.diagnose.experiments.candidates import candidate_experiments
from frictrack.diagnose.experiments.forecast import EvidenceForecast
from frictrack.diagnose.experiments.proposals import RatedExperiment, _rank
from frictrack.diagnose.experiments.virtual_runs import RunDesign
from frictrack.diagnose.model_selection import information_criterion
from frictrack.fit import fit
from frictrack.flow.command_history import Predictions, resolve_prediction
from frictrack.results.verdicts import describe_predictions
from frictrack.settings.costs import DEFAULT_COSTS, Costs, RunSettings

LAST = RunSettings(4.0, 0.35, 0.0, 4000.0)


@pytest.mark.parametrize(
    ("new", "cost"),
    [
        (LAST, 5.0),
        (replace(LAST, speed=-2.0), 7.0),
        (replace(LAST, mass=0.7), 15.0),
        (replace(LAST, mass=0.7, speed=-4.0), 17.0),
        (replace(LAST, incline=0.09), 35.0),
        (replace(LAST, fps=8000.0), math.inf),
        (replace(LAST, zoom=0.7), math.inf),
        (replace(LAST, speed=9.0), math.inf),
        (replace(LAST, mass=0.175), math.inf),
    ],
)
def test_a_change_costs_relative_to_the_last_run(new, cost):
    costs = Costs(film=5, mass=10, direction=2, incline=30, camera=math.inf, speeds=(2, 8), masses=(0.35, 0.7))
    assert costs.of_run(new, LAST) == cost


def test_defaults_rate_every_film_alike_and_a_sensor_like_ten():
    changed = (replace(LAST, mass=0.7), replace(LAST, speed=-4.0), replace(LAST, fps=8000.0), LAST)
    assert {DEFAULT_COSTS.of_run(new, LAST) for new in changed} == {1.0}
    assert DEFAULT_COSTS.of_check("accelerometer") == 10.0
    assert DEFAULT_COSTS.of_check("reference") == 1.0


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("film = 0", "expected film as a number above 0 but got 0"),
        ('mass = "5 min"', 'expected mass as a number but got "5 min"'),
        ("direction = nan", "expected direction as a number of at least 0 but got NaN"),
        ("film = true", "expected film as a number but got true"),
        ("speeds = [8, 2]", "expected the slowest speed first but got [8, 2]"),
        ("masses = []", "expected masses as a list of 1 or more values but got []"),
        ("frames = 12", "expected frames as a whole number of at least 30, or inf, but got 12"),
        ("frames = 99.5", "expected frames as a whole number of at least 30, or inf, but got 99.5"),
        ("fil = 1", 'unknown key "fil"; did you mean "film"?'),
    ],
)
def test_faults_of_the_table_are_said_at_load(tmp_path, line, sentence):
    path = tmp_path / "study.toml"
    path.write_text(f"[costs]\n{line}\n")
    with pytest.raises(FrictrackError) as e:
        study.load(path, allow_incomplete=True)
    assert sentence in str(e.value)
    assert "line 2" in str(e.value)


def test_the_table_is_read(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text('[costs]\nfilm = 5\ncamera = inf\nmasses = ["350 g", 0.7]\nframes = 1000\n')
    costs = study.load(path, allow_incomplete=True).costs
    assert costs == Costs(film=5.0, camera=math.inf, masses=(0.35, 0.7), frames=1000.0)


def rated(key, evidence, cost):
    both = dict.fromkeys([("drag", "drift"), ("drift", "drag")], EvidenceForecast(evidence))
    return RatedExperiment(key, key, both, cost)


def test_experiments_are_ranked_by_evidence_over_cost():
    heavy, plain = rated("double mass", 100.0, 1.0), rated("repeat", 40.0, 1.0)
    assert [o.key for o in _rank([plain, heavy])] == ["double mass", "repeat"]
    dear = rated("double mass", 100.0, 4.0)
    assert [o.key for o in _rank([plain, dear])] == ["repeat", "double mass"]


@pytest.mark.slow
def test_a_plan_leaves_out_what_is_not_possible_and_prefers_what_is_cheap():
    setup = default_setup(MASS, FPS, PITCH)
    free = choose_runs(setup).steps
    assert any(s.design and s.design.mass != 1 for s in free)
    costs = Costs(mass=math.inf, camera=math.inf, speeds=(2.0, 8.0))
    for step in choose_runs(replace(setup, costs=costs)).steps:
        if step.design:
            design = step.design
            assert design.mass == 1
            assert design.rate == 1
            assert 1.9 <= abs(design.start[1]) <= 8.2


def test_a_plan_takes_the_run_that_separates_most_pairs_for_its_cost(monkeypatch):
    """Two pairs for a cost of 1 come before three for a cost of 5."""

    def run(key, speed, mass):
        return SimpleNamespace(design=RunDesign((0.0, speed), (0.0, 0.4), mass, key=key))

    class Tables:
        names = ("a", "b", "c", "d")
        runs = (run("filmed", 4.0, 1.0), run("cheap", 6.0, 1.0), run("dear", 4.0, 2.0))

        def evidence(self, chosen, *, reference):
            out = np.zeros((4, 5))
            out[:, 4] = 1e6  # every effect is detected
            for pairs in ({0: (), 1: ((0, 1), (0, 2)), 2: ((1, 2), (1, 3), (2, 3))}[run] for run in chosen):
                for a, b in pairs:
                    out[a, b] = out[b, a] = 1e6
            return out

    monkeypatch.setattr(selection, "tabulate_evidence", lambda setup, notify: (Tables(), {}))
    filmed = (Tables.runs[0].design,)
    steps = choose_runs(replace(default_setup(MASS, FPS, PITCH), costs=Costs(mass=4.0), completed=filmed)).steps
    assert [(s.design.key, s.cost, len(s.separated)) for s in steps] == [("cheap", 1.0, 2), ("dear", 5.0, 3)]


@pytest.fixture(scope="module")
def ambiguous():
    truth, values, rival, speeds = AMBIGUOUS[0]
    runs = runs_with(truth, values, speeds, duration=0.12)
    made = fit(LAW, runs)
    return truth, rival, law_with(truth, values), runs, made, diagnose(made, quick=True).summary()


@pytest.mark.slow
def test_the_named_run_gives_the_evidence_that_is_predicted(ambiguous):
    truth, _, law, runs, made, found = ambiguous
    assert found["verdict"] == "ambiguous"
    costs = Costs(camera=math.inf, masses=(MASS, 2 * MASS))
    named = next_run(made, found, costs)
    assert named["cost"] == 1.0
    assert any(abs(named["settings"]["mass"] - m) < 0.02 * m for m in costs.masses)
    design = next(e for e in candidate_experiments(made.solution, costs, combined=True) if e.key == named["key"])
    effects_only = [p for p in named["predictions"] if p["true"] == truth and p["rival"] in effects.LIBRARY]
    least = min(effects_only, key=lambda p: p["expected"])
    _, after = explained([*runs, take(design, law, 0.02)], truth, least["rival"])
    realised = information_criterion(after[least["rival"]]) - information_criterion(after[truth])
    assert realised > 10  # it separates them
    assert 0.5 < realised / least["expected"] < 2.0


@pytest.mark.slow
def test_a_run_that_costs_much_is_named_only_if_it_is_worth_it(ambiguous):
    *_, made, found = ambiguous
    dear = Costs(camera=math.inf, mass=math.inf, direction=math.inf, incline=math.inf)
    named = next_run(made, found, dear)
    assert named["settings"]["speed"] > 0
    assert named["settings"]["mass"] == pytest.approx(MASS)
    assert next_run(made, {**found, "verdict": "missing", "missing": []}, dear) is None


def test_an_undetermined_model_is_answered_by_the_run_that_shows_the_effect():
    """Fast runs cannot show a Stribeck effect; a run to a stop can, and this needs no diagnosis to know."""
    made = fit(LAW, runs_with("viscous", {"F_v": 1.2}, (6.0, 6.5, 7.0, 7.5), duration=0.06))
    found = {"verdict": "undetermined", "undetermined": [{"what": "stribeck"}], "candidates": []}
    named = next_run(made, found, Costs(camera=math.inf))
    assert named["separates"] == ["stribeck"]
    assert abs(named["settings"]["speed"]) < 5.0
    assert named["predictions"][0]["expected"] > 10 * max(named["predictions"][0]["now"], 1.0)


PREDICTED = {
    "what": "Film a run",
    "key": "reversed",
    "predictions": [
        {"true": "drag", "rival": "drift", "expected": 50.0, "interval": [22.0, 78.0]},
        {"true": "drag", "rival": "lens", "expected": 90.0, "interval": [50.0, 130.0]},
        {"true": "drift", "rival": "drag", "expected": 40.0, "interval": [15.0, 65.0]},
    ],
}


def after(**gains):
    return {"model": LAW, "candidates": [{"effect": n, "delta_bic": g} for n, g in gains.items()]}


def test_what_was_realised_is_kept_once(tmp_path):
    kept = Predictions(tmp_path)
    kept.record(PREDICTED, LAW, ["r1", "r2"])
    kept.resolve(after(drag=100.0, drift=40.0, lens=20.0), ["r1", "r2"])  # no new run
    assert kept.rows[0]["realised"] is None
    kept.resolve(after(drag=100.0, drift=40.0, lens=20.0), ["r1", "r2", "r3"])
    row = kept.rows[0]
    assert row["filmed"] == "r3"
    assert row["realised"]["delta_bic"] == 60.0
    assert row["realised"]["factor"] == pytest.approx(1.2)
    kept.resolve(after(drag=500.0, drift=40.0, lens=20.0), ["r1", "r2", "r4"])
    assert kept.rows[0]["realised"]["delta_bic"] == 60.0
    assert "1.2 times as much" in describe_predictions({"predictions": kept.rows})[0]
    kept.record(PREDICTED, LAW, ["r1", "r2"])  # planned again for the same runs
    assert len(kept.rows) == 1


def test_a_prediction_is_answered_only_by_one_more_run_of_the_same_model():
    row = {**PREDICTED, "model": LAW, "runs": ["r1", "r2"], "realised": None}
    found = after(drag=30.0, drift=80.0, lens=20.0)
    assert resolve_prediction(row, found, ["r1", "r2", "r3", "r4"]) is None
    assert resolve_prediction(row, found, ["r1", "r3"]) is None
    assert resolve_prediction(row, {**found, "model": ["coulomb"]}, ["r1", "r2", "r3"]) is None
    answer = resolve_prediction(row, found, ["r1", "r2", "r3"])["realised"]
    assert (answer["true"], answer["delta_bic"]) == ("drift", 50.0)  # drift turned out to be true


@pytest.mark.slow
def test_the_text_names_the_run_its_cost_and_its_evidence(ambiguous):
    *_, made, found = ambiguous
    named = next_run(made, found, Costs(film=5, camera=math.inf))
    out = io.StringIO()
    shown = {"next": named, "next_reason": None, "assumed": [], "done": [], "runs": [], "pairs_before": 0}
    output.plan(
        Console(file=out, width=200), {**shown, "left": [], "unseen": [], "not_planned": {}, "detection_limits": {}}
    )
    text = out.getvalue()
    assert "Next run" in text
    assert "cost 5" in text
    assert "95 %" in text
    assert np.isfinite(named["expected_delta_bic"])
