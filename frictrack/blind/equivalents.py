"""Find the library effects that fit data without noise as well as a hidden effect does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from frictrack import effects
from frictrack.blind.ideal_detector import MIN_SCATTER
from frictrack.blind.truth import EffectValues, RunTruth, Truth, effect_named
from frictrack.effects import Effect
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution, refine
from frictrack.fit.linearised import LinearisedModel, linearise, measured_series
from frictrack.fit.parameters import ParameterLayout, penalty_residual
from frictrack.fit.stepwise import rebuild_problem, remove_effect, scan_effect, simulate_trial, try_effect
from frictrack.records import Array

MAX_CHI2_EXCESS = 10.0  # expected excess below which these runs cannot distinguish two effects
NOTHING = "nothing"  # stands among the equivalents of an effect that the law and the other effects imitate
SCREEN_SHARE, SCREEN_CHI2 = 0.3, 60.0  # share of the rise, and chi-squared, below which a linearised rival is refined


def equivalent_effects(truth: Truth, base: Solution) -> dict[str, tuple[str, ...]]:
    """Find for each hidden effect the library effects that can replace it, the others staying.

    `base`: fitted base law. Its pieces and layout are used; its data are replaced by the true motion. Returns for each
    hidden effect the names of equivalent effects, itself first; `NOTHING` where it is not needed: the other hidden
    effects and the law, fitted again, leave no more without it.
    """
    full = solution_at_truth(truth, base)
    return {name: (name, *_equivalents(full, name)) for name in truth.hidden}


def _equivalents(full: Solution, name: str) -> list[str]:
    """Names of effects that explain the data without noise as well as the hidden one does."""
    reduced = remove_effect(full, name)
    if reduced.objective - full.objective < MAX_CHI2_EXCESS:
        return [NOTHING]
    fits = _replacements(full, reduced, name)
    return [other for other, fitted in fits.items() if fitted.objective - full.objective < MAX_CHI2_EXCESS]


def replacements(full: Solution, name: str, max_chi2: float = np.inf) -> dict[str, Solution]:
    """Fit every effect of the library in place of a hidden one to data without noise.

    `full`: solution at the truth; see `solution_at_truth`; `max_chi2`: chi-squared that an effect may leave along the
    true motion; those that leave more are not simulated. Returns the best fit by effect; only effects that are not far
    worse along the true motion. The objective of a fit less that of `full` is the chi-squared by which these runs
    separate the two effects in the mean.
    """
    return _replacements(full, remove_effect(full, name), name, max_chi2)


def _replacements(full: Solution, reduced: Solution, name: str, max_chi2: float = np.inf) -> dict[str, Solution]:
    """Fit every effect of the library in place of a hidden one; `reduced` is the solution without it."""
    linearised = linearise(reduced)
    chi2_rise = reduced.objective - full.objective
    screen = min(SCREEN_SHARE * chi2_rise + SCREEN_CHI2, max_chi2) + _level_penalty(full)
    out = {}
    for effect in effects.LIBRARY.values():
        if effect.name in reduced.problem.model or effect.replaces or effect.name == name:
            continue
        kinds = {e.kind for e in reduced.problem.model.effects}
        if effect.modifies and not kinds & effect.modifies:
            continue
        try:
            fitted = _replacement(linearised, effect, full.tau, screen)
        except FrictrackError:
            continue
        if fitted is not None:
            out[effect.name] = fitted
    return out


def _replacement(linearised: LinearisedModel, effect: Effect, tau: float, screen: float) -> Solution | None:
    """The fit with another effect instead of the true one; None if it leaves more than `screen` along the motion."""
    data = measured_series(linearised)
    scans = scan_effect(linearised, effect, data)
    if not scans:
        return None
    trial = try_effect(linearised, effect, scans, data.coordinates[:, 0])
    if trial.misfit > screen:
        return None
    extended = simulate_trial(linearised, trial)
    return refine(extended.problem, extended.p, extended.starts, tau=tau)


def _level_penalty(full: Solution) -> float:
    """Penalty of the true friction levels, which scatter about 1."""
    penalty = penalty_residual(full.problem.layout, full.p, full.tau)
    return float(penalty @ penalty)


def solution_at_truth(truth: Truth, base: Solution) -> Solution:
    """Fit the true law to the true motion, from the true parameters; only rounding errors remain.

    `base`: fitted base law of the study. Returns the refined solution with all hidden effects.
    """
    trajectories = [truth.trajectory(run) for run in truth.runs]
    pieces = [replace(p, y=(trajectories[p.run].x + trajectories[p.run].shift)[p.frames]) for p in base.problem.pieces]
    base_layout = base.problem.layout
    model = base_layout.model
    for name in truth.hidden:
        model = model + effect_named(name)
    absent = frozenset((n, i) for i, run in enumerate(truth.runs) for n in truth.hidden if n not in run.values)
    layout = replace(base_layout, model=model, absent=absent)
    problem = rebuild_problem(base.problem.rebuild(base_layout, pieces), layout)
    starts = [
        np.array([np.interp(p.t[0], s.t - _release_time(p.t, s.t[p.frames]), q) for q in (s.x, s.v)])
        for p, s in ((p, trajectories[p.run]) for p in pieces)
    ]
    return refine(problem, _true_parameters(truth, layout), starts, tau=max(truth.scatter, MIN_SCATTER))


def _release_time(time: Array, recorded: Array) -> float:
    """Time of release on the clock of the table, s."""
    return float(recorded[0] - time[0])


def _true_parameters(truth: Truth, layout: ParameterLayout) -> Array:
    """True parameters in the order of the layout, (P,)."""
    out = []
    for slot in layout.slots:
        run = truth.runs[slot.run or 0]
        if slot.effect == "level":
            out.append(run.level)
        elif slot.effect in truth.law:
            out.append(truth.law[slot.effect][slot.parameter])
        else:
            out.append(_hidden_values(truth, slot.effect, slot.run)[slot.parameter])
    return np.array(out)


def _hidden_values(truth: Truth, name: str, run: int | None) -> dict[str, float]:
    """Parameter values of a hidden effect in one run, or in the first run that has it."""
    chosen: tuple[RunTruth, ...] = truth.runs if run is None else (truth.runs[run],)
    found: list[EffectValues] = [r.values for r in chosen if name in r.values]
    return found[0][name]
