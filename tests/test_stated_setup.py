"""Stated errors of incline, scale and mass: unknowns of the record, in every interval, and candidates of their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import frictrack as ft
from frictrack.effects import EffectSettings
from frictrack.records import GRAVITY

MASS, COULOMB, VISCOUS = 0.5, 0.06, 0.1


def cart(angle, way=1.0, *, seconds=1.5, seed=0, noise=1e-4, viscous=VISCOUS, v0=0.0, **stated):
    """A cart on a ramp that rises toward +x by `angle`: SciPy's motion, without stops."""

    def rates(t, y):
        s = np.sign(y[1]) or way
        return y[1], -GRAVITY * np.sin(angle) - (COULOMB * s + viscous * y[1]) / MASS

    t = np.arange(0, seconds, 0.005)
    x = solve_ivp(rates, (0, seconds), [0.0, v0], t_eval=t, rtol=1e-9, atol=1e-12, max_step=0.002).y[0]
    x += noise * np.random.default_rng(seed).normal(size=len(t))
    return ft.Run.from_arrays(t, x, mass=stated.pop("mass", MASS), **{"name": "cart", "incline": angle, **stated})


def with_scale_error(run, error):
    return replace(run, displacement=replace(run.displacement, relative_scale_error=error))


def test_an_incline_in_python_drives_the_run_and_keeps_its_error():
    run = cart(np.deg2rad(-3.0), incline="-3 +/- 0.1 deg")
    assert run.has_incline
    assert (run.incline, run.sigma_incline) == pytest.approx((np.deg2rad(-3.0), np.deg2rad(0.1)))


def test_scale_and_mass_are_in_the_intervals():
    """One way down, F = m (g sin - a): an error of the scale changes it by m a, one of the mass by F itself."""
    angle, noise = np.deg2rad(-3.0), 1e-6
    a = GRAVITY * np.sin(-angle) - COULOMB / MASS
    run = cart(angle, viscous=0.0, noise=noise)
    std = ft.fit(["coulomb"], [with_scale_error(run, 0.008)]).parameters["coulomb.F_c"].std
    assert std == pytest.approx(0.008 * MASS * a, rel=0.01)
    weighed = cart(angle, viscous=0.0, noise=noise, mass="500 +/- 5 g")
    assert ft.fit(["coulomb"], [weighed]).parameters["coulomb.F_c"].std == pytest.approx(0.01 * COULOMB, rel=0.02)


def test_a_stated_incline_is_one_unknown_of_the_record():
    """Up and down show the angle, one way leaves it as it is stated."""
    angle = np.deg2rad(3.6)
    both = cart(angle, v0=0.9, seconds=2.6, incline="3.5 +/- 0.1 deg")
    fit = ft.fit(["coulomb", "viscous"], [both])
    found = fit.parameters["slope.F"]
    assert found.value == pytest.approx(MASS * GRAVITY * (np.sin(angle) - np.sin(np.deg2rad(3.5))), abs=3 * found.std)
    assert found.std < 0.2 * MASS * GRAVITY * np.deg2rad(0.1)
    down = ft.fit(["coulomb", "viscous"], [cart(-angle, incline="-3.5 +/- 0.1 deg")])
    friction = down.parameters["coulomb.F_c"]
    assert friction.std == pytest.approx(MASS * GRAVITY * np.deg2rad(0.1), rel=0.1)
    assert abs(friction.value - COULOMB) < 2 * friction.std
    assert ft.fit(["coulomb", "viscous"], [both], domain="force").model.names == ["coulomb", "viscous"]


def test_settings_of_an_effect_that_the_runs_add_hold():
    """`[[effect]]` tables of slope and gravity, which no `model` names: only a stated incline or a circle adds them."""
    model = ft.models.of(["coulomb", "viscous"])
    down = cart(np.deg2rad(-3.6), incline="-3.5 +/- 0.1 deg")
    for keys in ({"fix": {"F": 0.01}}, {"prior": {"F": (0.0, 1e-3)}}):
        fit = ft.fit(model.adjusted([EffectSettings(effect="slope", **keys)]), [down])
        of = fit.model.effects[2].parameter("F")
        assert (of.fixed, of.prior) == (keys.get("fix", {}).get("F"), keys.get("prior", {}).get("F"))
    swing = replace(down, radius=0.5, incline=0.0, sigma_incline=0.0)
    assert ft.fit(model, [swing]).model.effects[2].parameter("g").prior[0] == GRAVITY
    held = ft.fit(model.adjusted([EffectSettings(effect="gravity", fix={"g": 9.81})]), [swing])
    assert held.model.effects[2].parameter("g").fixed == 9.81


@pytest.mark.usefixtures("no_formulas")
def test_a_wrong_incline_is_named_as_such():
    fit = ft.fit(["coulomb", "viscous"], [cart(np.deg2rad(3.6), v0=0.9, seconds=2.2, incline="3.0 deg")])
    found = ft.diagnose(fit, quick=True)
    assert found.missing[0] == "slope"
    assert "asymmetry" in found.best.indistinguishable_from  # its level part pulls alike
    assert found.best.words["here"].startswith("The incline is 3.6 degrees, not 3:")


@pytest.mark.slow
def test_an_incline_and_drag_together_stand_beside_the_effect_that_imitates_both():
    fit = ft.fit(["coulomb"], [cart(np.deg2rad(3.6), v0=0.7, seconds=1.6, incline="3.5 deg", noise=3e-4)])
    found = ft.diagnose(fit)
    sets = [set(found.missing), *(set(one["effects"]) for one in found.alternatives)]
    assert {"slope", "viscous"} in sets


@pytest.mark.usefixtures("no_formulas")
def test_an_incline_that_contradicts_its_stated_error_is_a_candidate():
    run = cart(np.deg2rad(3.6), v0=0.9, seconds=2.2, incline="2.0 +/- 0.01 deg")
    found = ft.diagnose(ft.fit(["coulomb", "viscous"], [run]), quick=True)
    assert found.missing[0] == "slope.F"
