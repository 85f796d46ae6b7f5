"""What moves in step with the residual is told first: vertical motion, another target, an accelerometer.

The motions are integrated by scipy under Coulomb and viscous friction with a mass whose load swings, which is shaken,
which meets a patch, or whose picture shakes.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from runs import BASE, Spec, measured, study
from scipy.integrate import solve_ivp

from frictrack.diagnose import diagnose
from frictrack.diagnose.auxiliary_signals import KnownFindings, assess_auxiliary_signals, evidence_curves
from frictrack.diagnose.compressed import compress_residual
from frictrack.effects import models
from frictrack.fit import fit
from frictrack.flow.sensor_stage import auxiliary_signals
from frictrack.records import Track

LAW = ["coulomb", "viscous"]
MASS, MU, HERTZ, LIFT = 0.35, 0.8, 61.0, 6.0  # kg, -, Hz, m/s^2
SPEEDS = (3.5, 4.0, 5.0, -4.0)
W = 2 * np.pi * HERTZ


@cache
def slides(cause, *, seed=0, speeds=SPEEDS, bounce=True):
    """Runs, and what an accelerometer on the mass would have felt (bias 0.3 and noise 0.5 m/s^2)."""
    rng = np.random.default_rng(seed)
    runs, felt = [], {}
    for i, speed in enumerate(speeds):
        s, (phase, other) = np.sign(speed), rng.uniform(-np.pi, np.pi, 2)

        def a(t, x, v, s=s, phase=phase, other=other):
            load = MASS * (9.81 + LIFT * np.sin(W * t + phase) * (cause == "load"))
            push = 0.8 * np.sin(W * t + other) * (cause == "vibration")
            patch = 0.6 * np.exp(-(((x - 0.3) / 0.012) ** 2) / 2) * (cause == "patch")
            return -(s * (MU * load + patch) + 1.2 * v + push) / MASS

        t = np.arange(360) / 4000.0
        start = [0.0 if s > 0 else 0.6, speed]
        solved = solve_ivp(
            lambda t, z, a=a: [z[1], a(t, z[0], z[1])], (0, t[-1]), start, t_eval=t, rtol=1e-10, max_step=5e-4
        )
        x = solved.y[0] + 3e-5 * np.sin(W * t + other) * (cause == "shake")
        run = measured(t, x, sigma=1e-5, mass=MASS, name=f"r{i}", rng=rng)
        lift = -LIFT / W**2 * np.sin(W * t + phase) + 1e-5 * rng.standard_normal(len(t))
        if bounce:
            run = replace(run, displacement=replace(run.displacement, y=lift))
        runs.append(run)
        felt[run.name] = {"accelerometer": a(t, *solved.y) + 0.3 + 0.5 * rng.standard_normal(len(t))}
    return runs, felt


def seen(runs, auxiliary=None):
    return assess_auxiliary_signals(fit(LAW, runs).solution, runs, np.random.default_rng(0), auxiliary)


@pytest.fixture(scope="module")
def load():
    """Runs whose load swings, the fit of them, and the first evidence."""
    runs, _ = slides("load")
    fitted = fit(LAW, runs).solution
    (first,) = assess_auxiliary_signals(fitted, runs, np.random.default_rng(0))
    return runs, fitted, first


def test_a_load_that_swings_with_the_vertical_motion_is_first_evidence(load):
    first = load[2]
    assert (first.kind, first.acts_on, first.run) == ("vertical", "force", None)
    assert first.share > 0.9
    assert first.p <= 0.01
    assert "the normal load changes with it" in first.words
    size = float(first.words.split("by ")[1].split(" of its vertical inertia")[0])
    assert size == pytest.approx(MU, rel=0.1)
    curve = evidence_curves([first])["evidence_0"]
    assert np.corrcoef(curve["left"], curve["told"])[0, 1] > 0.95
    assert "curve" not in first.summary()


@pytest.mark.slow
def test_vertical_motion_that_has_nothing_to_do_with_the_residual_is_no_evidence():
    found = []
    for seed in range(2):
        runs, _ = slides("load", seed=seed, bounce=False)
        rng = np.random.default_rng(seed)
        t = runs[0].displacement.t
        odd = [2e-5 * np.sin(2 * np.pi * 97 * t + rng.uniform(0, 6)) + 1e-5 * rng.standard_normal(len(t)) for _ in runs]
        runs = [replace(r, displacement=replace(r.displacement, y=y)) for r, y in zip(runs, odd, strict=True)]
        found += seen(runs)
    assert len(found) <= 1  # p of 0.01 each


@pytest.mark.slow
def test_vertical_motion_that_drifts_with_the_place_is_no_evidence_of_a_patch():
    """A rail that is not level under a path that has a patch: both repeat with the place, and are smooth."""
    found = []
    for seed, length in enumerate((0.02, 0.05)):
        runs, _ = slides("patch", bounce=False)
        rng = np.random.default_rng(seed)
        places = [r.displacement.x for r in runs]
        drifts = [3e-4 * np.sin(x / length + seed) + 1e-5 * rng.standard_normal(len(x)) for x in places]
        found += seen(
            [replace(r, displacement=replace(r.displacement, y=y)) for r, y in zip(runs, drifts, strict=True)]
        )
    assert found == []


def test_what_tells_less_than_the_best_candidate_is_evidence_only_beside_it(load):
    """A candidate that explains all of it leaves nothing to the witness."""
    runs, fitted, first = load
    assert assess_auxiliary_signals(fitted, runs, np.random.default_rng(0), None, KnownFindings(3 * fitted.chi2)) == []
    (more,) = assess_auxiliary_signals(
        fitted, runs, np.random.default_rng(0), None, KnownFindings(3 * fitted.chi2, fitted, ["patch"])
    )
    assert more.share == first.share
    assert "of what is left beside patch" in more.words


def test_another_target_in_step_is_told_by_its_name():
    runs, _ = slides("load", bounce=False)
    beam = {r.name: {"the beam, up": s.displacement.y} for r, s in zip(runs, slides("load")[0], strict=True)}
    (first,) = seen(runs, beam)
    assert (first.kind, first.name) == ("track", "the beam, up")
    assert first.words.startswith("the beam, up matches")


@pytest.mark.parametrize(
    ("cause", "acts_on", "word"), [("vibration", "force", "no camera shake"), ("shake", "measurement", "not the mass")]
)
def test_an_accelerometer_tells_a_mass_that_moves_from_a_picture_that_does(cause, acts_on, word):
    runs, felt = slides(cause, bounce=False)
    (first,) = seen(runs, felt)
    assert (first.kind, first.acts_on) == ("accelerometer", acts_on)
    assert word in first.words
    assert first.p < 1e-6


def test_an_accelerometer_too_noisy_says_nothing():
    runs, felt = slides("vibration", bounce=False)
    rng = np.random.default_rng(0)
    deaf = {n: {"accelerometer": f["accelerometer"] + 300 * rng.standard_normal(360)} for n, f in felt.items()}
    assert seen(runs, deaf) == []


def test_the_accelerometer_parts_vibration_from_camera_shake_in_the_diagnosis():
    runs, felt = slides("shake", bounce=False, speeds=SPEEDS[:1])
    fitted = fit(LAW, runs)
    found = diagnose(fitted, auxiliary=felt)
    assert found.missing[0] == "camera_shake"
    assert "vibration" not in found.candidates[0].indistinguishable_from
    assert found.summary()["evidence"][0]["kind"] == "accelerometer"


@pytest.mark.parametrize(
    ("name", "share", "counts"), [("beam", 0.0, True), ("backward", 1.0, False), ("mark", 0.9, False)]
)
def test_what_rides_on_the_mass_is_no_witness(name, share, counts):
    """A beam swings by itself; the mass tracked once more, or a second mark on it, goes where the mass goes."""
    run = slides("vibration", speeds=SPEEDS[:1], bounce=False)[0][0]
    t, x = run.displacement.t, run.displacement.x
    n = len(t)
    known = {"t": t, "x_px": 400 + share * x / 1e-3 + 0.2 * np.sin(W * t), "y_px": np.full(n, 30.0)}
    rest = {k: np.full(n, 0.01) for k in ("angle", "sigma_px", "sigma_y_px", "score")}
    seen_at = Track(**known, **rest, reason=np.full(n, ""), name=name)
    work = SimpleNamespace(
        to_run=lambda: replace(run, displacement=replace(run.displacement, pixel_pitch=1e-3)),
        stages=("tracks",),
        get=lambda stage: {name: seen_at} if stage == "tracks" else SimpleNamespace(a=None),
        run=SimpleNamespace(name=run.name),
    )
    assert bool(auxiliary_signals([work])[run.name]) is counts


def test_what_a_law_needs_beside_the_motion_is_read_along_with_it():
    law = {name: BASE[name] for name in LAW} | {"measured_load": {"coefficient": 1.0}}
    runs, _ = study(models.of([*law]), law, specs=(Spec(3.0, 1, 0.06), Spec(5.0, 1, 0.06)), sigma=1e-5)
    left = compress_residual(fit([*law], runs).solution)
    assert all(path.lift is not None and len(path.lift) == len(path.t) for path in left.paths)
