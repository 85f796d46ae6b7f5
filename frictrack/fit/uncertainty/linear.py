"""Compute estimates from the linearised model, in either domain, without profiles."""

from __future__ import annotations

import numpy as np

from frictrack.fit.least_squares import Solution
from frictrack.fit.uncertainty.estimates import Estimates, estimate_parameters, estimates_from_covariance
from frictrack.records import Array

MIN_STD = 1.96  # standard deviations by which F_s - F_c and v_s must differ from zero


def linear_estimates(solution: Solution, covariance: Array | None = None) -> Estimates:
    """Compute estimates from the model linearised where it stands, whether or not that is the optimum.

    Parameters
    ----------
    solution : Solution
        The fit, in the displacement or the force domain.
    covariance : array of shape (P, P), optional
        Replaces that of white noise, where the domain asks for another.

    Returns
    -------
    Estimates
        Reported values with standard deviations.

    """
    plain = estimate_parameters(solution, profile=False)
    covariance = plain.covariance if covariance is None else covariance
    absent = {name: e.reason for name, e in plain.parameters.items() if e.value is None and e.reason}
    return estimates_from_covariance(solution, covariance, absent | _undetermined_stribeck(solution, covariance))


def _undetermined_stribeck(solution: Solution, covariance: Array) -> dict[str, str]:
    """Stribeck parameters that the linearised model does not determine, with the reason."""
    layout = solution.problem.layout
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    out: dict[str, str] = {}
    for effect in (
        e for e in layout.model.effects if e.kind == "stribeck" and layout.are_shared_unknowns(e.name, "F_s", "v_s")
    ):
        rise, speed = layout.index(effect.name, "F_s"), layout.index(effect.name, "v_s")
        why = None
        if solution.p[rise] < MIN_STD * std[rise]:
            why = "F_s - F_c is not distinguishable from zero"
        elif solution.p[speed] < MIN_STD * std[speed]:
            why = "v_s is not bounded on both sides"
        if why:
            text = f"{why}; the slowest speed seen is {layout.span.v_min:.2g} m/s: film a run that slows to a stop"
            out |= {f"{effect.name}.{p.name}": text for p in effect.parameters if p.free}
    return out
