"""Methods on signals, side by side, and the tables."""

from __future__ import annotations

import importlib.metadata
import math
import platform
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import frictrack as ft
from frictrack.errors import FrictrackError

from . import ours
from .bounds import cramer_rao, wiener
from .estimate import Estimate, Method
from .measures import judge, summary
from .signals import Array, Signal, signal

Say = Callable[[str], None]
Rows = dict[str, dict[str, Any]]  # method -> figures
WIENER = "Wiener (oracle)"
COLUMNS = {
    "a": ("a", 1, 4),
    "/Wiener": ("over_wiener", 1, 3),
    "a mid": ("a_mid", 1, 3),
    "first5%": ("a_first", 1, 3),
    "last5%": ("a_last", 1, 3),
    "near": ("a_near", 1, 3),
    "off": ("a_off", 1, 3),
    "v mm/s": ("v", 1e3, 3),
    "x um": ("x", 1e6, 3),
    "z x": ("z_x", 1, 3),
    "z v": ("z_v", 1, 3),
    "z a": ("z_a", 1, 3),
    "ms": ("ms", 1, 3),
}


def methods(truth: Signal, noise: float) -> dict[str, Method]:
    """All methods that run here, the oracles fed with the truth."""
    return {WIENER: wiener(truth, noise)} | ours.methods(noise)


def measured(truth: Signal, noise: float, seed: int) -> Array:
    """Displacement with white noise; the same for every method."""
    number = sum(map(ord, truth.name))
    return truth.x + noise * np.random.default_rng([seed, number]).standard_normal(len(truth.t))


def row(method: Method, truth: Signal, noise: float, seeds: int) -> dict[str, Any]:
    """Figures of one method; a method that refuses leaves its reason instead."""
    estimates, seconds = [], []
    for seed in range(seeds):
        y = measured(truth, noise, seed)
        start = time.process_time()
        try:
            estimates.append(Estimate(*method(truth.t, y)))
        except FrictrackError as fault:
            return {"fault": str(fault)}
        seconds.append(time.process_time() - start)
    return judge(truth, estimates, seconds)


def bounds(truth: Signal, noise: float) -> Rows:
    """Cramer-Rao bound of the parametric model, and of a collision also with its duration known."""
    if truth.model is None:
        return {}
    rows = {}
    for title, known in {"Cramer-Rao": (), "Cramer-Rao, duration known": ("width",)}.items():
        if set(known) <= set(truth.parameters):
            deviations, parameters = cramer_rao(truth, noise, known)
            rows[title] = summary(truth, deviations[None] ** 2) | {"parameters": parameters}
    return rows


def table(name: str, noise: float, rows: Rows) -> str:
    """One signal at one noise, a method per line."""
    shown = {title: c for title, c in COLUMNS.items() if any(math.isfinite(r.get(c[0], np.nan)) for r in rows.values())}
    lines = [f"\n{name}, {1e6 * noise:g} um\n{'':32}" + " ".join(f"{title:>8}" for title in shown)]
    for method, figures in rows.items():
        cells = (_cell(figures.get(key, np.nan), scale, digits) for key, scale, digits in shown.values())
        lines.append(f"{method:32}" + figures.get("fault", " ".join(f"{cell:>8}" for cell in cells)))
    return "\n".join(lines)


def _cell(value: float, scale: float, digits: int) -> str:
    return f"{value * scale:.{digits}g}" if math.isfinite(value) else "-"


def compare(names: Sequence[str], noises: Sequence[float], seeds: int, wanted: Sequence[str], say: Say) -> Any:
    """Figures signal -> noise -> method; only methods whose name contains a wanted word, and the bounds."""
    results: dict[str, dict[str, Rows]] = {}
    for name in names:
        truth = signal(name)
        for noise in noises:
            rows = bounds(truth, noise)
            for title, method in methods(truth, noise).items():
                if title == WIENER or not wanted or any(word.lower() in title.lower() for word in wanted):
                    rows[title] = row(method, truth, noise, seeds)
            best = rows[WIENER]["a"]
            for figures in rows.values():
                figures["over_wiener"] = figures.get("a", np.nan) / best
            results.setdefault(name, {})[f"{1e6 * noise:g} um"] = rows
            say(table(name, noise, rows))
    return results


def machine() -> dict[str, str]:
    """Where and with what this was measured."""
    versions = {name: importlib.metadata.version(name) for name in ("numpy", "scipy")}
    return {"python": platform.python_version(), "cpu": _cpu(), "frictrack": ft.__version__} | versions


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())
