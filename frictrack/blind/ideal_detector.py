"""The ideal detector: what the best possible reading of a study could see of a hidden cause.

It knows the base law's form, the noise, the scatter of the levels and the form of the cause; it does not know starts,
the law's numbers, the levels and the cause's coefficients, and it looks through a library of forms as the diagnosis
does. With the displacement's sensitivities J to all that it must fit (levels held by their scatter) and the trace d
that the cause leaves, the likelihood ratio is chi-squared with the non-centrality

    rise = min_b |d/noise - J b|^2

and the limit is the rise that exceeds the threshold of the whole search in 95 of 100 repeats.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2, ncx2

from frictrack.blind.truth import EffectValues, RunTruth, Truth
from frictrack.effects import Effect, Path
from frictrack.models import Model
from frictrack.records import Array, Mask
from frictrack.simulate import Trajectory
from frictrack.simulate.dynamics import MotionResponse, Panels, solve_motion

ALPHA = 0.005  # of the candidates' half of a diagnosis
N_CANDIDATES = 25  # effects that are tried, each of which gets the same part of alpha
FORMS_PER_CELL = 4  # forms of a scan that are one: its steps are a quarter of a resolution cell
POWER = 0.95
MIN_SPEED = 0.02  # m/s, below which a run is taken for stuck
LAW_STEP = 1e-6  # relative step of a number of the law
EFFECT_STEP = 1e-3  # relative step of a number of a cause that does not enter linearly
MIN_SCATTER, MAX_SCATTER, N_SCATTERS = 1e-4, 0.5, 40


@cache
def noncentrality_limit(degrees_of_freedom: int, forms: int = 1) -> float:
    """Rise of chi-squared, with so many free coefficients, that is seen in 95 of 100 repeats.

    It is the largest of so many independent `forms` of one candidate.
    """
    threshold = float(chi2.isf(ALPHA / N_CANDIDATES / forms, degrees_of_freedom))
    return float(brentq(lambda nc: ncx2.sf(threshold, degrees_of_freedom, nc) - POWER, 1.0, 1e4))


def degrees_of_freedom(effect: Effect, runs: int) -> int:
    """Coefficients that a scan of an effect has free: a phase makes two of one, and so many in every run.

    Events of single runs are judged one by one.
    """
    if is_event(effect):
        return 1
    phases = [p for p in effect.parameters if p.role == "phase"]
    sizes = sum(p.linear or p.role == "depth" for p in effect.parameters)
    if not phases:
        return max(sizes, 1)
    return 2 * (runs if phases[0].per_run else 1)


def is_event(effect: Effect) -> bool:
    """Whether the cause happens at a moment of its own in every run."""
    return any(p.per_run and p.scan is not None for p in effect.parameters)


@dataclass(frozen=True)
class _LinearisedRun:
    """One run under the base law: its motion, the frames in which it moves, and how it answers to forces.

    `sensitivity` (n, 2 + P + 1): change of x per unit of start, law and level.
    """

    truth: RunTruth
    slide: Trajectory
    moving: Mask
    path: Path  # at the nodes
    at_frames: Path
    linear: MotionResponse
    mass: float
    sensitivity: Array


class IdealDetector:
    """The ideal detector of one study, made from the truth without what is hidden."""

    def __init__(self, base_study: Truth) -> None:
        self.base_study = base_study
        self._runs = [_linearise_run(base_study, run) for run in base_study.runs]

    @property
    def slides(self) -> list[Trajectory]:
        """The motions without what is hidden."""
        return [linearised.slide for linearised in self._runs]

    def limit(self, effect: Effect) -> float:
        """Rise of chi-squared at which an effect is seen in 95 of 100 repeats."""
        span, runs = self.base_study.span(self.slides), len(self.base_study.runs)
        scans = [len(p.scan(span)) for p in effect.parameters if p.scan is not None and p.fixed is None]
        forms = int(np.prod(scans)) * (runs if is_event(effect) else 1)
        return noncentrality_limit(degrees_of_freedom(effect, runs), max(1, forms // FORMS_PER_CELL))

    def trace_and_rise(self, truth: Truth) -> tuple[Array, float]:
        """The trace: what nothing but the hidden causes explains, in units of the noise, its square the rise.

        And the rise where nobody tells the scatter of the levels: the likeliest one takes its part.
        """
        split = self._remove_starts(*self._changes(truth))
        return self._unexplained(*split), self._rise_with_unknown_scatter(*split)

    def _changes(self, truth: Truth) -> tuple[list[Array], list[Mask]]:
        """Of every run the change of the recorded x (n,) by the hidden causes, and the frames in which both move."""
        shifts = []
        for linearised, run in zip(self._runs, truth.runs, strict=True):
            if not run.values:
                shifts.append((np.zeros(len(linearised.slide.t)), linearised.moving))
                continue
            full = truth.slide(run)
            shifts.append((full.x + full.shift - linearised.slide.x, linearised.moving & _moving_frames(full)))
        return [d for d, _ in shifts], [use for _, use in shifts]

    def linear_trace(self, effect: Effect, values: list[EffectValues]) -> Array:
        """The same to first order in a cause's size, for an effect with its numbers in every run (none: absent)."""
        moved = [self._response(linearised, effect, own) for linearised, own in zip(self._runs, values, strict=True)]
        return self._unexplained(*self._remove_starts(moved, [linearised.moving for linearised in self._runs]))

    def trace_derivatives(self, effect: Effect, values: list[EffectValues]) -> Array:
        """How the trace changes with every free number of a cause, (N, k): all that it can take beside another one."""
        trace, out = self.linear_trace(effect, values), []
        there = [i for i, own in enumerate(values) if own]
        for p in (p for p in effect.parameters if p.fixed is None):
            for rows in [[i] for i in there] if p.per_run else [there]:
                step = 1.0 if p.linear else EFFECT_STEP * max(abs(values[rows[0]][effect.name][p.name]), EFFECT_STEP)
                moved = [
                    _with_step(own, effect.name, p.name, step) if i in rows else own for i, own in enumerate(values)
                ]
                out.append((self.linear_trace(effect, moved) - trace) / step)
        return np.column_stack(out)

    def sensitivities(self, effect: Effect, values: list[EffectValues]) -> list[tuple[Trajectory, Mask, Array, Array]]:
        """Of every run: motion, frames in which it moves (m of them), answers of x to start (2), law and level, effect.

        The answers (m, 2 + P + 1) and (m,) are in m per unit.
        """
        pairs = zip(self._runs, values, strict=True)
        return [(s.slide, s.moving, s.sensitivity, self._response(s, effect, own)[s.moving]) for s, own in pairs]

    def force_share(self, effect: Effect, values: list[EffectValues]) -> float:
        """Root mean square of a hidden force over that of the base law, both along the base law's motion."""
        linearised = self._runs
        more = [self._force(run, effect, own) for run, own in zip(linearised, values, strict=True)]
        whole = [self.base_study.base.force(run.path, self.base_study.law) for run in linearised]
        return float(np.linalg.norm(np.concatenate(more)) / np.linalg.norm(np.concatenate(whole)))

    def _force(self, linearised: _LinearisedRun, effect: Effect, own: EffectValues) -> Array:
        """Force that an effect adds at the nodes, N."""
        if not own or effect.acts_on == "measurement":
            return np.zeros(len(linearised.path.t))
        more = (self.base_study.base + effect).force(linearised.path, self.base_study.law | own)
        return np.asarray(more - self.base_study.base.force(linearised.path, self.base_study.law))

    def _response(self, linearised: _LinearisedRun, effect: Effect, own: EffectValues) -> Array:
        """Change of the recorded x (n,) by an effect, first order."""
        out = np.zeros(len(linearised.slide.t))
        if own and effect.acts_on == "measurement":
            coefficients = [own[effect.name][p.name] for p in effect.linear]
            out[linearised.moving] = effect.columns(linearised.at_frames, own[effect.name]) @ coefficients
        elif own:
            g = -self._force(linearised, effect, own)[:, None] / linearised.mass
            out[linearised.moving] = linearised.linear.respond(g, np.zeros((2, 1)))[1][:, 0, 0]
        return out

    def _unexplained(self, a: Array, d: Array) -> Array:
        """What is left of whitened changes d (N,), over the noise, when law and levels are fitted again."""
        n = len(self._runs)
        prior = np.zeros((n, a.shape[1]))
        prior[:, -n:] = np.eye(n) / max(self.base_study.scatter, MIN_SCATTER)
        return unexplained_part(np.append(d, np.zeros(n)), np.vstack([a, prior]))

    def _rise_with_unknown_scatter(self, a: Array, d: Array) -> float:
        """Rise by whitened changes d (N,) where the scatter of the levels is the likeliest one (Harville 1977)."""
        n = len(self._runs)
        norm = np.linalg.norm(a[:, :-n], axis=0)
        law, _ = np.linalg.qr(a[:, :-n] / np.where(norm > 0, norm, 1.0))
        levels, d = (q - law @ (law.T @ q) for q in (a[:, -n:], d))
        gram, on_levels = levels.T @ levels, levels.T @ d
        known = max(self.base_study.scatter, MIN_SCATTER)

        def deviance(tau: float) -> float:
            left = float(d @ d - on_levels @ np.linalg.solve(gram + np.eye(n) / tau**2, on_levels))
            return left + float(np.linalg.slogdet(np.eye(n) + tau**2 * gram)[1])

        min_deviance = min(deviance(tau) for tau in np.geomspace(known, max(MAX_SCATTER, 2 * known), N_SCATTERS))
        return max(min_deviance - float(np.linalg.slogdet(np.eye(n) + known**2 * gram)[1]), 0.0)

    def _remove_starts(self, moved: list[Array], use: list[Mask]) -> tuple[Array, Array]:
        """Answers to law and levels (N, P + runs) and changes of x (N,) of all runs, whitened, their starts removed."""
        pairs = enumerate(zip(self._runs, moved, use, strict=True))
        split = [self._remove_start(i, linearised, change, frames) for i, (linearised, change, frames) in pairs]
        return np.vstack([part for _, part in split]), np.concatenate([row for row, _ in split])

    def _remove_start(self, i: int, linearised: _LinearisedRun, moved: Array, frames: Mask) -> tuple[Array, Array]:
        """A change (n,) and the answers to law and levels (n, P + runs) of one run, whitened, its start removed."""
        whole = np.zeros((len(moved), linearised.sensitivity.shape[1]))
        whole[linearised.moving] = linearised.sensitivity
        sensitivity, change = whole[frames] / self.base_study.noise, moved[frames] / self.base_study.noise
        q, _ = np.linalg.qr(sensitivity[:, :2])
        left = np.zeros(len(frames))
        left[frames] = change - q @ (q.T @ change)
        rest = sensitivity[:, 2:] - q @ (q.T @ sensitivity[:, 2:])
        laws = rest.shape[1] - 1
        part = np.zeros((len(frames), laws + len(self._runs)))
        part[frames, :laws] = rest[:, :-1]
        part[frames, laws + i] = rest[:, -1]
        return left, part


def unexplained_part(trace: Array, columns: Array) -> Array:
    """What is left of a trace (N,) when so many columns (N, k) are fitted beside it."""
    norm = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(norm > 0, norm, 1.0)
    return np.asarray(trace - columns @ np.linalg.lstsq(columns, trace, rcond=1e-11)[0])


def _with_step(own: EffectValues, effect: str, name: str, step: float) -> EffectValues:
    """The numbers of a cause with one of them changed."""
    return {effect: own[effect] | {name: own[effect][name] + step}}


def _moving_frames(slide: Trajectory) -> Mask:
    """Frames of the one stretch in which a run moves."""
    rows = np.flatnonzero(np.abs(slide.v) > MIN_SPEED)
    out: Mask = np.zeros(len(slide.t), dtype=bool)
    if len(rows):
        stops = np.flatnonzero(np.diff(rows) > 1)
        out[rows[: stops[0] + 1] if len(stops) else rows] = True
    return out


def _linearise_run(truth: Truth, run: RunTruth) -> _LinearisedRun:
    """One run under the base law, linearised."""
    slide, conditions, base = truth.slide(run, hidden=False), truth.conditions(run), truth.base
    moving, s = _moving_frames(slide), float(np.sign(run.speed))
    t, x, v = slide.t[moving], slide.x[moving], slide.v[moving]
    push = conditions.drive or np.zeros_like

    def law(x: Array, v: Array, t: Array) -> Array:
        return (push(t) - base.force(conditions.path(x, v, t, s), truth.law)) / conditions.mass

    panels = Panels(t)
    motion, linear = solve_motion(law, panels, (float(x[0]), float(v[0])), np.interp(panels.t, slide.t, slide.a))
    path = conditions.path(motion.x, motion.v, panels.t, s)
    inputs = np.column_stack([*_force_sensitivities(base, truth.law, path)]) / -conditions.mass
    start = np.zeros((2, inputs.shape[1] + 2))
    start[0, 0] = start[1, 1] = 1.0
    _, edges = linear.respond(np.column_stack([np.zeros((len(inputs), 2)), inputs]), start)
    return _LinearisedRun(
        run, slide, moving, path, conditions.path(x, v, t, s), linear, conditions.mass, edges[:, 0, :]
    )


def _force_sensitivities(base: Model, law: EffectValues, path: Path) -> list[Array]:
    """Force per unit of every free number of the law, and of the level, at the nodes."""
    force = base.force(path, law)
    out = []
    for effect in base.effects:
        for p in effect.parameters:
            if p.fixed is None:
                step = LAW_STEP * abs(law[effect.name][p.name])
                own = law[effect.name] | {p.name: law[effect.name][p.name] + step}
                out.append((base.force(path, law | {effect.name: own}) - force) / step)
    heavier = replace(path, load=path.load * (1 + LAW_STEP))
    return [*out, (base.force(heavier, law) - force) / LAW_STEP]
