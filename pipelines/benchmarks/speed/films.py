"""Measure demo, tracking beside decoding, and one long film over two processes."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2

from speed.child import frictrack

Say = Callable[[str], None]
SAMPLES = Path(__file__).resolve().parents[3] / "sample_videos"


def measure_demo(say: Say) -> dict[str, float]:
    """CPU seconds of the demo in an empty folder."""
    with tempfile.TemporaryDirectory() as name:
        spent = frictrack("demo", folder=Path(name))
    say(f"demo: {spent.cpu_s:.1f} s, {spent.peak_MB:.0f} MB, exit code {spent.code}")
    return {"cpu_s": spent.cpu_s, "peak_MB": spent.peak_MB}


def measure(say: Say) -> dict[str, float]:
    """CPU seconds from four films to the verdict, of their tracking, and of decoding them."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "study"
        shutil.copytree(SAMPLES, folder)
        tracked = frictrack("track", str(folder), folder=folder)
        shutil.rmtree(folder)
        shutil.copytree(SAMPLES, folder)
        verdict = frictrack("diagnose", str(folder), "--quick", folder=folder)
        start = time.process_time()
        frames = sum(_decode(path) for path in sorted(folder.glob("*.avi")))
        decoding = time.process_time() - start
    out = {"frames": frames, "verdict_s": verdict.cpu_s, "track_s": tracked.cpu_s, "decoding_s": decoding}
    say(", ".join(f"{key} {value:.2f}" for key, value in out.items()))
    return out


def _decode(path: Path) -> int:
    """Read a film to its end; the number of frames."""
    film, count = cv2.VideoCapture(str(path)), 0
    while film.read()[0]:
        count += 1
    return count
