"""Recognise a formula that an effect equals at certain values of its parameters: it is then no other cause."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.optimize import least_squares

from frictrack.effects import Effect, Path
from frictrack.fit.least_squares import Solution
from frictrack.records import Array

MAX_RESIDUAL_SHARE = 1e-4  # of the force of a formula that a special case leaves; imitations leave more


def is_special_case(formula: Solution, found: Solution) -> bool:
    """Return whether the effect of one fit can be exactly the formula of another, beside the law that both have.

    Parameters
    ----------
    formula
        The fit with a formula in place of the effect.
    found
        The fit with one effect more than the law. Only effects whose force depends on the moment alone, with parameters
        that all runs share, are compared.

    Returns
    -------
    bool

    """
    known = found.problem.model.names
    own = [e for e in found.problem.model.effects if e.name not in formula.problem.model.names]
    if len(own) != 1 or not _is_comparable(own[0]):
        return False
    target, law, paths = _force_of_others(formula, known)
    slots = [(i, s) for i, s in enumerate(found.problem.layout.slots) if s.effect == own[0].name]
    nonlinear = {p.name for p in own[0].nonlinear}
    moved = [(i, s) for i, s in slots if s.parameter in nonlinear]
    fixed = found.problem.layout.values(found.p, 0)[0][own[0].name]

    def residual(z: Array) -> Array:
        values = fixed | {s.parameter: float(one) for (_, s), one in zip(moved, z, strict=True)}
        columns = np.vstack([own[0].columns(path, values) for path in paths])
        return _unexplained_share(target, np.hstack([law, columns]))

    start = np.array([found.p[i] for i, _ in moved])
    if not moved:
        return float(np.linalg.norm(residual(start))) < MAX_RESIDUAL_SHARE
    low, high = np.array([s.bounds for _, s in moved]).T
    best = least_squares(residual, start, bounds=(low, high), x_scale=np.maximum(np.abs(start), 1e-9), ftol=1e-12)
    return float(np.linalg.norm(best.fun)) < MAX_RESIDUAL_SHARE


def _is_comparable(effect: Effect) -> bool:
    """Whether the force of an effect depends on the moment alone, with parameters that all runs share."""
    of_moment = effect.acts_on == "force" and not (effect.modifies or effect.memory or effect.counts_from_release)
    return of_moment and not any(p.per_run for p in effect.parameters)


def _force_of_others(formula: Solution, known: list[str]) -> tuple[Array, Array, list[Path]]:
    """Force (n,) of the effects that are not `known`, columns (n, k) of those that are, and the paths."""
    model, layout = formula.problem.model, formula.problem.layout
    forces, columns, paths = [], [], []
    for r in formula.responses:
        values, level = layout.values(formula.p, r.piece.run)
        path = r.piece.path_at_nodes(r.motion.x, r.motion.v, level)
        made: Mapping[str, Array] = model.force_columns(path, values)
        others = [made[name] @ model.coefficients(name, values) for name in made if name not in known]
        forces.append(np.sum(others, axis=0))
        columns.append(np.hstack([made[name] for name in made if name in known]))
        paths.append(path)
    return np.concatenate(forces), np.vstack(columns), paths


def _unexplained_share(target: Array, columns: Array) -> Array:
    """Residual (n,) of a force after a least-squares fit of columns (n, k), over the norm of the force."""
    norm = np.linalg.norm(columns, axis=0)
    unit = columns / np.where(norm > 0, norm, 1.0)
    fitted = unit @ np.linalg.lstsq(unit, target, rcond=None)[0]
    return np.asarray((target - fitted) / max(float(np.linalg.norm(target)), 1e-300))
