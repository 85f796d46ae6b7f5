"""An effect tried beside a fitted law: refined along the measured motion, where coefficients are linear.

The base law is fitted along with it, whole, so that a strong effect is judged as rightly as a weak one; a trial takes
milliseconds. Several places of the scan are tried, since the best form of a grid need not lead to the best law.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from frictrack.effects import Effect, Parameter
from frictrack.fit.linearised import CandidateScan, LinearisedModel, has_per_run_coefficients
from frictrack.fit.parameters import LEVEL, ParameterLayout, Slot
from frictrack.fit.separable import ProjectedProblem, SeparableModel, SeparableSolution, VariableProjection
from frictrack.models import Model
from frictrack.records import Array

EVENT_PENALTY = 2.0  # times log(frames): what a run's own event must gain to be kept there
ALPHA_SHARED_AMPLITUDE = 0.01  # one amplitude for all runs is kept unless it is worse at this level
MAX_STARTS = 4  # places of one scan that are tried
MIN_GRID_STEPS_APART = 3  # steps of the grid within which a second pick is the same one
MIN_GAIN_SHARE = 0.5  # of the best rise that a place must promise
MAX_EXCESS_CHI2_SHARE = 0.02  # beyond chance, of chi-squared, for something to stand wrong
STRONG_MISFIT_CHI2 = 2.0  # chi-squared per frame of a law that may stand far from the true one
ROUGH_STEPS, FINAL_STEPS = 4, 25  # steps of a refinement: of every place, and of the best two
ROUGH_MIN_FALL, FINAL_MIN_FALL = 1e-3, 1e-6  # share of the misfit that a step must promise

Pick = tuple[float, dict[str, float], Array]  # gain, grid point, coefficients (K,)
Start = tuple[dict[tuple[str, int | None], float], frozenset[tuple[str, int]]]


@dataclass(frozen=True, eq=False)
class CandidateTrial:
    """A law with an effect more: its unknowns p (P,) and its misfit along the measured motion."""

    effect: Effect
    layout: ParameterLayout
    p: Array
    misfit: float


def try_effect(law: LinearisedModel, effect: Effect, scans: list[CandidateScan], data: Array) -> CandidateTrial:
    """The best law with an effect more; `data` (L,) are the coordinates of the measured series in `law`.

    One amplitude serves all runs unless that is significantly worse than an amplitude per run.
    """
    left = law.residual_projector(law.solution.tau)
    runs = len(law.solution.problem.layout.run_names)
    sizes = {
        p.name: {"per_run": True} for p in effect.parameters if p.role in ("amplitude", "depth") and is_unconstrained(p)
    }
    shared = effect.single or not has_per_run_coefficients(effect) or runs == 1 or not sizes
    free = effect if shared else effect.adjusted(**sizes)
    loose = _best(law, free, [_start_values(law, free, picks) for picks in _starts_of_grids(scans, left, data)])
    if shared:
        return loose
    tied = _with_shared_amplitude(law, loose, effect)
    return loose if tied.misfit - loose.misfit > chi2_distribution.isf(ALPHA_SHARED_AMPLITUDE, runs - 1) else tied


def try_linear_effects(law: LinearisedModel, effects: Sequence[Effect]) -> CandidateTrial:
    """The best law with several effects more whose free parameters are all linear."""
    old = law.solution.problem.layout
    layout = replace(old, model=Model((*old.model.effects, *effects)))
    there = dict(zip(old.names, law.solution.p, strict=True))
    problem = _projected_problem(law, layout)
    p = np.array([there.get(name, _start_value({}, s)) for name, s in zip(layout.names, layout.slots, strict=True)])
    return _trial(effects[0], *_refined(problem, problem.at(p)))


def baseline_misfit(law: LinearisedModel) -> float:
    """Misfit of the law itself along the measured motion."""
    layout = law.solution.problem.layout
    problem = _projected_problem(law, layout)
    return problem.refine(problem.at(np.array(law.solution.p)), steps=FINAL_STEPS, enough=FINAL_MIN_FALL).misfit


def misfit_left_by_other(law: LinearisedModel, true: CandidateTrial, other: CandidateTrial) -> float:
    """Chi-squared that another effect leaves of what a true one makes of the runs, along the measured motion."""
    told = _projected_problem(law, true.layout)
    ideal = told.data - told.at(np.array(true.p)).residual
    problem = ProjectedProblem(TiedSeparableModel(other.layout, law.blocks), ideal, told.tau)
    found = problem.refine(problem.at(np.array(other.p)), steps=FINAL_STEPS, enough=ROUGH_MIN_FALL)
    return found.misfit - ProjectedProblem(told.separable, ideal, told.tau).at(np.array(true.p)).misfit


class TiedSeparableModel(SeparableModel):
    """A law along the motion in which waves that share an amplitude do so: their phases are numbers."""

    def is_wave(self, effect: Effect) -> bool:
        """Whether quadratures are linear: not where runs share an amplitude and have their own phases."""
        own = {p.per_run for p in effect.parameters if p.role in ("amplitude", "phase")}
        return super().is_wave(effect) and (len(own) == 1 or len(self.runs) == 1)


def _projected_problem(law: LinearisedModel, layout: ParameterLayout) -> ProjectedProblem:
    separable = TiedSeparableModel(layout, law.blocks)
    return ProjectedProblem(separable, separable.data, law.solution.tau or 0.03)


def _best(law: LinearisedModel, effect: Effect, starts: Iterable[Start]) -> CandidateTrial:
    """The best of the laws that several starts lead to."""
    found: list[tuple[ProjectedProblem, SeparableSolution]] = []
    for values, absent in starts:
        old = law.solution.problem.layout
        layout = replace(old, model=old.model + effect, absent=old.absent | absent)
        problem = _projected_problem(law, layout)
        there = dict(zip(old.names, law.solution.p, strict=True))
        slots = zip(layout.names, layout.slots, strict=True)
        p = np.array([there.get(name, _start_value(values, s)) for name, s in slots])
        found.append((problem, problem.refine(problem.at(p), steps=ROUGH_STEPS, enough=ROUGH_MIN_FALL)))
    found.sort(key=lambda pair: pair[1].misfit)
    best = min((_refined(problem, state) for problem, state in found[:2]), key=lambda pair: pair[1].misfit)
    return _trial(effect, *best)


def _start_value(values: dict[tuple[str, int | None], float], slot: Slot) -> float:
    """Where an unknown begins that the bare law does not have: as scanned, a friction level at one."""
    return 1.0 if slot.effect == LEVEL else values.get((slot.parameter, slot.run), 0.0)


def deepen_trials(law: LinearisedModel, trials: list[CandidateTrial]) -> list[CandidateTrial]:
    """Trials that may be the best, where they were not found in one go.

    Events of single runs were found one by one beside a law that lacked them all. And where no trial leaves the noise,
    or much is missing, the law may stand where it stood without the effect: all that scans quickly is found again.
    """
    misfit = baseline_misfit(law)
    half = MIN_GAIN_SHARE * max((misfit - t.misfit for t in trials), default=0.0)
    trials = [_with_own_events(law, t) if t.effect.single and misfit - t.misfit > half else t for t in trials]
    frames = sum(len(b.data) for b in law.blocks)
    enough = frames * (1 + MAX_EXCESS_CHI2_SHARE) + 3 * np.sqrt(2 * frames)
    if not trials or (misfit < STRONG_MISFIT_CHI2 * frames and min(t.misfit for t in trials) < enough):
        return trials
    return sorted((t if t.misfit < enough else _searched_again(law, t) for t in trials), key=lambda t: t.misfit)


def _searched_again(law: LinearisedModel, trial: CandidateTrial) -> CandidateTrial:
    problem = _projected_problem(law, trial.layout)
    state = VariableProjection(problem.separable, problem.tau).exchanged(problem, problem.at(trial.p), "")
    return _trial(trial.effect, *_refined(problem, state))


def _with_own_events(law: LinearisedModel, trial: CandidateTrial) -> CandidateTrial:
    """Events of single runs beside each other, in every run that gains more than their price by one."""
    name, price = trial.effect.name, EVENT_PENALTY * np.log(law.solution.problem.n_frames)
    layout = replace(trial.layout, absent=law.solution.problem.layout.absent)
    problem = _projected_problem(law, layout)
    search = VariableProjection(problem.separable, problem.tau)
    there = dict(zip(trial.layout.names, trial.p, strict=True))
    p = np.array([there.get(n, v) for n, v in zip(layout.names, search.first(), strict=True)])
    state = search.afresh(problem, problem.at(p), name)
    found = dict(zip(layout.names, problem.separable.law(state.numbers, state.coefficients), strict=True))
    gone = {pair for pair in search.idle(state, price) if pair[0] == name}
    kept = replace(layout, absent=layout.absent | gone)
    problem = _projected_problem(law, kept)
    new = _trial(trial.effect, *_refined(problem, problem.at(np.array([found[n] for n in kept.names]))))
    return min(new, trial, key=lambda t: t.misfit + price * len(t.layout.slots))


def _refined(problem: ProjectedProblem, state: SeparableSolution) -> tuple[ProjectedProblem, SeparableSolution]:
    return problem, problem.refine(state, steps=FINAL_STEPS, enough=FINAL_MIN_FALL)


def _trial(effect: Effect, problem: ProjectedProblem, state: SeparableSolution) -> CandidateTrial:
    layout = problem.layout
    p = problem.separable.law(state.numbers, state.coefficients)
    return CandidateTrial(effect, layout, np.clip(p, *layout.bounds), state.misfit)


def _with_shared_amplitude(law: LinearisedModel, loose: CandidateTrial, effect: Effect) -> CandidateTrial:
    """The same effect with one amplitude for all runs, from where an amplitude per run stands: at their mean."""
    old = loose.layout
    layout = replace(old, model=replace(old.model, effects=(*old.model.effects[:-1], effect)))
    there: dict[str, list[float]] = {}
    for name, value in zip(old.names, loose.p, strict=True):
        there.setdefault(name, []).append(float(value))
        there.setdefault(name.split("[")[0], []).append(float(value))
    problem = _projected_problem(law, layout)
    return _trial(effect, *_refined(problem, problem.at(np.array([np.mean(there[n]) for n in layout.names]))))


def is_unconstrained(p: Parameter) -> bool:
    """Whether nothing is said of an amplitude beside the runs."""
    return p.free and p.prior is None


def _starts_of_grids(scans: list[CandidateScan], left: Array, data: Array) -> list[list[Pick]]:
    """Places worth trying, of every family one each."""
    if len(scans) > 1:
        return [[_best_forms(s, left, data, 1)[0] for s in scans]]
    return [[pick] for pick in _best_forms(scans[0], left, data, MAX_STARTS)]


def _best_forms(found: CandidateScan, left: Array, data: Array, most: int) -> list[Pick]:
    """The best forms whose coefficients keep their bounds, none within a few steps of a better one."""
    family, rises = found.family, found.rises.copy()
    steps = np.stack(np.unravel_index(np.arange(len(rises)), family.shape), axis=1)
    out: list[Pick] = []
    while len(out) < most:
        g = int(np.argmax(rises))
        if out and not rises[g] > MIN_GAIN_SHARE * out[0][0]:
            break
        c = found.coefficients(g, left, data)
        if np.all((c >= family.low) & (c <= family.high)) or not np.any(np.delete(rises, g) > 0):
            low = np.where(np.isfinite(family.low), family.low + 1e-6, -np.inf)
            out.append((float(found.rises[g]), family.point(g), np.clip(c, low, family.high)))
            rises[np.all(np.abs(steps - steps[g]) <= MIN_GRID_STEPS_APART, axis=1)] = 0.0
        rises[g] = -1.0
        if not np.any(rises > 0):
            break
    return out


def _start_values(law: LinearisedModel, effect: Effect, picks: list[Pick]) -> Start:
    """Start values of the effect's parameters by (name, run), and the runs in which it is absent."""
    runs = range(len(law.solution.problem.layout.run_names))
    if effect.single:
        return _event_values(law, effect, picks)
    _, point, c = picks[0]
    out: dict[tuple[str, int | None], float] = {}
    for p in effect.nonlinear:
        if p.role not in ("phase", "depth"):
            out |= {(p.name, r): point[p.name] for r in (runs if p.per_run else [None])}
    if not any(p.role == "phase" and p.free for p in effect.parameters):
        return out | _scan_coefficients(effect, c, len(runs)), frozenset()
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


def _scan_coefficients(effect: Effect, c: Array, runs: int) -> dict[tuple[str, int | None], float]:
    """Coefficients of a scan without phases, of every run and for all."""
    sizes = [p for p in effect.parameters if p.linear or p.role == "depth"]
    out: dict[tuple[str, int | None], float] = {}
    if not sizes:  # a modifier without a size, such as a lag
        return out
    for p, column in zip(sizes, c.reshape(-1, len(sizes)).T, strict=True):
        out |= {(p.name, r): float(v) for r, v in enumerate(np.resize(column, runs))}
        out[p.name, None] = float(np.mean(column))
    return out


def _event_values(law: LinearisedModel, effect: Effect, picks: list[Pick]) -> Start:
    """Events of single runs: kept where they gain more than their price, at least in the best run."""
    price = EVENT_PENALTY * np.log(law.solution.problem.n_frames)
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
