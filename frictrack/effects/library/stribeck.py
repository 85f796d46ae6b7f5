"""Stribeck effect: dry friction rises from F_c to F_s as the speed falls toward zero."""

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path
from frictrack.effects.ranges import stribeck_velocities


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """L s exp(-(|v|/v_s)^delta), shape (n, 1): N per N of F_s - F_c."""
    decay = np.exp(-((path.speed / nonlinear["v_s"]) ** nonlinear["delta"]))
    return (path.load * path.s * decay)[:, None]


def quote(own: dict[str, float], model: dict[str, float]) -> dict[str, float]:
    """F_s is quoted as the static level itself: F_c plus the fitted rise."""
    return {"F_s": model.get("coulomb.F_c", 0.0) + own["F_s"]}


equation = "(F_s - F_c) L s exp(-(|v|/v_s)^delta)"
parameters = (
    Parameter("F_s", "N", (0.0, np.inf), linear=True, loaded=True),
    Parameter("v_s", "m/s", scan=stribeck_velocities),
    Parameter("delta", "1", (0.5, 2.0), fixed=1.0),
)
varies_with = "v"
scales_with = "load"
what = "Dry friction rises as the mass slows, because the film between the surfaces collapses and bonds form."
looks_like = "a hook at the slow end, only below about four Stribeck velocities"
mistaken_for = "everything smooth in v, when the run never slows"
confirm = "Film a run that slows to a stop."
invariant = "the Stribeck effect is strong only where the mass is slow"
in_base_law = True
basic = True
source = "Stribeck 1902; Tustin 1947 (delta = 1); first paper, Eqs. 1-2, read with |v|"
