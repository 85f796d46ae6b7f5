"""Whatever happens in the middle: nothing finished is lost or half-written, the next run ends as if nothing had."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from campaigns import campaign, contents, results
from repeats import few_or_many

from frictrack.base.errors import FrictrackError
from frictrack.flow import Session, open_study, run_pipeline, verify

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals and limits of POSIX")
SAMPLE = Path(__file__).resolve().parents[1] / "sample_videos" / "fast.avi"
STARTS = 0.9  # s until a command has loaded what it needs


def command(*words: str | Path) -> subprocess.Popen[bytes]:
    call = [sys.executable, "-m", "frictrack", *map(str, words)]
    return subprocess.Popen(call, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)


def done(folder: Path, *words: str | Path) -> float:
    """Run a command to its end; seconds."""
    start = time.monotonic()
    process = command(*words)
    assert process.wait(300) == 0, words
    assert not list(folder.rglob("*.part*"))
    return time.monotonic() - start


def killed(after: float, *words: str | Path) -> bool:
    """Run a command and end it with all its processes at once; no where it was faster."""
    process = command(*words)
    try:
        process.wait(after)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        return True
    return False


def finished(folder: Path) -> dict[str, str]:
    """What is done: the key of every group, by file and group."""
    return {
        f"{file}:{name}": value
        for file, held in results(folder).items()
        for name, value in held.items()
        if name.endswith("@key")
    }


def filmed(folder: Path) -> Path:
    """A study of a film and a table."""
    campaign(folder, 1)
    shutil.copy(SAMPLE, folder / "day_1")
    path = folder / "day_1" / "study.toml"
    text = path.read_text() + '[[run]]\nvideo = "fast.avi"\nfps = 4000\nscale = "0.5 mm/px"\nmass = 0.35\n'
    path.write_text(text)
    return folder


def survives(
    make: Callable[[Path], Path], at: Path, words: Callable[[Path], tuple[str | Path, ...]], kills: int, seed: int
) -> None:
    """Kill a command at random moments, look at what is there after each, and hold the end against undisturbed.

    Where it came to its end first, it begins anew: every kill falls into work.
    """
    calm, folder = make(at / "calm"), make(at / "disturbed")
    took = done(calm, *words(calm))
    rng = np.random.default_rng(seed)
    before: dict[str, str] = {}
    while kills:
        if not killed(rng.uniform(STARTS, max(took, STARTS + 0.1)), *words(folder)):
            shutil.rmtree(folder)
            make(folder)
            before = {}
            continue
        kills -= 1
        now = finished(folder)
        assert before.items() <= now.items()
        before = now
        if now:
            faults = [fault for fault in verify([folder])["faults"] if fault["kind"] not in ("missing", "leftover")]
            assert faults == []
    done(folder, *words(folder))
    assert results(folder) == results(calm)
    assert verify([folder])["sound"]


def run(folder: Path) -> tuple[str | Path, ...]:
    return "run", folder / "day_1" / "study.toml"


def fitting(folder: Path) -> tuple[str | Path, ...]:
    return "fit", folder / "day_1" / "study.toml"


def batch(folder: Path) -> tuple[str | Path, ...]:
    return "batch", folder, "-o", folder / "all", "--workers", "2"


def test_what_is_killed_goes_on(tmp_path: Path) -> None:
    survives(lambda folder: campaign(folder, 1), tmp_path, fitting, 1, 0)


@pytest.mark.slow
@pytest.mark.parametrize("turn", range(10))
def test_100_kills(tmp_path: Path, turn: int) -> None:
    """Five at a time, of run and batch, of tables and of a film."""
    make = filmed if turn % 2 else campaign_of_two
    survives(make, tmp_path / "run", run, 5, turn)
    survives(make, tmp_path / "batch", batch, 5, 100 + turn)


def campaign_of_two(folder: Path) -> Path:
    return campaign(folder, 2)


def limited(most: int, *words: str | Path) -> subprocess.CompletedProcess[str]:
    """A command whose files cannot grow beyond so many bytes, as on a disk that is full."""

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))

    call = [sys.executable, "-m", "frictrack", *map(str, words)]
    return subprocess.run(call, capture_output=True, text=True, preexec_fn=limit, check=False)


def test_a_disk_that_is_full(tmp_path: Path) -> None:
    folder = campaign(tmp_path / "c", 1)
    study = folder / "day_1" / "study.toml"
    calm = campaign(tmp_path / "calm", 1)
    Session(open_study(calm / "day_1" / "study.toml")).fit()
    Session(open_study(study)).bring_up_to("displacement")
    before = results(folder)
    failed = limited(60_000, "fit", study)
    assert failed.returncode == 1
    assert failed.stderr.splitlines()[-1].startswith("frictrack: "), failed.stderr
    assert "cannot write" in failed.stderr
    assert (
        before["day_1/study_results/r0.h5"].items()
        <= {
            **results(folder)["day_1/study_results/r0.h5"],
            **{
                k: v for k, v in before["day_1/study_results/r0.h5"].items() if k.startswith("@")
            },  # sums of what is there
        }.items()
    )
    Session(open_study(study)).fit()
    assert results(folder) == results(calm)


@pytest.mark.skipif(os.getuid() != 0, reason="only root can be somebody else")
def test_a_folder_that_may_not_be_written(tmp_path: Path) -> None:
    folder = campaign(tmp_path / "c", 2)
    Session(open_study(folder / "day_1" / "study.toml")).fit()  # all is loaded before we are somebody else
    for path in (*tmp_path.parents, tmp_path, folder):
        path.chmod(path.stat().st_mode | 0o055)
    try:
        os.seteuid(65534)
        for day, what in (("day_1", "comparison"), ("day_2", "study_results")):
            with pytest.raises(FrictrackError, match=rf"cannot write .*{day}.*[Pp]ermission denied"):
                Session(open_study(folder / day / "study.toml")).compare()
            assert what
    finally:
        os.seteuid(0)


def test_a_film_that_vanishes(tmp_path: Path) -> None:
    """Before work begins, and while it is read: one sentence; nothing half-written stays."""
    folder = filmed(tmp_path)
    study = open_study(folder / "day_1" / "study.toml")
    (folder / "day_1" / "fast.avi").unlink()
    with pytest.raises(FrictrackError, match=r"fast.avi: expected a recording but there is no such file"):
        Session(study).bring_up_to("friction")
    assert not run_pipeline(study, study.runs[0]).is_current("motion")  # all recordings are opened before work begins
    shutil.copy(SAMPLE, folder / "day_1")
    work = run_pipeline(study, study.runs[1])
    assert work.recording.n_frames > 0
    (folder / "day_1" / "fast.avi").unlink()
    with pytest.raises(FrictrackError, match=r"fast.avi"):
        work.get("track")
    assert not work.path.exists() or not work.is_current("track")
    shutil.copy(SAMPLE, folder / "day_1")
    Session(open_study(study.path)).bring_up_to("friction")
    assert run_pipeline(study, study.runs[1]).is_current("friction")


def test_a_clock_that_jumps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Results are current by what they were made from, whatever the time."""
    calm, folder = campaign(tmp_path / "calm", 1), campaign(tmp_path / "c", 1)
    Session(open_study(calm / "day_1" / "study.toml")).fit()
    study, now = folder / "day_1" / "study.toml", time.time()
    for jump in (0.0, -3e8, 3e8):
        monkeypatch.setattr(time, "time", lambda jump=jump: now + jump)
        for path in folder.rglob("*"):
            if path.is_file():
                os.utime(path, (now - jump, now - jump))
        Session(open_study(study)).fit()
        assert results(folder) == results(calm)
        assert run_pipeline(open_study(study), open_study(study).runs[0]).is_current("friction")
    assert contents(folder / "day_1" / "study_results" / "study.h5")


def test_what_a_killed_writer_left_is_swept(tmp_path: Path) -> None:
    from frictrack.base.files import _HOST, INTERNAL_FOLDER, lock_folder, replace_text  # noqa: PLC0415

    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    mine = tmp_path / f".a_{_HOST}-{gone.pid}_x.part.txt"
    live = tmp_path / f".a_{_HOST}-{os.getppid()}_x.part.txt"
    fresh, old = tmp_path / ".a_other-1_x.part.txt", tmp_path / ".a_other-1_y.part.txt"
    for path in (mine, live, fresh, old):
        path.touch()
    os.utime(old, (time.time() - 1e6,) * 2)
    with lock_folder(tmp_path):  # as any command that writes
        assert {path.name for path in tmp_path.iterdir()} == {INTERNAL_FOLDER, live.name, fresh.name}
    for path in (mine, old):
        path.touch()
    os.utime(old, (time.time() - 1e6,) * 2)
    replace_text(tmp_path / "another.h5", "a")
    assert {path.name for path in tmp_path.iterdir()} == {INTERNAL_FOLDER, "another.h5", live.name, fresh.name}


@pytest.mark.slow
@pytest.mark.parametrize(("words", "people"), few_or_many((fitting, 2), (run, 3)))
def test_several_at_once_come_to_what_one_does(
    tmp_path: Path, words: Callable[[Path], tuple[str | Path, ...]], people: int
) -> None:
    """Two people begin the same study: one works, the others wait and find all done."""
    calm, folder = campaign(tmp_path / "calm", 1), campaign(tmp_path / "c", 1)
    done(calm, *words(calm))
    together = [command(*words(folder)) for _ in range(people)]
    assert [process.wait(300) for process in together] == [0] * people
    assert results(folder) == results(calm)
    assert verify([folder])["sound"]
