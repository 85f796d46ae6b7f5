"""Evaluate the fitted law over the velocity: F(v) at the reference load, with its standard deviation.

The law is the sum of the force effects that depend on the velocity alone. Effects of place, time or memory, and those
that modify others, are left out of it: what is left is the friction of a steady slide.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from frictrack.effects import Effect, Path
from frictrack.effects.models import Model
from frictrack.fit.least_squares import Solution
from frictrack.fit.parameters import mass_ratio, without_mass
from frictrack.records import Array, Curve

POINTS = 40  # of a curve
STEP_STD = 1e-4  # of the finite differences, standard deviations
MIN_SPEED_SHARE = 1e-3  # slowest speed of a curve over the fastest one


def law_branches(
    solution: Solution, curves: Sequence[Curve], covariance: Array, load: float | None
) -> list[dict[str, Any]]:
    """Compute the law for each direction in which the fitted runs moved.

    Parameters
    ----------
    solution
        The fit.
    curves
        Its curves.
    covariance
        Covariance of the unknowns, (P, P).
    load
        Reference load, N; None if it is not known.

    Returns
    -------
    list of dict
        `direction` (+1 or -1), speeds `v` (m/s, above 0) from the slowest to the fastest that was seen, friction force
        against the motion `F` and its standard deviation `sigma_F` (N) at the reference load, `load_N` (that load; None
        if it is not known) and `effects`, the names of those that it contains. Empty without such effects.

    """
    speeds = np.concatenate([curve.v_model for curve in curves if curve.role == "fit"])
    effects = tuple(e for e in without_mass(solution.problem.model).effects if _is_of_velocity(e))
    if not effects:
        return []
    out = []
    for direction in (1, -1):
        seen = np.abs(speeds[direction * speeds > 0])
        if not len(seen) or float(np.max(seen)) < MIN_SPEED_SHARE * float(np.max(np.abs(speeds))):
            continue
        low, high = max(float(np.min(seen)), MIN_SPEED_SHARE * float(np.max(seen))), float(np.max(seen))
        v = low + (high - low) * np.linspace(0.0, 1.0, POINTS) ** 2  # closer where the law is steep
        force, sigma = _force_and_deviation(
            solution, covariance, Model(effects), Path(0 * v, 0 * v, direction * v, np.full_like(v, direction))
        )
        branch = {"direction": direction, "v": v, "F": direction * force, "sigma_F": sigma}
        out.append(branch | {"load_N": load, "effects": [e.name for e in effects]})
    return [{k: q.tolist() if isinstance(q, np.ndarray) else q for k, q in branch.items()} for branch in out]


def _is_of_velocity(effect: Effect) -> bool:
    """Whether an effect adds a force of friction, not of gravity or the drive, that depends on the velocity alone."""
    of_runs = any(p.per_run for p in effect.parameters)
    return effect.scales_with in ("load", "nothing") and not (effect.modifies or of_runs) and effect.is_of_velocity


def _force_and_deviation(solution: Solution, covariance: Array, law: Model, path: Path) -> tuple[Array, Array]:
    """Force of the law along a path, N, and its standard deviation to first order: the diagonal of J C J'."""
    layout, p = solution.problem.layout, solution.p

    def force(unknowns: Array) -> Array:
        return law.force(path, layout.values(unknowns, 0)[0]) / mass_ratio(layout, unknowns)

    steps = STEP_STD * np.sqrt(np.maximum(np.diag(covariance), 0.0))
    jacobian = np.zeros((len(path.v), len(p)))
    for k in np.flatnonzero(steps > 0):
        step = np.zeros(len(p))
        step[k] = steps[k]
        jacobian[:, k] = (force(p + step) - force(p - step)) / (2 * steps[k])
    variance = np.einsum("ij,jk,ik->i", jacobian, covariance, jacobian)
    return force(p), np.sqrt(np.maximum(variance, 0.0))
