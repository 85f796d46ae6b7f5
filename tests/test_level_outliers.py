"""A run whose frame rate or scale is wrong is found by its level of dry friction, which absorbs the error."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import frictrack as ft
from frictrack.cli.common import after_diagnosis
from frictrack.diagnose.compressed import compress_residual
from frictrack.fit.linearised import linearise
from frictrack.fit.stepwise import likely_levels
from frictrack.results.verdicts import headline

MU, DRAG, SIGMA = 0.26, 0.05, 5e-7  # of the weight; kg/s per kg; m
SPEEDS = (3.0, 4.0, 5.0, 6.0)


def slide(speed: float, seed: int, *, rate: float = 1.0, scale: float = 1.0, friction: float = 1.0) -> ft.Run:
    """x'' = -mu g - c x', in closed form; `rate` and `scale` are the errors of what the user states."""
    t = np.arange(400) / 4000.0
    level = friction * MU * 9.80665 / DRAG
    x = (speed + level) / DRAG * (1 - np.exp(-DRAG * t)) - level * t
    noise = SIGMA * np.random.default_rng(seed).standard_normal(len(t))
    return ft.Run.from_arrays(t / rate, scale * (x + noise), mass=0.35, name=f"v{speed:g}")


def remarks(**wrong: float) -> list[str]:
    runs = [slide(v, k, **(wrong if k == 2 else {})) for k, v in enumerate(SPEEDS)]
    return [
        line for line in ft.fit("coulomb, viscous", runs).summary()["remarks"] if line.startswith("dry friction in")
    ]


@pytest.mark.few(1)
@pytest.mark.parametrize(("wrong", "ratio"), [({"rate": 2.0}, 4.0), ({"rate": 0.5}, 0.25), ({"scale": 1.5}, 1.5)])
def test_a_wrong_frame_rate_or_scale_of_one_run_is_said(wrong: dict[str, float], ratio: float) -> None:
    (line,) = remarks(**wrong)
    found = re.match(r"dry friction in v5 is ([\d.]+) times", line)
    assert found, line
    assert float(found[1]) == pytest.approx(ratio, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wrong", "missing"), [({"rate": 2.0}, ["clock_rate"]), ({"friction": 1.05}, []), ({"scale": 1.5}, [])]
)
def test_a_wrong_frame_rate_is_named_and_is_no_other_friction(wrong: dict[str, float], missing: list[str]) -> None:
    runs = [slide(v, k, **(wrong if k == 2 else {})) for k, v in enumerate(SPEEDS)]
    found = ft.diagnose(ft.fit("coulomb, viscous", runs), quick=True)
    assert (found.missing, found.leads) == (missing, [])
    if missing:
        words = found.summary()["candidates"][0]["words"]["here"]
        assert words.startswith("In run v5, whose true times would be its recorded ones times 2.000")


@pytest.mark.few(1)
@pytest.mark.parametrize("friction", [0.9, 1.0, 1.1])
def test_friction_that_scatters_as_surfaces_do_is_no_remark(friction: float) -> None:
    assert remarks(friction=friction) == []


@pytest.mark.few(1)
@pytest.mark.parametrize(("rubber", "said"), [(1.1, 1), (1.0, 0)])
def test_groups_of_runs_that_rub_differently_are_said(rubber: float, said: int) -> None:
    scatter = 1 + 0.01 * np.random.default_rng(0).standard_normal(8)
    runs = [
        replace(slide(v, k, friction=scatter[k] * (rubber if k % 2 else 1)), group="rubber" if k % 2 else "steel")
        for k, v in enumerate((*SPEEDS, 3.2, 4.2, 5.2, 6.2))
    ]
    runs = [replace(run, name=f"r{k}") for k, run in enumerate(runs)]
    found = [line for line in ft.fit("coulomb, viscous", runs).summary()["remarks"] if "in the group" in line]
    assert len(found) == said
    for line in found:
        ratio = re.search(r"rubber is ([\d.]+) times that in the group steel", line)
        assert ratio is not None
        assert float(ratio[1]) == pytest.approx(1.1, abs=0.02)


# ---- what a friction level multiplies


def sliding(level_of: str, scatter: float, patch: float = 0.0, drag: float = 0.0, step: float = 0.0) -> list[ft.Run]:
    """Six runs whose friction scatters as a whole, or only its dry or viscous part, by SciPy; other forces do not."""
    rng, t, runs = np.random.default_rng(2), np.arange(500) / 2500, []
    for k in range(6):
        level = 1 + scatter * rng.standard_normal()
        viscous = 0.08 * (1.0 if level_of == "dry" else level)
        level = 1.0 if level_of == "viscous" else level

        def motion(_: float, y: np.ndarray, level: float = level, viscous: float = viscous) -> list[float]:
            dry = level * (1.0 + 0.35 * np.exp(-y[1] / 0.4))
            other = drag * y[1] ** 2 + patch * np.exp(-0.5 * ((y[0] - 0.25) / 0.012) ** 2) + step * (y[0] > 0.3)
            return [y[1], -(dry + viscous * y[1] + other) / 0.35]

        x = solve_ivp(motion, (0, t[-1]), [0.01, 2.0 + 0.3 * k], rtol=1e-10, atol=1e-13, t_eval=t, max_step=1e-3).y[0]
        runs.append(ft.Run.from_arrays(t, x + 2e-6 * rng.standard_normal(500), mass=0.35, sigma=2e-6, name=f"r{k}"))
    return runs


@pytest.mark.slow
@pytest.mark.parametrize("runs", [3, 6])
def test_friction_that_scatters_as_a_whole_lacks_nothing(runs: int) -> None:
    found = ft.diagnose(ft.fit("tustin", sliding("all", 0.04)[-runs:]), rng=1, quick=True)
    assert (found.missing, found.leads) == ([], [])
    assert found.verdict in {"complete", "undetermined"}
    assert any("level of a run multiplies viscous too" in line for line in found.remarks)
    assert found.summary()["levels"] == ["viscous.level"]
    if found.verdict == "complete":  # else the runs leave something open, which comes first
        assert "study.toml viscous.level lets friction differ" in after_diagnosis(found.summary(), "study.toml")
        assert headline(found.summary()) == (
            "Tustin + viscous.level is complete: no further effect is detectable in these runs"
        )


@pytest.mark.slow
def test_a_patch_is_named_alone_where_it_does_not_follow_the_friction_levels() -> None:
    found = ft.diagnose(ft.fit("tustin", sliding("dry", 0.01, 0.24)), rng=1, quick=True)
    assert (found.verdict, found.missing) == ("missing", ["patch"])


@pytest.mark.slow
@pytest.mark.parametrize("drag", [0.02, 0.04])
def test_drag_is_named_beside_friction_that_scatters_as_a_whole(drag: float) -> None:
    found = ft.diagnose(ft.fit("tustin", sliding("all", 0.03, drag=drag)), rng=1, quick=True)
    assert (found.verdict, found.missing) == ("missing", ["drag"])


@pytest.mark.slow
def test_a_step_outside_the_library_is_a_formula_beside_friction_that_scatters_as_a_whole() -> None:
    found = ft.diagnose(ft.fit("tustin", sliding("all", 0.03, step=0.12)), rng=1).summary()
    assert (found["verdict"], found["leads"], found["levels"]) == ("unexplained", [], ["viscous.level"])
    first = found["unexplained"]["formulas"][0]
    assert first["probability"] > 0.8
    assert first["form"] == "F * L * s * tanh(((x - c)/w))"
    assert "follows_level = false" in first["toml"]


@pytest.mark.slow
def test_viscous_friction_that_scatters_alone_is_no_wrong_clock() -> None:
    found = ft.diagnose(ft.fit("tustin", sliding("viscous", 0.05)), rng=1, quick=True)
    levels = [line for line in found.remarks if "multiplies viscous too but not coulomb" in line]
    assert found.leads == []
    assert found.missing == ["viscous.F_v"] or (found.missing == [] and levels)


@pytest.mark.parametrize(("level_of", "follows"), [("all", True), ("dry", False)])
def test_the_levels_multiply_what_they_multiplied(level_of: str, follows: bool) -> None:
    law = linearise(ft.fit("tustin", sliding(level_of, 0.03)).solution)
    assert [p.loaded for p in likely_levels(law).layout.model.effects[-1].linear] == [follows]


@pytest.mark.slow
def test_levels_that_multiply_more_are_added_and_kept() -> None:
    plain = ft.fit("tustin", sliding("all", 0.03))
    fit = ft.fit(plain.model + "viscous.level", plain.runs)
    law = ft.models.from_toml(fit.model.to_toml())
    assert "viscous follows the friction levels" in law.settings
    assert [e.linear[0].loaded for e in law.effects] == [True, True, True]
    assert fit.solution.objective < plain.solution.objective - 30
    found = ft.diagnose(fit, rng=1, quick=True)
    assert found.levels == []
    assert not any("friction level of a run" in line for line in found.remarks)


def test_a_force_that_the_levels_multiply_is_data_whatever_their_scatter() -> None:
    fit = ft.fit("tustin, patch", sliding("all", 0.03, patch=0.24))
    left = []
    for tau in (1e-3, 0.5):
        residual = compress_residual(replace(fit.solution, tau=tau), "patch").residual
        left.append(float(residual @ residual))
    assert left[1] > 0.5 * left[0] > 1e4


def test_a_force_that_is_no_friction_follows_no_level() -> None:
    with pytest.raises(ft.FrictrackError, match=r'"spring": follows_level: expected it of friction'):
        ft.models.from_toml('model = "coulomb, spring"\n[[effect]]\neffect = "spring"\nfollows_level = true')
