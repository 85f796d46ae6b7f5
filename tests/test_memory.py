"""Friction with memory against states that scipy integrates, and against runs of known truth."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
from runs import BASE, MASS, measured
from scipy.integrate import solve_ivp

from frictrack import samples
from frictrack.effects import Path, direction_of_motion, get, models
from frictrack.effects.library.presliding import bending
from frictrack.fit import fit, reference_of
from frictrack.fit.cutting import pieces_of
from frictrack.fit.least_squares import LeastSquaresProblem
from frictrack.records import Displacement, Motion, Run
from frictrack.simulate import Conditions, simulate

NM = 1e-9
LENGTH, LAG, RATE = 3e-5, 3e-3, 2 * np.pi * 7
LUGRE = {"F_c": 2.0, "sigma_1": 20.0, "sigma_0": 1e-4, "F_s": 1.5, "v_s": 0.05, "delta": 2.0}
DAHL = {"coulomb": {"F_c": 2.0}, "viscous": {"F_v": 1.0}, "presliding": {"stiffness": 1e-4, "exponent": 1.0}}


def place(t):
    return 2e-4 * np.sin(RATE * t) + 1e-4 * t


def speed(t):
    return 2e-4 * RATE * np.cos(RATE * t) + 1e-4


def to_and_fro(n=800, duration=0.7):
    t = np.linspace(0, duration, n)
    return Path(t, place(t), speed(t), direction_of_motion(speed(t)))


def state(rate, t, start):
    return solve_ivp(rate, (t[0], t[-1]), [start], rtol=1e-10, atol=1e-14, max_step=1e-4, t_eval=t).y[0]


def drive(t):
    return 5 * np.sin(2 * np.pi * 20 * t) * (1 - np.exp(-t / 0.02))


@pytest.mark.few(1)
@pytest.mark.parametrize("exponent", [1.0, 0.5, 1.5])
def test_dahls_state_is_the_one_that_scipy_integrates_through_many_reversals(exponent):
    path = to_and_fro()

    def rate(t, w):
        return speed(t) / LENGTH * np.maximum(1 - w * np.sign(speed(t)), 0.0) ** exponent

    np.testing.assert_allclose(bending(path, LENGTH, exponent), state(rate, path.t, 1.0), atol=1e-6)


def test_without_an_exponent_a_contact_is_elastic_up_to_slip():
    path = to_and_fro()
    w, truth = bending(path, LENGTH, 0.0), [1.0]
    for dx in np.diff(place(np.linspace(0, 0.7, 799 * 50 + 1))):
        truth.append(np.clip(truth[-1] + dx / LENGTH, -1.0, 1.0))
    np.testing.assert_allclose(w, np.array(truth)[::50], atol=2e-3)


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("gamma", "ratio"),
    [(800.0, -1.375), (8e3, 0.0), (3e4, 0.5), (3e4, -0.9), (5e3, -2.0), (1e4, 1.0)],
    ids=["benchmark", "dahl", "harder", "softer", "grows", "elastic"],
)
def test_boucs_and_wens_state_is_the_one_that_scipy_integrates(gamma, ratio):
    path = to_and_fro()

    def rate(t, w):
        v = speed(t)
        return v - gamma * (abs(v) * w + ratio * v * np.abs(w))

    w = state(rate, path.t, 0.0)
    made = get("bouc_wen").columns(path, {"gamma": gamma, "delta": ratio})[:, 0]
    np.testing.assert_allclose(made, w, atol=1e-6 * np.max(np.abs(w)))


def test_without_delta_boucs_and_wens_spring_is_dahls_contact():
    path = to_and_fro()
    rest = replace(path, s=np.append(0.0, path.s[1:]))
    dry = path.s * bending(rest, LENGTH, 1.0) * path.s
    made = get("bouc_wen").columns(rest, {"gamma": 1 / LENGTH, "delta": 0.0})[:, 0]
    np.testing.assert_allclose(made / LENGTH, dry, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "q"),
    [
        ("presliding", {"stiffness": LENGTH, "exponent": 1.0}),
        ("bouc_wen", {"gamma": 800.0, "delta": -1.375}),
        ("lugre", {name: value for name, value in LUGRE.items() if name not in ("F_c", "sigma_1")}),
        ("friction_lag", {"tau": LAG}),
    ],
)
def test_a_path_goes_on_from_what_was_remembered(name, q):
    whole, effect, cut = to_and_fro(3200), get(name), 700
    dry = [np.column_stack([whole.s * np.exp(-np.abs(whole.v) / 0.01)])] if effect.modifies else []
    first, rest = (
        replace(whole, **{key: getattr(whole, key)[rows] for key in ("t", "x", "v", "s")})
        for rows in (slice(None, cut + 1), slice(cut, None))
    )
    kept = effect.state(first, q, *(c[: cut + 1] for c in dry))[-1:]
    made = effect.columns(replace(rest, begin=kept), q, *(c[cut:] for c in dry))
    truth = effect.columns(whole, q, *dry)[cut:]
    np.testing.assert_allclose(made, truth, atol=2e-5 * np.max(np.abs(truth)))


def test_lugres_columns_sum_to_the_published_force():
    path = to_and_fro(3200)
    q = LUGRE | {"v_s": 0.004}
    stiffness = q["F_c"] / q["sigma_0"]

    def level(v):
        return q["F_c"] * (1 + (q["F_s"] - 1) * np.exp(-((v / q["v_s"]) ** 2)))

    def rate(t, z):
        return speed(t) - stiffness * np.abs(speed(t)) * z / level(speed(t))

    z = state(rate, path.t, level(speed(0.0)) / stiffness)
    truth = stiffness * z + q["sigma_1"] * rate(path.t, z)
    made = get("lugre").columns(path, q) @ [q["F_c"], q["sigma_1"]]
    np.testing.assert_allclose(made, truth, atol=1e-5 * np.max(np.abs(truth)))


@pytest.mark.parametrize("tau", [1e-6, 1e-4, 1e-3, 1e-2])
def test_a_lag_follows_the_level_of_dry_friction(tau):
    t = np.linspace(0, 0.1, 401)
    v = 4.0 - 38.0 * t
    path = Path(t, 4 * t - 19 * t**2, v, np.ones_like(t))
    level = np.exp(-v / 0.4)
    made = get("friction_lag").columns(path, {"tau": tau}, level[:, None])[:, 0]
    # u' = (c - u)/tau for c = exp(k t - 10) in closed form
    k = 38.0 / 0.4
    truth = level / (1 + k * tau) + level[0] * (1 - 1 / (1 + k * tau)) * np.exp(-t / tau)
    np.testing.assert_allclose(made, truth, atol=1e-6 * np.max(level))


@pytest.mark.parametrize("tau", [-0.02, 0.0, 0.013])
def test_a_delay_of_a_load_cell_shifts_any_force_of_every_individual(tau):
    t = np.linspace(0, 0.1, 101)
    both = np.r_[t, t + 3.0]
    path = Path(both, both, np.ones(202), np.ones(202), friction=np.ones(202), starts=(0, 101))
    made = get("cell_delay").columns(path, {"tau": tau}, np.column_stack([both, -2 * both]))
    late = np.clip(t - tau, 0, 0.1)
    np.testing.assert_allclose(made, np.outer(np.r_[late, late + 3.0], [1, -2]), atol=1e-12)


@pytest.mark.parametrize("tau", [1e-6, 1e-4, 1e-3, 1e-2])
def test_a_load_cell_that_is_late_shows_any_force_so(tau):
    t = np.linspace(0, 0.1, 401)
    path = Path(t, t, np.ones_like(t), np.ones_like(t), friction=np.ones_like(t))
    wave, answer = np.exp(30j * t), 1 / (1 + 30j * tau)  # u' = (c - u)/tau, u = c at first, in closed form
    columns = np.column_stack([np.ones_like(t), wave.imag])
    made = get("cell_lag").columns(path, {"tau": tau}, columns)
    truth = (answer * wave - answer * np.exp(-t / tau)).imag
    np.testing.assert_allclose(made, np.column_stack([np.ones_like(t), truth]), atol=1e-6)
    along_a_simulated_motion = replace(path, friction=None)
    np.testing.assert_array_equal(get("cell_lag").columns(along_a_simulated_motion, {"tau": tau}, columns), columns)


def test_a_contact_that_rests_is_unbent_and_one_that_slides_is_bent():
    t = np.linspace(0, 0.01, 50)
    path = Path(t, t**2, 2 * t, np.r_[0.0, np.ones(49)])
    w = bending(path, LENGTH, 1.0)
    np.testing.assert_allclose(w, 1 - np.exp(-(t**2) / LENGTH), atol=1e-12)
    sliding = Path(t, t, np.ones(50), np.ones(50))
    np.testing.assert_array_equal(bending(sliding, LENGTH, 1.0), 1.0)


@pytest.mark.parametrize("flicker", [0.0, 3.5e-3])  # m/s: beyond the three deviations at which a frame moves
def test_a_run_that_rested_as_its_push_set_in_begins_unbent(flicker):
    t = np.arange(200) / 4000
    v = np.maximum(t - 4.5 / 4000, 0.0) * 100.0
    v[0] = flicker
    x, one, nan = np.cumsum(v) / 4000, np.ones(200), np.full(200, np.nan)
    displacement = Displacement(t, x, nan, nan, nan, nan, one > 0)
    motion = Motion(t, x, v, np.gradient(v, t), nan, 1e-6 * one, 1e-3 * one, 0.1 * one, nan, 0)
    run = Run(displacement, motion, mass=1.0, drive=100.0 * one)
    ((piece,),) = pieces_of([run], reference_of([run]))
    began = piece.path.before[:, 0]
    assert began[2] == 0.0
    assert began[0] + run.motion.t[0] <= 4 / 4000
    assert bending(replace(piece.path, x=piece.x_hat, v=piece.v_hat), 1e-3, 1.0)[0] < 0.05
    ((same,),) = pieces_of([run], reference_of([run]), through_reversals=True)
    assert not same.turns  # it goes one way: nothing is to be followed through a stop


def test_a_path_begins_as_the_motion_before_it_has_left_the_contact():
    whole = to_and_fro()
    cut = 300
    before = np.stack([whole.t, whole.x, whole.v])[:, : cut + 1]
    rest = Path(whole.t[cut:], whole.x[cut:], whole.v[cut:], whole.s[cut:], before=before)
    np.testing.assert_allclose(bending(rest, LENGTH, 1.0), bending(whole, LENGTH, 1.0)[cut:], atol=1e-12)
    q = LUGRE | {"v_s": 0.004}
    np.testing.assert_allclose(get("lugre").columns(rest, q), get("lugre").columns(whole, q)[cut:], atol=1e-3)


@pytest.mark.parametrize(
    ("name", "of"),
    [
        ("presliding", {"stiffness": (2e-5, 1e-4, 7e-5), "exponent": (1.0, 0.3, 1.0)}),
        ("friction_lag", {"tau": (1e-3, 1e-2, 4e-3)}),
        ("bouc_wen", {"gamma": (800.0, 3e4, 5e3), "delta": (-1.375, 0.5, 0.0)}),
        (
            "lugre",
            {"sigma_0": (2e-5, 1e-4, 7e-5), "F_s": (1.2, 2.0, 1.5), "v_s": (0.01, 3e-3, 0.02), "delta": (2, 2, 2)},
        ),
    ],
)
def test_a_population_end_to_end_is_the_same_as_one_by_one(name, of):
    one, effect = to_and_fro(), get(name)
    n, count = len(one.t), 3
    inner = [np.column_stack([one.s, one.s * np.exp(-np.abs(one.v) / 0.01)])] if effect.modifies else []
    singles = [effect.columns(one, {k: q[i] for k, q in of.items()}, *inner) for i in range(count)]
    long = Path(*(np.tile(q, count) for q in (one.t, one.x, one.v, one.s)), starts=(0, n, 2 * n))
    values = {k: np.repeat(np.array(q, dtype=float), n) for k, q in of.items()}
    made = effect.columns(long, values, *(np.tile(c, (count, 1)) for c in inner))
    np.testing.assert_allclose(made, np.concatenate(singles), atol=1e-12)


def test_lag_comes_before_presliding_whatever_the_order_in_which_they_are_named():
    path = to_and_fro()
    values = {"coulomb": {}, "stribeck": {"v_s": 0.01, "delta": 1.0}, "friction_lag": {"tau": LAG}} | {
        "presliding": {"stiffness": LENGTH, "exponent": 1.0}
    }
    one = models.of(["coulomb", "stribeck", "friction_lag", "presliding"]).force_columns(path, values)
    two = models.of(["presliding", "friction_lag", "stribeck", "coulomb"]).force_columns(path, values)
    np.testing.assert_array_equal(one["stribeck"], two["stribeck"])


def test_stiffness_is_quoted_from_the_level_of_dry_friction():
    quote = get("presliding").quote({"stiffness": 1e-4}, {"coulomb.F_c": 2.0, "stribeck.F_s": 1.0})
    assert quote["stiffness"] == pytest.approx(3e4)
    quote = get("lugre").quote({"F_c": 2.0, "F_s": 1.5, "sigma_0": 1e-4}, {})
    assert quote == pytest.approx({"F_s": 3.0, "sigma_0": 2e4})
    quote = get("bouc_wen").quote({"alpha": 5e4, "gamma": 800.0, "delta": -1.375}, {})
    assert quote == pytest.approx({"delta": -1100.0})


def _dahl_rate(t, z):
    level = 2.0 * z[2] + z[1]
    return [z[1], (drive(t) - level) / MASS, z[1] / 1e-4 * (1 - z[2] * np.sign(z[1]))]


def _lugre_rate(t, z):
    stiffness, v = 2e4, z[1]
    bend = v - stiffness * abs(v) * z[2] / (2 * (1 + 0.5 * np.exp(-((v / 0.05) ** 2))))
    return [v, (drive(t) - stiffness * z[2] - 20 * bend - v) / MASS, bend]


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("values", "rate"),
    [(DAHL, _dahl_rate), ({"lugre": LUGRE, "viscous": {"F_v": 1.0}}, _lugre_rate)],
    ids=["dahl", "lugre"],
)
def test_a_slide_under_a_drive_is_followed_through_sticking_and_reversal(values, rate):
    t = np.arange(400) / 4000
    run = simulate(models.of(list(values)), values, Conditions(MASS, drive=drive), t, (0.0, 0.0))
    truth = solve_ivp(
        rate, (0, t[-1]), [0.0, 0.0, 0.0], method="LSODA", rtol=1e-12, atol=1e-14, max_step=1e-4, t_eval=t
    )
    assert np.sum(np.diff(np.sign(run.v[1:])) != 0) >= 3
    assert np.max(np.abs(run.x - truth.y[0])) < 0.1 * NM


def test_a_slide_with_a_lag_is_followed():
    t, values = np.arange(300) / 4000, BASE | {"friction_lag": {"tau": LAG}}
    run = simulate(models.of(list(values)), values, Conditions(MASS), t, (0.0, 4.0))

    def rate(t, z):
        return [z[1], -(8 + z[2] + 1.2 * z[1]) / MASS, (6 * np.exp(-z[1] / 0.4) - z[2]) / LAG]

    truth = solve_ivp(rate, (0, t[-1]), [0.0, 4.0, 6 * np.exp(-10.0)], rtol=1e-12, atol=1e-14, t_eval=t)
    assert np.max(np.abs(run.x - truth.y[0])) < 0.1 * NM


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [1e-6, 1e-5])
def test_the_stiffness_is_found_from_a_run_that_reverses_under_a_drive(sigma):
    t = np.arange(600) / 4000
    slide = simulate(models.dahl(), DAHL, Conditions(MASS, drive=drive), t, (0.0, 0.0))
    run = measured(t, slide.x, sigma=sigma, drive=drive(t))
    found = import_module("frictrack.fit").fit("dahl", [run])
    assert found.reduced_chi2 == pytest.approx(1.0, abs=0.2)
    for name, truth in (("coulomb.F_c", 2.0), ("viscous.F_v", 1.0), ("presliding.stiffness", 2e4)):
        estimate = found.parameters[name]
        assert abs(estimate.value - truth) < 4 * estimate.std + 1e-3 * truth
        assert estimate.std < 0.2 * truth


@pytest.mark.slow
def test_an_effect_with_memory_takes_few_simulations_where_something_else_is_missing(monkeypatch):
    evaluated, evaluate = [], LeastSquaresProblem.evaluate
    monkeypatch.setattr(LeastSquaresProblem, "evaluate", lambda *a, **k: (evaluated.append(1), evaluate(*a, **k))[1])
    fitted = fit(["coulomb", "stribeck", "viscous", "lugre"], samples.runs())
    assert fitted.reduced_chi2 == pytest.approx(8.42, rel=0.01)  # what two starts and all steps reach
    assert len(evaluated) < 100  # 11 to 63, by rounding: the start lies in a valley of the stiffness
