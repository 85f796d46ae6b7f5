"""Measure how much faster one long film is tracked by two processes, and whether the numbers are the same."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import wait
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from frictrack.base.workers import WorkerPool, local_workers
from frictrack.recording import Recording, open_recording
from frictrack.records import Track
from frictrack.tracking import TargetModel, learn_target, track
from scale.length import rendered_film

FRAMES, PROCESSES = 16000, 2
WARM_UP = "import time, frictrack.tracking.driver; time.sleep(2)"
Say = Callable[[str], None]


def measure(say: Say) -> dict[str, Any]:
    """Seconds with one and two processes, with a target to be learnt and with a known one."""
    rows: dict[str, Any] = {"frames": FRAMES, "processes": PROCESSES}
    with tempfile.TemporaryDirectory() as name, local_workers(PROCESSES) as pool:
        rendered_film(Path(name) / "long", FRAMES)
        film = open_recording(Path(name) / "long.mraw")
        wait([pool.submit(exec, WARM_UP) for _ in range(PROCESSES)])  # all processes have started
        for what, known in (("learnt", None), ("known", learn_target(film))):
            rows[what] = _compared(film, known, pool)
            row = rows[what]
            times = f"{row['one_s']:.1f} s, over {PROCESSES} processes {row['several_s']:.1f} s"
            ideal = f"{row['efficiency']:.2f} of the ideal (by processor time {row['efficiency_cpu']:.2f})"
            numbers = "the same" if row["same"] else "OTHER"
            say(f"{FRAMES} frames, target {what}: {times}, {ideal}; {numbers} numbers")
    return rows


def _compared(film: Recording, known: TargetModel | None, pool: WorkerPool) -> dict[str, Any]:
    place = None if known is None else known.template.image
    start, before = time.perf_counter(), _processor_times()
    one = track(film, place, known=known)
    middle, between = time.perf_counter(), _processor_times()
    several = track(film, place, known=known, pool=pool)
    took, after = (middle - start, time.perf_counter() - middle), _processor_times()
    own = os.getpid()
    alone = between[own] - before[own]
    longest = after[own] - between[own] + max(after[k] - between[k] for k in between if k != own)
    return {
        "one_s": took[0],
        "several_s": took[1],
        "efficiency": took[0] / (PROCESSES * took[1]),
        "one_cpu_s": alone,
        "several_cpu_s": longest,  # this process and the busiest other one, as if they never worked at the same time
        "efficiency_cpu": alone / (PROCESSES * longest),
        "same": _same(one, several),
    }


def _processor_times() -> dict[int, float]:
    """Processor time of this process and its children, s, by process id."""
    me = psutil.Process()
    times = {process.pid: process.cpu_times() for process in (me, *me.children(recursive=True))}
    return {pid: spent.user + spent.system for pid, spent in times.items()}


def _same(one: Track, other: Track) -> bool:
    pairs = [(getattr(one, f.name), getattr(other, f.name)) for f in fields(Track)]
    return all(np.array_equal(a, b, equal_nan=a.dtype.kind == "f") for a, b in pairs if isinstance(a, np.ndarray))
