"""Fuzz every reader, the study file and the store, guided by coverage.

    python pipelines/fuzz [TARGET ...] [--seconds 60] [--found FOLDER] [--replay FILE]

Needs `pip install atheris`. An exception other than one FrictrackError of one line, an input that takes longer than
10 s, more than 2 GB of memory, or a crash of a library beneath is a finding: the input is kept in FOLDER and the line
that replays it is printed. The corpus stays in FOLDER too, so that the next fuzzing goes on where this one ended.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

TIMEOUT = 10  # s for one input
FINDINGS_FOLDER = Path(tempfile.gettempdir()) / "frictrack_fuzz"
FAST_FOLDER = "/dev/shm" if Path("/dev/shm").is_dir() else None  # files that live for a millisecond
RUNS_PATTERN = re.compile(r"number_of_executed_units:\s*(\d+)")
COVERAGE_PATTERN = re.compile(r"cov: (\d+)")


def once(name: str, data: bytes) -> str:
    """Give one input to a target; what the library says of it."""
    from targets import TARGETS, excused  # noqa: PLC0415 - after the instrumentation

    with tempfile.TemporaryDirectory(dir=FAST_FOLDER) as folder:
        return excused(TARGETS[name], data, Path(folder))


def work(name: str, folder: Path, seconds: int) -> None:
    """The process of one target: libFuzzer mutates, coverage of frictrack's own code guides it."""
    import atheris  # noqa: PLC0415

    with atheris.instrument_imports(include=["frictrack"]):
        import targets  # noqa: PLC0415
    warnings.simplefilter("ignore")
    corpus = folder / name / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for i, seed in enumerate(targets.TARGETS[name].seeds()):
        (corpus / f"seed_{i}").write_bytes(seed)
        once(name, seed)  # what is loaded late is loaded before memory is bounded
    targets.bounded()
    flags = {
        "max_total_time": seconds,
        "timeout": TIMEOUT,
        "rss_limit_mb": 2 * targets.MEMORY,
        "max_len": targets.TARGETS[name].longest,
        "artifact_prefix": f"{folder / name}/",
        "print_final_stats": 1,
    }
    atheris.Setup(
        ["fuzz", *(f"-{k}={v}" for k, v in flags.items()), str(corpus)], lambda data: once(name, data) and None
    )
    atheris.Fuzz()


def fuzz(name: str, folder: Path, seconds: int) -> bool:
    """Fuzz one target and print its line; whether it stood."""
    (folder / name).mkdir(parents=True, exist_ok=True)
    before = set((folder / name).iterdir())
    command = [sys.executable, __file__, name, "--seconds", str(seconds), "--found", str(folder), "--work"]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
    (folder / name / "output.txt").write_text(done.stderr)
    units, covered = RUNS_PATTERN.findall(done.stderr), COVERAGE_PATTERN.findall(done.stderr)
    new = [p for p in (folder / name).iterdir() if p not in before and re.match("crash|timeout|oom|leak|slow", p.name)]
    stood = done.returncode == 0
    print(f"{name:10} {units[-1] if units else '?':>9} inputs {covered[-1] if covered else '?':>6} branches "
          f"{'stood' if stood else 'FAILED'}", flush=True)  # fmt: skip
    for path in new:
        print(f"    python pipelines/fuzz {name} --replay {path}", flush=True)
    if not stood:
        print("    " + "\n    ".join((done.stdout + done.stderr).strip().splitlines()[-40:]), flush=True)
    return stood


def main() -> int:
    """Fuzz the targets that are asked for, one after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", metavar="TARGET")
    parser.add_argument("--seconds", type=int, default=60, help="per target")
    parser.add_argument(
        "--found", type=Path, default=FINDINGS_FOLDER, help="folder of what is found, and of the corpus"
    )
    parser.add_argument("--replay", type=Path, help="one input instead")
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.work:
        work(asked.targets[0], asked.found, asked.seconds)
        return 0
    from targets import TARGETS, bounded  # noqa: PLC0415

    wrong = [name for name in asked.targets if name not in TARGETS]
    if wrong or (asked.replay and len(asked.targets) != 1):
        parser.error(f"expected targets among {', '.join(TARGETS)}")
    if asked.replay:
        bounded()
        print(once(asked.targets[0], asked.replay.read_bytes()) or "taken as it is")
        return 0
    os.environ["OMP_NUM_THREADS"] = "1"
    return 0 if all([fuzz(name, asked.found, asked.seconds) for name in asked.targets or TARGETS]) else 1


if __name__ == "__main__":
    sys.exit(main())
