"""What was typed is checked: every mistyped number is named with its correction, and no right one is doubted."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib import import_module
from io import StringIO
from itertools import pairwise
from math import cos, radians, sin
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from scipy.integrate import solve_ivp

from frictrack import samples
from frictrack.base.errors import FrictrackError
from frictrack.cli import main
from frictrack.cli.output import verdict
from frictrack.flow import Session, open_study, read_results
from frictrack.flow.new_study import propose_study
from frictrack.measure.motion import differentiate, low_pass
from frictrack.measure.plausibility import (
    ERROR,
    EnteredValues,
    estimate_slide,
    implausible_clocks,
    implausible_entries,
    implausible_inclines,
    implausible_masses,
    implausible_slide,
    missing_incline,
    path_angle,
    shifted_swings,
    swing_centre,
    wrong_incline,
)
from frictrack.measure.tables import displacement_of_table
from frictrack.records import GRAVITY, Array, Displacement, Motion, Run, Track
from frictrack.study import TableData, unnamed_force
from frictrack.validation.blind import write_study
from frictrack.validation.blind.truth_sampling import draw_truth
from frictrack.workbench.summaries import SnapshotReader, check_fields, refuse_implausible, state_of

NOISE = 1e-5  # m
FPS = 1000.0


def run_of(t: Array, x: Array, *, noise: float = NOISE, seed: int = 0, **known) -> Run:
    """A measured run of a motion x(t) with white noise."""
    return Run(*seen(t.tobytes(), x.tobytes(), noise, seed), **({"mass": 0.35} | known))


@cache
def seen(times: bytes, places: bytes, noise: float, seed: int) -> tuple[Displacement, Motion]:
    """Displacement and motion of a path seen with white noise, computed once for all tests that use it."""
    t, x = np.frombuffer(times), np.frombuffer(places)
    nan = np.full(len(t), np.nan)
    noisy = x + noise * np.random.default_rng(seed).standard_normal(len(t))
    sigma = np.full(len(t), noise)
    valid = np.ones(len(t), dtype=bool)
    displacement = Displacement(t=t, x=noisy, y=nan, angle=nan, sigma_x=sigma, sigma_y=nan, valid=valid)
    return displacement, differentiate(low_pass(displacement))


def moved(
    force: Callable[[float, float, float], float], x0: float, v0: float, seconds: float, fps: float = FPS
) -> tuple[Array, Array]:
    """Motion under an acceleration that is a function of t, x, v."""
    t = np.arange(round(seconds * fps)) / fps
    found = solve_ivp(lambda s, y: [y[1], force(s, y[0], y[1])], (0, t[-1]), [x0, v0], t_eval=t, rtol=1e-9, atol=1e-12)
    return t, found.y[0]


def struck(
    mu: float = 0.3, v0: float = 2.0, viscous: float = 0.0, mass: float = 0.35, fps: float = FPS
) -> tuple[Array, Array]:
    """A slider that was struck, up to half of its speed."""
    seconds = 0.5 * v0 / (mu * GRAVITY + viscous / mass * v0)
    return moved(lambda t, x, v: -mu * GRAVITY - viscous / mass * v, 0.0, v0, seconds, fps)


def slid(degrees: float, mu: float, seconds: float = 0.4, rest: float = 0.1) -> tuple[Array, Array]:
    """A mass that is let go on a course that falls toward +x, from rest."""
    t = np.arange(round(seconds * FPS)) / FPS
    a = GRAVITY * (sin(radians(degrees)) - mu * cos(radians(degrees)))
    return t, a * np.maximum(t - rest, 0.0) ** 2 / 2


# --- the study file alone


@pytest.mark.parametrize(
    ("typed", "said", "correction"),
    [
        ({"mass": 350.0, "bare": {"mass"}}, "mass = 350 has no unit and was read as 350 kg", 'mass = "350 g"'),
        (
            {"mass": 7e-4, "bare": {"mass"}},
            'which are 0.7 g; if 0.7 kg were meant give mass = "0.7 kg"',
            'mass = "0.7 kg"',
        ),
        ({"mass": 5000.0}, "a mass of 5000 kg lies outside 0.0001 to 1000 kg", 'mass = "5 kg"'),
        ({"mass": 3.5e-7}, "a mass of 3.5e-07 kg lies outside 0.0001 to 1000 kg", 'mass = "0.00035 kg"'),
        ({"pitch": 0.5, "bare": {"scale"}}, "scale = 0.5 has no unit and was read as 0.5 m/px", 'scale = "0.5 mm/px"'),
        ({"pitch": 0.5}, "1000 px would be 500 m wide", 'scale = "0.5 mm/px"'),
        ({"fps": 4.0}, "fps = 4 lies outside 5 to 1e+07 frames per second", "fps = 4000"),
        ({"fps": 4e9}, "fps = 4e+09 lies outside", ""),
        ({"incline": 1.2, "bare": {"incline"}}, "was read as rad, that is 68.8 deg", 'incline = "1.2 deg"'),
    ],
)
def test_a_mistyped_number_is_named_with_its_correction(typed, said, correction):
    (finding,) = implausible_entries(EnteredValues("a", **{**typed, "bare": frozenset(typed.get("bare", ()))}))
    assert said in finding.words
    assert finding.correction == correction
    assert correction in finding.words
    assert str(finding).startswith('run "a": ')
    assert finding.words.count(". ") == 0  # one sentence


@pytest.mark.parametrize(
    "typed",
    [
        {},
        {"mass": 0.35, "pitch": 5e-4, "fps": 4000.0, "bare": {"mass", "scale"}},
        {"mass": 95.1},  # EMPS
        {"mass": 350.0},  # its unit was typed
        {"mass": 0.002, "pitch": 1e-6, "fps": 5e6},
        {"incline": radians(60.0)},
        {"incline": -0.4, "bare": {"incline"}},
    ],
)
def test_right_numbers_are_not_doubted(typed):
    assert implausible_entries(EnteredValues("a", **{**typed, "bare": frozenset(typed.get("bare", ()))})) == ()


# --- one run: units


@pytest.mark.parametrize(
    ("length", "time", "said"),
    [
        (1e3, 1.0, "x_m holds mm"),
        (1.0, 1e3, "t_s holds ms"),
        (1e6, 1.0, "x_m holds um"),
        (1.0, 1e6, "t_s holds us"),
        (1e3, 1e3, "t_s holds ms and x_m mm"),
    ],
)
def test_units_of_a_table_are_recognised(length, time, said):
    t, x = struck()
    (finding,) = implausible_slide(run_of(time * t, length * x, noise=length * NOISE), film=False)
    assert said in finding.words
    assert said in finding.correction


@pytest.mark.parametrize(
    ("scale", "fps", "said", "grade"),
    [
        (1e3, 1.0, "the scale is a thousand times too large", "warning"),
        (1e4, 1.0, "faster than anything on rails (2885 m/s)", ERROR),
        (1e2, 1.0, "the scale is a hundred times too large", "warning"),
        (1.0, 1e-3, "fps is a thousand times too small", ERROR),
    ],
)
def test_scale_and_frame_rate_of_a_film_are_recognised(scale, fps, said, grade):
    t, x = struck()
    run = run_of(t / fps, scale * x, noise=scale * NOISE)
    (finding,) = implausible_slide(run, film=True)
    assert said in finding.words
    assert finding.grade == grade


@pytest.mark.parametrize("mu", [0.05, 0.3, 2.33, 4.0])
def test_friction_of_a_struck_slide_is_found_and_not_doubted(mu):
    run = run_of(*struck(mu))
    slide = estimate_slide(run)
    assert slide is not None
    assert slide.friction == pytest.approx(mu, rel=0.02)
    assert slide.speed == pytest.approx(2.0, rel=0.1)
    assert implausible_slide(run, film=True) == ()


def test_a_scale_ten_times_too_large_is_asked_for_where_friction_and_speed_are_as_large():
    run = run_of(*struck(mu=5.8, v0=25.0))  # 0.58 at 2.5 m/s, and 109 J of 0.35 kg
    (finding,) = implausible_slide(run, film=True)
    assert finding.check == ("scale", "fps", "mass")
    assert finding.correction == "the scale is ten times too large"
    assert "dry solids have at most 1.5 times the weight" in finding.words


def test_a_load_that_does_not_fit_is_named():
    run = run_of(*struck(mu=0.3), normal_load=0.05)
    (finding,) = implausible_slide(run, film=False)
    assert "dry solids have at most 1.5 times the normal load" in finding.words


def test_a_blow_of_too_much_energy_names_the_mass():
    (finding,) = implausible_slide(run_of(*struck(), mass=350.0), film=True)
    assert finding.kind == "mass"
    assert finding.correction == 'mass = "350 g"'


def test_a_driven_run_has_no_friction_to_be_judged():
    t, x = struck(mu=0.3)
    slide = estimate_slide(run_of(1e3 * t, x, drive=np.ones(len(t))))
    assert slide is not None
    assert slide.friction is None


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "mN"), (1e6, "uN"), (1e-5, "kN")])
def test_a_measured_force_in_another_unit_is_named(factor, unit):
    t = np.arange(600) / FPS
    x = 0.01 * np.sin(2 * np.pi * 3.0 * t)
    force = 0.4 * 5.0 * np.sign(np.cos(2 * np.pi * 3.0 * t))
    right = run_of(t, x, friction_N=force, normal_load=5.0, mass=None)
    assert implausible_slide(right, film=False) == ()
    (finding,) = implausible_slide(replace(right, friction_N=factor * force), film=False)
    assert finding.correction == f'columns = {{friction = "friction_N ({unit})"}}'


def swung_force() -> tuple[Array, Array, Array]:
    """Times, places and dry friction of a mass that is driven to and fro."""
    t = np.arange(600) / FPS
    return t, 0.01 * np.sin(2 * np.pi * 3.0 * t), 2.0 * np.sign(np.cos(2 * np.pi * 3.0 * t))


def test_a_friction_with_the_sign_of_the_force_on_the_mass_is_refused_with_its_remedy():
    t, x, force = swung_force()
    (finding,) = implausible_slide(run_of(t, x, friction_N=-force, mass=None), film=False)
    assert finding.grade == ERROR
    assert finding.correction == 'columns = {friction = "-friction_N"}'
    assert finding.words.endswith('friction = "-friction_N"')
    spring = 400.0 * x  # gives back what it takes
    assert implausible_slide(run_of(t, x, friction_N=spring + 0.2 * force, mass=None), film=False) == ()


def test_a_start_and_an_end_without_contact_are_said_with_the_line_to_write():
    t = np.arange(2000) / FPS
    x = 0.05 * t
    rising = np.clip((t - 0.4) / 0.04, 0.0, 1.0) * np.clip((t[-1] - 0.3 - t) / 0.01, 0.0, 1.0)
    (finding,) = implausible_slide(run_of(t, x, friction_N=2.0 * rising, mass=None), film=False)
    begin, end = (float(word) for word in finding.correction.removeprefix("free = [").removesuffix("]").split(","))
    assert 0.43 < begin < 0.45
    assert t[-1] - 0.32 < end < t[-1] - 0.3
    assert implausible_slide(run_of(t, x, friction_N=2.0 * rising, free=(begin, end), mass=None), film=False) == ()
    assert implausible_slide(run_of(t, x, friction_N=2.0 + 0.1 * t, mass=None), film=False) == ()


# --- one run: incline


@pytest.mark.few(2)
@pytest.mark.parametrize("angle", [3.0, 22.0, 40.0])
@pytest.mark.parametrize("toward", [1.0, -1.0])
def test_a_missing_incline_is_proposed(angle, toward):
    t, x = slid(angle, mu=0.03)
    run = run_of(t, toward * x)
    least = missing_incline(run)
    assert least is not None
    assert least.grade == "warning"
    proposed = float(least.correction.split('"')[1].removesuffix(" deg"))
    assert np.sign(proposed) == -toward
    assert 0.3 * angle < abs(proposed) <= 1.03 * angle  # a lower bound: friction is unknown
    filmed = missing_incline(run, radians(angle))
    assert filmed is not None
    assert filmed.correction == f'incline = "{-toward * angle:.3g} deg"'
    assert "its path in the picture falls by" in filmed.words


def test_a_path_in_the_picture_that_is_too_level_is_not_believed():
    run = run_of(*slid(22.0, mu=0.03))
    finding = missing_incline(run, radians(5.0))
    assert finding is not None
    assert "measure the angle" in finding.words


def test_motion_up_and_down_gives_the_angle_itself():
    def pull(t: float, x: float, v: float) -> float:
        return -GRAVITY * sin(radians(8.0)) - 0.05 * GRAVITY * cos(radians(8.0)) * np.sign(v)

    t, x = moved(pull, 0.0, 1.2, 1.6, fps=400.0)
    finding = missing_incline(run_of(t, x))
    assert finding is not None
    assert finding.correction == 'incline = "8 deg"'
    assert wrong_incline(run_of(t, x, incline=radians(8.0), has_incline=True)) is None
    wrong = wrong_incline(run_of(t, x, incline=radians(-8.0), has_incline=True))
    assert wrong is not None
    assert wrong.grade == ERROR
    assert 'the sign is wrong: give incline = "8 deg"' in wrong.words
    far = wrong_incline(run_of(t, x, incline=radians(40.0), has_incline=True))
    assert far is not None
    assert far.correction == 'incline = "8 deg"'


def both_ways(degrees: float, mu: float, **known) -> list[Run]:
    """Struck runs up and down a course that rises toward +x, on which all of them slow down."""
    g, angle = GRAVITY, radians(degrees)

    def pull(t: float, x: float, v: float) -> float:
        return -g * sin(angle) - (mu * g * cos(angle) + 0.3 * abs(v)) * np.sign(v)

    speeds = (1.5, 2.0, 2.5, -1.5, -2.0, -2.5)
    slides = [moved(pull, 0.0, v, 0.25 * abs(v) / (mu * g)) for v in speeds]
    return [run_of(t, x, seed=i, name=f"r{i}", **known) for i, (t, x) in enumerate(slides)]


@pytest.mark.parametrize("angle", [6.0, 20.0, -20.0])
def test_runs_that_slow_down_both_ways_tell_a_wrong_sign_and_a_missing_incline(angle):
    assert implausible_inclines(both_ways(angle, 0.5, incline=radians(angle), has_incline=True)) == ()
    (finding,) = implausible_inclines(both_ways(angle, 0.5, incline=radians(-angle), has_incline=True))
    assert (finding.grade, finding.correction, finding.run) == (ERROR, f'incline = "{angle:g} deg"', "")
    found = implausible_inclines(both_ways(angle, 0.5))
    if abs(angle) < 10:  # a slope that friction in one direction may imitate: that is for the diagnosis
        assert found == ()
        return
    proposed = float(found[0].correction.split('"')[1].removesuffix(" deg"))
    assert proposed == pytest.approx(angle, rel=0.1)
    assert "runs toward +x slow down by" in found[0].words
    assert found[0].contradicts


def test_a_course_on_which_runs_speed_up_one_way_ends_the_work():
    (finding,) = implausible_inclines(both_ways(25.0, 0.3))
    assert finding.grade == ERROR
    assert "runs toward -x speed up by" in finding.words
    assert 'set plausible = "checked"' in finding.words


def test_friction_that_is_the_same_both_ways_or_is_driven_tells_no_incline():
    level = both_ways(0.0, 0.3)
    assert implausible_inclines(level) == ()
    assert implausible_inclines(both_ways(20.0, 0.5)[:3]) == ()  # one way alone
    driven = [replace(run, drive=np.zeros(len(run.displacement))) for run in both_ways(20.0, 0.5)]
    assert implausible_inclines(driven) == ()


def test_a_mass_that_slows_down_less_than_gravity_alone_would_slow_it_tells_the_sign():
    falls = [replace(run, incline=radians(20.0), has_incline=True) for run in both_ways(-20.0, 0.5)]
    assert wrong_incline(replace(falls[0], incline=radians(-20.0))) is None
    finding = wrong_incline(falls[0])
    assert finding is not None
    assert finding.grade == ERROR
    assert "where gravity alone would slow it by 3.35" in finding.words
    assert wrong_incline(falls[3]) is None  # the other way friction may be that high


@pytest.mark.parametrize("toward", [1.0, -1.0])
def test_the_sign_of_an_incline_is_held_against_the_motion(toward):
    t, x = slid(22.0, mu=0.3)
    right = -toward * radians(22.0)
    assert wrong_incline(run_of(t, toward * x, incline=right, has_incline=True)) is None
    finding = wrong_incline(run_of(t, toward * x, incline=-right, has_incline=True))
    assert finding is not None
    assert finding.grade == ERROR
    assert f'give incline = "{-toward * 22:g} deg"' in finding.words


def test_an_incline_that_is_too_small_for_the_motion_is_remarked():
    finding = wrong_incline(run_of(*slid(22.0, mu=0.1), incline=radians(-2.2), has_incline=True))
    assert finding is not None
    assert finding.grade == "warning"
    assert "but incline = -2.2 deg gives only 0.376 m/s^2" in finding.words


def test_a_spring_and_a_push_contradict_no_incline():
    t = np.arange(round(2.0 * FPS)) / FPS
    for angle in (0.1, 3.0, -3.0):
        for x in (pendulum(t), np.where(t < 0.35, pushed(np.minimum(t, 0.35)), np.nan)[: round(0.35 * FPS)]):
            run = run_of(t[: len(x)], x, incline=radians(angle), has_incline=True)
            assert wrong_incline(run) is None


def test_an_incline_in_degrees_without_a_unit_is_refused_with_what_to_write(study_file: Path) -> None:
    edit(study_file, 'table = "slow.csv"', 'table = "slow.csv"\nincline = 22')
    with pytest.raises(FrictrackError, match='a number is in rad: write "22 deg" for degrees'):
        open_study(study_file)


def test_what_speeds_up_more_than_gravity_is_no_incline():
    t = np.arange(800) / FPS
    finding = missing_incline(run_of(t, 15.0 * t**2 / 2))
    assert finding is not None
    assert "more than gravity on any course" in finding.words


def pendulum(t: Array) -> Array:
    return 0.8 * np.exp(-0.05 * t) * np.cos(2 * np.pi * 1.1 * t)


def pushed(t: Array) -> Array:
    """Pushed by hand over a third of the way, then sliding."""
    push, slide = 12.0, 3.0
    v, way = push * 0.1, push * 0.1**2 / 2
    late = np.maximum(t - 0.1, 0.0)
    return np.where(t < 0.1, push * t**2 / 2, way + v * late - slide * late**2 / 2)


@pytest.mark.parametrize(
    ("seconds", "motion"),
    [(2.0, pendulum), (0.35, pushed), (0.4, lambda t: 2 * t - 2 * t**2), (0.5, lambda t: 0.5 * t)],
)
def test_what_is_driven_by_no_slope_gets_no_incline(seconds, motion):
    t = np.arange(round(seconds * FPS)) / FPS
    assert missing_incline(run_of(t, motion(t))) is None
    assert implausible_slide(run_of(t, motion(t)), film=True) == ()


def test_angle_of_the_path_in_the_picture():
    t = np.arange(50) / FPS
    ones = np.ones(50)
    track = Track(t, 300 - 4 * np.arange(50.0), 20 + 3 * np.arange(50.0), ones, ones, ones, ones, np.full(50, ""))
    assert path_angle(track) == pytest.approx(np.arctan(3 / 4))
    lost = replace(track, x_px=np.nan * ones, y_px=np.nan * ones)
    assert path_angle(lost) is None


# --- all runs together


def family(viscous: float, typed: dict[str, float] | None = None, **known) -> list[Run]:
    """Struck runs of one slider of 0.35 kg, some of them with another mass in the study file."""
    speeds = {"slow": 1.5, "middle": 2.0, "quick": 2.5, "other": 3.0}
    masses = dict.fromkeys(speeds, 0.35) | (typed or {})
    return [
        run_of(*struck(0.2, v0, viscous), name=name, mass=masses[name], seed=i, **known)
        for i, (name, v0) in enumerate(speeds.items())
    ]


@pytest.mark.parametrize(("wrong", "right"), [(3.5, "0.35"), (0.035, "0.35"), (350.0, "0.35")])
def test_one_mass_that_is_a_power_of_ten_off_is_questioned(wrong, right):
    (finding,) = implausible_masses(family(0.4, {"quick": wrong}))
    assert finding.run == "quick"
    assert finding.correction == f'mass = "{right} kg"'
    assert "the decimal point elsewhere" in finding.words
    assert finding.grade == "warning"
    assert finding.contradicts == (wrong == 350.0)  # a unit, and no other slider


def test_nothing_is_searched_while_a_mass_is_in_another_unit(tmp_path, monkeypatch):
    study = ['[study]\nmodel = ["coulomb", "viscous"]\n']
    for run in family(0.4, {"quick": 0.00035})[:3]:
        table = np.column_stack([run.displacement.t, run.displacement.x])
        np.savetxt(tmp_path / f"{run.name}.csv", table, delimiter=",", header="t_s,x_m", comments="")
        study.append(f'[[run]]\ntable = "{run.name}.csv"\nmass = "{run.mass} kg"\n')
    (tmp_path / "study.toml").write_text("".join(study))
    monkeypatch.setattr(import_module("frictrack.diagnose.conclusion"), "search_effects", None)
    session = Session(open_study(tmp_path / "study.toml"))
    session.fit()
    found = session.diagnose()
    assert (found["verdict"], found["candidates"]) == ("undetermined", [])
    assert found["undetermined"][0]["what"] == "the mass of quick"
    assert "nothing was searched before the mass of quick is right" in found["undetermined"][0]["why"]


def test_runs_of_several_masses_are_not_doubted():
    heavy = run_of(*struck(0.2, 2.5, 0.4, mass=0.7), name="heavy", mass=0.7)
    assert implausible_masses([*family(0.4), heavy]) == ()
    (finding,) = implausible_masses([*family(0.4, {"slow": 0.035}), heavy])
    assert (finding.run, finding.correction) == ("slow", 'mass = "0.35 kg"')


def test_friction_that_goes_with_the_weight_cannot_tell_a_mass():
    (finding,) = implausible_masses(family(0.0, {"quick": 3.5}))
    assert "friction that goes with the weight cannot show which is right" in finding.words
    assert implausible_masses(family(0.0, {"quick": 0.7, "slow": 0.5})) == ()
    assert implausible_masses(family(0.0)) == ()


def test_a_stated_load_tells_the_mass_by_dry_friction_alone():
    runs = family(0.0, {"middle": 0.035}, normal_load=3.43)
    (finding,) = implausible_masses(runs)
    assert (finding.run, finding.correction) == ("middle", 'mass = "0.35 kg"')


@pytest.mark.parametrize(("length", "time", "said"), [(10.0, 1.0, "length is 10 times"), (1.0, 0.1, "time 10 times")])
def test_one_run_in_another_unit_is_named(length, time, said):
    t, x = struck(0.2, 1.8)
    other = run_of(time * t, length * x, noise=length * NOISE, name="odd")
    (finding,) = implausible_masses([*family(0.0), other])
    assert finding.run == "odd"
    assert said in finding.words


def test_a_measured_drive_tells_the_mass():
    def drive(t):
        return 4.0 * np.sin(2 * np.pi * 4.0 * t)

    t, x = moved(lambda t, x, v: (drive(t) - 0.3 * np.tanh(v / 0.01) - 0.2 * v) / 0.35, 0.0, 0.0, 1.0, fps=500.0)
    assert implausible_masses([run_of(t, x, drive=drive(t))]) == ()
    (finding,) = implausible_masses([run_of(t, x, drive=drive(t), mass=350.0)])
    assert (finding.correction, finding.grade) == ('mass = "0.35 kg"', ERROR)
    (finding,) = implausible_masses([run_of(t, x, drive=drive(t), mass=4.5)])  # another mass, or another drive
    assert finding.grade == "warning"
    (finding,) = implausible_masses([run_of(t, x, drive=1e3 * drive(t))])
    assert "or the drive is 1000 times too large" in finding.words
    (finding,) = implausible_masses([run_of(1e3 * t, x, drive=drive(t))])
    assert "t_s holds ms" in finding.words
    (finding,) = implausible_masses([run_of(t, 1e3 * x, noise=1e3 * NOISE, drive=drive(t))])
    assert "x_m holds mm" in finding.words


@pytest.mark.slow
def test_the_drive_of_a_real_carriage_tells_its_published_mass():
    """EMPS, 95.1 kg (Janot, Gautier, Brunot 2019)."""
    q, drive = np.loadtxt(samples.DATA / "emps_200Hz.csv", delimiter=",").T
    q, drive = q[:1200], drive[:1200]  # six seconds
    t = np.arange(len(q)) / 200.0
    right = run_of(t, q, noise=1e-6, drive=drive, mass=95.1)
    assert implausible_masses([right]) == ()
    assert implausible_slide(right, film=False) == ()
    assert missing_incline(right) is None
    (finding,) = implausible_masses([replace(right, mass=951.0)])
    assert finding.correction == 'mass = "95.1 kg"'


# --- the flow


def doubts(seed: int, kind: str, folder: Path) -> list[str]:
    """Findings on a rendered study whose numbers are right."""
    write_study(draw_truth(seed, kind), folder)
    session = Session(open_study(folder / "study.toml"))
    session.bring_up_to("motion")
    session.findings.check_all_runs(session.runs)
    return list(session.findings.messages)


@pytest.mark.slow
def test_no_rendered_study_is_doubted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert doubts(1, "one", tmp_path) == []
    assert caplog.messages == []


@pytest.mark.release
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["none", "one", "two", "foreign", "fault"])
def test_no_rendered_study_of_many_is_doubted(kind: str, tmp_path: Path) -> None:
    assert {seed: found for seed in range(20, 30) if (found := doubts(seed, kind, tmp_path / str(seed)))} == {}


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_a_warning_is_said_once_first_and_stands_in_the_json(
    study_file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    edit(study_file, 'mass = "0.350 +/- 0.002 kg"', "mass = 350")
    seen: list[list[str]] = []
    session = Session(open_study(study_file), lambda done, total, what: seen.append(list(caplog.messages)))
    with caplog.at_level(logging.WARNING, "frictrack"):
        result = session.fit()
        again = session.diagnose()
    said = "mass = 350 has no unit and was read as 350 kg"
    assert [said in message for message in caplog.messages] == [True]  # of all three runs together, before their energy
    assert seen[0] == caplog.messages  # before anything is done
    assert [w["kind"] for w in result["warnings"]] == ["mass"]
    assert result["warnings"] == again["warnings"]
    assert result["warnings"][0]["correction"] == 'mass = "350 g"'
    assert any(said in note for note in session.findings.messages)


def test_a_warning_reaches_stderr_and_the_json_of_a_command(
    study_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    edit(study_file, 'table = "slow.csv"', 'table = "slow.csv"\nmass = 45')
    with pytest.raises(SystemExit) as ended:
        main(["friction", str(study_file), "--json"])
    assert ended.value.code == 0
    told = json.loads(capsys.readouterr().out)
    assert {(w["run"], w["grade"]) for w in told["warnings"]} == {("slow", "warning")}
    assert "mass = 45 has no unit" in told["warnings"][0]["words"]


@pytest.mark.slow
@pytest.mark.usefixtures("few_evaluations")
def test_a_warning_heads_the_report(study_file: Path) -> None:
    edit(study_file, 'mass = "0.350 +/- 0.002 kg"', "mass = 350")
    session = Session(open_study(study_file))
    assert session.report().read_text(encoding="utf-8").count("Check first:</b> mass = 350 has no unit") == 1
    assert session.results().warnings == session.findings.messages


def test_a_run_that_was_checked_is_not_doubted(study_file: Path) -> None:
    edit(study_file, 'mass = "0.350 +/- 0.002 kg"', 'mass = 350\nplausible = "checked"')
    session = Session(open_study(study_file))
    session.bring_up_to("friction")
    assert session.findings.summary == []
    edit(study_file, '"checked"', '"yes"')
    with pytest.raises(FrictrackError, match='expected plausible as "checked" but got "yes"'):
        open_study(study_file)


def incline_study(folder: Path, toward: float, keys: str) -> Path:
    t, x = slid(22.0, mu=0.2)
    rng = np.random.default_rng(3)
    for name in ("a", "b"):
        noisy = toward * x + NOISE * rng.standard_normal(len(t))
        np.savetxt(folder / f"{name}.csv", np.c_[t, noisy], delimiter=",", header="t_s,x_m", comments="")
    runs = "".join(f'\n[[run]]\ntable = "{name}.csv"\n{keys}\n' for name in ("a", "b"))
    (folder / "study.toml").write_text(f'[study]\nmass = 0.35\nmodel = ["coulomb", "viscous"]\n{runs}')
    return folder / "study.toml"


def test_an_incline_of_the_wrong_sign_ends_the_work_before_the_fit(tmp_path: Path) -> None:
    path = incline_study(tmp_path, 1.0, 'incline = "22 deg"')
    with pytest.raises(FrictrackError) as caught:
        Session(open_study(path)).fit()
    assert str(caught.value).count('the sign is wrong: give incline = "-22 deg"') == 1
    assert str(caught.value).endswith('the same in "b"')  # both runs at once
    edit(path, 'incline = "22 deg"', 'incline = "22 deg"\nplausible = "checked"')
    Session(open_study(path)).bring_up_to("friction")
    edit(path, 'incline = "22 deg"\nplausible = "checked"', 'incline = "-22 deg"')
    session = Session(open_study(path))
    fit = session.fit()
    assert fit["warnings"] == []
    assert fit["parameters"]["coulomb.F_c"]["mu"]["value"] == pytest.approx(0.2, rel=0.05)


def test_what_all_runs_show_together_is_confirmed_by_all_of_them(tmp_path: Path) -> None:
    for run in both_ways(20.0, 0.5):
        rows = np.c_[run.displacement.t, run.displacement.x]
        np.savetxt(tmp_path / f"{run.name}.csv", rows, delimiter=",", header="t_s,x_m", comments="")
    tables = "".join(f'\n[[run]]\ntable = "r{i}.csv"\nincline = "-20 deg"\n' for i in range(6))
    path = tmp_path / "study.toml"
    path.write_text(f'[study]\nmass = 0.35\nmodel = ["coulomb", "viscous"]\n{tables}')
    with pytest.raises(FrictrackError, match='the sign is wrong: give incline = "20 deg"'):
        Session(open_study(path)).bring_up_to("motion")
    edit(path, "mass = 0.35", 'mass = 0.35\nplausible = "checked"')
    session = Session(open_study(path))
    session.bring_up_to("motion")
    assert session.findings.summary == []


def test_a_missing_incline_is_proposed_instead_of_asking_for_the_free_section(tmp_path: Path) -> None:
    path = incline_study(tmp_path, -1.0, "")
    with pytest.raises(FrictrackError) as caught:
        Session(open_study(path)).fit()
    assert str(caught.value).count("the mass speeds up by itself with 1.8") == 1
    assert str(caught.value).endswith('the same in "b"')
    assert 'incline = "11 deg"' in str(caught.value)
    with pytest.raises(FrictrackError, match="the mass speeds up by itself"):
        Session(open_study(path)).runs[0].get("friction")


def test_the_page_says_what_is_to_be_checked(study_file: Path) -> None:
    (field,) = check_fields({"mass": "350"}).values()
    assert "350" in f"{field['warning']}{field['error']}"
    with pytest.raises(FrictrackError, match="mass = 350"):
        refuse_implausible("study", "mass", 350)


def test_a_clock_that_contradicts_its_rate_or_the_other_runs_is_named():
    def timed(name, fps):
        t, nan = np.arange(100) / fps, np.full(100, np.nan)
        seen = Displacement(t, 2 * t - t**2, nan, nan, np.full(100, 1e-5), nan, np.ones(100, bool))
        return Run(seen, differentiate(low_pass(seen)), mass=1.0, name=name)

    rates = {"a": 4000.0, "b": 4000.0, "c": 3156.0, "d": 4000.0, "e": 1000.0}
    runs = {name: timed(name, fps) for name, fps in rates.items()}
    found = {f.run: f for f in implausible_clocks(runs, dict.fromkeys(rates))}
    assert set(found) == {"c"}  # another setting, such as 1000 Hz, is no wrong clock
    assert "the time stamps say 3156 Hz where the other runs have 4000 Hz" in str(found["c"])
    stated = {"a": 4000.0, "b": None, "c": 4000.0, "d": 4010.0, "e": 1000.0}
    found = {f.run: f for f in implausible_clocks(runs, stated)}
    assert set(found) == {"c"}
    assert "but fps = 4000 is given, which the other runs have: its times are probably" in str(found["c"])
    assert "to be multiplied by 0.789; one of the two is wrong" in str(found["c"])
    assert found["c"].correction == ""
    assert found["c"].contradicts
    (found,) = implausible_clocks({"a": runs["a"], "b": runs["b"], "d": runs["d"]}, {"a": 5000.0})
    assert found.correction == "fps = 4000"  # as the other runs have it


def test_a_rate_that_replaced_that_of_the_time_stamps_is_a_contradiction():
    t = np.arange(400) / 4000
    seen = displacement_of_table(TableData(t, 2 * t - t**2), fps=4200.0)
    assert seen.stamped_rate == pytest.approx(4000.0)
    assert displacement_of_table(TableData(t, 2 * t - t**2), fps=4001.0).stamped_rate is None  # within one per cent
    run = Run(seen, differentiate(low_pass(seen)), mass=1.0, name="a")
    (found,) = implausible_clocks({"a": run}, {"a": 4200.0})
    assert found.contradicts
    assert found.correction == "fps = 4000"
    assert "the time stamps say 4000 Hz but fps = 4200 is given" in found.words


@pytest.mark.few(1)
@pytest.mark.parametrize(("factor", "unit"), [(1e3, "ms"), (1e6, "us"), (1 / 60, "min")])
def test_time_stamps_in_another_unit_than_the_stated_rate_are_an_error(factor, unit):
    t, nan = factor * np.arange(400) / 4000.0, np.full(400, np.nan)
    seen = Displacement(t, np.linspace(0.0, 0.1, 400), nan, nan, np.full(400, 1e-5), nan, np.ones(400, bool))
    run = Run(seen, differentiate(low_pass(seen)), mass=1.0, name="a")
    (finding,) = implausible_clocks({"a": run}, {"a": 4000.0})
    assert (finding.grade, finding.correction) == (ERROR, f'columns = {{t = "t_s ({unit})"}}')
    (finding,) = implausible_clocks({"a": run, "b": run}, {"a": 4000.0, "b": 4000.0})
    assert finding.run == ""  # said once of all runs


def test_a_column_of_forces_that_is_not_used_is_said(tmp_path):
    """A slide in closed form beside a force that no key names: it may be the drive."""
    t = np.arange(400) / 400
    x = 0.8 * t - 0.35 * t**2 + 1e-5 * np.random.default_rng(0).standard_normal(400)
    table = np.c_[t, x, np.full(400, 0.2)]
    np.savetxt(tmp_path / "m.csv", table, delimiter=",", header="Zeit [s],Weg [m],Kraft [N]", comments="")
    text = '[study]\nmass = "0.2 kg"\n[[run]]\ntable = "m.csv"\ncolumns = {t = "Zeit [s]", x = "Weg [m]"%s}\n'
    for more, said in (("", 1), (', drive = "Kraft [N]"', 0)):
        (tmp_path / "study.toml").write_text(text % more)
        session = Session(open_study(tmp_path / "study.toml"))
        session.bring_up_to("friction")
        assert sum('"Kraft [N]" that is not used' in one for one in session.findings.messages) == said
    assert unnamed_force(["t (s)", "Normal (N)", "x (mm)"], ()) is None


def test_swings_of_one_mass_with_other_origins(tmp_path):
    """0.1 kg on 1.39 N/m with dry friction, 0.02 N: the centre of its linear decay moves to and fro by 14 mm."""
    t, rng = np.arange(480) / 30, np.random.default_rng(1)
    half = np.floor(t * np.sqrt(13.9) / np.pi)
    swing = (0.22 - 2 * 0.02 / 1.39 * half / 4) * np.cos(t * np.sqrt(13.9)) * np.exp(-t / 140)
    places = {
        name: swing + at + 1e-3 * rng.standard_normal(480) for name, at in (("a", 0.2), ("b", 0.2), ("c", 0.2123))
    }
    ((name, first, shift),) = shifted_swings(places)
    assert (name, first) == ("c", "a")
    assert shift == pytest.approx(0.0123, abs=1e-3)
    assert not list(shifted_swings({"a": t * (2 - t), "b": 1 + t * (2 - t)}))
    for run, x in places.items():
        np.savetxt(tmp_path / f"{run}.csv", np.c_[t, x], delimiter=",", header="t_s,x_m", comments="")
    said = {one["file"]: one["words"] for one in propose_study(tmp_path, {"mass": "0.1 kg"})["found"]}
    assert "mm from those of a.csv" in said["c.csv"]
    assert "from those" not in said["b.csv"]


def test_an_implausible_number_stands_beside_its_box_and_above_the_verdict(study_file: Path) -> None:
    edit(study_file, 'mass = "0.350 +/- 0.002 kg"', 'mass = "350 kg"')
    session = Session(open_study(study_file))
    session.bring_up_to("friction")
    words = session.findings.messages
    assert len(words) == 3
    assert "more than a blow gives" in words[0]
    state = state_of(SnapshotReader(study_file).read())  # the page reads files, not the session
    assert state["check_first"] == [f"Check first: {one}." for one in words]
    assert state["fields"]["mass"]["warning"] == f"Check first: {words[0]}."
    assert state["runs"][1]["fields"]["mass"]["warning"] == f"Check first: {words[1]}."
    assert state["fields"]["fps"]["warning"] is None  # a table has a clock of its own
    assert read_results(session.study).warnings == words
    shown = StringIO()
    diagnosis = {"verdict": "complete", "missing": [], "candidates": [], "model": ["coulomb"]}
    diagnosis["warnings"] = session.findings.summary
    verdict(Console(file=shown, width=500), diagnosis)
    assert shown.getvalue().index(f"Check first: {words[0]}") < shown.getvalue().index("no further effect")
    edit(study_file, 'mass = "350 kg"', 'mass = "0.35 kg"')
    state = state_of(SnapshotReader(study_file).read())
    assert (state["check_first"], state["fields"]["mass"]["warning"]) == ([], None)  # the new one is not measured yet


def test_the_speed_of_a_film_questions_the_scale_first() -> None:
    run = run_of(*struck(), mass=350.0)
    assert [found.check for found in implausible_slide(run, film=True)] == [("scale", "fps", "mass")]
    assert [found.to_dict()["check"] for found in implausible_slide(run, film=False)] == [("mass",)]


def test_the_centre_of_a_swing_scatters_as_its_deviation_says():
    rng, z = np.random.default_rng(0), []
    for _ in range(60):  # half cosines between turning points that scatter about a decay
        turns = np.exp(-np.arange(16) / 40) * (-1.0) ** np.arange(16) + 0.01 * rng.standard_normal(16)
        ways = [a + (b - a) * (1 - np.cos(np.pi * np.arange(40) / 40)) / 2 for a, b in pairwise(turns)]
        centre, sigma = swing_centre(np.concatenate(ways))
        z.append(centre / sigma)
    assert 0.8 < np.std(z) < 1.4


@pytest.mark.parametrize(("stated", "wrong"), [(-3.6, True), (-1.9, False)])
def test_an_incline_is_contradicted_where_friction_would_push(stated: float, wrong: bool) -> None:
    """A cart goes up and down 1.9 degrees with a friction coefficient of 0.0025."""
    t, pull, brake = np.arange(0, 1.9, 0.005), 9.80665 * np.sin(radians(1.9)), 0.0245
    turn = 0.35 / (pull + brake)
    x = np.where(
        t < turn,
        -0.35 * t + (pull + brake) * t**2 / 2,
        -0.35 * turn / 2 + (pull - brake) * (t - turn) ** 2 / 2,
    )
    x = x + 1e-4 * np.random.default_rng(0).standard_normal(len(t))
    run = replace(Run.from_arrays(t, x, mass=0.25), incline=radians(stated), has_incline=True)
    finding = wrong_incline(run)
    assert (finding is not None) == wrong
    assert finding is None or finding.correction == 'incline = "-1.9 deg"'


def test_a_user_of_arrays_is_told_of_no_key_of_a_study_file() -> None:
    t = np.arange(0, 0.6, 0.005)
    with pytest.warns(UserWarning, match="the sign is wrong") as caught:
        Run.from_arrays(
            t, 0.5 * t**2 + 1e-5 * np.random.default_rng(0).standard_normal(len(t)), mass=0.3, incline="6 deg"
        )
    assert "ignore this warning" in str(caught[0].message)
    assert "plausible" not in str(caught[0].message)
