"""Measure memory and time of tracking over the length of a film."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Say = Callable[[str], None]
FRAMES = (1000, 4000, 16000)
WIDTH, HEIGHT, TOP = 1024, 256, 100  # px; the target's rows begin at TOP
BLOCK = (60, 40)  # px
HEADER = """#Camera Information Header
Record Rate(fps) : 4000
Total Frame : {n}
Start Frame : 0
Image Width : {width}
Image Height : {height}
Color Type : Mono
Color Bit : 8
EffectiveBit Depth : 8
EffectiveBit Side : Lower
File Format : MRaw
"""
TRACKER = r"""
import json, re, resource, sys
import numpy as np
import frictrack as ft

start = resource.getrusage(resource.RUSAGE_SELF)
track = ft.track(ft.open_recording(sys.argv[1]))
end = resource.getrusage(resource.RUSAGE_SELF)
peak = int(re.search(r"VmHWM:\s+(\d+)", open("/proc/self/status").read())[1]) * 1024
took = end.ru_utime + end.ru_stime - start.ru_utime - start.ru_stime
off = track.x_px - np.load(sys.argv[2])
off = off[track.found]
print(json.dumps({"found": int(track.found.sum()), "rms_px": float(np.std(off)), "peak_MB": peak / 1e6, "cpu_s": took}))
"""


def measure(say: Say) -> list[dict[str, Any]]:
    """One row for every length."""
    rows = []
    for n in FRAMES:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            x = rendered_film(folder / "long", n)
            np.save(folder / "truth.npy", x)
            call = [sys.executable, "-c", TRACKER, str(folder / "long.mraw"), str(folder / "truth.npy")]
            done = subprocess.run(call, capture_output=True, text=True, check=True)
        row = {"frames": n, "film_MB": n * WIDTH * HEIGHT / 1e6} | json.loads(done.stdout)
        row["us_per_frame"] = 1e6 * row["cpu_s"] / n
        say(
            f"{n} frames ({row['film_MB']:.0f} MB): {row['found']} found to {row['rms_px']:.4f} px, at most "
            f"{row['peak_MB']:.0f} MB, {row['us_per_frame']:.0f} us a frame"
        )
        rows.append(row)
    return rows


def rendered_film(path: Path, n: int) -> np.ndarray:
    """A bright block on a dark ground that swings; only the rows that it crosses hold anything. Its places (n,), px."""
    rng = np.random.default_rng(0)
    x = 500.0 + 300.0 * np.sin(2 * np.pi * np.arange(n) / 900.0)
    texture = _smooth(rng, BLOCK[0])
    path.with_suffix(".cih").write_text(HEADER.format(n=n, width=WIDTH, height=HEIGHT))
    u = np.arange(WIDTH)
    with path.with_suffix(".mraw").open("wb") as film:
        for i, at in enumerate(x):
            inside = u - at
            line = 20 + np.interp(inside, np.arange(BLOCK[0]) - BLOCK[0] / 2, texture, left=0.0, right=0.0)
            rows = line + 1.5 * rng.standard_normal((BLOCK[1], WIDTH))
            film.seek((i * HEIGHT + TOP) * WIDTH)
            film.write(np.clip(np.round(rows), 0, 255).astype(np.uint8).tobytes())
        film.truncate(n * WIDTH * HEIGHT)
    return x


def _smooth(rng: np.random.Generator, n: int) -> np.ndarray:
    """Grey levels across the block, as a lens leaves them."""
    wide = np.convolve(rng.uniform(60, 200, n), np.hanning(9) / np.hanning(9).sum(), "same")
    return wide * np.hanning(n) ** 0.3
