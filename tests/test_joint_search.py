"""Effects that were added one by one and imitate a pair of others are exchanged for that pair, or both are named.

The motions come from SciPy's integrator.
"""

from __future__ import annotations

import importlib
from dataclasses import replace

import numpy as np
import pytest
from runs import MASS, measured
from scipy.integrate import solve_ivp

import frictrack as ft
from frictrack.diagnose.conclusion import Conclusion, FinishedSearch
from frictrack.diagnose.joint_search import AlternativeSet, exchange_effects, with_rivals_of_sets
from frictrack.diagnose.refined_candidates import RefinedCandidate
from frictrack.diagnose.rounds import run_round
from frictrack.effects import LIBRARY
from frictrack.verdicts import indistinguishable_effects

joint_search = importlib.import_module("frictrack.diagnose.joint_search")
LAW = ["coulomb", "viscous"]
PLAN = ((2.5, 1), (4.0, 1), (6.0, 1), (4.0, 2), (-2.5, 1), (-5.5, 1))  # start speed m/s, mass over the reference
FRAMES, FPS = 260, 4000.0
DRAG = 0.01  # N s^2/m^2


def slides(slope: float, drag: float) -> list[ft.Run]:
    """Runs on an inclined course with an air drag, N at the reference mass and N s^2/m^2."""
    out = []
    for k, (speed, ratio) in enumerate(PLAN):
        t, mass, s = np.arange(FRAMES) / FPS, ratio * MASS, np.sign(speed)

        def motion(_: float, y: np.ndarray, mass: float = mass, ratio: float = ratio, s: float = s) -> list[float]:
            force = 4.0 * ratio * s + 0.5 * y[1] + slope * ratio + drag * y[1] * abs(y[1])
            return [y[1], -force / mass]

        x = solve_ivp(motion, (0.0, t[-1]), [0.0, speed], t_eval=t, rtol=1e-10, atol=1e-13).y[0]
        noise = np.random.default_rng(k)
        out.append(measured(t, x, sigma=3e-6, mass=mass, name=f"r{k}", rng=noise))
    return out


def diagnosed_as(wrong: list[str], runs: list[ft.Run]) -> tuple[list[str], list[frozenset[str]]]:
    """The effects and the other sets that remain of a wrong pair of effects."""
    bare, rng = ft.fit(LAW, runs).solution, np.random.default_rng(0)
    first = run_round(bare, [], rng, lambda what: None)
    law = ft.fit([*LAW, *wrong], runs).solution
    found = [RefinedCandidate(LIBRARY[name], law, 100.0, 0.001) for name in wrong]
    kept, others = exchange_effects(first, [first.tested], found)
    return [t.effect.name for t in kept], [frozenset(one.effects) for one in others]


@pytest.mark.slow
def test_a_pair_that_explains_less_gives_way_to_the_pair_that_is_true():
    named, others = diagnosed_as(["asymmetry", "spring"], slides(0.4, 0.06))
    assert {"slope", "drag"} in [set(named), *map(set, others)]
    assert set(named) != {"asymmetry", "spring"}


@pytest.mark.slow
def test_two_effects_that_each_explain_nothing_in_place_of_one_are_tried_together(monkeypatch):
    """Flash weakening imitates a late clock with air drag; drag in its place is of no use without the clock."""
    monkeypatch.setattr(joint_search, "N_EXCHANGED", 2)  # pairs of what explains most alone: without drag
    runs = []
    for i, (speed, ratio) in enumerate(PLAN):
        clock, mass, s = np.arange(FRAMES) / FPS, ratio * MASS, np.sign(speed)
        t = clock + 0.02 * clock**2 / 2  # y = x + k v t^2/2

        def motion(_: float, y: np.ndarray, mass: float = mass, ratio: float = ratio, s: float = s) -> list[float]:
            texture = 0.3 * np.sin(2 * np.pi * y[0] / 0.05)
            force = s * ratio * (4.0 + texture) + 0.5 * y[1] + DRAG * y[1] * abs(y[1])
            return [y[1], -force / mass]

        solved = solve_ivp(motion, (0.0, t[-1]), [0.0, speed], t_eval=t, rtol=1e-10, atol=1e-13, max_step=1e-4)
        rng = np.random.default_rng(i)
        runs.append(measured(clock, solved.y[0], sigma=3e-6, mass=mass, name=f"r{i}", rng=rng))
    first = run_round(ft.fit(LAW, runs).solution, [], np.random.default_rng(0), lambda what: None)
    wrong = ft.fit([*LAW, "flash_weakening", "texture"], runs).solution
    found = [RefinedCandidate(LIBRARY[name], wrong, 100.0, 0.001) for name in ("flash_weakening", "texture")]
    kept, others = exchange_effects(first, [first.tested], found)
    assert {"drag", "timebase", "texture"} in [{t.effect.name for t in kept}, *(set(one.effects) for one in others)]


@pytest.mark.slow
def test_one_effect_that_imitates_two_gives_way_to_them():
    """A spring imitates air drag with friction that grows with the logarithm of the speed."""
    runs = []
    for i, (speed, ratio) in enumerate(((2.1, 1), (3.8, 1), (5.4, 1), (7.0, 1), (4.6, 0.5), (4.6, 2))):
        t, mass = np.arange(900) / FPS, ratio * 0.22

        def motion(_: float, y: np.ndarray, mass: float = mass, ratio: float = ratio) -> list[float]:
            v = y[1]
            dry = 0.9 + 0.44 * np.exp(-v / 0.64) + 0.0172 * np.log(v / 1e-6)
            return [v, -(ratio * dry + 0.113 * v + 0.0013 * v * v) / mass]

        def slow(_: float, y: np.ndarray) -> float:
            return y[1] - 0.05

        slow.terminal = True
        solved = solve_ivp(motion, (0.0, t[-1]), [0.0, speed], t_eval=t, rtol=1e-10, atol=1e-13, events=slow)
        rng = np.random.default_rng(i)
        runs.append(measured(solved.t, solved.y[0], sigma=2.3e-6, mass=mass, name=f"r{i}", rng=rng))
    fit = ft.fit("tustin", runs)
    first = run_round(fit.solution, [], np.random.default_rng(0), lambda what: None)
    spring = next(t for t in first.tried if t.effect.name == "spring")
    found = [replace(spring, solution=ft.fit(["tustin", "spring"], runs).solution)]
    kept, others = exchange_effects(first, [first.tested], found)
    assert {"drag", "log_velocity"} in [{t.effect.name for t in kept}, *(set(one.effects) for one in others)]


def test_a_set_in_place_of_one_effect_is_its_rival_as_a_whole():
    runs = slides(0.4, 0.0)
    fit = ft.fit(LAW, runs)
    one, pair = (ft.fit([*LAW, *names], runs).solution for names in (["slope"], ["asymmetry", "spring"]))
    first, last = (run_round(law, [], np.random.default_rng(0), lambda what: None) for law in (fit.solution, one))
    found = [RefinedCandidate(LIBRARY["slope"], one, 100.0, 0.001)]
    others = [AlternativeSet(("asymmetry", "spring"), 3.0, pair)]
    assert with_rivals_of_sets(found, others)[0].indistinguishable_from == ()  # neither of them explains as much
    generators = np.random.default_rng(0).spawn(2)
    conclusion = Conclusion(fit, FinishedSearch(fit.solution, first, last, found, generators, None, others))
    told = conclusion.completed(None, lambda what: None).summary()
    assert (told["verdict"], told["missing"]) == ("ambiguous", ["slope"])
    assert indistinguishable_effects(told) == ["slope", "asymmetry with spring"]
    compared = {name for step in told["next_experiment"] for group in step["groups"] for name in group}
    assert compared >= {"slope", "asymmetry with spring"}


@pytest.mark.slow
def test_the_true_pair_stays():
    named, _ = diagnosed_as(["slope", "drag"], slides(0.4, 0.06))
    assert set(named) == {"slope", "drag"}


@pytest.mark.few(1)
@pytest.mark.parametrize(("together", "verdict"), [(0.5, "missing"), (2.0, "unexplained")])
def test_effects_are_named_if_the_model_with_all_of_them_predicts_better(together: float, verdict: str):
    """The first effect alone may predict worse, while the others are still missing."""
    runs = slides(0.4, 0.06)
    fit = ft.fit(LAW, runs)
    alone, whole = (ft.fit([*LAW, *names], runs).solution for names in (["slope"], ["slope", "drag"]))
    first, last = (run_round(law, [], np.random.default_rng(0), lambda what: None) for law in (fit.solution, whole))
    found = [RefinedCandidate(LIBRARY[n], law, 100.0, 0.001) for n, law in (("slope", alone), ("drag", whole))]
    generators = np.random.default_rng(0).spawn(2)
    conclusion = Conclusion(fit, FinishedSearch(fit.solution, first, last, found, generators))
    vars(conclusion)["_heldout"] = lambda law: (1.0, together if law is whole else 2.0, "run by run")
    assert conclusion.verdict.candidates[0].heldout_after == 2.0
    assert conclusion.verdict.verdict == verdict
