"""Fitted unknowns as a person wants them: value, standard deviation, and why a value is not given."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from frictrack.fit.mass import NAME as MASS
from frictrack.fit.mass import ratio, rescaled
from frictrack.fit.scan import families
from frictrack.fit.scatter import MIN_RUNS, restraint_rows
from frictrack.fit.solve import Solution
from frictrack.fit.start import without
from frictrack.records import Array

CHI2_95 = 3.84  # one parameter, 95 %
STIR = 1.05  # factor on the spread, to see which variances follow it
BATCHES = 2  # batches of segments per unknown at least
NULL = 1e-8  # singular value, over the largest, below which a direction is not seen by the data


@dataclass(frozen=True)
class Estimate:
    """One parameter: value and standard deviation in `unit`, or None with the reason.

    With the level scattering over few runs, `std` is the one whose +-1.96 covers 95 % (Student, runs - 1).
    """

    value: float | None
    std: float | None
    unit: str
    at_bound: bool = False
    reason: str | None = None


@dataclass(frozen=True)
class Estimates:
    """All parameters by address, and the covariance of the unknowns behind them (P, P)."""

    parameters: dict[str, Estimate]
    covariance: Array
    correlations: list[tuple[str, str, float]]


def covariance_of(solution: Solution) -> tuple[Array, Array]:
    """Covariance of the unknowns (P, P), and which of them the data do not see, (P,).

    A variance is known as well as the spread of few runs is, as far as it follows it: Student's t with
    (runs - 1)/share^2 degrees of freedom, share = d log variance / d log spread^2 (Satterthwaite 1946).
    """
    layout = solution.problem.layout
    tau = solution.tau or 0.03
    full, unseen = _inverse(np.vstack([solution.jac, restraint_rows(layout, tau)]))
    if any(p.cut for p in solution.problem.pieces):
        return _by_segment(solution, full), unseen
    if len(layout.levels) < MIN_RUNS:
        return full, unseen
    more, _ = _inverse(np.vstack([solution.jac, restraint_rows(layout, STIR * tau)]))
    variance = np.maximum(np.diag(full), 1e-300)
    share = np.maximum(np.log(np.maximum(np.diag(more), 1e-300) / variance) / (2 * np.log(STIR)), 1e-3)
    widen = student.ppf(0.975, (len(layout.levels) - 1) / share**2) / 1.96
    return full * widen[:, None] * widen, unseen


def _by_segment(solution: Solution, bread: Array) -> Array:
    """Covariance (P, P) where segments hold more than noise: the scatter of what batches of them pull the law to.

    What is not modelled is alike within a segment (Liang & Zeger 1986, Biometrika 73) and often in its neighbours too:
    as many batches as there are segments in each (batch means; Flegal & Jones 2010, Annals of Statistics 38), known
    as well as so many scatter (Student's t).
    """
    pulls = np.zeros((len(solution.responses), len(solution.p)))
    for pull, r in zip(pulls, solution.responses, strict=True):
        pull[r.active] = r.jac.T @ r.r
    count = min(max(round(np.sqrt(len(pulls))), BATCHES * len(solution.p)), len(pulls))
    batches = np.array([part.sum(axis=0) for part in np.array_split(pulls, count)])
    widen = (student.ppf(0.975, count - 1) / 1.96) ** 2 * count / (count - 1)
    held = restraint_rows(solution.problem.layout, solution.tau or 0.03)
    return np.asarray(bread @ (widen * batches.T @ batches + held.T @ held) @ bread)


def _inverse(jac: Array) -> tuple[Array, Array]:
    norm = np.linalg.norm(jac, axis=0)
    dead = norm == 0
    norm[dead] = 1.0
    _, s, vt = np.linalg.svd(jac / norm, full_matrices=False)
    keep = s > NULL * s[0]
    unseen = dead | (np.max(np.abs(vt[~keep]), axis=0, initial=0.0) > 1e-2)
    half = vt[keep] / s[keep, None] / norm
    return half.T @ half, unseen


def estimates(solution: Solution, *, profile: bool = True) -> Estimates:
    """Parameters with deviations; what the data do not determine is null with a reason.

    `profile` also looks at the profile of F_s and v_s, which takes further fits.
    """
    layout = solution.problem.layout
    names = layout.names
    covariance, unseen = covariance_of(solution)
    low, high = layout.bounds
    p = solution.p
    values = dict(zip(names, p, strict=True))
    quoted, jacobian = _quoted(solution, values)
    std = np.sqrt(np.maximum(np.einsum("ai,ij,aj->a", jacobian, covariance, jacobian), 0.0))
    unsure = undetermined(solution, covariance) if profile else {}
    out: dict[str, Estimate] = {}
    shown = [i for i, s in enumerate(layout.slots) if s.effect != "level"]
    massless = MASS in layout.model and unseen[layout.index(MASS, "m")]
    for row, i in enumerate(shown):
        slot = layout.slots[i]
        near = 1e-6 * max(1.0, abs(p[i]))
        at_bound = bool(p[i] <= low[i] + near or p[i] >= high[i] - near)
        reason = unsure.get((slot.effect, slot.parameter))
        if reason is None and unseen[i]:
            reason = _partners(names, jacobian, solution, i)
        if reason is None and massless and slot.linear:
            reason = "these runs do not determine the mass, and no force without it"
        out[names[i]] = Estimate(
            value=None if reason else float(quoted[row]),
            std=None if reason else float(std[row]),
            unit=slot.unit,
            at_bound=at_bound,
            reason=reason,
        )
    for (effect, parameter), value in layout.fixed.items():
        unit = next(e for e in layout.model.effects if e.name == effect).parameter(parameter).unit
        out[f"{effect}.{parameter}"] = Estimate(value, 0.0, unit, False, "fixed")
    return Estimates(out, covariance, _correlations(names, shown, covariance))


def _quoted(solution: Solution, values: dict[str, float]) -> tuple[Array, Array]:
    """Parameters as they are quoted (F_s for F_s - F_c), and their derivatives in the unknowns, (A, P)."""
    layout = solution.problem.layout
    shown = [i for i, s in enumerate(layout.slots) if s.effect != "level"]

    def all_quoted(p: Array) -> Array:
        q = ratio(layout, p)  # forces were fitted as q times themselves
        known = dict(zip(layout.names, rescaled(layout, p, q), strict=True))
        out = known | {"mass.m": solution.problem.pieces[0].mass / q}
        for effect in layout.model.effects:
            if effect.quote is not None:
                own = {
                    s.parameter: known[n]
                    for n, s in zip(layout.names, layout.slots, strict=True)
                    if s.effect == effect.name
                }
                out |= {f"{effect.name}.{k}": v for k, v in effect.quote(own, known).items()}
        return np.array([out[layout.names[i]] for i in shown])

    base = all_quoted(solution.p)
    jacobian = np.zeros((len(shown), len(solution.p)))
    for j in range(len(solution.p)):
        step = 1e-6 * max(abs(solution.p[j]), 1e-3)
        moved = solution.p.copy()
        moved[j] += step
        jacobian[:, j] = (all_quoted(moved) - base) / step
    return base, jacobian


def _partners(names: list[str], jacobian: Array, solution: Solution, i: int) -> str:
    jac = solution.jac
    norm = np.linalg.norm(jac, axis=0)
    if norm[i] == 0:
        return "the runs do not respond to it"
    norm[norm == 0] = 1.0
    _, s, vt = np.linalg.svd(jac / norm, full_matrices=False)
    null = vt[s <= NULL * s[0]]
    others = [names[j] for j in np.flatnonzero(np.max(np.abs(null), axis=0, initial=0.0) > 0.05) if j != i]
    return f"these runs cannot tell it from {', '.join(others[:3]) or 'the other parameters'}"


def _correlations(names: list[str], shown: list[int], covariance: Array) -> list[tuple[str, str, float]]:
    d = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    r = covariance / d[:, None] / d
    pairs = [(a, b) for k, a in enumerate(shown) for b in shown[k + 1 :]]
    return [(names[a], names[b], round(float(r[a, b]), 4)) for a, b in pairs if abs(r[a, b]) > 0.95]


def undetermined(solution: Solution, covariance: Array) -> dict[tuple[str, str], str]:
    """Stribeck parameters that these runs do not settle, with the reason and the run that would.

    F_s counts when taking the effect away costs more than chi-squared 3.84, v_s when its profile rises by as much
    on both sides within its bounds.
    """
    out: dict[tuple[str, str], str] = {}
    slowest = solution.problem.layout.span.v_min
    for effect in solution.problem.model.effects:
        if effect.kind != "stribeck" or any(effect.kind in e.modifies for e in solution.problem.model.effects):
            continue
        rise = solution.problem.layout.index(effect.name, "F_s")
        faint = solution.p[rise] < 1.96 * np.sqrt(covariance[rise, rise])
        why = "F_s - F_c is not distinguishable from zero" if faint else _stribeck_profile(solution, effect.name)
        if why:
            text = f"{why}; the slowest speed seen is {slowest:.2g} m/s: film a run that slows to a stop"
            out |= {(effect.name, p.name): text for p in effect.parameters if p.fixed is None}
    return out


def _stribeck_profile(solution: Solution, name: str) -> str | None:
    if len(solution.problem.model.effects) == 1:
        return None
    bare = without(solution, name)
    basis = bare.basis
    effect = next(e for e in solution.problem.model.effects if e.name == name)
    family = families(bare, effect, basis)[0]
    data = bare.unlevelled()[:, None]
    on_basis, shrink = basis.u.T @ data, basis.shrink(bare.tau or 0.03)
    gains = family.gains(family.project(data), on_basis, shrink)[:, 0]
    best = bare.objective - solution.objective
    if best < CHI2_95:
        return "F_s - F_c is not distinguishable from zero"
    speeds = np.array([g["v_s"] for g in family.grid])
    order = np.argsort(speeds)
    if best - gains[order[0]] < CHI2_95 or best - gains[order[-1]] < CHI2_95:
        return "v_s is not bounded on both sides"
    return None
