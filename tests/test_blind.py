"""The blind benchmark: what it hides is fair, sealed, and counted as it is."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from few_effects import use_few_effects
from scipy.integrate import solve_ivp

from frictrack.base.errors import FrictrackError
from frictrack.cli import main
from frictrack.effects import LIBRARY
from frictrack.fit import remove_effect
from frictrack.flow import Session, open_study
from frictrack.records import Array
from frictrack.simulate import simulate
from frictrack.validation import blind as benchmark
from frictrack.validation.blind import SEAL_FILE, make, open_seal, run_table, score, write_study
from frictrack.validation.blind import truth_sampling as drawing
from frictrack.validation.blind.ideal_detector import (
    IdealDetector,
    degrees_of_freedom,
    ideal_detection_limit,
    is_event,
    limits_over_ideal,
    noncentrality_limit,
)
from frictrack.validation.blind.outcome import (
    NOTHING,
    Outcome,
    equivalent_effects,
    overlap,
    parameter_deviations,
    solution_at_truth,
    tally,
    wilson,
)
from frictrack.validation.blind.truth import FOREIGN, RunTruth, Truth, effect_named
from frictrack.validation.blind.truth_sampling import LAWS, SIZE_RANGE, candidates, draw_truth

LAW = {"coulomb": {"F_c": 3.0}, "viscous": {"F_v": 0.3}}
TRUTH = Truth(
    seed=1,
    kind="one",
    model=("coulomb", "viscous"),
    law=LAW,
    mass=0.3,
    fps=2000.0,
    pitch=5e-4,
    noise=1e-5,
    scatter=0.0,
    course=1.0,
    hidden=("texture",),
    runs=(
        RunTruth("r1", 3.0, 1.0, 1.0, 160),
        RunTruth("r2", 5.0, 1.0, 1.0, 160),
        RunTruth("r3", -4.0, 2.0, 1.0, 160),
        RunTruth("r4", -3.0, 1.0, 1.0, 160),
    ),
)


def holding(truth: Truth, **values: dict[str, float]) -> Truth:
    """The same study with causes in all its runs."""
    return replace(truth, runs=tuple(replace(run, values=values) for run in truth.runs))


# --- the ideal detector


def brute_force(truth: Truth) -> float:
    """Rise of chi-squared: what simulated motions of another start, law and level leave of the true one.

    The same number by finite differences of the simulator, and an explicit prior on every level.
    """
    numbers = [(e, p) for e in truth.law for p in truth.law[e]]
    blocks, right = [], []
    for i, run in enumerate(truth.runs):
        plain = truth.trajectory(run, hidden=False)
        full = truth.trajectory(run)
        columns = [np.ones_like(plain.t)]
        columns.append((truth.trajectory(replace(run, speed=run.speed + 1e-3), hidden=False).x - plain.x) / 1e-3)
        free = np.zeros((len(plain.t), 2 * len(truth.runs) + len(numbers) + len(truth.runs)))
        free[:, 2 * i : 2 * i + 2] = np.column_stack(columns)
        for k, (e, p) in enumerate(numbers):
            more = truth.law | {e: truth.law[e] | {p: truth.law[e][p] * 1.001}}
            moved = replace(truth, law=more).trajectory(run, hidden=False).x - plain.x
            free[:, 2 * len(truth.runs) + k] = moved / 0.001
        moved = truth.trajectory(replace(run, level=run.level * 1.001), hidden=False).x - plain.x
        free[:, 2 * len(truth.runs) + len(numbers) + i] = moved / 0.001
        blocks.append(free / truth.noise)
        right.append((full.x + full.shift - plain.x) / truth.noise)
    held = np.zeros((len(truth.runs), blocks[0].shape[1]))
    held[:, -len(truth.runs) :] = np.eye(len(truth.runs)) / max(truth.scatter, 1e-4)
    a, d = np.vstack([*blocks, held]), np.concatenate([*right, np.zeros(len(truth.runs))])
    norm = np.linalg.norm(a, axis=0)
    left = d - (a / norm) @ np.linalg.lstsq(a / norm, d, rcond=1e-12)[0]
    return float(left @ left)


CAUSES = {
    "texture": {"amplitude": 0.05, "period": 0.031, "phase": 0.4},
    "lens": {"k": 2e-3, "x_c": 0.3},
    "drag": {"c": 0.01},
}


@pytest.mark.few(2)
@pytest.mark.parametrize("scatter", [0.0, 0.03])
@pytest.mark.parametrize("name", CAUSES)
def test_the_ideal_rise_is_that_of_a_brute_force_likelihood_ratio(name: str, scatter: float):
    truth = holding(replace(TRUTH, scatter=scatter), **{name: CAUSES[name]})
    left = IdealDetector(truth).trace_and_rise(truth)[0]
    assert float(left @ left) == pytest.approx(brute_force(truth), rel=0.02)


@pytest.mark.parametrize("name", CAUSES)
def test_the_linear_trace_is_the_simulated_one_of_a_small_cause(name: str):
    own = {name: CAUSES[name]}
    truth, detector = holding(TRUTH, **own), IdealDetector(TRUTH)
    simulated, linear = (
        detector.trace_and_rise(truth)[0],
        detector.linear_trace(effect_named(name), [own] * len(truth.runs)),
    )
    assert np.linalg.norm(simulated - linear) < 0.03 * np.linalg.norm(simulated)


def test_a_scatter_that_is_not_known_takes_what_levels_could_explain_and_nothing_else():
    for name, values, kept in (("texture", CAUSES["texture"], (0.95, 1.0)), ("slope", {"F": 0.01}, (0.0, 0.5))):
        truth = holding(replace(TRUTH, scatter=0.0), **{name: values})
        left, rise = IdealDetector(truth).trace_and_rise(truth)
        assert kept[0] <= rise / float(left @ left) <= kept[1] + 1e-9


def test_the_limit_is_seen_in_95_of_100_repeats():
    rng = np.random.default_rng(4)
    from scipy.stats import chi2  # noqa: PLC0415

    threshold = chi2.isf(0.005 / 25 / 40, 3)
    offset = np.array([np.sqrt(noncentrality_limit(3, 40)), 0.0, 0.0])
    seen = np.sum((rng.standard_normal((20000, 3)) + offset) ** 2, axis=1) > threshold
    assert np.mean(seen) == pytest.approx(0.95, abs=0.006)


def test_a_phase_in_every_run_costs_two_numbers_in_every_run():
    counts = {"texture": 2, "vibration": 12, "drag": 1, "spring": 2, "collision": 1, "friction_lag": 1}
    assert {name: degrees_of_freedom(effect_named(name), 6) for name in counts} == counts
    assert noncentrality_limit(12) > noncentrality_limit(2) > noncentrality_limit(1)
    assert noncentrality_limit(1, 100) > noncentrality_limit(1)


def test_the_size_at_the_limit_makes_that_rise():
    detector = IdealDetector(TRUTH)
    size = ideal_detection_limit(detector, effect_named("drag"), {})
    assert size is not None
    left = detector.linear_trace(effect_named("drag"), [{"drag": {"c": size}}] * 4)
    assert float(left @ left) == pytest.approx(noncentrality_limit(1), rel=1e-6)


def test_what_a_film_shows_beside_the_truth_has_no_ideal_limit():
    told = {name: {"value": 0.1, "at": {}} for name in ("drag", "measured_load", "target_rotation")}
    assert list(limits_over_ideal(TRUTH, told)) == ["drag"]


# --- motion with a memory, and causes of no library


@pytest.mark.parametrize(("name", "value"), [("presliding", 1e-3), ("friction_lag", 1e-3)])
def test_a_law_with_memory_is_followed_as_its_equation_says(name: str, value: float):
    truth = replace(TRUTH, push=0.012, model=("coulomb", "stribeck", "viscous"))
    truth = replace(truth, law=LAW | {"stribeck": {"F_s": 2.0, "v_s": 0.4, "delta": 1.0}})
    run = truth.runs[0]
    values = truth.law | {name: {"tau": value, "stiffness": value, "exponent": 1.0}}
    conditions, t = truth.conditions(run), np.arange(160) / 2000
    trajectory = simulate(truth.base + effect_named(name), values, conditions, t, truth.start(run))
    fine = np.linspace(0, t[-1], 40 * 159 + 1)  # Euler, from the first row of its equation
    x = v = 0.0
    state = 5.0 if name == "friction_lag" else 0.0
    push = truth.drive(run)(fine)
    for i, h in enumerate(np.diff(fine)):
        dry = 3.0 + 2.0 * np.exp(-v / 0.4)
        force = (state if name == "friction_lag" else state * dry) + 0.3 * v
        a = 0.0 if name == "friction_lag" and v == 0 and push[i] < force else (push[i] - force) / 0.3
        state += h * ((dry - state) / value if name == "friction_lag" else v / value * (1 - state))
        x, v = x + h * v, v + h * a
    assert trajectory.x[-1] - trajectory.x[0] == pytest.approx(x, rel=2e-3)
    assert trajectory.v[-1] == pytest.approx(v, rel=2e-3)


def test_the_way_since_release_counts_in_a_law_with_memory():
    ring = {"amplitude": 0.3, "frequency": 120.0, "r": 0.8, "beam_length": 0.9, "phase": 0.4}
    heat = {"dF": 0.4, "length": 0.03}
    law = TRUTH.base + effect_named("presliding") + effect_named("beam_vibration") + effect_named("thermal")
    values = LAW | {"presliding": {"stiffness": 1e-3, "exponent": 1.0}, "beam_vibration": ring, "thermal": heat}
    conditions, t = replace(TRUTH, push=0.012, clamp=-0.02).conditions(TRUTH.runs[0]), np.arange(160) / 2000
    push = conditions.drive
    assert push is not None

    def motion(now: float, y: Array) -> list[float]:
        x, v, cycles, state = y
        u = (x + 0.02) / 0.9
        rate = 120.0 / np.sqrt(1 + 0.8 * ((3 * u**2 - u**3) / 2) ** 2)
        warm = -0.4 * (1 - np.exp(-(x - 0.05) / 0.03))
        friction = 3.0 * state + 0.3 * v + warm + 0.3 * np.sin(2 * np.pi * cycles + 0.4)
        return [v, (float(push(np.array([now]))[0]) - friction) / 0.3, rate, v / 1e-3 * (1 - state)]

    found = simulate(law, values, conditions, t, (0.05, 0.0))
    truth = solve_ivp(motion, (0.0, t[-1]), [0.05, 0.0, 0.0, 0.0], "LSODA", t, rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(found.x, truth.y[0], rtol=0, atol=3e-9)


@pytest.mark.parametrize("name", FOREIGN)
def test_a_foreign_cause_moves_the_mass_and_is_in_no_library(name: str):
    assert name not in LIBRARY
    values = {
        p.name: {"speed": 2.0, "place": 0.2, "frequency": 30.0}.get(p.name, 0.03) for p in effect_named(name).parameters
    }
    truth = holding(TRUTH, **{name: values | {"amplitude": 0.1}})
    run = truth.runs[0]
    assert np.max(np.abs(truth.trajectory(run).x - truth.trajectory(run, hidden=False).x)) > 1e-6


def test_foreign_causes_are_of_place_time_velocity_and_memory():
    axes = {p for name in FOREIGN for p in effect_named(name).parameters if not p.linear}
    assert {p.name for p in axes} == {"speed", "place", "length", "frequency", "time"}
    assert len(FOREIGN) >= 8


# --- draws

ORDER = list(dict.fromkeys(n for law, _ in LAWS for n in candidates("one", law)))


@pytest.fixture
def short_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw runs of few frames, for speed."""
    monkeypatch.setattr(drawing, "MAX_FRAMES", 150)


@pytest.mark.usefixtures("short_runs")
@pytest.mark.parametrize(("seed", "name"), [(20, "drag"), pytest.param(21, "vibration", marks=pytest.mark.slow)])
def test_a_draw_hides_what_it_says_at_the_size_it_says(seed: int, name: str):
    truth = draw_truth(seed, "one", ORDER.index(name))
    assert truth.hidden == (name,)
    detector = IdealDetector(replace(truth, runs=tuple(replace(r, values={}) for r in truth.runs)))
    left, surely = detector.trace_and_rise(truth)
    rise = min(float(left @ left), surely)
    assert np.sqrt(rise / detector.limit(effect_named(name))) == pytest.approx(truth.size[0], rel=0.06)
    assert SIZE_RANGE[0] <= truth.size[0] <= SIZE_RANGE[1]


def test_every_cause_takes_its_turn():
    seen = candidates("one", LAWS[0][0])
    laws = {name for name, effect in LIBRARY.items() if effect.replaces}
    unseen = {"bouc_wen", "target_rotation", "clock_rate", "drive_delay", "gravity"}
    unseen |= {name for name, effect in LIBRARY.items() if effect.needs == ("friction",)}  # these runs have no cell
    assert set(seen) == set(LIBRARY) - laws - {"coulomb", "stribeck", "viscous"} - unseen
    assert {"stribeck"} <= set(candidates("one", ("coulomb", "viscous")))
    assert "viscous_modulation" not in candidates("one", ("coulomb", "drag"))
    assert all(LIBRARY[n].acts_on == "measurement" for n in candidates("fault", LAWS[0][0]))


@pytest.mark.slow
@pytest.mark.usefixtures("short_runs")
def test_a_draw_hides_nothing_that_its_camera_cannot_show():
    for seed in range(3):
        truth = draw_truth(100 + seed, "one", ORDER.index("rolling_shutter"))
        assert truth.hidden == ("rolling_shutter",)
        assert truth.fps == 1000.0


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("name", "key"), [("drive_error", "push"), ("measured_load", "lift"), ("beam_vibration", "clamp")]
)
def test_a_draw_measures_what_its_cause_needs(name: str, key: str, tmp_path: Path):
    truth = draw_truth(3, "one", ORDER.index(name))
    assert truth.hidden == (name,)
    assert getattr(truth, key)
    frame = run_table(truth, truth.runs[0], np.random.default_rng(0))
    assert ("drive_N" in frame) == bool(truth.push)
    assert ("y_m" in frame) == (truth.lift is not None)


@pytest.mark.usefixtures("short_runs")
def test_a_study_has_runs_of_many_speeds_both_ways_and_another_mass():
    for seed in range(3):
        truth = draw_truth(seed, "none")
        speeds = [run.speed for run in truth.runs]
        assert 5 <= len(speeds) <= 8
        assert min(speeds) < 0 < max(speeds)
        assert {run.mass_ratio for run in truth.runs} in ({1.0, 0.5}, {1.0, 2.0})
        assert 1.5 <= min(map(abs, speeds)) < max(map(abs, speeds)) <= 8.0
        assert not any(run.values for run in truth.runs)


@pytest.mark.usefixtures("short_runs")
def test_events_happen_in_some_runs_each_at_a_moment_of_its_own():
    truth = draw_truth(8, "one", ORDER.index("dropped_frame"))
    own = [run.values["dropped_frame"] for run in truth.runs if run.values]
    assert is_event(effect_named("dropped_frame"))
    assert 1 <= len(own) <= len(truth.runs)
    assert {abs(o["frames"]) for o in own} == {1.0}
    assert len({o["time"] for o in own}) == len(own)
    assert all((o["time"] * truth.fps) % 1 == pytest.approx(0.5, abs=1e-6) for o in own)


@pytest.mark.usefixtures("short_runs")
def test_the_same_seed_draws_the_same_study():
    assert draw_truth(5, "foreign", 3) == draw_truth(5, "foreign", 3)
    assert draw_truth(5, "foreign", 3) != draw_truth(6, "foreign", 3)


# --- what nobody can tell from the truth


WAVE = {"amplitude": 0.6, "frequency": 61.0, "phase": 0.3}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "own"), [("vibration", WAVE), ("texture", CAUSES["texture"] | {"amplitude": 0.3})])
def test_a_force_in_time_is_like_a_shake_and_one_in_place_is_not(name: str, own: dict[str, float], tmp_path: Path):
    truth = holding(replace(TRUTH, hidden=(name,)), **{name: own})
    write_study(truth, tmp_path)
    session = Session(open_study(tmp_path / "study.toml"))
    session.fit()
    fit = session.models.fit(session.models.current()[0])
    full = solution_at_truth(truth, fit.solution)
    assert full.chi2 < 0.05  # the true law at the true motion leaves nothing
    found = equivalent_effects(truth, fit.solution)[name]
    assert found[0] == name
    assert ("camera_shake" in found) == (name == "vibration")
    assert not {"texture", "vibration"} - {name} & set(found)


@pytest.mark.slow
@pytest.mark.usefixtures("short_runs")
@pytest.mark.parametrize(("kind", "number", "rel"), [("two", 2, 0.1), ("three", 3, 0.5)])  # two others move further
def test_several_causes_are_as_large_as_each_is_seen_beside_the_others(
    kind: str, number: int, rel: float, tmp_path: Path
):
    truth = draw_truth(9004, kind, 4)
    assert len(truth.hidden) == number
    write_study(truth, tmp_path)
    session = Session(open_study(tmp_path / "study.toml"))
    session.fit()
    full = solution_at_truth(truth, session.models.fit(session.models.current()[0]).solution)
    for name, size, rise in zip(truth.hidden, truth.size, truth.rise, strict=True):
        assert size >= SIZE_RANGE[0]
        assert remove_effect(full, name).objective - full.objective == pytest.approx(rise, rel=rel)


@pytest.mark.slow
@pytest.mark.parametrize("fps", [2000.0, 6000.0])  # three frames of rest, and an end that smoothing bends
def test_a_contact_is_unbent_where_a_push_begins_with_the_record(fps: float, tmp_path: Path):
    law = {"coulomb": {"F_c": 1.09}, "stribeck": {"F_s": 0.31, "v_s": 0.24, "delta": 1.0}, "viscous": {"F_v": 0.137}}
    slow = RunTruth("r1", 2.46, 1.0, 1.0, int(0.06 * fps))
    runs = (slow, *(replace(slow, name=f"r{i}", speed=v) for i, v in enumerate((4.0, -5.4), 2)))
    pushed = replace(TRUTH, model=tuple(law), law=law, mass=0.24, fps=fps, noise=6e-6, push=0.012, runs=runs)
    truth = holding(replace(pushed, hidden=("presliding",)), presliding={"stiffness": 2.7e-3, "exponent": 1.0})
    write_study(truth, tmp_path)
    session = Session(open_study(tmp_path / "study.toml"))
    session.fit()
    full = solution_at_truth(truth, session.models.fit(session.models.current()[0]).solution)
    assert full.chi2 < 0.01  # the true law at the true motion leaves nothing


# --- seal and benchmark


@pytest.fixture(scope="module")
def studies(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("blind") / "out"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(drawing, "MAX_FRAMES", 150)  # short runs, for speed
        use_few_effects(patched)
        made_of = make(folder, 3, seed=3, workers=1)
    assert made_of["studies"] == 3
    return folder


@pytest.mark.slow
def test_names_and_files_say_nothing_of_the_truth(studies: Path):
    assert sorted(p.name for p in studies.iterdir()) == [SEAL_FILE, "study_1", "study_2", "study_3"]
    truths = open_seal(studies)
    text = " ".join(p.read_text() for p in studies.glob("*/study.toml")) + (studies / SEAL_FILE).read_text()
    for name in {n for t in truths.values() for n in t.hidden} - {"coulomb", "stribeck", "viscous", "drag"}:
        assert name not in text


def test_the_seal_tells_a_changed_file_and_a_missing_one(studies: Path):
    path = studies / "study_2" / "r1.csv"
    before = path.read_text()
    path.write_text(before.replace("1", "2", 1))
    with pytest.raises(FrictrackError, match=r"study_2/r1\.csv changed since; make them again"):
        open_seal(studies)
    path.write_text(before)
    assert len(open_seal(studies)) == 3


def test_kinds_come_in_proportion_and_in_no_order():
    planned = benchmark._plan_studies(420, benchmark.STUDIES_PER_KIND_TABLES, 0)
    kinds = [kind for _, kind, _ in planned]
    assert {k: kinds.count(k) for k in set(kinds)} == benchmark.STUDIES_PER_KIND_TABLES
    assert kinds != sorted(kinds)
    assert kinds[:200].count("one") < 140
    few = [kind for _, kind, _ in benchmark._plan_studies(7, benchmark.STUDIES_PER_KIND_TABLES, 0)]
    assert {k: few.count(k) for k in set(few)} == {"one": 3, "none": 2, "two": 1, "foreign": 1}
    assert len({turn for _, kind, turn in planned if kind == "one"}) == 200


@pytest.mark.slow
def test_studies_are_diagnosed_once_and_counted(studies: Path, monkeypatch: pytest.MonkeyPatch):
    use_few_effects(monkeypatch)
    done: list[str] = []
    real = benchmark.judge_study

    def judged(name: str, *rest: object) -> Outcome:
        done.append(name)
        if len(done) == 2:
            raise KeyboardInterrupt
        return real(name, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(benchmark, "judge_study", judged)
    with pytest.raises(KeyboardInterrupt):
        score(studies, workers=1)
    assert len(list((studies / "outcomes").iterdir())) == 1
    result = score(str(studies), workers=1)
    assert sorted(done[2:]) == ["study_2", "study_3"]  # the first is kept
    assert result["studies"] == 3
    assert result["failed"] == []
    kept = json.loads((studies / "score.json").read_text())
    assert {row["name"] for row in kept["outcomes"]} == {"study_1", "study_2", "study_3"}
    assert sum(result[k][s]["of"] for k, s in (("one", "in_group"), ("none", "false_alarms"), ("two", "both"))) >= 2
    assert all(row["seconds"] > 0 for row in kept["outcomes"])


def test_a_study_that_cannot_be_judged_is_an_outcome(tmp_path: Path):
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "study.toml").write_text('[study]\nmass = 1\n[[run]]\nname = "r1"\ntable = "r1.csv"\n')
    pd.DataFrame({"t_s": np.arange(5) / 1e3, "x_m": np.zeros(5)}).to_csv(folder / "r1.csv", index=False)
    row = benchmark.judge_study("s", TRUTH, folder)
    assert row.verdict == "failed"
    assert "expected" in row.fault


def test_folders_that_cannot_be_used_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(FrictrackError, match=r"no seal\.json in"):
        open_seal(tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    for call, said in (
        (["blind", "make", str(tmp_path)], "expected a new or empty folder"),
        (["blind", "make", str(tmp_path / "new"), "--n", "0"], "expected at least one study but got --n 0"),
        (["blind", "score", str(tmp_path)], "expected the folder of `frictrack blind make`"),
    ):
        with pytest.raises(SystemExit) as left:
            main(call)
        assert left.value.code == 2
        assert said in capsys.readouterr().err


# --- counting


def outcome(kind: str, hidden: tuple[str, ...], group: tuple[str, ...] = (), **more: object) -> Outcome:
    verdict = "missing" if group else "complete"
    equivalents = {h: (h,) for h in hidden}
    given = {"verdict": verdict, "named": group[:1], "group": group, "equivalents": equivalents} | more
    return Outcome("s", kind, hidden, tuple(3.0 for _ in hidden), **given)  # type: ignore[arg-type]


def test_a_group_counts_only_where_nobody_could_tell_its_members_apart():
    equivalents = {"drag": ("drag", "viscous", "drift")}
    rows = [
        outcome("one", ("drag",), ("drag",)),
        outcome("one", ("drag",), ("drift", "drag"), equivalents=equivalents),
        outcome("one", ("drag",), ("drift", "drag")),  # alone on what it does: the group is too large
        outcome("one", ("drag",), ("spring",), equivalents=equivalents),
        outcome("one", ("drag",)),
    ]
    one = tally(rows)["one"]
    assert (one["named_first"]["hits"], one["in_group"]["hits"], one["missed"]["hits"]) == (1, 2, 1)
    assert one["first_where_alone"] == {"hits": 1, "of": 3, "share": 1 / 3, "interval": list(wilson(1, 3))}
    assert one["median_group"] == 1.5


def test_two_causes_are_both_found_by_name_or_by_what_nobody_can_tell_from_them():
    equivalents = {"drag": ("drag", "viscous"), "texture": ("texture",)}
    hidden = ("drag", "texture")
    rows = [
        outcome("two", hidden, named=("texture", "drag"), verdict="missing", equivalents=equivalents),
        outcome("two", hidden, named=("texture", "viscous"), verdict="missing", equivalents=equivalents),
        outcome("two", hidden, named=("drag", "viscous"), verdict="missing", equivalents=equivalents),  # twice one
        outcome("two", hidden, named=("texture",), verdict="missing", equivalents=equivalents),
    ]
    two = tally(rows)["two"]
    assert (two["both"]["hits"], two["both_by_name"]["hits"]) == (2, 1)


def test_a_cause_that_the_others_imitate_need_not_be_named():
    equivalents = {"drag": ("drag",), "thermal": ("thermal", NOTHING)}
    hidden = ("drag", "thermal")
    rows = [
        outcome("two", hidden, named=("drag",), verdict="missing", equivalents=equivalents),
        outcome("two", hidden, named=("thermal", "drag"), verdict="missing", equivalents=equivalents),
        outcome("two", hidden, named=("drag", "lens"), verdict="missing", equivalents=equivalents),
        outcome("two", hidden, named=("thermal",), verdict="missing", equivalents=equivalents),
    ]
    two = tally(rows)["two"]
    assert (two["both"]["hits"], two["wrong_without_doubt"]["hits"]) == (3, 2)


def test_what_a_track_notes_may_be_named_as_well():
    hidden = ("drag", "lens")
    rows = [
        outcome("two", hidden, named=("lens", "drag"), verdict="missing", noted=("lens",)),
        outcome("two", hidden, named=("drag",), verdict="missing", noted=("lens",)),
        outcome("two", hidden, named=("lens",), verdict="missing", noted=("lens",)),
    ]
    assert tally(rows)["two"]["wrong_without_doubt"]["hits"] == 1


def test_a_fault_that_the_law_imitates_is_none_that_the_data_can_show():
    seen = outcome("one", ("lens",), ("lens",), equivalents={"lens": ("lens",)})
    fault = tally([seen, replace(seen, equivalents={"lens": ("lens", NOTHING)})])["fault"]["called"]
    assert (fault["hits"], fault["of"]) == (1, 1)


def test_three_causes_are_all_found():
    hidden = ("drag", "texture", "lens")
    rows = [
        outcome("three", hidden, named=("lens", "texture", "drag"), verdict="missing"),
        outcome("three", hidden, named=("texture", "drag"), verdict="missing"),
    ]
    stated = replace(rows[0], verdict="ambiguous", named=("drag",), sets=(("drag",), tuple(rows[0].hidden)))
    assert tally([stated])["three"]["all_stated"]["hits"] == 1
    assert tally([replace(stated, verdict="missing", sets=())])["three"]["wrong_without_doubt"]["hits"] == 1
    assert tally(rows)["three"]["all"]["hits"] == tally(rows)["three"]["all_by_name"]["hits"] == 1


def test_a_foreign_cause_is_unexplained_or_reproduced():
    rows = [
        outcome("foreign", ("joint",), verdict="unexplained"),
        outcome("foreign", ("joint",), ("patch",), reduced_chi2=1.02),
        outcome("foreign", ("joint",), ("patch",), reduced_chi2=1.3),
        outcome("foreign", ("joint",), reduced_chi2=1.0),  # "complete": it was overlooked
    ]
    assert tally(rows)["foreign"]["unexplained_or_reproduced"]["hits"] == 2


def test_a_fault_counts_where_the_data_can_show_it():
    rows = [
        outcome("one", ("lens",), ("lens",)),
        outcome("one", ("lens",), ("spring",)),
        outcome("one", ("camera_shake",), ("vibration",), equivalents={"camera_shake": ("camera_shake", "vibration")}),
        outcome("fault", ("camera_shake",), film=True, noted=("camera_shake",)),
        outcome("fault", ("timebase",), ("lens",), film=True),
    ]
    fault = tally(rows)["fault"]["called"]
    assert (fault["hits"], fault["of"]) == (3, 4)


def test_what_is_left_is_counted_where_the_cause_was_named():
    rows = [
        outcome("one", ("drag",), ("drag",), reduced_chi2=1.04, heldout=1.02, z={"a": 1.0, "b": -2.5}),
        outcome("one", ("drag",), ("drag",), reduced_chi2=1.14, heldout=1.08, z={"a": 3.0}),
        outcome("one", ("drag",), ("lens",), reduced_chi2=2.0, heldout=2.0, z={"a": 9.0}),
    ]
    after = tally(rows)["after"]
    assert (after["reduced_chi2"]["hits"], after["heldout"]["hits"]) == (1, 1)
    assert (after["parameters"]["hits"], after["parameters"]["of"]) == (2, 3)
    assert tally(rows)["confusion"] == {"drag": {"drag": 2, "lens": 1}}


def test_no_outcome_has_no_share():
    empty = tally([])
    assert empty["one"]["in_group"]["share"] is None
    assert empty["seconds"] == {"median": None, "largest": None}


@pytest.mark.parametrize(
    ("hits", "of", "low", "high"), [(95, 100, 0.8882, 0.9785), (0, 50, 0.0, 0.0713), (81, 263, 0.2553, 0.3662)]
)
def test_wilson(hits: int, of: int, low: float, high: float):
    assert wilson(hits, of) == pytest.approx((low, high), abs=1e-4)


def test_deviations_are_taken_from_the_truth_as_it_is_quoted():
    law = LAW | {"stribeck": {"F_s": 2.0, "v_s": 0.4, "delta": 1.0}}
    own = {"amplitude": 0.1, "period": 0.03, "phase": 3.1}
    truth = holding(replace(TRUTH, law=law), texture=own)
    told = {
        "stribeck.F_s": {"value": 5.2, "std": 0.1},
        "texture.period": {"value": 0.0305, "std": 0.001},
        "texture.phase": {"value": -3.1, "std": 0.1},
        "coulomb.F_c": {"value": None, "std": None},
    }
    found = parameter_deviations(truth, ("texture",), told)
    assert found == pytest.approx({"stribeck.F_s": 2.0, "texture.period": 0.5, "texture.phase": 0.832}, abs=1e-3)
    assert parameter_deviations(truth, ("drag",), told) == {}


def test_overlap_counts_frames_of_where_a_patch_acts():
    truth = replace(TRUTH, hidden=("patch",), runs=TRUTH.runs[:1])
    truth = holding(truth, patch={"F": 0.3, "x_c": 0.15, "w": 0.01})
    trajectory = truth.trajectory(truth.runs[0])
    inside = trajectory.t[np.abs(trajectory.x - 0.15) <= 0.02]
    exact = [{"run": "r1", "t": [inside[0], inside[-1]]}]
    assert overlap(truth, exact, {}) == 1.0
    assert overlap(truth, [], {}) == 0.0
    half = [{"run": "r1", "t": [inside[0], inside[len(inside) // 2 - 1]]}]
    assert overlap(truth, half, {}) == pytest.approx(2 / 3, abs=0.02)
    assert overlap(replace(truth, hidden=("drag",)), exact, {}) is None


def test_what_shifts_the_picture_does_so_under_a_law_with_memory():
    truth = draw_truth(5, "none")
    law = truth.base + effect_named("presliding") + effect_named("peak_locking")
    values = truth.law | {"presliding": {"stiffness": 1e-4, "exponent": 1.0}}
    values |= {"peak_locking": {"amplitude": 0.02, "phase": 0.3}}
    trajectory = simulate(
        law, values, replace(truth, push=0.012).conditions(truth.runs[0]), np.arange(99) / 4000, (0.05, 0.0)
    )
    np.testing.assert_allclose(
        trajectory.shift, 0.02 * truth.pitch * np.sin(2 * np.pi * trajectory.x / truth.pitch + 0.3)
    )
