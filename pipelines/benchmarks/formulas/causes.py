"""Causes of known formula, written a second time: nothing of frictrack's formulas is used here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from frictrack.records import Array

Values = Mapping[str, float]
Force = Callable[..., Array]  # x, |v|, t, direction, load, values -> N per unit of the amplitude


@dataclass(frozen=True)
class Cause:
    """A force of one amplitude and at most two further parameters.

    Attributes
    ----------
    text
        The formula as it would stand in a study file, parameters w (scale or width) and c (place).
    force
        The same in Python.
    axis
        Axis of its parameters: "x", "t" or "v".
    draws
        Range of every parameter, as a share of the range of the axis.

    """

    text: str
    force: Force
    axis: str = "x"
    draws: Mapping[str, tuple[float, float]] | None = None


SCALE = {"w": (0.1, 0.6)}
PLACE = {"c": (0.3, 0.7), "w": (0.03, 0.12)}
PLACED = "((abs(v) - c)/w)"
CAUSES: dict[str, Cause] = {
    "logarithm of speed": Cause(
        "F * L * s * log(1 + abs(v)/w)", lambda x, v, t, s, load, q: load * s * np.log(1 + v / q["w"]), "v", SCALE
    ),
    "decay with speed": Cause(
        "F * L * s * exp(-abs(v)/w)", lambda x, v, t, s, load, q: load * s * np.exp(-v / q["w"]), "v", SCALE
    ),
    "fraction of speed": Cause(
        "F * L * s * 1/(1 + abs(v)/w)", lambda x, v, t, s, load, q: load * s / (1 + v / q["w"]), "v", SCALE
    ),
    "hydrodynamic hump": Cause(
        "F * L * s * abs(v)/w*exp(-abs(v)/w)",
        lambda x, v, t, s, load, q: load * s * v / q["w"] * np.exp(-v / q["w"]),
        "v",
        SCALE,
    ),
    "magnetic brake": Cause(
        "F * s * abs(v)/w/(1 + (abs(v)/w)^2)",
        lambda x, v, t, s, load, q: s * v / q["w"] / (1 + (v / q["w"]) ** 2),
        "v",
        SCALE,
    ),
    "resonance in speed": Cause(
        f"F * L * s * exp(-{PLACED}^2/2)",
        lambda x, v, t, s, load, q: load * s * np.exp(-(((v - q["c"]) / q["w"]) ** 2) / 2),
        "v",
        PLACE,
    ),
    "joint": Cause(
        "F * L * s * tanh(((x - c)/w))",
        lambda x, v, t, s, load, q: load * s * np.tanh((x - q["c"]) / q["w"]),
        "x",
        PLACE,
    ),
    "magnet": Cause(
        "F * ((x - c)/w)/(1 + ((x - c)/w)^2)^2",
        lambda x, v, t, s, load, q: (x - q["c"]) / q["w"] / (1 + ((x - q["c"]) / q["w"]) ** 2) ** 2,
        "x",
        PLACE,
    ),
    "hill": Cause(
        "F * 1/(1 + ((x - c)/w)^2)", lambda x, v, t, s, load, q: 1 / (1 + ((x - q["c"]) / q["w"]) ** 2), "x", PLACE
    ),
    "viscous friction that grows along the course": Cause(
        "F * L * s * x * abs(v)", lambda x, v, t, s, load, q: load * s * v * x
    ),
    "viscous friction in proportion to the load": Cause(
        "F * L * s * mass * abs(v)", lambda x, v, t, s, load, q: load**2 * s * v
    ),
    "gust": Cause("F * tanh(((t - c)/w))", lambda x, v, t, s, load, q: np.tanh((t - q["c"]) / q["w"]), "t", PLACE),
    "viscous friction that fades with time": Cause(
        "F * s * abs(v) * exp(-t/w)", lambda x, v, t, s, load, q: s * v * np.exp(-t / q["w"]), "t", SCALE
    ),
    "viscous friction of a patch": Cause(
        "F * s * abs(v) * exp(-((x - c)/w)^2/2)",
        lambda x, v, t, s, load, q: s * v * np.exp(-(((x - q["c"]) / q["w"]) ** 2) / 2),
        "x",
        PLACE,
    ),
}


def normalised(text: str) -> str:
    """A study-file formula with its factors in one order, without the names of its parameters' suffixes.

    The product of linear factors is commutative; factors of a formula are separated by " * ".
    """
    return " * ".join(sorted(text.split(" * ")))
