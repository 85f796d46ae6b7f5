"""Errors of every model tried, and the spans where the last one fails, against a patch whose place is known."""

from __future__ import annotations

import numpy as np
import pytest
from runs import BASE, Spec, study

from frictrack.base.errors import FrictrackError
from frictrack.diagnose.compare import compare, failing_spans, history
from frictrack.effects import models
from frictrack.fit import fit
from frictrack.results import to_builtins

PATCH = {"F": 4.0, "x_c": 0.2, "w": 0.008}
PAIR = (Spec(4.0, 1, 0.1), Spec(5.0, 1, 0.09))


@pytest.fixture(scope="module")
def runs():
    model = models.of(["coulomb", "viscous"]) + "patch"
    values = {"coulomb": BASE["coulomb"], "viscous": BASE["viscous"], "patch": PATCH}
    return study(model, values, specs=PAIR, sigma=2e-6)[0]


@pytest.fixture(scope="module")
def fits(runs):
    return [fit("coulomb,viscous", runs), fit("coulomb,viscous,patch", runs)]


def test_it_fails_in_every_run_until_the_patch_is_known(runs, fits):
    spans = failing_spans(fits[0].solution, runs)
    assert {s["run"] for s in spans} == {r.name for r in runs}
    for s in spans:  # time, place and share belong together, t in recording time
        seen = next(r.displacement for r in runs if r.name == s["run"])
        x = seen.x[(seen.t >= s["t"][0]) & (seen.t <= s["t"][1])]
        assert s["x"] == pytest.approx([x.min(), x.max()], abs=1e-3)
        assert s["v"][0] <= (x[-1] - x[0]) / (s["t"][1] - s["t"][0]) <= s["v"][1]
    shares = [s["share_of_error"] for s in spans]
    assert shares == sorted(shares, reverse=True)
    assert 0.5 < sum(shares) <= 1 + 1e-3
    assert failing_spans(fits[1].solution, runs) == []


def test_what_is_missing_shows_where_it_acts(runs, fits):
    spans = failing_spans(fits[1].solution, runs, missing="patch")
    assert [s["run"] for s in sorted(spans, key=lambda s: s["run"])] == [r.name for r in runs]
    for s in spans:
        assert s["x"][0] < PATCH["x_c"] < s["x"][1]
        assert s["x"] == pytest.approx([PATCH["x_c"] - 2 * PATCH["w"], PATCH["x_c"] + 2 * PATCH["w"]], abs=PATCH["w"])


def test_a_missing_effect_takes_the_share_of_the_misfit_that_each_run_has_without_it():
    law = {name: BASE[name] for name in ("coulomb", "viscous")} | {
        "texture": {"amplitude": 0.4, "period": 0.03, "phase": 0.5}
    }
    made, _ = study(models.of(list(law)), law, specs=PAIR, sigma=2e-6)
    bare, grown = fit("coulomb,viscous", made), fit(list(law), made)
    spans = failing_spans(grown.solution, made, missing="texture")
    excess = {made[r.piece.run].name: float(r.r @ r.r) - len(r.r) for r in bare.solution.responses}
    shares = {name: sum(s["share_of_error"] for s in spans if s["run"] == name) for name in excess}
    assert sum(shares.values()) == pytest.approx(1.0, abs=0.05)
    for name, share in shares.items():
        assert share == pytest.approx(excess[name] / sum(excess.values()), abs=0.05)


def test_errors_fall_in_the_order_tried(fits):
    table = to_builtins(compare(fits).summary())
    assert table.keys() == {"models", "fails_at"}
    assert [m["name"] for m in table["models"]] == ["1_coulomb+viscous", "2_coulomb+viscous+patch"]
    assert [m["model"] for m in table["models"]] == [f.model.names for f in fits]
    before, after = (m["errors"] for m in table["models"])
    for key in ("rms_displacement_um", "rms_acceleration", "sse_acceleration", "relative_force_error", "reduced_chi2"):
        assert after[key] < before[key]
    assert after["heldout_rms_um"] == pytest.approx(2.0, rel=0.1)
    assert table["fails_at"] == []
    assert to_builtins(history(fits).summary()) == table
    assert compare(fits[0]).summary()["models"] == [table["models"][0]] != []


def test_nothing_to_compare_is_said():
    with pytest.raises(FrictrackError, match="expected at least one fitted model to compare but got none"):
        compare([])


@pytest.mark.slow
def test_the_true_law_fails_nowhere_by_chance():
    spans = []
    for seed in range(5):
        runs, _ = study(specs=(Spec(4.0, 1, 0.06), Spec(-4.0, 1, 0.06)), rng=np.random.default_rng(seed), sigma=1e-5)
        spans += failing_spans(fit("coulomb,stribeck,viscous", runs).solution, runs)
    assert spans == []
