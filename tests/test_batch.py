"""Many studies at once: side by side, on a cluster, resumed, with failures and deaths in the middle."""

from __future__ import annotations

import csv
import io
import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pandas as pd
import pytest
import rich.progress
from campaigns import campaign, die_once, killed_workers, results, short_study, slide
from rich.console import Console
from scipy import stats

from frictrack.base import workers
from frictrack.base.errors import FrictrackError, raise_faults
from frictrack.cli.common import BatchPrinter, ProgressBars
from frictrack.flow import Session
from frictrack.flow.batch import BatchState, Journal, batch, find_studies, find_trends, fit_slope, tasks, write_table
from frictrack.flow.batch.tasks import Scheduler, StudyOutcome

NUMBERS = ["coulomb.F_c", "coulomb.F_c std", "level", "noise_um", "rms_displacement_um"]  # columns of the table


class Inline:
    """A crew that does a piece of work as soon as it gets it."""

    def __init__(self, room: int = 4) -> None:
        self.given: list[tuple[str, ...]] = []
        self._room = room

    def submit(self, of: Callable[..., Any], *told: Any) -> Future[Any]:
        self.given.append((of.__name__, *(str(one) for one in told)))
        future: Future[Any] = Future()
        try:
            future.set_result(of(*told))
        except Exception as e:  # noqa: BLE001
            future.set_exception(e)
        return future

    def capacity(self) -> int:
        return self._room


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Studies that are fitted, not diagnosed."""

    def stand_in(session: Session, seed: int = 0) -> dict[str, Any]:
        fit = session.fit()
        (session.study.output / "report.html").write_text(" ".join(session.notes))
        return {
            "fit": fit,
            "diagnose": {"verdict": "complete", "missing": []},
            "output": str(session.study.output),
        }

    monkeypatch.setattr(Session, "run", stand_in)


@pytest.fixture
def inline(quick: None, monkeypatch: pytest.MonkeyPatch) -> Inline:
    """Batches are done in this process."""
    from contextlib import contextmanager  # noqa: PLC0415

    one = Inline()

    @contextmanager
    def here(workers: int | None = None) -> Iterator[Inline]:
        yield one

    monkeypatch.setattr("frictrack.flow.batch.local_workers", here)
    return one


def test_numbers_in_paths_count_as_numbers(tmp_path: Path) -> None:
    for name in ("run_10", "run_9", "run_2"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "study.toml").touch()
    found = find_studies([str(tmp_path), str(tmp_path / "run_9" / "*.toml")])
    assert [path.parent.name for path in found] == ["run_2", "run_9", "run_10"]


def test_a_batch_begun_again_does_what_is_missing(tmp_path: Path, inline: Inline) -> None:
    folder, stem = campaign(tmp_path / "c", 3), tmp_path / "out" / "all"
    first = batch([str(folder)], stem)
    assert [one["verdict"] for one in first["studies"]] == ["complete"] * 3
    assert (first["kept"], len(inline.given), first["failed"]) == (0, 3, [])
    again = batch([str(folder)], stem)
    assert (again["kept"], len(inline.given)) == (3, 3)
    assert again["studies"] == first["studies"]
    slide(folder / "day_2" / "r0.csv", 77, force=0.9)
    third = batch([str(folder)], stem)
    assert third["kept"] == 2
    assert inline.given[3][:2] == ("begin_study", str(folder / "day_2" / "study.toml"))
    values = pd.read_csv(stem.with_name("all.csv"))["coulomb.F_c"]
    assert values.tolist() == pytest.approx([0.6, 0.9, 0.6], rel=0.02)
    (folder / "day_3" / "study_results" / "study.h5").unlink()  # what came of it counts too
    assert batch([str(folder)], stem)["kept"] == 2
    assert batch([str(folder)], stem, seed=1)["kept"] == 0


def test_a_failed_run_is_left_out_and_the_rest_goes_on(tmp_path: Path, inline: Inline) -> None:
    folder, stem = campaign(tmp_path / "c", 2, runs=3), tmp_path / "all"
    kept = (folder / "day_1" / "r1.csv").read_text()
    (folder / "day_1" / "r1.csv").write_text("t_s,x_m\n0,nothing\n")
    (folder / "day_2" / "study.toml").write_text("[study]\nmas = 1\n")
    found = batch([str(folder)], stem)
    by_name = {Path(one["study"]).parent.name: one for one in found["studies"]}
    assert (by_name["day_1"]["runs"], by_name["day_1"]["left_out"]) == (2, ["r1"])
    assert 'unknown key "mas"' in by_name["day_2"]["reason"]
    assert [(one["run"], one["reason"][:14]) for one in found["failed"]] == [
        ("r1", "displacement: "),
        ("", "study.toml: [s"),
    ]
    assert 'run "r1" is left out: displacement' in (folder / "day_1" / "study_results" / "report.html").read_text()
    rows = list(csv.DictReader(stem.with_name("all.csv").read_text().splitlines()))
    assert [row["run"] for row in rows] == ["r0", "r2", "r1", ""]
    page = stem.with_name("all.html").read_text()
    assert "1 study failed" in page
    assert "1 run failed" in page
    (folder / "day_1" / "r1.csv").write_text(kept)  # mended: the same as if nothing had been
    mended = batch([str(folder)], stem)
    assert mended["studies"][0]["runs"] == 3
    other = campaign(tmp_path / "other", 1, runs=3)
    batch([str(other)], tmp_path / "other" / "all")
    assert results(folder)["day_1/study_results/study.h5"] == results(other)["day_1/study_results/study.h5"]


def test_a_study_none_of_whose_runs_can_be_measured_failed(tmp_path: Path, inline: Inline) -> None:
    folder = campaign(tmp_path / "c", 1)
    (folder / "day_1" / "r0.csv").write_text("t_s,x_m\n0,1\n")
    found = batch([str(folder)], tmp_path / "all")
    assert found["studies"][0]["reason"] == "none of its runs could be measured"
    assert [one["run"] for one in found["failed"]] == ["", "r0"]


def test_the_tables_say_the_same(tmp_path: Path, inline: Inline) -> None:
    batch([str(campaign(tmp_path / "c", 2))], tmp_path / "all")
    left, right = pd.read_csv(tmp_path / "all.csv"), pd.read_parquet(tmp_path / "all.parquet")
    pd.testing.assert_frame_equal(left[NUMBERS], right[NUMBERS])
    assert left["study"].tolist() == right["study"].tolist()
    assert right["coulomb.F_c"].dtype == np.float64


def test_other_programs_open_the_table_of_100_000_runs(tmp_path: Path) -> None:
    force = np.random.default_rng(0).normal(1.2, 0.01, size=20_000)
    shared = {"verdict": "complete", "missing": "", "model": "coulomb", "domain": "displacement"}
    rows: list[dict[str, Any]] = []
    for i, one in enumerate(force.tolist()):
        law = shared | {"study": f"lab/{i}/study.toml", "coulomb.F_c": one, "coulomb.F_c std": 0.01}
        rows += [law | {"run": f"r{k}", "role": "fit", "level": 1.0 + 0.1 * k, "segments": None} for k in range(5)]
    rows[17] = {"study": "lab/3/study.toml", "run": "r2", "reason": "displacement: v3.csv is empty"}
    paths = write_table(rows, tmp_path / "lab", {"coulomb.F_c": "N"})
    table = duckdb.sql(f"""
        select count(*), count("coulomb.F_c"), avg("coulomb.F_c"), sum(level), count(reason) from '{paths[1]}'
    """).fetchall()[0]
    whole = np.repeat(force, 5)
    assert table[:2] == (100_000, 99_999)
    assert table[2] == pytest.approx(np.delete(whole, 17).mean(), rel=1e-12)
    assert table[3:] == (pytest.approx(120_000 - 1.2), 1)
    left, right = pd.read_parquet(paths[1]), pd.read_csv(paths[0], low_memory=False)
    assert left.attrs["units"] == {"coulomb.F_c": "N", "coulomb.F_c std": "N", "coulomb.F_c std_misfit": "N"}
    np.testing.assert_array_equal(left["coulomb.F_c"], right["coulomb.F_c"])
    assert paths[1].stat().st_size < 2_000_000


def test_the_journal_bears_a_line_that_was_cut_off(tmp_path: Path) -> None:
    study = tmp_path / "study.toml"
    study.write_text("")
    files = {str(study): [0, study.stat().st_mtime_ns]}
    journal = Journal(tmp_path / "all.jsonl")
    journal.append(StudyOutcome(str(study), {"runs": 1}, [{"run": "a"}], files=files))
    whole = journal.path.read_bytes()
    for cut in range(len(whole)):
        journal.path.write_bytes(whole[:cut])
        assert set(journal.finished([study], 0)) <= {study}
        journal.append(StudyOutcome(str(study), {"runs": 2}, [{"run": "b"}], files=files))
        assert journal.finished([study], 0)[study].summary == {"runs": 2}
    journal.path.write_bytes(b'\xff\x00{"version": 1}\n[]\n' + whole.replace(b'"version": "', b'"version": "9'))
    assert journal.finished([study], 0) == {}


def test_films_of_a_study_are_measured_side_by_side(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first one before all others, whose failure only makes the second one the first."""
    from frictrack.flow.batch import tasks  # noqa: PLC0415

    folder = campaign(tmp_path, 1, runs=4)
    path = folder / "day_1" / "study.toml"
    path.write_text(path.read_text().replace('table = "', 'scale = "1 mm/px"\nfps = 1000\nvideo = "'))
    seen: list[tuple[str, ...]] = []

    def measured(study: Any, name: str) -> str | None:
        seen.append((name, *(run.name for run in study.runs)))
        return "no light" if name == "r0" else None

    monkeypatch.setattr(tasks, "_measure_run", measured)
    monkeypatch.setattr(tasks.Session, "run", lambda session, seed: (_ for _ in ()).throw(FrictrackError("not asked")))
    pool = Inline(room=2)
    state = BatchState(1)
    looks: list[int] = []
    done = list(Scheduler([path], 0, pool, state).run(lambda s: looks.append(len(s.under_way))))
    assert [given[0] for given in pool.given] == ["begin_study", "measure_film", "measure_film", "finish_study"]
    assert seen[:4] == [
        ("r0", "r0", "r1", "r2", "r3"),
        ("r1", "r1", "r2", "r3"),
        ("r2", "r1", "r2", "r3"),
        ("r3", "r1", "r2", "r3"),
    ]
    assert max(looks) == 2
    assert done[0].failures == [{"run": "", "reason": "not asked"}, {"run": "r0", "reason": "no light"}]


def test_workers_that_give_up(tmp_path: Path) -> None:
    class Leaving(Inline):
        def submit(self, of: Callable[..., Any], *told: Any) -> Future[Any]:
            future: Future[Any] = Future()
            future.cancel()
            future.set_running_or_notify_cancel()
            return future

    path = campaign(tmp_path, 1) / "day_1" / "study.toml"
    done = list(Scheduler([path], 0, Leaving(), BatchState(1)).run(lambda state: None))
    assert "task was cancelled" in done[0].failures[0]["reason"]


def test_a_moment_of_a_batch_is_shown() -> None:
    state = BatchState(5, kept=1, done=["/a/b.toml"], runs=3)
    state.under_way = {"/a/[c].toml": state.began, "/a/d.toml": state.began}
    state.failures = [{"study": "/a/b.toml", "run": "v3", "reason": "no light"}]
    file = io.StringIO()
    console = Console(width=100, file=file, force_terminal=True)
    columns = (rich.progress.TextColumn("{task.description}", markup=False), rich.progress.MofNCompleteColumn())
    with rich.progress.Progress(*columns, console=console) as drawn:
        BatchPrinter(ProgressBars(drawn))(state)
    for told in ("2 of 5: /a/b.toml", "failed: /a/b.toml, v3: no light", "/a/[c].toml, 0:00 and 1 more", "2/5"):
        assert told in file.getvalue()


# --- trends


def test_a_trend_is_told_from_scatter() -> None:
    """Against closed forms: without scatter the weighted line; with equal weights Student's t of a plain line."""
    rng = np.random.default_rng(0)
    at, s = np.arange(1.0, 13.0), rng.uniform(0.5, 2.0, 12)
    y = 3.0 + 0.4 * at + 0.2 * s * rng.standard_normal(12)  # less than its bars: no scatter beside
    slope, std, scatter, _ = fit_slope(at, y, s)
    w = 1.0 / s**2
    middle = np.average(at, weights=w)
    assert scatter == 0.0
    assert slope == pytest.approx(np.sum(w * (at - middle) * y) / np.sum(w * (at - middle) ** 2))
    assert std == pytest.approx(np.sum(w * (at - middle) ** 2) ** -0.5)
    y = rng.standard_normal(12)
    slope, std, scatter, p = fit_slope(at, y, np.zeros(12))
    plain = stats.linregress(at, y)
    assert (slope, std, p) == pytest.approx((plain.slope, plain.stderr, plain.pvalue), rel=1e-6)


def test_p_of_no_trend_is_uniform() -> None:
    rng = np.random.default_rng(1)
    at, found = np.arange(1.0, 11.0), []
    for _ in range(600):
        s = rng.uniform(0.5, 1.5, 10)
        found.append(fit_slope(at, rng.standard_normal(10) + s * rng.standard_normal(10), s)[3])
    assert stats.kstest(found, "uniform").pvalue > 0.001


def test_a_force_that_drifts_over_a_campaign_is_found() -> None:
    rng = np.random.default_rng(2)
    done = []
    for k in range(20):
        force = 5.0 + 0.1 * k + 0.1 * rng.standard_normal()
        row = {"run": "a", "role": "fit", "verdict": "complete", "level": 1.0, "noise_um": 5.0 + rng.standard_normal()}
        row |= {"coulomb.F_c": force, "coulomb.F_c std": 0.02, "viscous.F_v": None, "viscous.F_v std": None}
        done.append(StudyOutcome(str(k), {}, [row], units={"coulomb.F_c": "N", "viscous.F_v": "N s/m"}))
    found = {trend["name"]: trend for trend in find_trends(done)}
    assert set(found) == {"coulomb.F_c", "noise of the displacement"}  # one is unknown, one is constant
    assert found["coulomb.F_c"]["holds"]
    assert found["coulomb.F_c"]["change"] == pytest.approx(1.9, abs=3 * found["coulomb.F_c"]["change_std"])
    assert found["coulomb.F_c"]["scatter"] == pytest.approx(0.1, rel=0.5)
    assert not found["noise of the displacement"]["holds"]


def test_the_p_value_of_a_trend_counts_all_trends_of_the_batch() -> None:
    """Bonferroni: three quantities are tested, so each p-value is three times that of its line alone."""
    rng, names = np.random.default_rng(3), ("coulomb.F_c", "viscous.F_v")
    done = []
    for k in range(12):
        row = {"role": "fit", "verdict": "complete", "noise_um": rng.standard_normal() + 0.35 * k}
        row |= {name: rng.standard_normal() + 0.35 * k for name in names}
        done.append(StudyOutcome(str(k), {}, [row], units=dict.fromkeys(names, "N")))
    found = find_trends(done)
    assert len(found) == 3
    for trend in found:
        alone = stats.linregress(trend["at"], trend["value"]).pvalue
        assert trend["p"] == pytest.approx(min(1.0, 3 * alone), rel=1e-4)
        assert trend["holds"] == (3 * alone < 0.01)


# --- who does it


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_a_process_that_dies_takes_only_its_own_work_with_it(tmp_path: Path) -> None:
    with workers.local_workers(2) as ours:
        once = ours.submit(die_once, str(tmp_path / "mark"))
        always, failing, fine = (
            ours.submit(signal.raise_signal, signal.SIGKILL),
            ours.submit(raise_faults, ["expected light"], "a"),
            ours.submit(os.path.basename, "a/b"),
        )
        assert once.result(60) == "done"
        assert fine.result(60) == "b"
        with pytest.raises(FrictrackError, match="ended by signal 9, 2 times; was memory short"):
            always.result(60)
        with pytest.raises(FrictrackError, match="expected light"):
            failing.result(60)
        with pytest.raises(TypeError, match="result of a task cannot be sent"):
            ours.submit(threading.Lock).result(60)


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_processes_that_die_before_they_have_begun_a_task() -> None:
    with killed_workers([0.0, 0.0, 0.05, 0.1]) as dead, workers.local_workers(2) as ours:
        found = [ours.submit(os.path.basename, f"a/{i}") for i in range(20)]
        assert [one.result(60) for one in found] == [str(i) for i in range(20)]
    assert len(dead) >= 3


@pytest.mark.skipif(sys.platform == "win32", reason="limits of a process")
def test_processes_that_cannot_start() -> None:
    import resource  # noqa: PLC0415 - not on Windows

    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    with workers.local_workers(1) as ours:
        resource.setrlimit(resource.RLIMIT_NOFILE, (1, before[1]))
        try:
            error = ours.submit(os.path.basename, "a/b").exception(60)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert str(error) == "cannot start a process: Too many open files; try fewer --workers"


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize("turn", range(10))
def test_workers_of_a_batch_killed_at_100_moments(turn: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten moments in each turn."""
    monkeypatch.setattr("frictrack.flow.batch.tasks.begin_study", short_study)
    moments = np.random.default_rng(0).permutation(np.linspace(0.001, 2.0, 100))
    kills = 0
    for i, moment in enumerate(moments[turn::10]):
        folder = campaign(tmp_path / str(i), 8)
        with killed_workers([moment]) as dead:
            found = batch([str(folder)], folder / "all", workers=2)
        kills += len(dead)
        assert not found["failed"]
        lines = (folder / ".frictrack" / "all.jsonl").read_text().splitlines()
        written = [json.loads(line)["study"] for line in lines]
        assert sorted(written) == sorted(str(path) for path in folder.rglob("study.toml"))
        counts = [len(path.read_text()) for path in folder.rglob("ended")]
        assert len(counts) == 8
        assert sum(counts) <= 8 + len(dead)  # only the task of the dead process, if it had just ended
    assert kills >= 4  # where the work had not ended before


def test_as_many_as_the_memory_takes(tmp_path: Path) -> None:
    assert workers.max_parallel(free=3e9, taken=1e9, need=1.5e9) == 2
    assert workers.max_parallel(free=0.1e9, taken=0.0, need=1.5e9) == 1  # one always goes on
    machine = workers.free_memory(tmp_path)
    assert machine > 0
    (tmp_path / "memory.max").write_text("1000000\n")
    (tmp_path / "memory.current").write_text("900000\n")
    (tmp_path / "memory.stat").write_text("anon 1\ninactive_file 50000\n")
    assert workers.free_memory(tmp_path) == 150000.0
    (tmp_path / "memory.max").write_text("max\n")
    assert workers.free_memory(tmp_path) == pytest.approx(machine, rel=0.5)


def test_a_scheduler_that_does_not_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tasks, "SCHEDULER_TIMEOUT_S", 0.5)
    campaign(tmp_path, 1)
    with pytest.raises(FrictrackError, match=r"expected a Dask scheduler at tcp:.* but none answers"):
        batch([str(tmp_path)], tmp_path / "all", scheduler="tcp://127.0.0.1:9")


CLUSTER = """
import os, signal, sys
from pathlib import Path
from distributed import LocalCluster
from frictrack.flow.batch import batch

if __name__ == "__main__":
    with LocalCluster(n_workers=3, threads_per_worker=1, dashboard_address=None) as cluster:
        killed = []

        def watch(state):
            busy = [worker.name for worker in cluster.scheduler.workers.values() if worker.processing]
            if not killed and state.seconds > 1.5 and busy:
                os.kill(cluster.workers[busy[0]].pid, signal.SIGKILL)
                killed.append(busy[0])

        found = batch([sys.argv[1]], Path(sys.argv[1]) / "all", scheduler=cluster.scheduler_address, watch=watch)
        assert killed
        assert not found["failed"], found["failed"]
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_a_cluster_that_loses_a_worker_comes_to_the_same_as_this_machine(tmp_path: Path) -> None:
    import subprocess  # noqa: PLC0415

    script = tmp_path / "cluster.py"
    script.write_text(CLUSTER)
    there, ours = campaign(tmp_path / "there", 2), campaign(tmp_path / "here", 2)
    done = subprocess.run([sys.executable, script, there], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = batch([str(ours)], ours / "all", workers=2)
    assert not found["failed"]
    assert results(there) == results(ours)
    journals = [(folder / ".frictrack" / "all.jsonl").read_text().splitlines() for folder in (there, ours)]
    told = [json.loads(lines[-1])["version"] for lines in journals]
    assert told[0] == told[1]
