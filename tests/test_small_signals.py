"""Small hidden effects: they are named at the detection limit, and never as another effect that explains as much."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import frictrack as ft
from frictrack.diagnose.examination import examine
from frictrack.diagnose.model_selection import information_criterion, likelihood_gain, parameter_penalty
from frictrack.effects import LIBRARY
from frictrack.fit import add_effect
from frictrack.present.plots import passes
from frictrack.records import Displacement, Run
from frictrack.validation.blind.outcome import replacements, solution_at_truth

sys.path.insert(0, str(Path(__file__).parents[1] / "pipelines" / "benchmarks"))

from small_signals import ideal, run
from small_signals.run import recorded

LAW = ["coulomb", "stribeck", "viscous"]
NOISE, FPS, MASS = 1e-5, 4000.0, 0.35
FC, FS, VS, FV = 2.8, 1.6, 0.35, 0.3  # N, N above F_c, m/s, N s/m
ONE_PERCENT = 0.01 * (FC + 2 * FV)  # of the friction at 2 m/s, N


def slide(speed: float, ratio: float, frequency: float, rng: np.random.Generator) -> Run:
    """One run with a vibration of 1 % of the friction, integrated by SciPy."""
    t = np.arange(int(min(0.72 / abs(speed), 0.22) * FPS)) / FPS
    s, level, phase = np.sign(speed), 1 + 0.03 * rng.standard_normal(), rng.uniform(-np.pi, np.pi)

    def rate(t: float, y: np.ndarray) -> list[float]:
        dry = s * (FC + FS * np.exp(-abs(y[1]) / VS)) * level * ratio
        return [y[1], -(dry + FV * y[1] + ONE_PERCENT * np.sin(2 * np.pi * frequency * t + phase)) / (MASS * ratio)]

    start = [0.05 if speed > 0 else 0.75, speed]
    x = solve_ivp(rate, (0, t[-1]), start, method="DOP853", t_eval=t, rtol=1e-11, atol=1e-13).y[0]
    nan = np.full(len(t), np.nan)
    x = x + NOISE * rng.standard_normal(len(t))
    shift = Displacement(t, x, nan, nan, np.full(len(t), NOISE), nan, np.ones(len(t), dtype=bool), pixel_pitch=5e-4)
    return Run(shift, ft.differentiate(ft.low_pass(shift)), mass=MASS * ratio, name=f"{speed}_{ratio}")


def verdict_and_group(runs: list[Run]) -> tuple[str, set[str]]:
    """The verdict, and the effect named first with those stated as indistinguishable."""
    found = ft.diagnose(ft.fit(LAW, runs), rng=0, quick=True)
    return found.verdict, set(run.named_group(found))


@pytest.mark.slow
def test_runs_of_one_mass_name_a_vibration_of_one_percent_beside_what_they_cannot_tell_from_it():
    rng = np.random.default_rng(3)
    verdict, group = verdict_and_group([slide(v, 1.0, 24.0, rng) for v in (2.2, 3.0, 4.0, 5.5)])
    assert verdict == "ambiguous"
    assert {"vibration", "load_modulation"} <= group


@pytest.mark.slow
def test_a_double_mass_names_it_alone():
    rng = np.random.default_rng(3)
    runs = [slide(v, m, 20.0, rng) for v, m in ((2.2, 1), (4.0, 1), (5.5, 1), (4.0, 2), (-3.0, 1))]
    assert verdict_and_group(runs) == ("missing", {"vibration"})


@pytest.fixture(scope="module")
def at_the_limit():
    """A study with a vibration at the limit of the ideal detector, and the fit of its base law."""
    truth = next(run.studies("vibration", 1.0, 1, seed=1))
    fit = ft.fit(list(truth.model), recorded(truth, np.random.default_rng([truth.seed, 7])))
    return truth, fit


@pytest.mark.slow
def test_an_effect_of_many_parameters_is_named_at_the_limit_although_bic_asks_for_more(at_the_limit):
    truth, fit = at_the_limit
    found = ft.diagnose(fit, rng=truth.seed, quick=True)
    best = found.best
    assert best.delta_bic < 0
    assert best.p < 0.005
    assert best.passes
    assert passes(best.summary())
    assert "vibration" in run.named_group(found)


@pytest.mark.slow
def test_a_fit_that_falls_short_of_the_critical_value_is_not_confirmed(at_the_limit):
    truth, fit = at_the_limit
    vibration = LIBRARY["vibration"]
    examined = examine(fit.solution, (), np.random.default_rng(truth.seed), 0.005)
    law = add_effect(fit.solution, vibration)
    assert information_criterion(law) > information_criterion(fit.solution)  # BIC alone would discard it
    assert examined.confirms(law, vibration)
    gain = likelihood_gain(fit.solution, law)
    extra = [parameter_penalty(s.problem.layout, s.problem) for s in (fit.solution, law)]
    fall = information_criterion(fit.solution) - information_criterion(law)
    assert gain == pytest.approx(fall + extra[1] - extra[0])
    harder = replace(examined, null=examined.null + gain + 40.0)
    assert not harder.confirms(law, vibration)


@pytest.mark.slow
def test_the_ideal_detector_knows_which_effects_nobody_can_tell_apart(at_the_limit):
    truth, fit = at_the_limit
    named = ideal.name_ideally(truth, fit.solution)
    assert named.detected
    assert named.named
    assert {"load_modulation", "camera_shake"} & set(named.equivalents)
    assert "drag" not in named.equivalents
    full = solution_at_truth(truth, fit.solution)
    near = replacements(full, "vibration", 30.0)
    assert set(named.equivalents) <= set(near)


def test_studies_hide_the_effect_at_the_size():
    for truth in run.studies("drag", 1.5, 1, seed=4):
        assert truth.hidden == ("drag",)
        assert truth.size[0] == pytest.approx(1.5, rel=1e-3)


def test_the_table_counts_by_effect_and_size():
    def row(effect: str, *, named: bool, ideal: bool) -> dict[str, object]:
        found = {"detected": ideal, "first": ideal, "named": ideal}
        own = {"detected": True, "first": False, "named": named, "false": []}
        return {"effect": effect, "size": 1.00004, **own, "ideal": found}

    rows = [row("drag", named=True, ideal=True), row("drag", named=False, ideal=True)]
    drag, whole = run.table([*rows, row("slope", named=False, ideal=False)])[::2]
    assert (drag["studies"], drag["named"], drag["ideal_named"], drag["ratio"]) == (2, 1, 2, 0.5)
    assert (whole["effect"], whole["studies"], whole["detected"], whole["ratio"]) == ("all", 3, 3, 0.5)
    assert "0.50" in run.overview([drag])


@pytest.mark.slow
def test_a_vibration_that_lasts_is_not_ambiguous_with_one_that_decays():
    rng = np.random.default_rng(5)
    runs = [slide(v, m, 31.0, rng) for v, m in ((2.2, 1), (4.0, 1), (5.5, 1), (4.0, 2), (-3.0, 1))]
    _, group = verdict_and_group(runs)
    assert "vibration" in group
    assert "decaying_vibration" not in group
