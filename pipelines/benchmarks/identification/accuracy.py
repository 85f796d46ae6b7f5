"""Compute errors of every method over the Cramer-Rao bound, scene by scene."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from derivatives.signals import Array

from frictrack.base.errors import FrictrackError

from .bound import bound
from .estimates import METHODS, Estimate
from .scenes import SCENES, Scene, films

Say = Callable[[str], None]
Rows = dict[str, dict[str, Any]]  # method -> figures
Results = dict[str, dict[str, Any]]  # scene -> noise -> truth, bound and methods
NORMAL = 1.96  # standard deviations that hold 95 %
MIN_LINE_SIGMAS = 5.0  # standard deviations that a line must stand out for a bound to mean anything
DEFAULT, QUICK = "structural", "kalman"  # smoothers that start a fit and say where it begins and ends
OURS = next(iter(METHODS))
QUICK_SMOOTHER = "frictrack, quick smoother"


class Job(NamedTuple):
    """One draw of a scene: every method of `titles` on the same films."""

    scene: str
    noise: float
    seed: int
    titles: tuple[str, ...]


Draw = dict[str, tuple[Estimate, float] | str]  # method -> estimate and CPU seconds, or its fault


def draw(job: Job) -> Draw:
    """The estimates of every method on one draw of the noise."""
    scene = SCENES[job.scene]
    found: Draw = {}
    for title in job.titles:
        runs = films(scene, job.noise, job.seed, QUICK if title == QUICK_SMOOTHER else DEFAULT)
        start = time.process_time()
        try:
            estimate = METHODS[OURS if title == QUICK_SMOOTHER else title](scene, runs)
        except FrictrackError as fault:
            found[title] = str(fault)
            continue
        found[title] = estimate, time.process_time() - start
    return found


def judge(scene: Scene, limits: dict[str, float], draws: Sequence[tuple[Estimate, float] | str]) -> dict[str, Any]:
    """Figures of one method: errors over the bound, by parameter, and CPU milliseconds of a fit."""
    made = [d for d in draws if not isinstance(d, str)]
    if not made:
        return {"failed": len(draws)}
    names, scale = list(scene.law), np.array(list(limits.values()))
    error = np.array([[_error_ratio(n, e.values[n], scene.law[n]) for n in names] for e, _ in made])
    stated = np.array([[e.stds[n] for n in names] for e, _ in made])
    with np.errstate(invalid="ignore"):
        inside = np.where(np.isfinite(stated), np.abs(error) <= NORMAL * stated, np.nan)
    said = np.isfinite(inside)
    return {
        "rms": _by(names, np.sqrt(np.mean(error**2, axis=0)) / scale),
        "bias": _by(names, np.mean(error, axis=0) / scale),
        "cover": _by(names, np.sum(inside == 1, axis=0) / np.where(said.any(axis=0), said.sum(axis=0), np.nan)),
        "ms": 1e3 * float(np.mean([seconds for _, seconds in made])),
        "draws": len(made),
        "failed": len(draws) - len(made),
        "withheld": sum(e.withheld > 0 for e, _ in made),
    }


def _error_ratio(name: str, value: float, truth: float) -> float:
    """Error of one parameter; phases are taken the short way round."""
    error = value - truth
    return float(np.angle(np.exp(1j * error))) if name.startswith("phase") else error


def _by(names: Sequence[str], values: Array) -> dict[str, float]:
    return dict(zip(names, map(float, values), strict=True))


class Plan(NamedTuple):
    """What to draw: scenes, noises in m, draws of the default fit, and fewer of what is shown other_draws it."""

    scenes: Sequence[str]
    noises: Sequence[float]
    seeds: int
    other_draws: int
    workers: int

    def jobs(self, scene: str, noise: float) -> list[Job]:
        """All draws of a scene; the quick smoother has half as many as what is shown other_draws."""
        wanted = (
            (OURS, self.seeds),
            *((m, self.other_draws) for m in METHODS if m != OURS),
            (QUICK_SMOOTHER, self.other_draws // 2),
        )
        return [Job(scene, noise, s, tuple(t for t, n in wanted if s < n)) for s in range(self.seeds)]


def compare(plan: Plan, say: Say) -> Results:
    """Every way on every scene at every noise."""
    results: Results = {}
    with ProcessPoolExecutor(plan.workers) as pool:
        for name, noise in product(plan.scenes, plan.noises):
            scene = SCENES[name]
            limits = bound(scene, noise)
            if faint := _is_faint(scene, limits):
                say(f"\n{name}, {1e6 * noise:g} um: left out, {faint}")
                continue
            draws = list(pool.map(draw, plan.jobs(name, noise), chunksize=5))
            rows = _judged(scene, limits, draws)
            apart = _differs(limits, draws)
            result = {"truth": dict(scene.law), "bound": limits, "methods": rows, "quick_smoother_apart": apart}
            results.setdefault(name, {})[f"{1e6 * noise:g} um"] = result
            say(table(f"{name}, {1e6 * noise:g} um", result))
    return results


def _judged(scene: Scene, limits: dict[str, float], draws: Sequence[Draw]) -> Rows:
    return {title: judge(scene, limits, [d[title] for d in draws if title in d]) for title in METHODS}


def _is_faint(scene: Scene, limits: dict[str, float]) -> str:
    """Why a scene has no meaningful bound at this noise, empty where it has."""
    lines = [n for n in scene.law if n[0] == "F" and scene.law[n] < MIN_LINE_SIGMAS * limits[n]]
    return "".join(f"{n} stands only {scene.law[n] / limits[n]:.1f} standard deviations out" for n in lines[:1])


def _differs(limits: dict[str, float], draws: Iterable[Draw]) -> float:
    """Most that a parameter changes with the quick smoother in place of the default one, over its bound."""
    apart = [0.0]
    for d in draws:
        one, other = d.get(QUICK_SMOOTHER), d[OURS]
        if one is not None and not isinstance(one, str) and not isinstance(other, str):
            apart += [abs(_error_ratio(n, one[0].values[n], other[0].values[n])) / limit for n, limit in limits.items()]
    return max(apart)


def table(title: str, result: dict[str, Any]) -> str:
    """One scene at one noise: a parameter per line, RMS error and bias over the bound, and coverage, per method."""
    rows = result["methods"]
    lines = [f"\n{title}; the quick smoother changes at most {result['quick_smoother_apart']:.2g} bounds"]
    lines.append(f"{'':28}" + "".join(f"{_head(r):>24}" for r in rows.values()))
    lines.append(f"{'':28}" + "".join(f"{t[:23]:>24}" for t in rows))
    lines.append(f"{'':8}{'truth':>9}{'bound':>11}" + "".join(f"{'rms':>8}{'bias':>8}{'cover':>8}" for _ in rows))
    for name, truth in result["truth"].items():
        cells = "".join(_cell(r[k][name]) if k in r else f"{'-':>8}" for r in rows.values() for k in MEASURES)
        lines.append(f"{name:8}{truth:>9.4g}{result['bound'][name]:>11.3g}{cells}")
    return "\n".join(lines)


MEASURES = ("rms", "bias", "cover")


def _head(row: dict[str, Any]) -> str:
    faults = f", {row['failed']} failed" if row["failed"] else ""
    return f"{row.get('draws', 0)} draws, {row.get('ms', np.nan):.0f} ms{faults}"


def _cell(value: float) -> str:
    return f"{value:>8.3g}" if np.isfinite(value) else f"{'-':>8}"
