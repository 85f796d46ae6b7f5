"""Causes that the library does not know: what a diagnosis must call unexplained, or replace by an equal."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.integrate import cumulative_trapezoid

from frictrack.effects import Effect, Parameter, Path, Span
from frictrack.records import Array

Shape = Callable[[Path, dict[str, float]], Array]
RESONANCE_WIDTH = 0.15  # width of a resonance in the speed, over that speed
N_HARMONICS = 5  # harmonics of a saw tooth, and one


def _rate_and_state(path: Path, q: dict[str, float]) -> Array:
    """Friction falls with the logarithm of the speed (Dieterich 1979, steady state)."""
    return -path.load * path.s * np.log((path.speed + 1e-3) / q["speed"])


def _flash_weakening(path: Path, q: dict[str, float]) -> Array:
    """Asperities melt beyond a speed, and friction falls with its inverse (Rice 2006)."""
    return path.load * path.s * (1 + (path.speed / q["speed"]) ** 4) ** -0.25


def _speed_resonance(path: Path, q: dict[str, float]) -> Array:
    """The mounting resonates, and takes energy, at one speed of sliding."""
    return path.load * path.s * np.exp(-(((path.speed - q["speed"]) / (RESONANCE_WIDTH * q["speed"])) ** 2) / 2)


def _joint(path: Path, q: dict[str, float]) -> Array:
    """Two halves of the course are of different material."""
    return path.load * path.s * np.tanh((path.x - q["place"]) / 2e-3)


def _saw(path: Path, q: dict[str, float]) -> Array:
    """Plates of equal length lie on the course like scales: a saw tooth, its edges rounded by the slider's length."""
    turns = 2 * np.pi * path.x / q["length"]
    return path.load * path.s * np.sum([np.sin(k * turns) / k for k in range(1, N_HARMONICS)], axis=0)


def _magnet(path: Path, q: dict[str, float]) -> Array:
    """Something beside the course attracts the mass, on the way there and back."""
    u = (path.x - q["place"]) / q["length"]
    return np.asarray(u / (1 + u**2) ** 2)


def _chirp(path: Path, q: dict[str, float]) -> Array:
    """A machine next door runs up."""
    return np.sin(2 * np.pi * q["frequency"] * (1 + 4 * path.t) * path.t)


def _gust(path: Path, q: dict[str, float]) -> Array:
    """A constant force sets in at some moment after release."""
    return (1 + np.tanh((path.t - q["time"]) / 2e-3)) / 2


def _breakdown(path: Path, q: dict[str, float]) -> Array:
    """The film of lubricant is used up after some way, wherever that began."""
    return path.load * path.s * (1 + np.tanh((path.distance - q["length"]) / 3e-3)) / 2


def _heat(path: Path, q: dict[str, float]) -> Array:
    """Friction falls with a temperature that follows the power of friction late: a memory of the speed."""
    t, v = path.t, path.v
    if path.before is not None:
        t, v = np.append(path.before[0], t), np.append(path.before[2], v)
    growth = np.exp((t - t[-1]) / q["time"])
    warm = np.append(0.0, cumulative_trapezoid(growth * np.abs(v), t)) / growth / q["time"]
    return -path.load * path.s * warm[-len(path.t) :]


UNITS = {"speed": "m/s", "place": "m", "length": "m", "frequency": "Hz", "time": "s"}
FOREIGN: dict[str, tuple[Shape, tuple[str, ...]]] = {
    "rate_and_state": (_rate_and_state, ("speed",)),
    "flash_weakening": (_flash_weakening, ("speed",)),
    "speed_resonance": (_speed_resonance, ("speed",)),
    "joint": (_joint, ("place",)),
    "saw": (_saw, ("length",)),
    "magnet": (_magnet, ("place", "length")),
    "chirp": (_chirp, ("frequency",)),
    "gust": (_gust, ("time",)),
    "breakdown": (_breakdown, ("length",)),
    "heat": (_heat, ("time",)),
}  # name: shape, and the numbers that it needs


def foreign_effect(name: str) -> Effect:
    """A cause of that name as an effect with one coefficient, which no library lists."""
    shape, needs = FOREIGN[name]
    return Effect(
        name=name,
        acts_on="force",
        equation=f"amplitude {name}",
        parameters=(
            Parameter("amplitude", "N", linear=True),
            *(Parameter(n, UNITS[n], signed=True) for n in needs),
        ),
        columns=lambda path, nonlinear: np.asarray(shape(path, dict(nonlinear)))[:, None],
        scales_with="load",
    )


def parameter_range(name: str, span: Span) -> tuple[float, float]:
    """Where a number of such a cause may lie, given how far the runs reach."""
    travel = span.x_max - span.x_min
    return {
        "place": (span.x_min + 0.3 * travel, span.x_max - 0.3 * travel),
        "length": (0.06 * travel, 0.4 * travel),
        "speed": (max(0.15 * span.v_max, span.v_min), 0.8 * span.v_max),
        "frequency": (15.0, 60.0),
        "time": (0.1 * span.duration, 0.4 * span.duration),
    }[name]
