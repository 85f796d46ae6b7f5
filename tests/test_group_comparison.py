"""One parameter compared between groups of runs: p uniform without a difference, coverage 95 %, the whole chain."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import kstest

import frictrack as ft
from frictrack.cli import main
from frictrack.diagnose.compare.groups import _compare

MASS = 0.35


def slide(v0: float, level: float, F_v: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Times and positions of a slide under F = level + F_v v, in closed form, with a noise of 5 um."""
    k, a = F_v / MASS, level / MASS
    t = np.arange(0.0, 0.97 * np.log(1 + k * v0 / a) / k, 4e-3)
    x = (v0 + a / k) * (1 - np.exp(-k * t)) / k - a / k * t
    return t, x + 5e-6 * rng.standard_normal(len(t))


def runs(difference: float, counts: tuple[int, int] = (4, 4), seed: int = 0) -> list[ft.Run]:
    """Runs of two groups with levels that scatter by 3 %; the second has a larger viscous coefficient."""
    rng, out = np.random.default_rng(seed), []
    for i in range(sum(counts)):
        second = i >= counts[0]
        t, x = slide(rng.uniform(1.0, 2.5), 0.9 * (1 + 0.03 * rng.standard_normal()), 0.2 + second * difference, rng)
        group = "magnetic" if second else "good"
        out.append(ft.Run.from_arrays(t, x, mass=MASS, name=f"r{i}", group=group))
    return out


@pytest.mark.few(1)
@pytest.mark.parametrize(("counts", "tau"), [((4, 4), 0.03), ((2, 3), 0.03), ((3, 6), 0.0), ((2, 2), 0.1)])
def test_p_is_uniform_and_intervals_cover(counts: tuple[int, int], tau: float) -> None:
    rng, p, covered, n = np.random.default_rng(1), [], 0, sum(counts)
    x = np.repeat(np.eye(2), counts, axis=0)
    for k in range(200):
        root = 0.02 * rng.uniform(0.5, 1.5, n)[:, None] * (np.eye(n) + 0.2)  # what the joint fit leaves common
        y = root @ rng.standard_normal(n) + tau * rng.standard_normal(n)
        difference = 0.05 * (k % 2)
        found = _compare(("a.b", "N"), ["a", "b"], (y + difference * x[:, 1], root @ root.T, x), {}, {})
        pair = found.differences["b - a"]
        covered += pair.interval[0] < difference < pair.interval[1]
        if not difference:
            p.append(pair.p)
    assert kstest(p, "uniform").pvalue > 0.01
    assert covered >= 182  # of 200; 99 % of binomial(200, 0.95)


def test_a_difference_is_found_and_none_is_not_invented() -> None:
    found = ft.compare_groups(ft.fit(["coulomb", "viscous"], runs(0.01)), "viscous.F_v")
    pair = found.differences["magnetic - good"]
    assert pair.interval[0] < 0.01 < pair.interval[1]
    assert pair.p is not None
    assert pair.p < 1e-3
    level = ft.compare_groups(ft.fit(["coulomb", "viscous"], runs(0.01, (3, 3))), "coulomb.F_c")
    assert level.p > 0.01
    assert level.scatter == pytest.approx(0.027, rel=0.6)  # N: 3 % of 0.9 N
    assert level.degrees == 4
    assert level.groups["good"].value == pytest.approx(0.9, abs=3 * level.groups["good"].std)


def test_points_of_a_bench_in_two_groups() -> None:
    rng, v = np.random.default_rng(2), np.geomspace(0.01, 1.0, 20)
    made = [
        ft.Run.from_curve(
            v, level + 0.1 * i + 0.5 * v + 0.01 * rng.standard_normal(20), sigma=0.01, name=f"{g}{i}", group=g
        )
        for g, level in (("dry", 2.0), ("oil", 1.0))
        for i in range(3)
    ]
    found = ft.compare_groups(ft.fit(["coulomb", "viscous"], made), "coulomb.F_c")
    assert found.differences["oil - dry"].value == pytest.approx(-1.0, abs=0.01)
    assert found.scatter == pytest.approx(0.1, rel=0.05)  # of 0, 0.1, 0.2


def test_faults_are_one_sentence() -> None:
    some = runs(0.0, (2, 1))
    fitted = ft.fit(["coulomb", "viscous"], some)
    with pytest.raises(
        ft.FrictrackError, match=r'expected a parameter of the model .* "viscous.F"; it has coulomb.F_c'
    ):
        ft.compare_groups(fitted, "viscous.F")
    with pytest.raises(ft.FrictrackError, match="expected runs of at least two groups"):
        ft.compare_groups(ft.fit(["coulomb", "viscous"], some[:2]), "viscous.F_v")
    without = [replace(run, group="") for run in some]
    with pytest.raises(ft.FrictrackError, match="expected every run to have a group but r0, r1, r2 has none"):
        ft.compare_groups(ft.fit(["coulomb", "viscous"], without), "viscous.F_v")


def test_the_command_says_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng, text = np.random.default_rng(3), '[study]\nmass = "350 g"\nmodel = ["coulomb", "viscous"]\n'
    for i in range(4):
        t, x = slide(1.0 + 0.3 * i, 0.9, 0.2 + 0.01 * (i > 1), rng)
        np.savetxt(tmp_path / f"r{i}.csv", np.column_stack([t, x]), delimiter=",", header="t_s,x_m", comments="")
        text += f'[[run]]\ntable = "r{i}.csv"\ngroup = "{"ab"[i > 1]}"\n'
    (tmp_path / "study.toml").write_text(text)
    with pytest.raises(SystemExit):
        main(["compare", str(tmp_path / "study.toml"), "--parameter", "viscous.F_v", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["differences"]["b - a"]["value"] == pytest.approx(0.01, rel=0.1)
    assert found["words"][1].startswith("b - a: 0.0")
