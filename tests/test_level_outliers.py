"""A run whose frame rate or scale is wrong is found by its level of dry friction, which absorbs the error."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

import frictrack as ft

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
def test_a_wrong_frame_rate_is_not_taken_for_a_wrong_mass() -> None:
    runs = [slide(v, k, rate=2.0 if k == 2 else 1.0) for k, v in enumerate(SPEEDS)]
    found = ft.diagnose(ft.fit("coulomb, viscous", runs), quick=True)
    assert found.undetermined[0].what == "the frame rate, mass and surface of v5"
    assert "a frame rate that is 2 times too high does this" in found.undetermined[0].why


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
