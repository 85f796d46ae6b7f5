"""A plan promises what films then keep: pairs it calls parted are parted, those it leaves open are open.

Truth is a simulation of the planned runs with noise, or a formula by hand.
"""

from __future__ import annotations

import io
import json
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from few_effects import use_few_effects
from rich.console import Console
from runs import BASE, FPS, MASS, PITCH, Spec, measured, study

from frictrack import effects
from frictrack.base.errors import FrictrackError
from frictrack.cli import main, output
from frictrack.diagnose.experiments import (
    ExperimentSetup,
    candidate_runs,
    choose_runs,
    default_setup,
    fitted_setup,
    summarise_plan,
)
from frictrack.diagnose.experiments.candidates import COULOMB_DECELERATION, DEFAULT_NOISE_PX
from frictrack.diagnose.experiments.evidence import simulate_runs
from frictrack.diagnose.model_selection import information_criterion
from frictrack.effects import models
from frictrack.fit import add_effect, fit
from frictrack.fit.stepwise import refine_to_end
from frictrack.flow import open_study
from frictrack.flow import plan as plan_study
from frictrack.results import to_builtins
from frictrack.simulate import Conditions, simulate

BARE = '[study]\nname = "before"\nmass = "0.35 kg"\n[camera]\nfps = 4000\nscale = "0.5 mm/px"\n'
LAW = ["coulomb", "stribeck", "viscous"]
# What the tests below ask about; a plan of the whole library takes twice as long.
SOME = (
    *("coulomb", "stribeck", "viscous", "drag", "vibration", "texture", "spring", "drift", "asymmetry", "slope"),
    *("drive_error", "camera_shake", "presliding"),
)


@pytest.fixture(scope="module")
def run_plan():
    with pytest.MonkeyPatch.context() as patched:
        use_few_effects(patched, SOME)
        return choose_runs(default_setup(MASS, FPS, PITCH))


@pytest.mark.slow
def test_a_plan_of_the_whole_library_takes_less_than_a_minute():
    begin = time.process_time()
    found = choose_runs(default_setup(MASS, FPS, PITCH))
    assert time.process_time() - begin < 60
    assert len(found.tables.names) > 1.5 * (len(SOME) - 4)
    assert len(found.runs) <= 8


@pytest.fixture(scope="module")
def told(run_plan):
    return json.loads(json.dumps(to_builtins(summarise_plan(run_plan)), allow_nan=False))


@pytest.mark.few(1)
def test_the_usual_set_up_is_stated_and_is_what_is_simulated(run_plan, told):
    setup = run_plan.setup
    assert setup.noise == DEFAULT_NOISE_PX * PITCH
    assert setup.values["coulomb"]["F_c"] == MASS * COULOMB_DECELERATION
    assert any("0.02 px (10 µm)" in line for line in told["assumed"])
    assert any("5 m/s²" in line for line in told["assumed"])
    fast = next(r for r in run_plan.tables.runs if r.design.key == "8 m/s")
    t, x = fast.piece.t, fast.piece.y
    a = -(x[2] - 2 * x[1] + x[0]) / (t[1] - t[0]) ** 2
    assert a == pytest.approx(
        COULOMB_DECELERATION + 0.1 * COULOMB_DECELERATION * 8.0, rel=1e-3
    )  # F_c and F_v v over m; Stribeck is gone


def test_every_run_brings_pairs_apart_until_nothing_more_helps(run_plan, told):
    left = [told["pairs_before"], *(run["pairs_left"] for run in told["runs"])]
    assert left[0] == told["pairs"] == len(run_plan.tables.names) * (len(run_plan.tables.names) - 1) // 2
    assert all(b <= a for a, b in pairwise(left))
    assert sum(run["adds"] for run in told["runs"]) >= left[0] - left[-1]
    assert len(told["runs"]) <= 8
    assert any(run["speed"] is not None and run["speed"] < 0 for run in told["runs"])  # a slope shows no other way
    assert any(run["mass"] != MASS for run in told["runs"])  # a vibration against a shake of the camera


def test_more_runs_never_tell_less(run_plan):
    few = run_plan.tables.evidence([0, 5], reference=False)
    more = run_plan.tables.evidence([0, 5, 9], reference=False)
    assert np.all(more[:, -1] >= few[:, -1] - 1e-6)


def test_a_mark_at_rest_rules_the_camera_out(run_plan):
    k = run_plan.tables.names.index("camera_shake")
    v = run_plan.tables.names.index("vibration")
    without = run_plan.tables.evidence([2], reference=False)
    with_it = run_plan.tables.evidence([2], reference=True)
    assert without[v, k] < 10 < with_it[v, k]
    assert with_it[k, v] >= without[k, v] + run_plan.tables.raw_chi2[2, k] * 0.999


def test_a_slope_and_a_direction_stay_together_and_a_level_settles_it(told):
    left = {frozenset(one["effects"]): one for one in told["left"]}
    alike = left[frozenset({"asymmetry", "slope"})]
    assert alike["expected_chi2"] < 1e-3
    assert alike["why"] == "both change every candidate run in the same way"
    assert "level" in alike["settle"]


def test_memory_is_not_seen_in_runs_that_only_slide_one_way(told):
    unseen = {one["effect"]: one for one in told["unseen"]}
    assert "presliding" in unseen
    assert "reverse the drive" in unseen["presliding"]["settle"]
    assert told["detection_limits"]["presliding"]["value"] is None
    assert "drive_error" in told["not_planned"]


def film_planned(run_plan, name, factor=1.0, seed=4):
    """Every planned run simulated with one effect at its planned size, seen with noise, levels scattering."""
    rng, setup = np.random.default_rng(seed), run_plan.setup
    k = run_plan.tables.names.index(name)
    cause, size = run_plan.tables.causes[k], run_plan.tables.sizes[k] * factor
    law = {n: dict(q) for n, q in setup.values.items()}
    own = dict(cause.setting) | {p.name: 0.0 for p in cause.effect.linear}
    first = next(p.name for p in cause.effect.parameters if p.linear or p.role == "depth")
    made = []
    for i, run in enumerate(run_plan.runs):
        design = run.design
        law[name] = (
            own
            | {first: size}
            | {p.name: rng.uniform(-3, 3) for p in cause.effect.parameters if p.role == "phase" and p.per_run}
        )
        held = Conditions(
            MASS * design.mass, design.mass * (1 + setup.scatter * rng.standard_normal()), design.mass, PITCH
        )
        t = run.piece.t
        slide = simulate(models.of(law), law, held, t, design.start)
        moving = int(np.argmin(np.sign(design.start[1]) * slide.v > 0.02)) or len(t)
        x = (slide.x + slide.shift)[:moving]
        made.append(measured(t[:moving], x, sigma=setup.noise, mass=held.mass, name=f"p{i}", rng=rng))
    return made


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "rival"), [("vibration", "camera_shake"), ("spring", "drift"), ("texture", "vibration")]
)
def test_films_of_the_planned_runs_keep_what_the_plan_promised(run_plan, name, rival):
    a, b = (run_plan.tables.names.index(n) for n in (name, rival))
    assert run_plan.evidence[a, b] > 10
    bare = fit(LAW, film_planned(run_plan, name)).solution
    true, other = (refine_to_end(add_effect(bare, effects.get(n))) for n in (name, rival))
    assert information_criterion(other) - information_criterion(true) > 10
    assert information_criterion(bare) - information_criterion(true) > 10


@pytest.mark.slow
def test_the_detection_limit_is_where_the_effect_begins_to_show(run_plan, told):
    limit = told["detection_limits"]["texture"]
    assert limit["unit"] == "N"
    for factor, shows in ((3 * limit["share"], True), (0.1 * limit["share"], False)):
        bare = fit(LAW, film_planned(run_plan, "texture", factor)).solution
        rise = bare.objective - refine_to_end(add_effect(bare, effects.get("texture"))).objective
        assert (rise > 40) is shows


def test_runs_that_were_filmed_count_and_their_law_is_assumed():
    law = {n: BASE[n] for n in ("coulomb", "viscous")}
    runs, _ = study(models.of(law), law, specs=(Spec(3.0, 1, 0.1), Spec(5.0, 1, 0.1)), sigma=2e-5)
    setup = fitted_setup(fit(list(law), runs))
    assert setup.values["coulomb"]["F_c"] == pytest.approx(8.0, rel=0.01)
    assert setup.noise == pytest.approx(2e-5, rel=0.1)
    assert [e.key for e in setup.completed] == ["run r0", "run r1"]
    assert setup.completed[0].start[1] == pytest.approx(3.0, rel=0.01)
    run = simulate_runs(setup, list(setup.completed))
    seen = fit(list(law), runs).solution.responses
    for planned, real in zip(run, seen, strict=True):  # the run as it was, up to the frames that were fitted
        n = min(len(real.piece.t), len(planned.piece.t)) - 20
        gone = real.model_y[:n] - real.model_y[0]
        assert np.max(np.abs(planned.piece.y[:n] - planned.piece.y[0] - gone)) < 1e-3
    assert len(candidate_runs(setup)) > 10


def test_a_course_too_short_for_any_run_is_said():
    short = default_setup(MASS, 100.0, 1e-6)
    with pytest.raises(FrictrackError, match="expected a course long enough for a run"):
        choose_runs(short)
    assert isinstance(short, ExperimentSetup)


@pytest.fixture
def before(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(BARE)
    return path


def test_a_study_without_films_gets_a_plan_and_a_page(before, capsys, monkeypatch, run_plan):
    """The command asks for a plan of the very set-up that `run_plan` has planned already."""
    asked = []
    planner = sys.modules["frictrack.diagnose.experiments"]
    monkeypatch.setattr(planner, "choose_runs", lambda setup, progress: asked.append(setup) or run_plan)
    main_ok(["plan", str(before), "--json"])
    assert [repr(setup) for setup in asked] == [repr(run_plan.setup)]
    found = json.loads(capsys.readouterr().out)
    assert found["runs"]
    assert found["runs"][0].keys() >= {"what", "speed", "mass", "incline_deg", "separates", "adds", "pairs_left"}
    page = Path(found["page"]).read_text(encoding="utf-8")
    assert "What to film" in page
    assert found["runs"][0]["what"] in page
    assert "http" not in page.replace("http://www.w3.org", "")
    out = io.StringIO()
    output.plan(Console(file=out, width=200), found)
    assert len(out.getvalue().splitlines()) <= 15
    output.plan_details(Console(file=out, width=200), found)
    said = out.getvalue()
    assert "pairs left" in said
    assert "presliding cannot be detected" in said


def main_ok(argv):
    with pytest.raises(SystemExit) as left:
        main(argv)
    assert left.value.code in (0, None)


@pytest.mark.parametrize("command", ["run", "diagnose", "motion", "compare", "report"])
def test_other_commands_say_that_runs_are_missing(before, capsys, command):
    with pytest.raises(SystemExit) as left:
        main([command, str(before)])
    assert left.value.code == 2
    assert "expected at least one [[run]] but got none" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[camera]\nfps = 4000\nscale = 1e-4\n", "expected a mass in [study]"),
        ("[study]\nmass = 1\n[camera]\nscale = 1e-4\n", "expected the frame rate in [camera]"),
        ("[study]\nmass = 1\n[camera]\nfps = 4000\n", "expected a scale in [camera]"),
    ],
)
def test_what_a_plan_needs_is_asked_for(tmp_path, text, says):
    path = tmp_path / "study.toml"
    path.write_text(text)
    with pytest.raises(FrictrackError) as raised:
        plan_study(open_study(path, allow_incomplete=True))
    assert says in str(raised.value)
    assert raised.value.usage


def test_help_names_the_command():
    said = subprocess.run([sys.executable, "-m", "frictrack", "--help"], capture_output=True, text=True, check=True)
    assert "plan" in said.stdout
