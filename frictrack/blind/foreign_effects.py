"""Effects that the library does not contain: a diagnosis must call them unexplained, or reproduce them by others."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.integrate import cumulative_trapezoid

from frictrack.effects import Effect, Parameter, Path, Span
from frictrack.records import Array

Shape = Callable[[Path, dict[str, float]], Array]
RESONANCE_WIDTH = 0.15  # width of a resonance in speed, over that speed
N_HARMONICS = 5  # one more than the harmonics of a sawtooth


def _speed_resonance(path: Path, q: dict[str, float]) -> Array:
    """The mounting resonates and takes energy at one sliding speed."""
    return path.load * path.s * np.exp(-(((path.speed - q["speed"]) / (RESONANCE_WIDTH * q["speed"])) ** 2) / 2)


def _joint(path: Path, q: dict[str, float]) -> Array:
    """Two halves of the course consist of different materials."""
    return path.load * path.s * np.tanh((path.x - q["place"]) / 2e-3)


def _saw(path: Path, q: dict[str, float]) -> Array:
    """Overlapping plates of equal length: a sawtooth in place, with edges rounded by the length of the slider."""
    turns = 2 * np.pi * path.x / q["length"]
    return path.load * path.s * np.sum([np.sin(k * turns) / k for k in range(1, N_HARMONICS)], axis=0)


def _magnet(path: Path, q: dict[str, float]) -> Array:
    """A magnet next to the course attracts the mass; the force does not depend on the direction of motion."""
    u = (path.x - q["place"]) / q["length"]
    return np.asarray(u / (1 + u**2) ** 2)


def _chirp(path: Path, q: dict[str, float]) -> Array:
    """A nearby machine runs up: a force with rising frequency."""
    return np.sin(2 * np.pi * q["frequency"] * (1 + 4 * path.t) * path.t)


def _gust(path: Path, q: dict[str, float]) -> Array:
    """A constant force begins at some time after release."""
    return (1 + np.tanh((path.t - q["time"]) / 2e-3)) / 2


def _breakdown(path: Path, q: dict[str, float]) -> Array:
    """The lubricant film is used up after some sliding distance, at any place."""
    return path.load * path.s * (1 + np.tanh((path.distance - q["length"]) / 3e-3)) / 2


def _heat(path: Path, q: dict[str, float]) -> Array:
    """Friction falls with a temperature that follows the dissipated power with a delay: a memory of the speed."""
    t, v = path.t, path.v
    if path.before is not None:
        t, v = np.append(path.before[0], t), np.append(path.before[2], v)
    growth = np.exp((t - t[-1]) / q["time"])
    temperature = np.append(0.0, cumulative_trapezoid(growth * np.abs(v), t)) / growth / q["time"]
    return -path.load * path.s * temperature[-len(path.t) :]


UNITS = {"speed": "m/s", "place": "m", "length": "m", "frequency": "Hz", "time": "s"}
FOREIGN: dict[str, tuple[Shape, tuple[str, ...]]] = {
    "speed_resonance": (_speed_resonance, ("speed",)),
    "joint": (_joint, ("place",)),
    "saw": (_saw, ("length",)),
    "magnet": (_magnet, ("place", "length")),
    "chirp": (_chirp, ("frequency",)),
    "gust": (_gust, ("time",)),
    "breakdown": (_breakdown, ("length",)),
    "heat": (_heat, ("time",)),
}  # name: shape, and the non-linear parameters that it needs


def foreign_effect(name: str) -> Effect:
    """Build an effect that is not in the library.

    Parameters
    ----------
    name
        Key of `FOREIGN`.

    Returns
    -------
    Effect
        Force effect with one coefficient, the amplitude in N.

    """
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
    """Range from which a non-linear parameter of a foreign effect is drawn.

    Parameters
    ----------
    name
        "place", "length" (m), "speed" (m/s), "frequency" (Hz) or "time" (s).
    span
        Range of place, speed and time that the runs cover.

    Returns
    -------
    tuple of float
        Lowest and highest value.

    """
    travel = span.x_max - span.x_min
    return {
        "place": (span.x_min + 0.3 * travel, span.x_max - 0.3 * travel),
        "length": (0.06 * travel, 0.4 * travel),
        "speed": (max(0.15 * span.v_max, span.v_min), 0.8 * span.v_max),
        "frequency": (15.0, 60.0),
        "time": (0.1 * span.duration, 0.4 * span.duration),
    }[name]
