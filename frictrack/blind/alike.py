"""Which library effects nobody could tell from what is hidden: their best fits to data without noise are as good."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from frictrack import effects
from frictrack.blind.detector import LEAST_SCATTER
from frictrack.blind.truth import Numbers, RunTruth, Truth, made
from frictrack.effects import Effect
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution, refine
from frictrack.fit.linearised import LinearisedModel, candidate_grids, linearise, measured_series, scan_candidate
from frictrack.fit.parameters import ParameterLayout, penalty_residual
from frictrack.fit.stepwise import effect_for_scan, remove_effect, simulate_trial, try_effect, with_layout
from frictrack.records import Array

SAME = 10.0  # expected chi-squared below which two causes are one for these runs
NEAR = 0.3, 60.0  # share of the rise, and chi-squared, along the motion below which a rival is followed to its end


def alike(truth: Truth, base: Solution) -> dict[str, tuple[str, ...]]:
    """For every hidden cause the library effects that stand in for it beside all the rest, itself first.

    `base` is the fitted base law, whose pieces and layout are taken; its data are replaced by the true motion.
    """
    whole = exact(truth, base)
    return {name: (name, *_standing_in(whole, name)) for name in truth.hidden}


def _standing_in(whole: Solution, name: str) -> list[str]:
    """Effects that explain the data without noise as well as the hidden one does."""
    bare = remove_effect(whole, name)
    law = linearise(bare)
    rise = bare.objective - whole.objective
    out = []
    for effect in effects.LIBRARY.values():
        if effect.name in bare.problem.model or effect.replaces or effect.name == name:
            continue
        kinds = {e.kind for e in bare.problem.model.effects}
        if effect.modifies and not kinds & effect.modifies:
            continue
        try:
            worse = _worse(law, effect, whole, rise)
        except FrictrackError:
            continue
        if worse < SAME:
            out.append(effect.name)
    return out


def _worse(law: LinearisedModel, effect: Effect, whole: Solution, rise: float) -> float:
    """By how much chi-squared is larger with another effect in the place of the true one."""
    made_of = candidate_grids(law, effect_for_scan(law.solution, effect))
    if not made_of:
        return np.inf
    series = measured_series(law)
    trial = try_effect(law, effect, [scan_candidate(law, family, series) for family in made_of], series.own[:, 0])
    if trial.misfit > NEAR[0] * rise + NEAR[1] + _restraint(whole):
        return np.inf
    grown = simulate_trial(law, trial)
    fitted = refine(grown.problem, grown.p, grown.starts, tau=whole.tau)
    return fitted.objective - whole.objective


def _restraint(whole: Solution) -> float:
    """What the true levels' departure from one costs."""
    held = penalty_residual(whole.problem.layout, whole.p, whole.tau)
    return float(held @ held)


def exact(truth: Truth, base: Solution) -> Solution:
    """The true law at the true motion, refined by what rounding leaves."""
    slides = [truth.slide(run) for run in truth.runs]
    pieces = [replace(p, y=(slides[p.run].x + slides[p.run].shift)[p.frames]) for p in base.problem.pieces]
    old = base.problem.layout
    model = old.model
    for name in truth.hidden:
        model = model + made(name)
    absent = frozenset((n, i) for i, run in enumerate(truth.runs) for n in truth.hidden if n not in run.values)
    layout = replace(old, model=model, absent=absent)
    problem = with_layout(base.problem.over(old, pieces), layout)
    starts = [
        np.array([np.interp(p.t[0], s.t - _release(p.t, s.t[p.frames]), q) for q in (s.x, s.v)])
        for p, s in ((p, slides[p.run]) for p in pieces)
    ]
    return refine(problem, _unknowns(truth, layout), starts, tau=max(truth.scatter, LEAST_SCATTER))


def _release(since: Array, recorded: Array) -> float:
    """When a run was released, on the clock of its table, s."""
    return float(recorded[0] - since[0])


def _unknowns(truth: Truth, layout: ParameterLayout) -> Array:
    """The true numbers as a fit counts them, (P,)."""
    out = []
    for slot in layout.slots:
        run = truth.runs[slot.run or 0]
        if slot.effect == "level":
            out.append(run.level)
        elif slot.effect in truth.law:
            out.append(truth.law[slot.effect][slot.parameter])
        else:
            out.append(_own(truth, slot.effect, slot.run)[slot.parameter])
    return np.array(out)


def _own(truth: Truth, name: str, run: int | None) -> dict[str, float]:
    """Numbers of a hidden cause in one run, or in any that has it."""
    chosen: tuple[RunTruth, ...] = truth.runs if run is None else (truth.runs[run],)
    found: list[Numbers] = [r.values for r in chosen if name in r.values]
    return found[0][name]
