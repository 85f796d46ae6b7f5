"""Effects of speed, load and picture: each is named or in the stated group, and contained effects are no rivals."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from runs import BASE, TOLD, Spec, measured, study
from scipy.integrate import solve_ivp

from frictrack.diagnose import diagnose
from frictrack.diagnose.explanations import Explanation, Explanations
from frictrack.diagnose.model_selection import information_criterion, likelihood_gain
from frictrack.effects import LIBRARY, models
from frictrack.fit import fit
from frictrack.fit.linearised import linearise
from frictrack.fit.stepwise import try_together, with_smaller_scatter
from frictrack.records import Array

LAW = {name: BASE[name] for name in ("coulomb", "viscous")}
SPEEDS = (  # m/s, mass over the reference, s: none stops
    *(Spec(3.5, 1, 0.06), Spec(5.0, 1, 0.08), Spec(8.0, 1, 0.1), Spec(-5.0, 1, 0.08)),
    *(Spec(5.0, 2, 0.08), Spec(3.5, 2, 0.06), Spec(6.0, 0.5, 0.05)),
)
SIGMA = 1e-5  # m
SPAN = SimpleNamespace(x_min=0.0, x_max=0.5, v_min=1.0, v_max=8.0, fps=1000.0)


def runs_with(name, values=None, specs=SPEEDS):
    law = LAW | {name: values or TOLD[name]}
    return study(models.of(law), law, specs, sigma=SIGMA, rng=np.random.default_rng(4))[0]


def group(found):
    """The first effect named, and those that the diagnosis cannot distinguish from it."""
    return {found.missing[0], *found.candidates[0].indistinguishable_from}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        *("flash_weakening", "log_velocity", "power_law_viscosity", "adhesion", "load_exponent"),
        *("eddy_brake", "hydrodynamic_hump"),  # beside viscous friction, in whose place they once stood
    ],
)
def test_a_hidden_effect_is_named(name):
    found = diagnose(fit(list(LAW), runs_with(name)), quick=True)
    assert found.verdict in ("missing", "ambiguous")
    assert name in group(found)


@pytest.mark.slow
def test_an_inclined_course_is_named():
    found = diagnose(fit(list(LAW), runs_with("out_of_plane", {"k": 2e-3})), quick=True)
    assert "out_of_plane" in group(found)


@pytest.mark.slow
def test_drag_stays_drag_beside_an_effect_that_contains_it():
    found = diagnose(fit(list(LAW), runs_with("drag", {"c": 0.05})), quick=True)
    assert (found.verdict, found.missing) == ("missing", ["drag"])
    assert "power_law_viscosity" in [c.effect for c in found.candidates]
    assert found.candidates[0].indistinguishable_from == ()


def test_a_special_case_is_fitted_again_from_the_effect_that_contains_it():
    runs = runs_with("drag", {"c": 0.05})
    start, drag, power = (fit([*LAW, *more], runs).solution for more in ([], ["drag"], ["power_law_viscosity"]))
    space = Explanations(start)
    (empty,) = space.known.values()
    prior = -2 * Explanation((LIBRARY["drag"],), 0.0).log_prior
    poor = Explanation((LIBRARY["drag"],), empty.criterion + 5.0, empty, solution=drag)  # as if in a poor minimum
    better = Explanation((LIBRARY["power_law_viscosity"],), information_criterion(power) + prior, empty, solution=power)
    space.known |= {poor.names: poor, better.names: better}
    space.refine(1)
    first, second = space.laws(1)
    assert first.names == poor.names
    assert first.criterion == pytest.approx(information_criterion(drag) + prior, abs=0.01)
    assert second is better


def test_adhesion_and_coulomb_friction_are_one_with_one_mass():
    single = runs_with("adhesion", specs=SPEEDS[:4])
    found = fit(list(LAW), single)
    assert found.reduced_chi2 == pytest.approx(1.0, abs=0.2)
    assert found.parameters["coulomb.F_c"].value == pytest.approx(
        LAW["coulomb"]["F_c"] + TOLD["adhesion"]["F"], rel=1e-3
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["adhesion", "load_exponent"])
def test_two_masses_cannot_part_adhesion_from_a_power_of_the_load_and_a_third_is_asked_for(name):
    runs = runs_with(name, specs=SPEEDS[:6])
    found = diagnose(fit(list(LAW), runs))
    assert found.verdict == "ambiguous"
    assert group(found) == {"adhesion", "load_exponent"}
    assert found.next_experiment[0]["separates"] == ["adhesion", "load_exponent"]
    assert found.next_experiment[0]["settings"]["mass"] not in {run.mass for run in runs}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["adhesion", "load_exponent"])
def test_three_masses_part_adhesion_from_a_power_of_the_load(name):
    found = diagnose(fit(list(LAW), runs_with(name)), quick=True)
    assert (found.verdict, found.missing) == ("missing", [name])


@pytest.mark.parametrize(("name", "start"), [("adhesion", {"F": 1.0}), ("load_exponent", {"excess": -0.02})])
def test_a_trial_that_needs_no_scatter_of_the_levels_promises_what_its_fit_gains(name, start):
    """The levels of two masses differ, which the model without the effect takes for their scatter."""
    runs = runs_with(name, specs=SPEEDS[:6])
    law = linearise(fit(list(LAW), runs).solution)
    own = law.solution.problem.layout
    taken_up = {(s.effect, s.parameter, s.run): law.solution.p[i] for i, s in enumerate(own.slots) if i in own.levels}
    trial = try_together(law, [LIBRARY[name]], taken_up | {(name, p, None): value for p, value in start.items()})
    fitted = fit([*LAW, name], runs).solution
    promised = law.solution.objective - trial.misfit + with_smaller_scatter(law, trial)[1]
    assert law.solution.objective - trial.misfit < 10 < promised
    assert promised == pytest.approx(likelihood_gain(law.solution, fitted), abs=3)


def test_a_camera_does_not_read_for_longer_than_a_frame():
    shutter = LIBRARY["rolling_shutter"]
    assert shutter.plausible({"tau": 0.0019}, SPAN) == ""
    assert "for 2 frames, expected at most one frame" in shutter.plausible({"tau": -0.004}, SPAN)
    fast = SimpleNamespace(**vars(SPAN) | {"fps": 4000.0})
    assert "expose all lines at once" in shutter.plausible({"tau": 1e-5}, fast)


def test_an_inclined_course_bends_the_picture_by_an_eighth():
    x = np.linspace(0.0, 0.5, 501)
    left = 0.1 * x**2 - (
        0.1 * 0.5 * x - 0.1 * 0.5**2 / 8
    )  # the best line leaves equal errors at both ends and the middle
    inclined = LIBRARY["out_of_plane"]
    assert np.max(np.abs(left)) == pytest.approx(0.1 * 0.5**2 / 8)
    assert inclined.plausible({"k": 0.4}, SPAN) == ""
    assert "of the span, expected at most 3 %" in inclined.plausible({"k": 0.6}, SPAN)


@pytest.mark.few(3)
@pytest.mark.parametrize("name", ["eddy_brake", "lugre", "hydrodynamic_hump", "rate_state_slip", "rate_state_ageing"])
def test_a_law_is_fitted_beside_those_in_whose_place_it_may_stand(name):
    law = {"coulomb": {"F_c": 4.0}, "stribeck": {"F_s": 2.0, "v_s": 0.4, "delta": 1.0}, "viscous": {"F_v": 0.5}}
    runs = study(models.of(law), law, [Spec(3.0, 1, 0.06), Spec(5.0, 1, 0.06)], sigma=1e-5)[0]
    model = [*law, name]
    found = fit(model, runs)
    assert found.model.names == model
    assert found.reduced_chi2 == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("scale", [0.1, 10.0])
def test_a_wrong_scale_is_absorbed_by_the_forces_and_by_the_stribeck_velocity(scale: float) -> None:
    """Tustin's law by Runge-Kutta, its lengths multiplied by a constant: v_s of 4 m/s lies beyond no bound."""
    law = {"F_c": 0.9, "F_s": 1.3, "v_s": 0.4, "F_v": 0.04}

    def acceleration(t: float, y: Array) -> list[float]:
        dry = law["F_c"] + (law["F_s"] - law["F_c"]) * np.exp(-y[1] / law["v_s"])
        return [y[1], -(dry + law["F_v"] * y[1]) / 0.35]

    runs = []
    for k, (start, seconds) in enumerate(((6.0, 0.1), (1.5, 0.1), (0.4, 0.11))):
        t = np.arange(round(2000 * seconds)) / 2000
        x = solve_ivp(acceleration, (0, t[-1]), [0.0, start], t_eval=t, rtol=1e-10, atol=1e-12).y[0]
        rng = np.random.default_rng(k)
        runs.append(measured(t, scale * x, sigma=scale * 1e-6, mass=0.35, name=f"r{k}", pitch=scale * 5e-4, rng=rng))
    values = {name: found.value for name, found in fit("tustin", runs).parameters.items()}
    assert values["stribeck.v_s"] == pytest.approx(scale * law["v_s"], rel=0.05)
    assert values["coulomb.F_c"] == pytest.approx(scale * law["F_c"], rel=0.02)
    assert values["viscous.F_v"] == pytest.approx(law["F_v"], rel=0.1)
