"""Measure frames per second from an uncompressed and a compressed file, and of the decoder alone."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import cv2

import frictrack as ft

from .conditions import FPS, Condition, condition

FRAMES = 4000
ROUNDS = 3


class Took(NamedTuple):
    """CPU seconds of all threads, and seconds on the clock."""

    cpu: float
    wall: float


def measure(say: Callable[[str], None], n: int = FRAMES) -> dict[str, Any]:
    """Medians of a few rounds in which every line has its turn; files in the page cache."""
    raw, packed = condition("nominal", 0, n), condition("mjpg", 0, n)
    _track(condition("nominal", 0, 60))  # imports, first use
    of_raw, of_packed = (ft.learn_target(ft.open_recording(c.film, fps=FPS), c.rectangle) for c in (raw, packed))
    lines: dict[str, Callable[[], None]] = {
        "8-bit TIFF: read the pictures": lambda: _read(raw),
        "8-bit TIFF: track, template known": lambda: _track(raw, of_raw),
        "8-bit TIFF: track": lambda: _track(raw),
        "8-bit TIFF: find by itself and track": lambda: _track(raw, rectangle=None),
        "MJPEG: decode by OpenCV, one thread": lambda: _opencv(packed),
        "MJPEG: decode": lambda: _read(packed),
        "MJPEG: track, template known": lambda: _track(packed, of_packed),
        "MJPEG: track": lambda: _track(packed),
    }
    rounds = [{name: _time(line) for name, line in lines.items()} for _ in range(ROUNDS)]
    out: dict[str, Any] = {}
    say(f"\nspeed, {n} frames of 1024 x 128 px, target 83 x 53 px{'frames / CPU s':>20}{'frames / s':>14}")
    for name in lines:
        cpu, wall = (n / statistics.median(getattr(r[name], kind) for r in rounds) for kind in ("cpu", "wall"))
        out[name] = {"frames_per_cpu_s": cpu, "frames_per_s": wall}
        say(f"{name:54}{cpu:20.0f}{wall:14.0f}")
    for line in ("MJPEG: track, template known", "MJPEG: track"):
        over = {kind: _over(rounds, line, kind) for kind in ("cpu", "wall")}
        out[f"{line}, over the decoder"] = over
        say(f"{line}: {over['cpu']:+.1%} CPU over decoding alone, {over['wall']:+.1%} on the clock")
    return out


def _over(rounds: list[dict[str, Took]], line: str, kind: str) -> float:
    """Median over the rounds of (track / decode) - 1."""
    return statistics.median(getattr(r[line], kind) / getattr(r["MJPEG: decode"], kind) - 1 for r in rounds)


def _time(what: Callable[[], None]) -> Took:
    cpu, wall = time.process_time(), time.perf_counter()
    what()
    return Took(time.process_time() - cpu, time.perf_counter() - wall)


def _track(film: Condition, known: Any = None, rectangle: Any = ...) -> None:
    target = film.rectangle if rectangle is ... else rectangle
    ft.track(ft.open_recording(film.film, fps=FPS), target, known=known)


def _read(film: Condition) -> None:
    for frame in ft.open_recording(film.film, fps=FPS).frames():
        frame.sum(axis=0)[0]  # a mapped file is read when it is looked at


def _opencv(film: Condition) -> None:
    capture = cv2.VideoCapture(str(film.film))
    while capture.grab():
        capture.retrieve()
