"""The benchmark of faulty records: it spoils as it says, and it counts a wrong verdict as wrong."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from frictrack.results import to_builtins
from frictrack.validation.blind.truth import RunTruth, Truth

sys.path.insert(0, str(Path(__file__).parents[1] / "pipelines" / "benchmarks"))

from reality.faults import KINDS, Fault, draw_fault, noted
from reality.judge import OUT_OF_TIME, Outcome, OutOfTime, cpu_limit, judge, judged, read_outcome
from reality.spoil import Recorded, copied, lines_with_fault, with_fault
from reality.studies import Case, InclinedCase, draw_case, inclined_case, planned, write_case
from reality.tally import table, tally

N, FPS, NOISE = 400, 4000.0, 1e-5
T = np.arange(N) / FPS
CLEAN = 3.0 * T - 4.0 * T**2
TRUTH = Truth(
    seed=1,
    kind="none",
    model=("coulomb", "viscous"),
    law={"coulomb": {"F_c": 1.2}, "viscous": {"F_v": 0.1}},
    mass=0.35,
    fps=2000.0,
    pitch=5e-4,
    noise=NOISE,
    scatter=0.01,
    course=1.0,
    runs=(
        RunTruth("r1", 3.0, 1.0, 1.0, 120),
        RunTruth("r2", 5.0, 1.0, 1.01, 120),
        RunTruth("r3", -4.0, 2.0, 0.99, 120),
    ),
)


def spoil(kind: str, size: float = 1.0, variant: str = "", seed: int = 0) -> tuple[pd.DataFrame, Fault, Recorded]:
    """One run with a fault, the fault, and the run as it should be."""
    rng = np.random.default_rng(seed)
    x = CLEAN + NOISE * rng.standard_normal(N)
    good = Recorded(pd.DataFrame({"t_s": T, "x_m": x, "sigma_m": NOISE}), CLEAN, NOISE)
    return *with_fault(good, "r1", Fault(kind, variant, size, ("r1",)), rng), good


# --- spoiling


@pytest.mark.parametrize("variant", KINDS["outliers"].variants)
def test_outliers_lie_off_by_their_size_in_their_frames_and_nowhere_else(variant: str):
    data, fault, good = spoil("outliers", 300.0, variant)
    off = np.abs(data["x_m"] - good.data["x_m"]).to_numpy() / NOISE
    assert np.flatnonzero(off).tolist() == list(fault.frames["r1"])
    assert np.all((off[off > 0] >= 0.7 * 300 - 1e-6) & (off[off > 0] <= 1.4 * 300 + 1e-6))
    assert 0.002 * N <= len(fault.frames["r1"]) <= 0.02 * N + 4


@pytest.mark.parametrize(("variant", "count"), [("one", 1), ("three", 3), ("scattered", 20)])
def test_a_doubled_frame_repeats_the_one_before_and_delays_all_later_ones(variant: str, count: int):
    data, fault, good = spoil("doubled", 0.05, variant)
    rows = np.array(fault.frames["r1"])
    x = data["x_m"].to_numpy()
    assert len(data) == N + count
    assert np.all(x[rows] == x[rows - 1])
    np.testing.assert_array_equal(np.delete(x, rows), good.data["x_m"])
    np.testing.assert_allclose(np.diff(data["t_s"]), 1 / FPS)


@pytest.mark.parametrize("variant", ["one in place", "three in place", "scattered in place"])
def test_a_doubled_frame_in_place_of_another_delays_none(variant: str):
    data, fault, good = spoil("doubled", 0.05, variant)
    rows, x = np.array(fault.frames["r1"]), data["x_m"].to_numpy()
    assert len(data) == N
    assert np.all(x[rows] == x[rows - 1])
    np.testing.assert_array_equal(np.delete(x, rows), np.delete(good.data["x_m"].to_numpy(), rows))


def test_missing_frames_are_gone_and_the_stamps_do_not_show_it():
    data, fault, good = spoil("missing", 0.03, "scattered")
    np.testing.assert_array_equal(data["x_m"], np.delete(good.data["x_m"].to_numpy(), fault.frames["r1"]))
    np.testing.assert_allclose(np.diff(data["t_s"]), 1 / FPS)


def test_quantised_positions_are_multiples_of_their_step_and_louder():
    data, fault, _ = spoil("quantised", 12.0)
    steps = data["x_m"].to_numpy() / (12.0 * NOISE)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert fault.louder == pytest.approx(np.sqrt(1 + 12**2 / 12), rel=0.1)  # variance of a step: its square over 12


@pytest.mark.parametrize("variant", KINDS["jitter"].variants)
def test_jitter_has_its_size(variant: str):
    data, fault, good = spoil("jitter", 0.1, variant)
    late = data["t_s"].to_numpy() - T
    off = (data["x_m"] - good.data["x_m"]).to_numpy() / np.gradient(CLEAN, T)
    stamped, moved = variant != "samples on even stamps", variant != "stamps"
    assert np.std(late) * FPS == pytest.approx(0.1 * stamped, rel=0.1)
    assert np.std(off) * FPS == pytest.approx(0.1 * moved, rel=0.1)
    assert (fault.louder > 2) == (variant == "samples on even stamps")


def test_coloured_noise_has_its_size_and_its_correlation():
    noise = np.concatenate([(spoil("coloured", 0.8, seed=s)[0]["x_m"] - CLEAN).to_numpy() for s in range(20)])
    assert np.std(noise) == pytest.approx(NOISE, rel=0.1)
    assert np.corrcoef(noise[1:], noise[:-1])[0, 1] == pytest.approx(0.8, abs=0.05)


def test_a_clock_is_wrong_by_its_share_and_the_study_file_follows_where_it_should():
    data, fault, _ = spoil("clock", 0.12, "stamps and fps")
    factor = data["t_s"].iloc[-1] / T[-1]
    assert abs(factor - 1) == pytest.approx(0.12)
    lines = ["fps = 4000", "[[run]]", 'name = "r1"', "[[run]]", 'name = "r2"']
    wrong = lines_with_fault(lines, fault)
    assert wrong[3] == f"fps = {4000 / factor:.8g}"
    assert [line for line in wrong if line != wrong[3]] == lines
    assert lines_with_fault(lines, replace(fault, variant="stamps")) == lines


def test_units_scale_all_columns_of_their_kind():
    in_mm, in_ms = spoil("unit", 1000.0, "x")[0], spoil("unit", 1000.0, "t")[0]
    assert in_mm["sigma_m"].iloc[0] == pytest.approx(1e3 * NOISE)
    assert in_mm["t_s"].to_numpy() == pytest.approx(T)
    assert in_ms["t_s"].to_numpy() == pytest.approx(1e3 * T)


STUDY = ["[study]", "mass = 0.35", "[[run]]", 'name = "r1"', "[[run]]", 'name = "r2"', "mass = 0.7", "[[run]]"]


@pytest.mark.parametrize(
    ("runs", "in_all", "masses"),
    [(("r1",), False, [0.35, 350.0, 0.7]), (("r2",), False, [0.35, 700.0]), (("r1", "r2"), True, [350.0, 700.0])],
)
def test_a_mass_is_mistyped_in_one_run_or_in_all(runs: tuple[str, ...], in_all: bool, masses: list[float]):
    wrong = lines_with_fault(STUDY, Fault("mass", "1000", 1.0, runs, in_all))
    assert [float(line.split("=")[1]) for line in wrong if line.startswith("mass")] == masses


def test_a_scale_is_typed_in_the_wrong_unit():
    assert lines_with_fault(['scale = "0.5 mm/px"'], Fault("unit", "scale")) == ['scale = "0.5 m/px"']


@pytest.mark.parametrize("variant", KINDS["copy"].variants)
def test_a_copy_is_the_same_measurement(variant: str):
    _, fault, good = spoil("copy", 0.2, variant)
    again = copied(good, fault, np.random.default_rng(0))
    first = (N - len(again)) // 2
    difference = again["x_m"].to_numpy() - good.data["x_m"].to_numpy()[first : first + len(again)]
    assert np.std(difference) <= 0.3 * NOISE


def test_a_study_on_a_slope_follows_gravity():
    flat = replace(TRUTH, law={"coulomb": {"F_c": 3.0}, "viscous": {"F_v": 0.0}}, scatter=0.0)
    on = inclined_case(flat, 20.0, np.random.default_rng(3))
    assert isinstance(on, InclinedCase)
    assert abs(np.degrees(on.incline)) == pytest.approx(20.0)
    run = on.runs[0]
    trajectory = on.trajectory(run)
    expected = -9.80665 * np.sin(on.incline) - run.level * on.law["coulomb"]["F_c"] / on.mass
    assert np.polyfit(trajectory.t[:20], trajectory.x[:20], 2)[0] * 2 == pytest.approx(expected, rel=1e-3)


# --- drawing


def test_a_longer_plan_begins_like_a_shorter_one_and_holds_every_fault():
    long = planned(200, 3)
    assert planned(20, 3) == long[:20]
    assert {fault for _, fault, _, _ in long[:20]} == set(KINDS)
    assert sum(fault == "none" for _, fault, _, _ in long) == 20
    assert {fault for _, fault, _, _ in planned(5, 3, "mass")} == {"mass"}


def test_sizes_stay_in_their_ranges():
    rng = np.random.default_rng(0)
    for kind, about in KINDS.items():
        sizes = [draw_fault(kind, ["r1", "r2"], rng).size for _ in range(50)]
        assert min(sizes) >= about.low * (1 - 1e-12)
        assert max(sizes) <= about.high * (1 + 1e-12)


# --- judging


@pytest.mark.parametrize(
    ("said", "why"),
    [
        (Outcome("s", Fault(), verdict="missing", groups=(("lens",),), allowed=("drag",)), "names lens"),
        (Outcome("s", Fault(), verdict="missing", groups=(("drag",), ("lens",)), allowed=("drag",)), "names lens"),
        (Outcome("s", Fault(), verdict="missing", groups=(("lens", "drag"),), allowed=("drag",)), ""),
        (Outcome("s", Fault(), ("drag",), (2.5,), verdict="complete"), "complete, while drag"),
        (Outcome("s", Fault(), ("drag",), (1.5,), verdict="complete"), ""),
        (Outcome("s", Fault("coloured", louder=4.0), ("drag",), (2.5,), verdict="complete"), ""),
        (Outcome("s", Fault(), ("drag",), (2.5,), verdict="undetermined"), ""),
        (Outcome("s", Fault(), verdict="complete", z={"viscous.F_v": -6.0}), "viscous.F_v -6.0"),
        (Outcome("s", Fault(), verdict="complete", z={"viscous.F_v": -6.0}, findings=("a remark",)), ""),
        (Outcome("s", Fault(), verdict="unexplained", z={"viscous.F_v": -60.0}), ""),
    ],
)
def test_what_is_confidently_wrong(said: Outcome, why: str):
    assert judged(said).wrong.startswith(why)
    assert bool(judged(said).wrong) == bool(why)


@pytest.mark.parametrize(
    ("fault", "finding", "named"),
    [
        (Fault("mass", "10", runs=("r2",)), 'run "r2": a mass of 3.5 kg is 10 times that of the other runs', True),
        (Fault("mass", "10", runs=("r2",)), 'run "r1": a mass of 3.5 kg is 10 times that of the other runs', False),
        (Fault("outliers", runs=("r1",)), 'run "r1": 1 sample lies 1 mm off its course (frame 7): left out', True),
        (Fault("outliers", runs=("r1",)), 'run "r1": 1 sample repeats the one before: frame 7; left out', False),
        (Fault("clock", runs=("r1", "r2"), in_all=True), 'run "r2": the time stamps say 900 Hz', True),
    ],
)
def test_a_fault_is_named_by_its_words_in_its_run(fault: Fault, finding: str, named: bool):
    assert fault.is_named([finding]) == named


def test_an_effect_that_is_the_fault_names_it():
    assert Fault("missing", runs=("r1",)).is_named([], ["dropped_frame"])
    assert not Fault("incline", runs=("r1",)).is_named([], ["slope"])  # it may be named, but says nothing of the angle
    assert noted(['run "r1": 1 sample lies 1 mm off its course']) == ["outliers"]


def test_work_that_takes_too_long_is_ended():
    with pytest.raises(OutOfTime), cpu_limit(0.05):
        sum(1 for _ in iter(int, 1))  # without an end


def test_figures_count_what_is_wrong_and_what_is_not_named():
    good = Outcome("a", Fault("outliers", runs=("r1",)), verdict="complete", named=True, seconds=3.0)
    bad = Outcome("b", Fault(), verdict="missing", groups=(("lens",),), wrong="names lens", seconds=5.0)
    late = Outcome("c", Fault("mass", "10", in_all=True, visible=False), verdict=OUT_OF_TIME, seconds=120.5)
    counts = tally([good, bad, late])
    assert (counts["confidently_wrong"]["hits"], counts["confidently_wrong"]["of"]) == (1, 3)
    assert (counts["fault_named"]["hits"], counts["fault_named"]["of"]) == (1, 1)  # that of `late` leaves no trace
    assert counts["within_120_s"]["hits"] == 2
    assert [row["study"] for row in counts["wrong"]] == ["b"]
    assert counts["seconds"] == {"median": 5.0, "largest": 120.5}
    assert "confidently wrong: 1 of 3" in "\n".join(table(counts))


@pytest.mark.slow
def test_two_studies_are_made_and_judged(tmp_path: Path):
    clean = judge(Case("clean", TRUTH, Fault()), tmp_path / "clean")
    assert (clean.verdict, clean.wrong, clean.noted) == (clean.verdict, "", ())
    assert clean.verdict in ("complete", "undetermined")
    assert 0 < abs(clean.worst[1]) < 5
    assert read_outcome(json.loads(json.dumps(to_builtins(clean.to_dict())))) == clean
    fault = Fault("outliers", "single", 400.0, ("r2",))
    spoilt_one = judge(Case("outliers", TRUTH, fault), tmp_path / "outliers")
    assert spoilt_one.named
    assert not spoilt_one.wrong
    assert spoilt_one.fault.frames["r2"]


def test_a_unit_that_is_named_by_an_error_counts_as_named(tmp_path: Path):
    case = Case("speeds", TRUTH, Fault("unit", "x", 1000.0, ("r1", "r2", "r3"), True))
    said = judge(case, tmp_path / "speeds")
    assert said.named
    assert not said.wrong


@pytest.mark.slow
@pytest.mark.parametrize("kind", [k for k in KINDS if k not in ("rotation", "occlusion")])
def test_every_fault_of_a_table_is_drawn_written_and_judged(kind: str, tmp_path: Path):
    (plan,) = planned(1, 7, kind)
    said = judge(draw_case("study", *plan), tmp_path / "study")
    assert said.verdict
    assert said.verdict not in ("broken", OUT_OF_TIME)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["rotation", "occlusion"])
def test_every_fault_of_a_film_is_drawn_and_written(kind: str, tmp_path: Path):
    (plan,) = planned(1, 7, kind)
    case = write_case(draw_case("study", *plan), tmp_path / "study")
    assert case.truth.film
    assert sorted(p.name for p in (tmp_path / "study").glob("*.avi")) == sorted(
        f"{r.name}.avi" for r in case.truth.runs
    )
