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
from frictrack.fit.linearised import Beside, Scan, per_run_coefficients
from frictrack.fit.parameters import LEVEL, Layout, Slot
from frictrack.fit.separable import Along, Projected, Search, State
from frictrack.models import Model
from frictrack.records import Array

PULSE_PRICE = 2.0  # times log(frames): what a run's own event must gain to be kept there
TIE_ALPHA = 0.01  # one amplitude for all runs is kept unless it is worse at this level
PICKS = 4  # places of one scan that are tried
APART = 3  # steps of the grid within which a second pick is the same one
WORTH = 0.5  # of the best rise that a place must promise
POOR = 0.02  # beyond chance, of chi-squared, for something to stand wrong
STRONG = 2.0  # chi-squared per frame of a law that may stand far from the true one
ROUGH, LAST = 4, 25  # steps of a refinement: of every place, and of the best two
CLOSE, ENOUGH = 1e-3, 1e-6  # share of the misfit that a step must promise

Pick = tuple[float, dict[str, float], Array]  # gain, grid point, coefficients (K,)
Start = tuple[dict[tuple[str, int | None], float], frozenset[tuple[str, int]]]


@dataclass(frozen=True, eq=False)
class Trial:
    """A law with an effect more: its unknowns p (P,) and its misfit along the measured motion."""

    effect: Effect
    layout: Layout
    p: Array
    misfit: float


def tried(law: Beside, effect: Effect, scans: list[Scan], data: Array) -> Trial:
    """The best law with an effect more; `data` (L,) are the coordinates of the measured series in `law`.

    One amplitude serves all runs unless that is significantly worse than an amplitude per run.
    """
    left = law.left(law.solution.tau)
    runs = len(law.solution.problem.layout.run_names)
    sizes = {p.name: {"per_run": True} for p in effect.parameters if p.role in ("amplitude", "depth") and is_loose(p)}
    shared = effect.single or not per_run_coefficients(effect) or runs == 1 or not sizes
    free = effect if shared else effect.adjusted(**sizes)
    loose = _best(law, free, [_start_values(law, free, picks) for picks in _picked(scans, left, data)])
    if shared:
        return loose
    tied = _tied(law, loose, effect)
    return loose if tied.misfit - loose.misfit > chi2_distribution.isf(TIE_ALPHA, runs - 1) else tied


def tried_together(law: Beside, effects: Sequence[Effect]) -> Trial:
    """The best law with several effects more whose free parameters are all linear."""
    old = law.solution.problem.layout
    layout = replace(old, model=Model((*old.model.effects, *effects)))
    there = dict(zip(old.names, law.solution.p, strict=True))
    problem = _projected(law, layout)
    p = np.array([there.get(name, _first({}, s)) for name, s in zip(layout.names, layout.slots, strict=True)])
    return _trial(effects[0], *_finished(problem, problem.at(p)))


def bare(law: Beside) -> float:
    """Misfit of the law itself along the measured motion."""
    layout = law.solution.problem.layout
    problem = _projected(law, layout)
    return problem.refine(problem.at(np.array(law.solution.p)), steps=LAST, enough=ENOUGH).misfit


def shortfall(law: Beside, true: Trial, other: Trial) -> float:
    """Chi-squared that another effect leaves of what a true one makes of the runs, along the measured motion."""
    told = _projected(law, true.layout)
    ideal = told.data - told.at(np.array(true.p)).residual
    problem = Projected(Tied(other.layout, law.blocks), ideal, told.tau)
    found = problem.refine(problem.at(np.array(other.p)), steps=LAST, enough=CLOSE)
    return found.misfit - Projected(told.along, ideal, told.tau).at(np.array(true.p)).misfit


class Tied(Along):
    """A law along the motion in which waves that share an amplitude do so: their phases are numbers."""

    def is_wave(self, effect: Effect) -> bool:
        """Whether quadratures are linear: not where runs share an amplitude and have their own phases."""
        own = {p.per_run for p in effect.parameters if p.role in ("amplitude", "phase")}
        return super().is_wave(effect) and (len(own) == 1 or len(self.runs) == 1)


def _projected(law: Beside, layout: Layout) -> Projected:
    along = Tied(layout, law.blocks)
    return Projected(along, along.data, law.solution.tau or 0.03)


def _best(law: Beside, effect: Effect, starts: Iterable[Start]) -> Trial:
    """The best of the laws that several starts lead to."""
    found: list[tuple[Projected, State]] = []
    for values, absent in starts:
        old = law.solution.problem.layout
        layout = replace(old, model=old.model + effect, absent=old.absent | absent)
        problem = _projected(law, layout)
        there = dict(zip(old.names, law.solution.p, strict=True))
        slots = zip(layout.names, layout.slots, strict=True)
        p = np.array([there.get(name, _first(values, s)) for name, s in slots])
        found.append((problem, problem.refine(problem.at(p), steps=ROUGH, enough=CLOSE)))
    found.sort(key=lambda pair: pair[1].misfit)
    best = min((_finished(problem, state) for problem, state in found[:2]), key=lambda pair: pair[1].misfit)
    return _trial(effect, *best)


def _first(values: dict[tuple[str, int | None], float], slot: Slot) -> float:
    """Where an unknown begins that the bare law does not have: as scanned, a friction level at one."""
    return 1.0 if slot.effect == LEVEL else values.get((slot.parameter, slot.run), 0.0)


def deepened(law: Beside, trials: list[Trial]) -> list[Trial]:
    """Trials that may be the best, where they were not found in one go.

    Events of single runs were found one by one beside a law that lacked them all. And where no trial leaves the noise,
    or much is missing, the law may stand where it stood without the effect: all that scans quickly is found again.
    """
    misfit = bare(law)
    half = WORTH * max((misfit - t.misfit for t in trials), default=0.0)
    trials = [_events(law, t) if t.effect.single and misfit - t.misfit > half else t for t in trials]
    frames = sum(len(b.data) for b in law.blocks)
    enough = frames * (1 + POOR) + 3 * np.sqrt(2 * frames)
    if not trials or (misfit < STRONG * frames and min(t.misfit for t in trials) < enough):
        return trials
    return sorted((t if t.misfit < enough else _exchanged(law, t) for t in trials), key=lambda t: t.misfit)


def _exchanged(law: Beside, trial: Trial) -> Trial:
    problem = _projected(law, trial.layout)
    state = Search(problem.along, problem.tau).exchanged(problem, problem.at(trial.p), "")
    return _trial(trial.effect, *_finished(problem, state))


def _events(law: Beside, trial: Trial) -> Trial:
    """Events of single runs beside each other, in every run that gains more than their price by one."""
    name, price = trial.effect.name, PULSE_PRICE * np.log(law.solution.problem.n_frames)
    layout = replace(trial.layout, absent=law.solution.problem.layout.absent)
    problem = _projected(law, layout)
    search = Search(problem.along, problem.tau)
    there = dict(zip(trial.layout.names, trial.p, strict=True))
    p = np.array([there.get(n, v) for n, v in zip(layout.names, search.first(), strict=True)])
    state = search.afresh(problem, problem.at(p), name)
    found = dict(zip(layout.names, problem.along.law(state.numbers, state.coefficients), strict=True))
    gone = {pair for pair in search.idle(state, price) if pair[0] == name}
    kept = replace(layout, absent=layout.absent | gone)
    problem = _projected(law, kept)
    new = _trial(trial.effect, *_finished(problem, problem.at(np.array([found[n] for n in kept.names]))))
    return min(new, trial, key=lambda t: t.misfit + price * len(t.layout.slots))


def _finished(problem: Projected, state: State) -> tuple[Projected, State]:
    return problem, problem.refine(state, steps=LAST, enough=ENOUGH)


def _trial(effect: Effect, problem: Projected, state: State) -> Trial:
    layout = problem.layout
    p = problem.along.law(state.numbers, state.coefficients)
    return Trial(effect, layout, np.clip(p, *layout.bounds), state.misfit)


def _tied(law: Beside, loose: Trial, effect: Effect) -> Trial:
    """The same effect with one amplitude for all runs, from where an amplitude per run stands: at their mean."""
    old = loose.layout
    layout = replace(old, model=replace(old.model, effects=(*old.model.effects[:-1], effect)))
    there: dict[str, list[float]] = {}
    for name, value in zip(old.names, loose.p, strict=True):
        there.setdefault(name, []).append(float(value))
        there.setdefault(name.split("[")[0], []).append(float(value))
    problem = _projected(law, layout)
    return _trial(effect, *_finished(problem, problem.at(np.array([np.mean(there[n]) for n in layout.names]))))


def is_loose(p: Parameter) -> bool:
    """Whether nothing is said of an amplitude beside the runs."""
    return p.free and p.prior is None


def _picked(scans: list[Scan], left: Array, data: Array) -> list[list[Pick]]:
    """Places worth trying, of every family one each."""
    if len(scans) > 1:
        return [[_picks(s, left, data, 1)[0] for s in scans]]
    return [[pick] for pick in _picks(scans[0], left, data, PICKS)]


def _picks(found: Scan, left: Array, data: Array, most: int) -> list[Pick]:
    """The best forms whose coefficients keep their bounds, none within a few steps of a better one."""
    family, rises = found.family, found.rises.copy()
    steps = np.stack(np.unravel_index(np.arange(len(rises)), family.shape), axis=1)
    out: list[Pick] = []
    while len(out) < most:
        g = int(np.argmax(rises))
        if out and not rises[g] > WORTH * out[0][0]:
            break
        c = found.coefficients(g, left, data)
        if np.all((c >= family.low) & (c <= family.high)) or not np.any(np.delete(rises, g) > 0):
            low = np.where(np.isfinite(family.low), family.low + 1e-6, -np.inf)
            out.append((float(found.rises[g]), family.point(g), np.clip(c, low, family.high)))
            rises[np.all(np.abs(steps - steps[g]) <= APART, axis=1)] = 0.0
        rises[g] = -1.0
        if not np.any(rises > 0):
            break
    return out


def _start_values(law: Beside, effect: Effect, picks: list[Pick]) -> Start:
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


def _event_values(law: Beside, effect: Effect, picks: list[Pick]) -> Start:
    """Events of single runs: kept where they gain more than their price, at least in the best run."""
    price = PULSE_PRICE * np.log(law.solution.problem.n_frames)
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
