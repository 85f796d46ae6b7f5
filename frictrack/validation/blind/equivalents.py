"""Find the library effects that fit data without noise as well as a hidden effect does."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from frictrack import effects
from frictrack.base.errors import FrictrackError
from frictrack.effects import Effect
from frictrack.fit.least_squares import Solution, refine
from frictrack.fit.linearised import LinearisedModel, linearise, measured_series
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.penalties import penalty_residual
from frictrack.fit.stepwise import remove_effect, scan_effect, simulate_trial, try_effect
from frictrack.records import Array
from frictrack.validation.blind.ideal_detector import MIN_SCATTER
from frictrack.validation.blind.truth import Truth, effect_named

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
    fits = replacements(full, name, reduced=reduced)
    return [other for other, fitted in fits.items() if fitted.objective - full.objective < MAX_CHI2_EXCESS]


def replacements(
    full: Solution, name: str, max_chi2: float = np.inf, reduced: Solution | None = None
) -> dict[str, Solution]:
    """Fit every effect of the library in place of a hidden one to data without noise.

    `full`: solution at the truth; see `solution_at_truth`; `max_chi2`: chi-squared that an effect may leave along the
    true motion; those that leave more are not simulated. Returns the best fit by effect; only effects that are not far
    worse along the true motion. The objective of a fit less that of `full` is the chi-squared by which these runs
    separate the two effects in the mean.
    """
    reduced = reduced or remove_effect(full, name)
    linearised, levels = linearise(reduced), penalty_residual(full.problem.layout, full.p, full.tau)
    screen = min(SCREEN_SHARE * (reduced.objective - full.objective) + SCREEN_CHI2, max_chi2) + float(levels @ levels)
    model, out = reduced.problem.model, dict[str, Solution]()
    kinds = {e.kind for e in model.effects}
    for effect in effects.LIBRARY.values():
        fits_in = not effect.replaces and (not effect.modifies or kinds & effect.modifies)
        if fits_in and effect.name not in model and effect.name != name:
            with suppress(FrictrackError):
                fitted = _replacement(linearised, effect, full.tau, screen)
                out |= {} if fitted is None else {effect.name: fitted}
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
    problem = base.problem.rebuild(base_layout, pieces).rebuild(layout, pieces)
    starts = [np.array([s.x[i], s.v[i]]) for s, i in ((trajectories[p.run], p.frames[0]) for p in pieces)]
    return refine(problem, _true_parameters(truth, layout), starts, tau=max(truth.scatter, MIN_SCATTER))


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
            chosen = truth.runs if slot.run is None else (run,)  # the first run that has it
            out.append(next(r.values[slot.effect] for r in chosen if slot.effect in r.values)[slot.parameter])
    return np.array(out)
