"""Run methods on signals and write the tables."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import numpy as np
from machine import described

from frictrack.base.errors import FrictrackError

from . import bayes, classics, others, ours
from .bounds import cramer_rao, wiener
from .estimate import Estimate, Method
from .measures import judge, summary
from .plan import Plan
from .signals import Array, Signal, signal

Say = Callable[[str], None]
Rows = dict[str, dict[str, Any]]  # method -> figures
Results = dict[str, dict[str, Rows]]  # signal -> noise -> method
WIENER = "Wiener (oracle)"
COLUMNS = {
    "a": ("a", 1, 4),
    "/Wiener": ("over_wiener", 1, 3),
    "worst": ("a_worst", 1, 3),
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
    return {WIENER: wiener(truth, noise)} | ours.methods(noise) | bayes.methods() | classics.methods(truth)


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
    lines = [f"\n{name}, {1e6 * noise:g} um\n{'':34}" + " ".join(f"{title:>8}" for title in shown)]
    for method, figures in rows.items():
        cells = (_cell(figures.get(key, np.nan), scale, digits) for key, scale, digits in shown.values())
        lines.append(f"{method:34}" + figures.get("fault", " ".join(f"{cell:>8}" for cell in cells)))
    return "\n".join(lines)


def _cell(value: float, scale: float, digits: int) -> str:
    return f"{value * scale:.{digits}g}" if math.isfinite(value) else "-"


def compare(plan: Plan, say: Say) -> Results:
    """Figures of all methods wanted and the bounds, on every signal at every noise."""
    results: Results = {}
    for name, noise in product(plan.signals, plan.noises):
        truth = signal(name)
        rows = bounds(truth, noise) | _own_methods(plan, truth, noise) | _elsewhere(plan, truth, noise)
        for figures in rows.values():
            figures["over_wiener"] = figures.get("a", np.nan) / rows[WIENER]["a"]
        results.setdefault(name, {})[f"{1e6 * noise:g} um"] = rows
        say(table(name, noise, rows))
    return results


def _own_methods(plan: Plan, truth: Signal, noise: float) -> Rows:
    """Methods of this Python; the Wiener filter is always one of them."""
    return {
        title: row(method, truth, noise, plan.seeds)
        for title, method in methods(truth, noise).items()
        if title == WIENER or plan.wants(title)
    }


def _elsewhere(plan: Plan, truth: Signal, noise: float) -> Rows:
    """Peers of the other Python, on few records, because most take long."""
    rows: Rows = {}
    records = [measured(truth, noise, seed) for seed in range(min(plan.seeds, plan.peer_seeds))]
    for method, choice in product(others.METHODS, others.CHOICES) if plan.python else ():
        title = f"PyNumDiff {method} {choice}"
        if plan.wants(title):
            rows[title] = _judge_peer(truth, [others.peer(plan, truth, y, method, choice) for y in records])
    return rows


def _judge_peer(truth: Signal, found: Sequence[tuple[Estimate, float] | str]) -> dict[str, Any]:
    faults = [one for one in found if isinstance(one, str)]
    if faults:
        return {"fault": faults[0]}
    estimates, seconds = zip(*found, strict=True)
    return judge(truth, estimates, seconds)


def overview(results: Results) -> str:
    """RMS error of the acceleration of every method on every signal."""
    cells = {(name, noise): rows for name, noises in results.items() for noise, rows in noises.items()}
    titles = dict.fromkeys(title for rows in cells.values() for title in rows)
    head = "".join(f"{name + ' ' + noise.split()[0]:>12}" for name, noise in cells)
    lines = [f"\n{'RMS error of a, m/s^2; noise um':34}{head}"]
    for title in titles:
        values = (_cell(rows.get(title, {}).get("a", np.nan), 1, 3) for rows in cells.values())
        lines.append(f"{title:34}" + "".join(f"{value:>12}" for value in values))
    return "\n".join(lines)


def machine(python: str | None) -> dict[str, str]:
    """Where and with what this was measured."""
    peers = {"pynumdiff": others.version(python)} if python else {}
    return described("numpy", "scipy") | peers
