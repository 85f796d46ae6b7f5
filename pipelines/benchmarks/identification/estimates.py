"""The methods that are compared: frictrack in both domains, and alternatives without it.

Each takes measured runs and returns the parameters of the scene's law with the deviations it states.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from derivatives.signals import MASS, RATE, Array, friction, vibration
from numpy.polynomial import Polynomial
from scipy.optimize import least_squares
from scipy.signal import butter, filtfilt

import frictrack as ft
from frictrack.fit.uncertainty import reported_by_address as quoted
from frictrack.records import Run

from .scenes import Scene

ADDRESSES = {"coulomb.F_c": "fc", "stribeck.F_s": "fs", "viscous.F_v": "fv", "stribeck.v_s": "vs"}
LINE = {"amplitude": "F", "frequency": "f", "phase": "phase"}
SEARCH_BOUNDS = {"fc": (0.0, 40.0), "fs": (0.0, 80.0), "fv": (0.0, 20.0), "vs": (0.05, 3.0), "F": (0.0, 20.0)}
SEARCH_RANGE = {"f": 10.0, "phase": np.pi}  # Hz and rad about the truth
ORDER = 4  # of Butterworth, forward and backward
TRIM_SHARE = 0.05  # of the record, at either end


class Estimate(NamedTuple):
    """Values of the law by name, stated standard deviations (nan where none), and how many were withheld."""

    values: dict[str, float]
    stds: dict[str, float]
    withheld: int = 0


Method = Callable[[Scene, Sequence[Run]], Estimate]


def displacement(scene: Scene, runs: Sequence[Run]) -> Estimate:
    """frictrack as it comes."""
    return _named(ft.fit(scene.model, runs))


def force(scene: Scene, runs: Sequence[Run]) -> Estimate:
    """frictrack in the force domain: the model passes through the same low-pass and differences."""
    return _named(ft.fit(scene.model, runs, domain="force"))


def _named(fit: ft.Fit) -> Estimate:
    """A fit in the scene's names. Lines are numbered by frequency; here they push, in a friction law they resist."""
    solution = fit.found.force or fit.found.solution
    values, parameters = quoted(solution, solution.p), fit.parameters
    of = {address: ADDRESSES[address] for address in values if address in ADDRESSES}
    lines = sorted((a for a in values if a.endswith(".frequency")), key=values.__getitem__)
    for k, line in enumerate(lines):
        effect = line.split(".")[0]
        of |= {a: f"{LINE[p]}{k}" for a in values for p in LINE if a.split("[")[0] == f"{effect}.{p}"}
    resist = {a: np.pi if ".phase" in a else 0.0 for a in of}
    return Estimate(
        {name: values[a] - resist[a] for a, name in of.items()},
        {name: parameters[a].std or np.nan for a, name in of.items()},
        sum(parameters[a].value is None for a in of),
    )


def tuned(scene: Scene, runs: Sequence[Run]) -> Estimate:
    """A well-tuned plain chain: Butterworth 200 Hz of what a cubic leaves, 5 % of either end not compared."""
    return _fitted(scene, [_derived(run, 200.0, detrend=True, trim=TRIM_SHARE) for run in runs])


def papers(scene: Scene, runs: Sequence[Run]) -> Estimate:
    """As the papers do: Butterworth 100 Hz forward and backward, two differences, the whole record."""
    return _fitted(scene, [_derived(run, 100.0, detrend=False, trim=0.0) for run in runs])


def _derived(run: Run, cutoff: float, *, detrend: bool, trim: float) -> tuple[Array, Array, Array]:
    """Time, velocity and acceleration of a displacement after a low-pass, by central differences."""
    t, y = run.displacement.t, run.displacement.x
    trend = Polynomial.fit(t, y, 3)(t) if detrend else np.zeros_like(y)
    x = trend + filtfilt(*butter(ORDER, cutoff, fs=RATE), y - trend)
    v = np.gradient(x, t)
    k = round(trim * len(t))
    inside = slice(k, len(t) - k)
    return t[inside], v[inside], np.gradient(v, t)[inside]


def _fitted(scene: Scene, runs: Sequence[tuple[Array, Array, Array]]) -> Estimate:
    """Least squares of the accelerations, started at the truth and held in a wide box about it."""
    t, v, a = (np.concatenate(series) for series in zip(*runs, strict=True))
    names, truth = list(scene.law), np.array(list(scene.law.values()))
    low, high = np.array([_box(name, value) for name, value in scene.law.items()]).T

    def residual(p: Array) -> Array:
        law: Mapping[str, float] = dict(zip(names, p, strict=True))
        made: Array = (vibration(t, law) - friction(v, law)) / MASS - a
        return made

    found = least_squares(residual, truth, bounds=(low, high), x_scale=np.maximum(np.abs(truth), 0.1))
    return Estimate(dict(zip(names, found.x, strict=True)), dict.fromkeys(names, np.nan))


def _box(name: str, truth: float) -> tuple[float, float]:
    kind = name if name in SEARCH_BOUNDS else name.rstrip("0123456789")
    return SEARCH_BOUNDS[kind] if kind in SEARCH_BOUNDS else (truth - SEARCH_RANGE[kind], truth + SEARCH_RANGE[kind])


METHODS: dict[str, Method] = {
    "frictrack": displacement,
    "force domain, model through the chain": force,
    "plain chain, 200 Hz, trimmed": tuned,
    "the papers' way, 100 Hz": papers,
}
