"""What else may be at fault: a run whose mass is wrong, or another sensor than a camera."""

from __future__ import annotations

import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import frictrack as ft
from frictrack.diagnose.conclusion import Conclusion
from frictrack.diagnose.data_faults import MAX_FRAMES, camera_remarks, remarks_on_places, suspect_run_remarks
from frictrack.effects import LIBRARY

MU, VISCOUS, SIGMA = 0.26, 0.3, 5e-7  # of the weight; N s/m; m


def slide(speed: float, mass: float, stated: float, frames: int = 300) -> ft.Run:
    """m x'' = -mu m g - c x', in closed form."""
    t = np.arange(frames) / 4000.0
    drag = VISCOUS / mass
    level = MU * 9.80665 / drag
    x = (speed + level) / drag * (1 - np.exp(-drag * t)) - level * t
    noise = SIGMA * np.random.default_rng(round(10 * speed)).standard_normal(frames)
    return ft.Run.from_arrays(t, x + noise, mass=stated, name=f"v{speed:g}")


def remarks(masses: list[float], stated: list[float], frames: int = 300) -> list[str]:
    speeds = (3.0, 4.0, 5.0, 6.0)
    runs = [slide(v, m, s, frames) for v, m, s in zip(speeds, masses, stated, strict=True)]
    fitted = ft.fit("coulomb, viscous", runs)
    return suspect_run_remarks(fitted.solution, runs, np.random.default_rng(0))


def test_the_run_whose_mass_is_wrong_is_named() -> None:
    (line,) = remarks([0.35, 0.35, 0.7, 0.7], [0.35, 0.35, 0.7, 0.35])
    assert line.startswith("without ")
    assert "v6" in line.partition(" the model")[0]
    assert "check " in line
    assert "mass" in line


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [2.0, 10.0, 1000.0])
def test_a_mass_that_explains_all_runs_is_asked_before_effects_are_named(ratio: float) -> None:
    stated = (0.35, 0.35, 0.35 / ratio, 0.35)  # as by a decimal point
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of a mass that is likely in another unit
        runs = [slide(v, 0.35, m) for v, m in zip((3.0, 4.0, 5.0, 6.0), stated, strict=True)]
    found = ft.diagnose(ft.fit("coulomb, viscous", runs), quick=True)
    assert (found.verdict, found.missing, found.undetermined[0].what) == ("undetermined", [], "the mass of v5")
    assert found.undetermined[0].why.startswith(f"with {ratio:g} times its stated mass")


@pytest.mark.slow
def test_a_mass_that_is_typed_for_runs_of_double_mass_is_asked() -> None:
    runs = [slide(v, m, 0.35) for v, m in zip((3.0, 4.0, 5.0, 6.0), (0.35, 0.35, 0.7, 0.7), strict=True)]
    found = ft.diagnose(ft.fit("coulomb, viscous", runs), quick=True)
    assert found.verdict == "undetermined"
    what, ratios = found.undetermined[0].what, found.undetermined[0].why.partition(" the model")[0]
    assert (what, ratios) in {
        ("the mass of v5 and v6", "with 2 times their stated mass, or 0.5 times that of the others,"),
        ("the mass of v3 and v4", "with 0.5 times their stated mass, or 2 times that of the others,"),
    }


@pytest.mark.slow
def test_right_masses_are_not_doubted_and_long_records_are_left_out() -> None:
    assert remarks([0.35] * 4, [0.35] * 4) == []
    long = [slide(v, 0.35, 0.35, MAX_FRAMES // 3) for v in (15.0, 20.0, 25.0)]
    fitted = ft.fit("coulomb, viscous", long[:2])
    assert suspect_run_remarks(fitted.solution, long * 2, np.random.default_rng(0)) == []


def test_errors_of_a_camera_are_doubted_where_runs_are_tables() -> None:
    runs, named = [slide(3.0, 0.35, 0.35)], [LIBRARY[name] for name in ("lens", "spring", "camera_shake")]
    (line,) = camera_remarks(runs, named)
    assert line.startswith("lens and camera_shake are errors of a camera, but these runs are tables")
    assert camera_remarks(runs, [LIBRARY["spring"]]) == []
    displacement = replace(runs[0].displacement, pixel_pitch=5e-4)
    assert camera_remarks([replace(runs[0], displacement=displacement)], named) == []


@pytest.mark.parametrize(
    ("pitch", "left", "names"), [(None, True, []), (None, False, ["lens"]), (5e-4, True, ["lens"])]
)
def test_what_a_camera_does_is_no_lead_where_no_camera_is_known(pitch, left, names) -> None:
    lens = SimpleNamespace(effect=LIBRARY["lens"], objection="")
    search = SimpleNamespace(last=SimpleNamespace(leaves_misfit=left), something_is_missing=True)
    conclusion = Conclusion(SimpleNamespace(runs=[SimpleNamespace(pixel_pitch=pitch)]), search)
    vars(conclusion).update(_named=[lens], _n_worth_adding=1)
    assert conclusion._plausible_names == names


@pytest.mark.slow
@pytest.mark.parametrize(("pitch", "first"), [(None, ["vibration"]), (5e-4, ["camera_shake", "vibration"])])
def test_of_two_equal_causes_that_of_a_camera_comes_last_where_none_is_known(
    pitch: float | None, first: list[str]
) -> None:
    t, rng, runs = np.arange(300) / 4000, np.random.default_rng(3), []
    for k, v_0 in enumerate((2.0, 3.0, 4.0)):
        x = v_0 * t - 1.5 * t**2 + 4e-5 * np.sin(2 * np.pi * 61.0 * t + k) + 2e-6 * rng.standard_normal(len(t))
        run = ft.Run.from_arrays(t, x, mass=0.35, sigma=2e-6, name=f"r{k}")
        runs.append(replace(run, displacement=replace(run.displacement, pixel_pitch=pitch)))
    found = ft.diagnose(ft.fit("coulomb", runs), quick=True)
    assert found.verdict == "ambiguous"
    (named,) = found.missing
    assert named in first  # in a film their chi-squared is equal to 1e-12
    assert {"vibration", "camera_shake"} <= {named, *found.best.indistinguishable_from}


def test_a_force_of_the_place_may_be_friction_where_all_runs_move_one_way() -> None:
    named = [LIBRARY[name] for name in ("vibration", "run_in", "spring")]
    there = slide(3.0, 0.35, 0.35)
    back = ft.Run.from_arrays(there.displacement.t, -there.displacement.x, mass=0.35, name="back")
    (line,) = remarks_on_places(ft.fit("coulomb, viscous", [there]).solution, named)
    assert line.startswith("all runs move one way, so that spring may be friction that changes along the course")
    assert remarks_on_places(ft.fit("coulomb, viscous", [there, back]).solution, named) == []
    t = np.arange(0.0, 3.0, 0.01)
    swing = ft.Run.from_arrays(t, 0.2 * np.exp(-0.05 * t) * np.cos(6.0 * t), mass=0.35, name="swing")
    assert remarks_on_places(ft.fit("spring, viscous", [swing]).solution, named) == []


@pytest.mark.parametrize(("growth", "said"), [(0.0, True), (0.5, False)])
def test_a_force_of_the_place_may_be_one_of_the_way_where_all_strokes_turn_at_the_same_places(growth, said) -> None:
    t = np.arange(0.0, 4.0, 0.005)
    x = 1e-4 * (1.0 + growth * t) * np.sin(2 * np.pi * t)
    friction = 2.0 * np.sign(np.cos(2 * np.pi * t)) + 0.01 * np.random.default_rng(0).standard_normal(len(t))
    strokes = ft.Run.from_arrays(t, x, friction=friction, normal_load=5.0, name="strokes")
    found = remarks_on_places(ft.fit("coulomb", [strokes]).solution, [LIBRARY["patch"]])
    assert bool(found) == said
    assert not found or "so that patch may depend on the way since the turn" in found[0]


def test_four_swings_without_dry_friction_have_no_levels_to_compare() -> None:
    t = np.arange(0.0, 1.5, 0.02)
    swings = [
        ft.Run.from_arrays(t, size * np.exp(-0.05 * t) * np.cos(6.0 * t), mass=0.35, name=f"swing {size}")
        for size in (0.1, 0.15, 0.2, 0.25)
    ]
    remarks = ft.fit("spring, viscous", swings).summary()["remarks"]
    assert not [one for one in remarks if "dry friction" in one]
