"""A run that was not fitted, under the law of the others: what it shares is foretold, what is its own is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from runs import BASE, FPS, MASS, SIX, measured, study, with_hidden

from frictrack.fit import fit
from frictrack.simulate import Conditions, simulate

SIGMA = 1e-6
LINE = {"amplitude": 0.8, "frequency": 61.3}


def seen(law, values, speed, name, *, seed, role="fit", duration=0.12):
    """One measured run of a law."""
    t = np.arange(round(duration * FPS)) / FPS
    slide = simulate(law, values, Conditions(MASS), t, (0.0, speed))
    run = measured(t, slide.x, sigma=SIGMA, name=name, rng=np.random.default_rng(seed))
    return replace(run, role=role)


def rms_um(found, name):
    (row,) = [r for r in found.summary()["per_run"] if r["run"] == name]
    return row["errors"]["rms_displacement_um"]


@pytest.mark.few(3)
@pytest.mark.parametrize("turn", np.arange(8) * np.pi / 4)
def test_a_phase_of_its_own_is_found_all_the_way_round(turn):
    law, _ = with_hidden("vibration")
    runs = [
        seen(law, BASE | {"vibration": LINE | {"phase": 0.4}}, 4.0, "a", seed=1),
        seen(law, BASE | {"vibration": LINE | {"phase": 0.4 + turn}}, 4.5, "b", seed=2, role="validation"),
    ]
    assert rms_um(fit(law, runs), "b") == pytest.approx(1e6 * SIGMA, rel=0.15)


def test_an_event_of_other_runs_does_not_happen_to_it():
    law, values = with_hidden("collision")
    runs = [
        seen(law, values, 4.0, "a", seed=1),
        seen(law, values, 4.5, "b", seed=2),
        seen(law - "collision", BASE, 5.0, "c", seed=3, role="validation"),
    ]
    found = fit(law, runs)
    assert rms_um(found, "c") == pytest.approx(1e6 * SIGMA, rel=0.15)
    (curve,) = [c for c in found.curves if c.run == "c"]
    assert np.all(curve.parts["collision"] == 0.0)


def test_the_level_of_a_validation_run_is_that_of_the_law():
    runs, levels = study("tustin", BASE, SIX, sigma=SIGMA, scatter=0.03, rng=np.random.default_rng(4))
    held = replace(runs[2], role="validation")
    found = fit("tustin", [*runs[:2], held, *runs[3:]])
    (row,) = [r for r in found.summary()["per_run"] if r["role"] == "validation"]
    assert row["level"] == 1.0
    assert row["errors"]["rms_displacement_um"] > 5 * rms_um(found, "r0")  # nothing but its start was fitted
    assert abs(levels[2] - 1) > 0.001


def test_a_run_that_was_held_back_lies_in_its_band():
    law, _ = with_hidden("texture")
    values = BASE | {"texture": {"amplitude": 0.8, "period": 0.03, "phase": 1.0}}
    runs = [seen(law, values, v, f"v{v}", seed=k) for k, v in enumerate((3.5, 4.0, 4.5))]
    (told,) = fit(law, runs[:2]).predict(runs[2])
    slide = simulate(law, values, Conditions(MASS), told.t, (told.x[0], told.v[0]))
    assert (told.run, told.role) == ("v4.5", "validation")
    assert np.max(np.abs(told.x - slide.x) / told.sigma_x) < 4
    assert np.mean(np.abs(told.F + MASS * slide.a) < 2 * told.sigma_F) > 0.9
