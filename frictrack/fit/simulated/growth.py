"""An effect added to a fitted law where its scan gains most, or taken away from it; the rest refined along."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from frictrack.effects import Effect, Parameter
from frictrack.errors import FrictrackError
from frictrack.fit.simulated.beside import beside
from frictrack.fit.simulated.pieces import Piece
from frictrack.fit.simulated.problem import Problem
from frictrack.fit.simulated.scan import Family, Scan, families, one_series, per_run_coefficients, scan
from frictrack.fit.simulated.solve import Solution, refine, settle_scatter
from frictrack.fit.simulated.turns import follows, in_turn, known, untied
from frictrack.fit.unknowns.layout import Layout
from frictrack.models import Model
from frictrack.records import Array

TRIAL_STEPS = 8  # of Gauss-Newton for an effect on trial; the true one needs fewer, a wrong one need not settle
PULSE_PRICE = 2.0  # times log(frames): what a run's own event must gain to be kept there
TIE_ALPHA = 0.01  # one amplitude for all runs is kept unless it is worse at this level


def first_guess(problem: Problem) -> Array:
    """Coefficients of a linear model by least squares on the smoothed acceleration."""
    layout = problem.layout
    rows, right = [], []
    p = np.array([1.0 if s.effect == "level" else 0.0 for s in layout.slots])
    linear = [i for i, s in enumerate(layout.slots) if s.linear]
    for piece in problem.pieces:
        none = _acceleration(problem, piece, p)
        units = [_acceleration(problem, piece, p + np.eye(len(p))[i]) - none for i in linear]
        rows.append(np.stack(units, axis=1) if units else np.empty((len(none), 0)))
        right.append(piece.a_hat - piece.known - none)
    p[linear] = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=1e-8)[0]
    return p


def _acceleration(problem: Problem, piece: Piece, p: Array) -> Array:
    """What the law p (P,) adds to the acceleration along the smoothed motion, (3 p,)."""
    values, level = problem.layout.values(p, piece.run)
    return np.asarray(-problem.model.force(piece.along(piece.x_hat, piece.v_hat, level), values) / piece.mass)


def grow(solution: Solution, effect: Effect) -> Solution:
    """Add an effect to a fitted law; where that law is too wild to move on from, add it before the scanned ones.

    Without the effect that it lacks, a law may have gone where no motion can be integrated beside it.
    Raises FrictrackError when the runs lack what the effect needs, or when neither way can be integrated.
    """
    plain, scanned = in_turn(solution.problem.model)
    try:
        return _grown(solution, effect)
    except FrictrackError:
        if not scanned:
            raise
    if not plain:
        raise FrictrackError(f"{effect.name} cannot be added to this law: its motion cannot be integrated")
    layout = replace(solution.problem.layout, model=Model(tuple(plain)), absent=frozenset())
    problem = solution.problem.over(layout, solution.problem.pieces)
    grown = settle_scatter(problem, first_guess(problem), problem.first_starts())
    for e in [effect, *scanned] if follows(effect, plain) else [*scanned, effect]:
        grown = _grown(grown, e)
    return reordered(grown, Model((*solution.problem.model.effects, effect)))


def _grown(solution: Solution, effect: Effect) -> Solution:
    """Add an effect where its scan gains most, and refine everything as far as a trial needs; see `settled`.

    One amplitude serves all runs unless that is significantly worse than an amplitude per run.
    Raises FrictrackError when the runs lack what the effect needs.
    """
    law = beside(solution)
    made = families(law, known(solution, effect))
    if not made:
        raise FrictrackError(effect.lacks([p.path for p in solution.problem.pieces]))
    series = one_series(law)
    picks = [_pick(scan(law, f, series), law.left(solution.tau), series.own[:, 0]) for f in made]
    tied = _refined(solution, effect, _start_values(solution, effect, made, picks))
    if not (per_run_coefficients(effect) and len(solution.problem.layout.run_names) > 1) or len(made) > 1:
        return tied
    return _loosened(solution, tied, effect, (made, picks))


def _loosened(solution: Solution, tied: Solution, effect: Effect, scan: tuple[list[Family], list[Pick]]) -> Solution:
    """The same effect with an amplitude per run, where one amplitude is significantly worse."""
    sizes = {p.name: {"per_run": True} for p in effect.parameters if p.role in ("amplitude", "depth") and is_loose(p)}
    if not sizes:
        return tied
    loose_effect = effect.adjusted(**sizes)
    loose = _refined(solution, loose_effect, _start_values(solution, loose_effect, *scan))
    freedom = len(solution.problem.layout.run_names) - 1
    worse = tied.objective - loose.objective
    return loose if worse > chi2_distribution.isf(TIE_ALPHA, freedom) else tied


def is_loose(p: Parameter) -> bool:
    """Whether nothing is said of an amplitude beside the runs."""
    return p.free and p.prior is None


Pick = tuple[float, dict[str, float], Array]  # gain, grid point, coefficients (K,)


def _pick(found: Scan, left: Array, data: Array) -> Pick:
    """The best form whose coefficients keep their bounds."""
    family = found.family
    for g in np.argsort(-found.rises)[:50].tolist():
        c = found.coefficients(g, left, data)
        if np.all((c >= family.low) & (c <= family.high)):
            return float(found.rises[g]), family.point(g), c
    g = int(np.argmax(found.rises))
    return float(found.rises[g]), family.point(g), np.maximum(found.coefficients(g, left, data), 1e-6)


Start = tuple[dict[tuple[str, int | None], float], frozenset[tuple[str, int]]]


def _start_values(solution: Solution, effect: Effect, made: list[Family], picks: list[Pick]) -> Start:
    """Start values of the effect's parameters by (name, run), and the runs in which it is absent."""
    runs = range(len(solution.problem.layout.run_names))
    if len(made) > 1 or any(p.scan is not None and p.per_run for p in effect.nonlinear):
        return _event_values(solution, effect, picks)
    _, point, c = picks[0]
    out: dict[tuple[str, int | None], float] = {}
    for p in effect.nonlinear:
        if p.role not in ("phase", "depth"):
            out |= {(p.name, r): point[p.name] for r in (runs if p.per_run else [None])}
    if not any(p.role == "phase" and p.free for p in effect.parameters):
        return out | _sizes(effect, c, len(runs)), frozenset()
    size = np.hypot(*c.reshape(-1, 2).T)
    phase = np.arctan2(*c.reshape(-1, 2).T[::-1])
    for p in effect.parameters:
        if p.role == "phase":
            each = phase
        elif p.role in ("amplitude", "depth"):
            each = size if p.per_run else np.mean(size, keepdims=True)
        else:
            continue
        places: list[int | None] = [*runs] if p.per_run else [None]
        out |= {(p.name, r): float(np.resize(each, len(places))[i]) for i, r in enumerate(places)}
    return out, frozenset()


def _sizes(effect: Effect, c: Array, runs: int) -> dict[tuple[str, int | None], float]:
    """Coefficients of a scan without phases, of every run and for all."""
    sizes = [p for p in effect.parameters if p.linear or p.role == "depth"]
    out: dict[tuple[str, int | None], float] = {}
    if not sizes:  # a modifier without a size, such as a lag
        return out
    for p, column in zip(sizes, c.reshape(-1, len(sizes)).T, strict=True):
        out |= {(p.name, r): float(v) for r, v in enumerate(np.resize(column, runs))}
        out[p.name, None] = float(np.mean(column))
    return out


def _event_values(solution: Solution, effect: Effect, picks: list[Pick]) -> Start:
    """Events of single runs: kept where they gain more than their price, at least in the best run."""
    price = PULSE_PRICE * np.log(solution.problem.n_frames)
    gains = np.array([g for g, _, _ in picks])
    kept = np.flatnonzero((gains > price) | (gains == gains.max()))
    out: dict[tuple[str, int | None], float] = {}
    for p in effect.parameters:
        if p.linear:
            out |= {(p.name, int(r)): float(picks[r][2][0]) for r in kept}
        elif p.per_run:
            out |= {(p.name, int(r)): picks[r][1][p.name] for r in kept}
        else:
            out[p.name, None] = picks[int(np.argmax(gains))][1][p.name]
    absent = frozenset((effect.name, r) for r in range(len(picks)) if r not in kept)
    return out, absent


def _refined(solution: Solution, effect: Effect, start: Start) -> Solution:
    """The model with the effect added, refined from the given start."""
    values, absent = start
    old = solution.problem.layout
    layout = replace(old, model=old.model + effect, absent=old.absent | absent)
    there = dict(zip(old.names, solution.p, strict=True))
    p = [
        there[name] if name in there else values[s.parameter, s.run]
        for name, s in zip(layout.names, layout.slots, strict=True)
    ]
    problem = rebuilt(solution.problem, layout)
    tau = solution.tau or 0.03
    # the scan's coefficients go with a base law that has moved along: that first; without them the old law stands
    mine = np.array([s.linear and s.effect == effect.name for s in layout.slots])
    how: dict[str, Any] = {"tau": tau, "free": layout.coefficients, "max_steps": 4}
    try:
        first = refine(problem, np.array(p), solution.starts, **how)
    except FrictrackError:
        first = refine(problem, np.where(mine, 0.0, p), solution.starts, **how)
    return settle_scatter(problem, first.p, first.starts, tau, max_steps=TRIAL_STEPS)


def settled(solution: Solution) -> Solution:
    """A law that `grow` has tried, refined to its end."""
    return settle_scatter(solution.problem, solution.p, solution.starts, solution.tau or 0.03)


def rebuilt(problem: Problem, layout: Layout) -> Problem:
    """The same pieces under another layout, with as many panels per frame as its effects need."""
    fine = max(e.fine for e in layout.model.effects)
    pieces = [piece if piece.per_frame >= fine else piece.refined(fine) for piece in problem.pieces]
    return problem.over(layout, pieces)


def reordered(solution: Solution, model: Model) -> Solution:
    """The same solution with the effects in the order of `model`."""
    old = solution.problem.layout
    made = {e.name: e for e in old.model.effects}
    layout = replace(old, model=Model(tuple(made[e.name] for e in model.effects)))
    known = dict(zip(old.names, solution.p, strict=True))
    p = np.array([known[n] for n in layout.names])
    problem = solution.problem.over(layout, solution.problem.pieces)
    return refine(problem, p, solution.starts, tau=solution.tau, max_steps=2)


def without(solution: Solution, name: str) -> Solution:
    """The model without one effect, refined from where it stands."""
    old = solution.problem.layout
    absent = frozenset(pair for pair in old.absent if pair[0] != name)
    layout = replace(old, model=untied(solution, name), absent=absent)
    known = dict(zip(old.names, solution.p, strict=True))
    problem = solution.problem.over(layout, solution.problem.pieces)
    return settle_scatter(problem, np.array([known[n] for n in layout.names]), solution.starts, solution.tau or 0.03)
