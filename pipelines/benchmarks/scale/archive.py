"""Measure an archive of finished studies: time to repeat its batch and to verify it."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Say = Callable[[str], None]
STUDIES = (1000, 5000, 25_000)
RUNS = 4  # of a study
VERIFIED = 200  # studies
MASS, FORCE, FPS = 0.5, 0.6, 1000.0  # kg, N, 1/s


def measure(say: Say) -> dict[str, Any]:
    """Seconds and most memory of a batch in which nothing is left to do, for every number of studies."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        line = _one(folder / "one")
        for n in STUDIES:
            (folder / ".frictrack").mkdir(exist_ok=True)
            lines = "".join(_copies(folder / "one", folder / str(n), n, line))
            (folder / ".frictrack" / f"{n}.jsonl").write_text(lines)
            start = time.perf_counter()
            _frictrack("batch", folder / str(n), "-o", folder / str(n))
            took = time.perf_counter() - start
            peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024 / 1e6  # of the largest one so far
            page = (folder / f"{n}.html").stat().st_size / 1e6
            rows.append({"studies": n, "runs": RUNS * n, "seconds": took, "peak_MB": peak, "page_MB": page})
            say(f"{n} studies, {RUNS * n} runs: {took:.1f} s, at most {peak:.0f} MB, a page of {page:.2f} MB")
        few = sorted((folder / str(STUDIES[0])).iterdir())[:VERIFIED]
        start = time.perf_counter()
        _frictrack("verify", *few)
        verified = (time.perf_counter() - start) / VERIFIED
    say(f"verify: {1e3 * verified:.0f} ms a study")
    return {"rows": rows, "verify_s_per_study": verified}


def _one(folder: Path) -> str:
    """A finished study; its line of the journal."""
    rng = np.random.default_rng(0)
    folder.mkdir()
    text = f'[study]\nmass = {MASS}\nmodel = ["coulomb"]\n'
    t = np.arange(160) / FPS
    for i in range(RUNS):
        x = 2.0 * t - 0.5 * FORCE / MASS * t**2 + 5e-6 * rng.standard_normal(len(t))
        np.savetxt(folder / f"r{i}.csv", np.column_stack([t, x]), delimiter=",", header="t_s,x_m", comments="")
        text += f'[[run]]\ntable = "r{i}.csv"\n'
    (folder / "study.toml").write_text(text)
    _frictrack("batch", folder, "-o", folder.with_name("begun"))
    return (folder.parent / ".frictrack" / "begun.jsonl").read_text().splitlines()[-1]


def _copies(one: Path, folder: Path, n: int, line: str) -> list[str]:
    """The study n times, its files linked; lines of the journal, each with values of its own."""
    rng = np.random.default_rng(n)
    files = [path.relative_to(one) for path in one.rglob("*") if path.is_file()]
    lines = []
    for k in range(n):
        other = folder / f"day_{k + 1}"
        for path in files:
            (other / path).parent.mkdir(parents=True, exist_ok=True)
            os.link(one / path, other / path)
        record = json.loads(line.replace(f"{one}/", f"{other}/"))
        for row in record["rows"]:
            row |= {key: v * rng.normal(1.0, 0.01) for key, v in row.items() if isinstance(v, float)}
        lines.append(json.dumps(record) + "\n")
    return lines


def _frictrack(*words: str | Path) -> None:
    subprocess.run([sys.executable, "-m", "frictrack", *map(str, words)], check=True, stdout=subprocess.DEVNULL)
