"""Measure the throughput of a batch over the number of processes."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from frictrack.base.workers import processors
from scale.scenes import RUNS, filmed

STUDIES = 6  # for every process that there is
Say = Callable[[str], None]


def measure(say: Say) -> dict[str, Any]:
    """Runs a minute on 1, 2, 4, ... processes, how much of the ideal that is, and what a finished study costs."""
    steps = [n for n in (1, 2, 4, 8, 16, 32, 64) if n <= processors()]
    count = STUDIES * steps[-1]
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for seed in range(count):
            filmed(folder / f"study_{seed}", seed)
        for workers in steps:
            for results in folder.glob("*/study_results"):
                shutil.rmtree(results)
            took = _batch(folder, workers, f"on_{workers}")
            rows.append({"processes": workers, "seconds": took, "runs_per_minute": 60 * RUNS * count / took})
            rows[-1]["efficiency"] = rows[0]["seconds"] / (workers * took)
            say(f"{workers} processes: {rows[-1]['runs_per_minute']:.1f} runs a minute, {rows[-1]['efficiency']:.3f}")
        again = _batch(folder, steps[-1], f"on_{steps[-1]}")
        afresh = _batch(folder, steps[-1], "afresh")
    say(f"resumed by the journal {again:.2f} s, without one {afresh:.2f} s for {count} studies")
    return {"studies": count, "runs": RUNS * count, "on": rows, "resumed_s": again, "without_journal_s": afresh}


def _batch(folder: Path, workers: int, name: str) -> float:
    """Seconds of the whole command."""
    call = [
        sys.executable,
        "-m",
        "frictrack",
        "batch",
        folder,
        "-o",
        folder / name,
        "--workers",
        str(workers),
        "--json",
    ]
    start = time.perf_counter()
    done = subprocess.run(call, capture_output=True, text=True, check=True)
    took = time.perf_counter() - start
    assert not json.loads(done.stdout)["failed"]
    return took
