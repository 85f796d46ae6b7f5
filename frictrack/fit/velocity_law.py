"""Evaluate the fitted law over the velocity: F(v) at the reference load, with its standard deviation.

The law is the sum of the force effects that depend on the velocity alone. Effects of place, time or memory, and those
that modify others, are left out of it: what is left is the friction of a steady slide.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from frictrack.effects import Effect, Path
from frictrack.effects.models import Model, Values
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
    values = solution.problem.layout.values(solution.p, 0)[0]
    speeds = np.concatenate([curve.v_model for curve in curves if curve.role == "fit"])
    effects = tuple(e for e in without_mass(solution.problem.model).effects if _is_of_velocity(e, values))
    if not effects:
        return []
    out = []
    for direction in (1, -1):
        seen = np.abs(speeds[direction * speeds > 0])
        if not len(seen) or float(np.max(seen)) < MIN_SPEED_SHARE * float(np.max(np.abs(speeds))):
            continue
        low, high = max(float(np.min(seen)), MIN_SPEED_SHARE * float(np.max(seen))), float(np.max(seen))
        v = low + (high - low) * np.linspace(0.0, 1.0, POINTS) ** 2  # closer where the law is steep
        force, sigma = _force_and_deviation(solution, covariance, Model(effects), _steady_path(direction * v))
        branch = {"direction": direction, "v": v, "F": direction * force, "sigma_F": sigma}
        out.append(branch | {"load_N": load, "effects": [e.name for e in effects]})
    return [{k: q.tolist() if isinstance(q, np.ndarray) else q for k, q in branch.items()} for branch in out]


def _steady_path(v: Array, at: float = 0.0) -> Path:
    """Samples of velocities v (n,), all at one place (m) and one time (s)."""
    return Path(np.full_like(v, at), np.full_like(v, at), v, np.sign(v))


def _is_of_velocity(effect: Effect, values: Values) -> bool:
    """Whether an effect adds a force that depends on the velocity alone."""
    is_friction = effect.acts_on == "force" and effect.scales_with in ("load", "nothing")  # not gravity or the drive
    if not is_friction or effect.modifies:
        return False
    if effect.formula is not None:
        return not re.search(r"\b[xt]\b", effect.formula)
    if effect.varies_with not in ("", "v") or any(p.per_run for p in effect.parameters):  # events and waves are per run
        return False
    v = np.array([0.3, -0.3, 1.7])
    now, later = (effect.columns(_steady_path(v, t), values[effect.name]) for t in (0.0, 1.0))
    return np.array_equal(now, later)


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
