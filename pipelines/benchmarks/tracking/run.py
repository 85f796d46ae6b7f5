"""Run trackers on films and write the tables."""

from __future__ import annotations

import json
import math
import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from machine import described

import frictrack as ft
from frictrack.base.errors import FrictrackError

from .conditions import FPS, MAX_FRAMES, Condition, condition
from .measures import Judged, judge, pool
from .peers import ONLY_ON, PEERS

OURS, OURS_Y = "frictrack", "frictrack, along y"
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
Results = dict[str, dict[str, dict[str, Any]]]  # condition -> tracker -> figures
COLUMNS = {
    "RMS mpx": ("rms_mpx", "{:.2f}"),
    "/bound": ("rms_over_bound", "{:.2f}"),
    "locking": ("locking_mpx", "{:.2f}"),
    "(noise)": ("locking_noise_mpx", "{:.2f}"),
    "max px": ("worst_px", "{:.4f}"),
    "lost": ("lost", "{:d}"),
    "silent": ("silent", "{:d}"),
    "acc/white": ("acceleration_over_white", "{:.2f}"),
    "z": ("z_rms", "{:.2f}"),
    "frames/s": ("frames_per_s", "{:.0f}"),
}


def ours(film: Condition) -> dict[str, Judged]:
    """frictrack from the file to the track, along x and along y; reading counts."""
    follow, read = ft.track, ft.open_recording  # imported now, not while the clock runs
    start = time.process_time()
    try:
        track = follow(read(film.film, fps=FPS), film.rectangle)
    except FrictrackError as fault:
        print(f"{film.film.name}: {fault}")
        nothing = judge(np.full(len(film.x), np.nan), film.x, film.bound, time.process_time() - start)
        return {OURS: nothing, OURS_Y: nothing}
    seconds = time.process_time() - start
    x, y, w, h = film.rectangle
    return {
        OURS: judge(track.x_px - x - (w - 1) / 2, film.x, film.bound, seconds, track.sigma_px),
        OURS_Y: judge(track.y_px - y - (h - 1) / 2, film.y, film.bound_y, seconds, track.sigma_y_px),
    }


def others(name: str, film: Condition, python: str) -> dict[str, Judged]:
    """Every peer that the other Python has installed."""
    peers = [p for p in PEERS if ONLY_ON.get(p, name) == name]
    frames: Any = film.frames
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "found.npz"
        job = {"file": str(frames.filename), "offset": frames.offset, "shape": frames.shape}
        job |= {"rectangle": film.rectangle, "peers": peers, "out": str(out)}
        command = [python, str(Path(__file__).with_name("peers.py")), json.dumps(job)]
        subprocess.run(command, check=True, env=os.environ | ONE_THREAD)
        found = dict(np.load(out))
    installed = [p for p in peers if f"{p}/found" in found]
    return {p: judge(found[f"{p}/found"][:, 0], film.x, film.bound, float(found[f"{p}/seconds"])) for p in installed}


def accuracy(names: Sequence[str], seeds: int, frames: int, python: str | None, say: Callable[[str], None]) -> Results:
    """Figures of every tracker on every condition; without another Python only ours."""
    results: Results = {}
    for name in names:
        judged: dict[str, list[Judged]] = {}
        # A short film is made up for by more seeds.
        for seed in range(-(-seeds * frames // min(frames, MAX_FRAMES.get(name, frames)))):
            film = condition(name, seed, frames)
            rows = ours(film) | (others(name, film, python) if python else {})
            for tracker, one in rows.items():
                judged.setdefault(tracker, []).append(one)
        results[name] = {tracker: pool(films) for tracker, films in judged.items()}
        say(table(name, results[name]))
    return results


def table(name: str, rows: dict[str, dict[str, Any]]) -> str:
    """One condition, a tracker per line."""
    first = next(iter(rows.values()))
    head = f"\n{name}: bound {first['bound_mpx']:.3f} mpx, {first['frames']} frames\n{'':36}"
    lines = [head + " ".join(f"{title:>9}" for title in COLUMNS)]
    for tracker, figures in rows.items():
        lines.append(f"{tracker:36}" + " ".join(f"{_cell(figures[k], form):>9}" for k, form in COLUMNS.values()))
    return "\n".join(lines)


def _cell(value: float, form: str) -> str:
    return "-" if isinstance(value, float) and math.isnan(value) else form.format(value)


def overview(results: Results) -> str:
    """RMS / bound of every tracker under every condition; L = frames lost, ! = silently."""
    trackers = list(dict.fromkeys(t for rows in results.values() for t in rows))
    lines = ["", f"{'RMS / bound':36}" + " ".join(f"{name:>14}" for name in results)]
    for tracker in trackers:
        cells = [_short(rows[tracker]) if tracker in rows else "" for rows in results.values()]
        lines.append(f"{tracker:36}" + " ".join(f"{cell:>14}" for cell in cells))
    return "\n".join(lines)


def _short(figures: dict[str, Any]) -> str:
    if figures["lost"] > 0.9 * figures["frames"]:
        return "lost"
    lost = f" L{figures['lost']}" if figures["lost"] else ""
    return f"{figures['rms_over_bound']:.2f}{lost}{'!' if figures['silent'] else ''}"


def machine() -> dict[str, str]:
    """Where and with what this was measured."""
    return described("numpy", "scipy", "opencv-python-headless")


def missing(python: str) -> list[str]:
    """Libraries of peers that the other Python does not have."""
    libraries = sorted({library for library, _ in PEERS.values()})
    code = f"import importlib.util as u; print(*[m for m in {libraries} if not u.find_spec(m)])"
    return subprocess.run([python, "-c", code], capture_output=True, text=True, check=True).stdout.split()
