"""Laws with memory that are fitted by name: elasto-plastic contact, age of contacts."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from runs import MASS, measured
from scipy.integrate import solve_ivp

from frictrack.diagnose import diagnose
from frictrack.effects import Path, direction_of_motion, get, models
from frictrack.fit import fit, refine
from frictrack.records import Displacement, Motion, Run
from frictrack.simulate import Conditions, simulate

LENGTH, RATE = 3e-5, 2 * np.pi * 7
V_0, NM = 1e-4, 1e-9
NAMES = ("elasto_plastic", "maxwell_slip", "rate_state_ageing", "rate_state_slip")
SETTINGS = {
    "elasto_plastic": {"stiffness": LENGTH, "share": 0.6},
    "maxwell_slip": {"stiffness": LENGTH, "spread": 6.0},
    "rate_state_ageing": {"D_c": LENGTH, "v_0": V_0},
    "rate_state_slip": {"D_c": LENGTH, "v_0": V_0},
}
OTHERS = {
    "elasto_plastic": {"stiffness": (2e-5, 1e-4, 7e-5), "share": (0.0, 0.6, 0.9)},
    "maxwell_slip": {"stiffness": (2e-5, 1e-4, 7e-5), "spread": (1.0, 4.0, 50.0)},
    "rate_state_ageing": {"D_c": (2e-5, 1e-4, 7e-5), "v_0": (1e-4, 1e-4, 1e-3)},
    "rate_state_slip": {"D_c": (2e-5, 1e-4, 7e-5), "v_0": (1e-4, 1e-4, 1e-3)},
}


def place(t):
    return 2e-4 * np.sin(RATE * t) + 1e-4 * t + 4e-5 * np.sin(5 * RATE * t)


def speed(t):
    return 2e-4 * RATE * np.cos(RATE * t) + 1e-4 + 4e-5 * 5 * RATE * np.cos(5 * RATE * t)


def to_and_fro(n=1600, duration=0.5):
    t = np.linspace(0, duration, n)
    return Path(t, place(t), speed(t), direction_of_motion(speed(t)))


def state(rate, t, start):
    return solve_ivp(rate, (t[0], t[-1]), [start], rtol=1e-9, atol=1e-12, max_step=1e-4, t_eval=t).y[0]


def made(name, path, q):
    effect = get(name)
    inner = [path.s[:, None]] if effect.modifies else []
    return effect.columns(path, q, *inner)


@pytest.mark.few(1)
@pytest.mark.parametrize("share", [0.0, 0.6, 0.95])
def test_the_elasto_plastic_state_is_the_one_that_scipy_integrates(share):
    path = to_and_fro()

    def rate(t, w):
        v = speed(t)
        y = w * np.sign(v)
        inside = np.clip((y - share) / (1 - share), 0.0, 1.0)
        alpha = 0.5 + 0.5 * np.sin(np.pi * (inside - 0.5)) if y > share else 0.0
        return v / LENGTH * (1 - alpha * y)

    found = made("elasto_plastic", path, {"stiffness": LENGTH, "share": share})[:, 0]
    np.testing.assert_allclose(found, state(rate, path.t, 1.0), atol=2e-5)


def test_an_elasto_plastic_contact_does_not_drift_below_its_share():
    t = np.linspace(0, 2.0, 4001)
    x = 1e-5 * np.sin(2 * np.pi * 10 * t)
    v = 1e-5 * 2 * np.pi * 10 * np.cos(2 * np.pi * 10 * t)
    path = Path(t, x, v, np.r_[0.0, direction_of_motion(v)[1:]])
    found = made("elasto_plastic", path, {"stiffness": LENGTH, "share": 0.5})[:, 0]
    np.testing.assert_allclose(found[1:], x[1:] / LENGTH, atol=1e-9)


@pytest.mark.few(1)
@pytest.mark.parametrize("spread", [1.0, 6.0, 100.0])
def test_the_springs_of_maxwell_slip_stop_at_their_own_loads(spread):
    t = np.linspace(0, 0.5, 160_001)
    fine = np.diff(place(t))
    lengths = LENGTH * np.mean(spread ** -np.linspace(0, 1, 8)) * spread ** np.linspace(0, 1, 8)
    truth = np.ones((len(t), 8))
    for i, step in enumerate(fine):
        truth[i + 1] = np.clip(truth[i] + step / lengths, -1.0, 1.0)
    path = to_and_fro(1601)
    found = made("maxwell_slip", path, {"stiffness": LENGTH, "spread": spread})[:, 0]
    np.testing.assert_allclose(found, truth[::100].mean(axis=1), atol=3e-3)
    assert np.mean(1 / lengths) == pytest.approx(1 / LENGTH)  # the stiffness of all together


def test_a_small_loop_inside_a_large_one_closes_under_maxwell_slip_and_drifts_under_dahl():
    corners = np.cumsum([0.0, 60e-6, -50e-6, 12e-6, -12e-6, 12e-6, -12e-6, -20e-6])  # m
    x = np.concatenate([np.linspace(a, b, 400, endpoint=False) for a, b in pairwise(corners)])
    t = np.arange(len(x)) * 1e-3
    path = Path(t, x, np.gradient(x, t), direction_of_motion(np.diff(x, append=corners[-1])))
    outer, gone = 800, (1600, 2400)  # where the small loops begin, and end
    maxwell = made("maxwell_slip", path, {"stiffness": LENGTH, "spread": 6.0})[:, 0]
    dahl = get("presliding").columns(path, {"stiffness": LENGTH, "exponent": 1.0}, path.s[:, None])[:, 0]
    assert all(maxwell[row] == pytest.approx(maxwell[outer], abs=5e-3) for row in gone)
    assert all(abs(dahl[row] - dahl[outer]) > 0.1 for row in gone)


def rates_of_contacts(t, u):
    return [V_0 / LENGTH - u[0] * abs(speed(t)) / LENGTH]


@pytest.mark.parametrize(("n", "tolerance"), [(400, 6e-3), (1600, 5e-4), (6400, 5e-5)])
def test_the_age_of_contacts_converges_to_the_one_that_scipy_integrates(n, tolerance):
    path = to_and_fro(n)
    u = state(rates_of_contacts, path.t, V_0 / speed(0.0))
    found = made("rate_state_ageing", path, SETTINGS["rate_state_ageing"]) * path.s[:, None]
    np.testing.assert_allclose(found[:, 2], np.log(u), atol=tolerance * np.ptp(np.log(u)))
    np.testing.assert_allclose(found[:, 1], np.log1p(np.abs(path.v) / V_0), rtol=1e-12)


@pytest.mark.parametrize(("n", "tolerance"), [(400, 2e-2), (1600, 3e-3), (6400, 4e-4)])
def test_the_state_of_the_slip_law_converges_to_the_one_that_scipy_integrates(n, tolerance):
    path = to_and_fro(n)

    def rate(t, w):
        return -abs(speed(t)) / LENGTH * (w + np.log1p(abs(speed(t)) / V_0))

    w = state(rate, path.t, -np.log1p(speed(0.0) / V_0))
    found = made("rate_state_slip", path, SETTINGS["rate_state_slip"])[:, 2] * path.s
    np.testing.assert_allclose(found, w, atol=tolerance * np.max(np.abs(w)))


@pytest.mark.parametrize("hold", [1.0, 10.0, 100.0])
def test_contacts_grow_with_the_time_of_a_hold_and_with_the_slip_law_they_do_not(hold):
    t = np.r_[np.linspace(0, 0.1, 101), 0.1 + hold]
    v = np.r_[np.full(101, 1e-3), 0.0]
    path = Path(t, np.r_[1e-3 * t[:101], 1e-4], v, np.ones(102))
    aged, slipped = (get(n).state(path, SETTINGS[n])[:, 0] for n in ("rate_state_ageing", "rate_state_slip"))
    assert aged[-1] - aged[-2] == pytest.approx(V_0 / LENGTH * hold, rel=1e-2)
    assert slipped[-1] == pytest.approx(slipped[-2], rel=1e-6)


def test_a_steady_slide_has_a_level_of_the_logarithm_of_its_speed():
    t = np.linspace(0, 1.0, 400)
    for v in (1e-3, 1e-2):
        path = Path(t, v * t, np.full(400, v), np.ones(400))
        age = get("rate_state_ageing").state(path, SETTINGS["rate_state_ageing"])[:, 0]
        np.testing.assert_allclose(age, V_0 / v, rtol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_a_path_goes_on_from_what_was_remembered(name):
    whole, effect, cut = to_and_fro(3200), get(name), 700
    inner = [whole.s[:, None]] if effect.modifies else []
    first, rest = (
        replace(whole, **{key: getattr(whole, key)[rows] for key in ("t", "x", "v", "s")})
        for rows in (slice(None, cut + 1), slice(cut, None))
    )
    kept = effect.state(first, SETTINGS[name], *(c[: cut + 1] for c in inner))[-1:]
    found = effect.columns(replace(rest, begin=kept), SETTINGS[name], *(c[cut:] for c in inner))
    truth = effect.columns(whole, SETTINGS[name], *inner)[cut:]
    np.testing.assert_allclose(found, truth, atol=2e-5 * np.max(np.abs(truth)))


@pytest.mark.parametrize("name", NAMES)
def test_a_population_end_to_end_is_the_same_as_one_by_one(name):
    one, effect, of = to_and_fro(), get(name), OTHERS[name]
    n, count = len(one.t), 3
    inner = [one.s[:, None]] if effect.modifies else []
    singles = [effect.columns(one, {k: q[i] for k, q in of.items()}, *inner) for i in range(count)]
    long = Path(*(np.tile(q, count) for q in (one.t, one.x, one.v, one.s)), starts=(0, n, 2 * n))
    values = {k: np.repeat(np.array(q, dtype=float), n) for k, q in of.items()}
    found = effect.columns(long, values, *(np.tile(c, (count, 1)) for c in inner))
    np.testing.assert_allclose(found, np.concatenate(singles), atol=1e-11)


def drive(t):
    return 5 * np.sin(2 * np.pi * 20 * t) * (1 - np.exp(-t / 0.02))


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("elasto_plastic", {"stiffness": 1e-4, "share": 0.6}),
        ("maxwell_slip", {"stiffness": 1e-4, "spread": 5.0}),
        ("rate_state_ageing", {"F_0": 2.0, "A": 0.03, "B": 0.05, "D_c": 1e-4, "v_0": V_0}),
        ("rate_state_slip", {"F_0": 2.0, "A": 0.03, "B": 0.05, "D_c": 1e-4, "v_0": V_0}),
    ],
)
def test_the_parameters_are_found_in_a_measured_friction(name, values):
    effect = get(name)
    law = {"coulomb": {"F_c": 2.0}, name: values} if effect.modifies else {name: values}
    path, nan = to_and_fro(2000), np.full(2000, np.nan)
    seen = Displacement(path.t, path.x, nan, nan, np.full(2000, NM), nan, np.ones(2000, bool))
    tiny = (np.full(2000, size) for size in (NM, 1e-6, 1e-3))
    motion = Motion(path.t, path.x, path.v, np.gradient(path.v, path.t), nan, *tiny, nan)
    noise = 0.01 * np.random.default_rng(0).standard_normal(2000)
    force = models.of(list(law)).force(path, law) + noise
    run = Run(seen, motion, friction_N=force, name="cell")
    found = fit(models.of(list(law)), [run])
    for own, value in values.items():
        estimate = found.parameters[f"{name}.{own}"]
        truth = 2e4 if own == "stiffness" else value
        assert abs(estimate.value - truth) < 4 * (estimate.std or 0.0) + 0.01 * truth, own


@pytest.mark.slow
def test_an_elasto_plastic_contact_is_found_from_a_run_that_reverses():
    values = {"coulomb": {"F_c": 2.0}, "viscous": {"F_v": 1.0}, "elasto_plastic": {"stiffness": 1e-4, "share": 0.6}}
    t = np.arange(600) / 4000
    slide = simulate(models.of(list(values)), values, Conditions(MASS, drive=drive), t, (0.0, 0.0))
    found = fit(models.of(list(values)), [measured(t, slide.x, sigma=1e-6, drive=drive(t))])
    assert found.reduced_chi2 == pytest.approx(1.0, abs=0.2)
    for address, value in (("coulomb.F_c", 2.0), ("elasto_plastic.stiffness", 2e4), ("elasto_plastic.share", 0.6)):
        estimate = found.parameters[address]
        assert abs(estimate.value - value) < 4 * estimate.std + 1e-3 * value


@pytest.mark.parametrize("name", NAMES)
def test_a_law_that_replaces_others_is_no_candidate_of_a_diagnosis(name):
    values = {"coulomb": {"F_c": 2.0}, "viscous": {"F_v": 1.0}}
    t = np.arange(400) / 4000
    slide = simulate(models.of(list(values)), values, Conditions(MASS, drive=drive), t, (0.0, 0.0))
    found = diagnose(fit("coulomb,viscous", [measured(t, slide.x, sigma=1e-6, drive=drive(t))]))
    assert not found.missing
    assert name not in {c.effect for c in found.candidates}


@pytest.fixture(scope="module")
def swung():
    """A fit of two runs that a drive swings to and fro."""
    values = {"coulomb": {"F_c": 1.0}, "stribeck": {"F_s": 0.5, "v_s": 0.3, "delta": 1.0}, "viscous": {"F_v": 0.1}}
    values["presliding"] = {"stiffness": 3e-4, "exponent": 1.0}
    t, runs = np.arange(400) / 1000, []
    for i, push in enumerate((2.6, 4.0)):

        def pushed(t, push=push):
            return push * np.sin(2 * np.pi * 6.0 * t) * (1 - np.exp(-np.asarray(t) / 0.02))

        slide = simulate(models.of(list(values)), values, Conditions(MASS, drive=pushed), t, (0.0, 0.0))
        rng = np.random.default_rng(i)
        runs.append(measured(t, slide.x, sigma=1e-6, drive=pushed(t), name=f"r{i}", rng=rng))
    return values, fit(list(values), runs).solution


@pytest.mark.slow
def test_the_sensitivities_through_reversals_are_the_differences_of_simulations(swung):
    _, solution = swung
    problem, p = solution.problem, solution.p
    assert any(piece.turns for piece in problem.pieces)
    for i in range(5):
        step = np.zeros(len(p))
        step[i] = 1e-4 * p[i]
        above, below = (problem.evaluate(p + sign * step, solution.starts) for sign in (1, -1))
        for more, less, here in zip(above, below, solution.responses, strict=True):
            change = (less.r_full - more.r_full) / 2
            change -= here.q @ (here.q.T @ change)  # less what another start would do
            column = here.jac[:, here.active.index(i)] * step[i]
            assert np.linalg.norm(column - change) < 5e-3 * np.linalg.norm(change)


@pytest.mark.slow
def test_a_fit_through_reversals_ends_where_one_from_the_truth_ends(swung):
    values, solution = swung
    truth = np.array(solution.p)
    truth[:5] = 1.0, 0.5, 0.3, 0.1, values["presliding"]["stiffness"]
    truth[5:] = 1.0
    other = refine(solution.problem, truth, solution.starts, max_steps=40)
    assert solution.objective < other.objective + 0.1


def test_a_contact_that_bends_is_found_together_with_a_patch_in_measured_friction():
    """Dahl's contact in closed form from reversal to reversal: 1 - s w falls by e over the length."""
    rng, t, length = np.random.default_rng(0), np.arange(1500) / 500.0, 5e-4
    x, v = 0.01 * np.sin(2 * np.pi * t), 0.02 * np.pi * np.cos(2 * np.pi * t)
    s, w = np.sign(v), np.zeros(len(t))
    for i in range(1, len(t)):
        w[i] = s[i] * (1 - (1 - s[i] * w[i - 1]) * np.exp(-abs(x[i] - x[i - 1]) / length))
    force = 2.0 * w + 3.0 * v + 0.5 * s * np.exp(-(((x - 0.004) / 0.001) ** 2) / 2)
    run = measured(t, x, sigma=1e-7, friction_N=force + 0.01 * rng.standard_normal(len(t)), rng=rng)
    found = fit(["coulomb", "viscous", "presliding", "patch"], [run])
    assert found.reduced_chi2 < 2
    assert found.parameters["patch.x_c"].value == pytest.approx(0.004, abs=1e-4)
