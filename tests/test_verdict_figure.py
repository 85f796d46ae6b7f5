"""The figure of a verdict: the axis that matters, failing spans, what repairs the model, and the errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from runs import BASE, Spec, study
from test_plots import candidate, diagnosis, drawn, model, results

import frictrack as ft
from frictrack.diagnose.residual_curves import residual_series
from frictrack.effects import models
from frictrack.present import plots
from frictrack.present.plots import failed_model
from frictrack.present.plots.model import HeldOutError
from frictrack.present.plots.verdict import _spans, data_of_diagnosis, data_of_study
from frictrack.present.report import tables
from frictrack.results.candidates import candidate_rows

PATCH = {"F": 2.0, "x_c": 0.2, "w": 0.008}
REPEAT = {"share": 0.9, "runs": 2, "of": 2, "evidence": 50.0}
LAW = "coulomb,viscous"


def failing(**more):
    """A study whose only model lacks texture and has not got it yet."""
    r = results()
    found = diagnosis("missing", [candidate("texture", 0.001, 812.0)], ["texture"], **more)
    m = replace(r.models[0], diagnosis=found, current=True)
    return replace(r, models=(m,), diagnosis=found, figures=m.figures)


def missing_force(r):
    t = np.linspace(0, 0.1, 50)
    series = {"run": np.repeat([0.0, 1.0], 25), "t": t, "x": t, "v": 1 - t, "a": t, "F": np.sin(100 * t)}
    figures = {"residual_force": series | {"sigma_F": np.full(50, 0.1)}}
    return replace(r, models=(replace(r.models[0], figures=figures),), figures=figures)


def test_residual_before_and_after_and_the_errors_of_both_models():
    figure = plots.verdict(results())
    left, middle, right = figure.axes
    assert left.get_title(loc="left") == "Residual: 36.0 µm before, 10.0 after"
    assert "The missing force is not computed yet" in drawn(figure)
    np.testing.assert_allclose(
        [line.get_ydata()[0] for line in right.lines if len(line.get_ydata()) == 1], [39.6, 11.0]
    )
    assert right.get_title(loc="left") == "Error falls to the noise"
    assert figure.get_suptitle() == "Tustin lacks texture: with it the residual falls from 36.0 to 10.0 µm"
    assert plots.verdict(results(), title=False).get_suptitle() == ""
    assert not middle.axison


@pytest.mark.parametrize(
    ("holds", "axis", "label"),
    [("x", "x", "displacement x / m"), ("v", "v", "speed |v| / (m/s)"), ("phase", "t", "time since release t / s")],
)
def test_the_axis_is_the_one_over_which_the_misfit_repeats(holds, axis, label):
    repeats = [REPEAT | {"axis": holds, "holds": True}, REPEAT | {"axis": "x", "holds": False}]
    figure = plots.verdict(missing_force(failing(repeats=repeats)))
    assert [ax.get_xlabel() for ax in figure.axes[:2]] == [label, label]
    assert figure.axes[0].get_xlim() == figure.axes[1].get_xlim()
    assert data_of_study(failing(repeats=repeats)).axis == axis


def test_overlapping_spans_are_shaded_once():
    span = {"t": [0.0, 0.1], "v": [-0.6, -0.4], "share_of_error": 0.2, "run": "v1"}
    found = failing(
        fails_at=[span | {"x": x} for x in ([0.1, 0.2], [0.15, 0.3], [0.5, 0.6])],
        repeats=[REPEAT | {"axis": "x", "holds": True}],
    )
    assert _spans(data_of_study(found)) == [(0.1, 0.3), (0.5, 0.6)]
    by_speed = failing(fails_at=[span | {"x": [0, 1]}], repeats=[REPEAT | {"axis": "v", "holds": True}])
    assert _spans(data_of_study(by_speed)) == [(0.4, 0.6)]


def test_before_anything_is_added_the_errors_are_those_tried():
    importance = [
        {"effect": "texture", "explained_alone": 0.9, "explained_in_sequence": 0.9, "heldout_rms_after_um": 10.2}
    ]
    errors = data_of_study(failing(importance=importance)).errors
    assert [(e.label, e.value, e.tried) for e in errors] == [
        ("Tustin", 21.2, False),  # of the same held-out frames
        ("+ texture", 10.2, True),
    ]


def test_a_complete_model_shows_what_would_have_been_seen():
    r = results()
    first = replace(r.models[0], diagnosis=diagnosis("complete"), current=True)
    figure = plots.verdict(replace(r, models=(first,), diagnosis=first.diagnosis))
    assert figure.axes[1].get_title(loc="left") == "What these runs would have shown"
    assert figure.axes[1].lines[0].get_xdata() == pytest.approx([150.0])  # mN, of texture; the slope is absorbed
    assert failed_model(r).name == "1_tustin"
    assert failed_model(replace(r, models=(first,))) is None


def test_a_study_that_is_not_diagnosed_says_so():
    r = results()
    figure = plots.verdict(replace(r, models=(replace(r.models[0], diagnosis=None, current=True),), diagnosis=None))
    assert figure.get_suptitle() == "Tustin, not yet diagnosed"
    assert "The missing force is not computed yet" in [text.get_text() for text in figure.axes[1].texts]
    with pytest.raises(ValueError, match="expected a study with a fitted model but got none"):
        plots.verdict(replace(r, models=()))


def test_many_models_are_numbered():
    r = results()
    effects = ["coulomb", "viscous", "texture", "drag", "spring", "slope"]
    tried = [model(f"{k}_tustin", 40.0 - k, r.runs, effects=effects[: k + 1]) for k in range(1, 6)]
    tried = [replace(m, current=m is tried[-1]) for m in tried]
    ax = plots.verdict(replace(r, models=tuple(tried), diagnosis=None)).axes[2]
    assert [label.get_text() for label in ax.get_xticklabels()] == ["1", "2", "3", "4", "5"]


# ---- of the Python interface


@pytest.fixture(scope="module")
def patched():
    runs = study(
        models.of(LAW.split(",")) + "patch", {name: BASE[name] for name in LAW.split(",")} | {"patch": PATCH},
        specs=(Spec(4.4, 1, 0.09), Spec(5.0, 1, 0.09)), sigma=5e-6, rng=np.random.default_rng(3),
    )[0]  # fmt: skip
    fit = ft.fit(LAW, runs)
    return fit, ft.diagnose(fit)


def test_a_diagnosis_stores_its_residual_with_and_without_the_effect_found(patched):
    fit, found = patched
    kept = found.figures["residual"]
    assert found.missing == ["patch"]
    assert np.std(kept["before"]) > 5 * np.std(kept["after"])
    assert np.std(kept["after"]) == pytest.approx(5e-6, rel=0.15)
    at = np.abs(kept["x"] - PATCH["x_c"]) < 1e-3
    assert kept["F"][at] == pytest.approx(PATCH["F"], rel=0.1)
    alone = residual_series(fit.solution, None, [])
    assert set(kept) - set(alone) == {"after", "F"}
    curves = np.concatenate([c.residual for c in fit.curves])
    assert len(alone["before"]) <= len(curves)
    assert np.std(alone["before"]) == pytest.approx(np.std(curves), rel=0.05)


def test_a_diagnosis_draws_its_verdict(patched):
    fit, found = patched
    figure = plots.verdict(found)
    assert figure.get_suptitle().startswith("Coulomb + viscous lacks patch: with it the residual falls from ")
    assert "with patch, as tried" in drawn(figure)
    better = ft.fit(fit.model + "patch", fit.runs)
    later = data_of_diagnosis(found, better)
    assert later.errors[-1] == HeldOutError("Coulomb + viscous + patch", better.errors["heldout_rms_um"])
    assert later.after.rms == pytest.approx(1e6 * np.std(found.figures["residual"]["after"]), rel=0.05)
    assert np.max(later.after.rows["force"]) == pytest.approx(PATCH["F"], rel=0.1)


# ---- the table of candidates


def test_candidates_are_listed_in_the_order_of_the_verdict():
    far = candidate("lens", 0.001, 700.0) | {"heldout_rms_after_um": None, "parameters": {}}
    worse = candidate("drag", 0.001, 900.0) | {"heldout_rms_after_um": 15.0}
    found = diagnosis("missing", [candidate("texture", 0.001, 812.0, ["patch"]), far, worse,
                                  candidate("patch", 0.001, 811.0)], ["texture"])  # fmt: skip
    shown, others = tables.candidate_table(candidate_rows(found))
    names = [[str(row[0]).rpartition("<code>")[2].removesuffix("</code>") for row in t.rows] for t in (shown, others)]
    assert names == [["texture", "patch"], ["drag", "lens"]]
    assert 'class="mark named"' in shown.rows[0][0]
    assert shown.rows[1][1] == "predicts the same data as texture"
