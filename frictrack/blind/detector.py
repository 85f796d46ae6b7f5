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

from frictrack.blind.truth import Numbers, RunTruth, Truth
from frictrack.effects import Effect, Path
from frictrack.models import Model
from frictrack.records import Array, Mask
from frictrack.simulate.dynamics import Panels, solve
from frictrack.simulate.dynamics import Response as Linear
from frictrack.simulate.slide import Slide

ALPHA = 0.005  # of the candidates' half of a diagnosis
CANDIDATES = 25  # effects that are tried, each of which gets the same part of alpha
OVERSAMPLED = 4  # forms of a scan that are one: its steps are a quarter of a resolution cell
POWER = 0.95
SLOW = 0.02  # m/s, below which a run is taken for stuck
SMALL = 1e-6  # relative step of a number of the law
STEP = 1e-3  # relative step of a number of a cause that does not enter linearly
LEAST_SCATTER, MOST_SCATTER, SCATTERS = 1e-4, 0.5, 40


@cache
def limit(freedom: int, forms: int = 1) -> float:
    """Rise of chi-squared, with so many free coefficients, that is seen in 95 of 100 repeats.

    It is the largest of so many independent `forms` of one candidate.
    """
    threshold = float(chi2.isf(ALPHA / CANDIDATES / forms, freedom))
    return float(brentq(lambda nc: ncx2.sf(threshold, freedom, nc) - POWER, 1.0, 1e4))


def freedom(effect: Effect, runs: int) -> int:
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
class _Seen:
    """One run under the base law: its motion, the frames in which it moves, and how it answers to forces.

    `block` (n, 2 + P + 1): change of x per unit of start, law and level.
    """

    truth: RunTruth
    slide: Slide
    moves: Mask
    path: Path  # at the nodes
    at_frames: Path
    linear: Linear
    mass: float
    block: Array


class Detector:
    """The ideal detector of one study, made from the truth without what is hidden."""

    def __init__(self, bare: Truth) -> None:
        self.bare = bare
        self._seen = [_looked_at(bare, run) for run in bare.runs]

    @property
    def slides(self) -> list[Slide]:
        """The motions without what is hidden."""
        return [seen.slide for seen in self._seen]

    def limit(self, effect: Effect) -> float:
        """Rise of chi-squared at which an effect is seen in 95 of 100 repeats."""
        span, runs = self.bare.span(self.slides), len(self.bare.runs)
        scans = [len(p.scan(span)) for p in effect.parameters if p.scan is not None and p.fixed is None]
        forms = int(np.prod(scans)) * (runs if is_event(effect) else 1)
        return limit(freedom(effect, runs), max(1, forms // OVERSAMPLED))

    def shown(self, truth: Truth) -> tuple[Array, float]:
        """The trace: what nothing but the hidden causes explains, in units of the noise, its square the rise.

        And the rise where nobody tells the scatter of the levels: the likeliest one takes its part.
        """
        split = self._split(*self._changes(truth))
        return self._unexplained(*split), self._surely(*split)

    def _changes(self, truth: Truth) -> tuple[list[Array], list[Mask]]:
        """Of every run the change of the recorded x (n,) by the hidden causes, and the frames in which both move."""
        shifts = []
        for seen, run in zip(self._seen, truth.runs, strict=True):
            if not run.values:
                shifts.append((np.zeros(len(seen.slide.t)), seen.moves))
                continue
            full = truth.slide(run)
            shifts.append((full.x + full.shift - seen.slide.x, seen.moves & _moving(full)))
        return [d for d, _ in shifts], [use for _, use in shifts]

    def unit(self, effect: Effect, values: list[Numbers]) -> Array:
        """The same to first order in a cause's size, for an effect with its numbers in every run (none: absent)."""
        moved = [self._answer(seen, effect, own) for seen, own in zip(self._seen, values, strict=True)]
        return self._unexplained(*self._split(moved, [seen.moves for seen in self._seen]))

    def tangent(self, effect: Effect, values: list[Numbers]) -> Array:
        """How the trace changes with every free number of a cause, (N, k): all that it can take beside another one."""
        here, out = self.unit(effect, values), []
        there = [i for i, own in enumerate(values) if own]
        for p in (p for p in effect.parameters if p.fixed is None):
            for rows in [[i] for i in there] if p.per_run else [there]:
                step = 1.0 if p.linear else STEP * max(abs(values[rows[0]][effect.name][p.name]), STEP)
                moved = [_moved(own, effect.name, p.name, step) if i in rows else own for i, own in enumerate(values)]
                out.append((self.unit(effect, moved) - here) / step)
        return np.column_stack(out)

    def designs(self, effect: Effect, values: list[Numbers]) -> list[tuple[Slide, Mask, Array, Array]]:
        """Of every run: motion, frames in which it moves (m of them), answers of x to start (2), law and level, effect.

        The answers (m, 2 + P + 1) and (m,) are in m per unit.
        """
        pairs = zip(self._seen, values, strict=True)
        return [(s.slide, s.moves, s.block, self._answer(s, effect, own)[s.moves]) for s, own in pairs]

    def share(self, effect: Effect, values: list[Numbers]) -> float:
        """Root mean square of a hidden force over that of the base law, both along the base law's motion."""
        seen = self._seen
        more = [self._force(run, effect, own) for run, own in zip(seen, values, strict=True)]
        whole = [self.bare.base.force(run.path, self.bare.law) for run in seen]
        return float(np.linalg.norm(np.concatenate(more)) / np.linalg.norm(np.concatenate(whole)))

    def _force(self, seen: _Seen, effect: Effect, own: Numbers) -> Array:
        """Force that an effect adds at the nodes, N."""
        if not own or effect.acts_on == "measurement":
            return np.zeros(len(seen.path.t))
        more = (self.bare.base + effect).force(seen.path, self.bare.law | own)
        return np.asarray(more - self.bare.base.force(seen.path, self.bare.law))

    def _answer(self, seen: _Seen, effect: Effect, own: Numbers) -> Array:
        """Change of the recorded x (n,) by an effect, first order."""
        out = np.zeros(len(seen.slide.t))
        if own and effect.acts_on == "measurement":
            coefficients = [own[effect.name][p.name] for p in effect.linear]
            out[seen.moves] = effect.columns(seen.at_frames, own[effect.name]) @ coefficients
        elif own:
            g = -self._force(seen, effect, own)[:, None] / seen.mass
            out[seen.moves] = seen.linear.respond(g, np.zeros((2, 1)))[1][:, 0, 0]
        return out

    def _unexplained(self, a: Array, d: Array) -> Array:
        """What is left of whitened changes d (N,), over the noise, when law and levels are fitted again."""
        n = len(self._seen)
        held = np.zeros((n, a.shape[1]))
        held[:, -n:] = np.eye(n) / max(self.bare.scatter, LEAST_SCATTER)
        return beside(np.append(d, np.zeros(n)), np.vstack([a, held]))

    def _surely(self, a: Array, d: Array) -> float:
        """Rise by whitened changes d (N,) where the scatter of the levels is the likeliest one (Harville 1977)."""
        n = len(self._seen)
        norm = np.linalg.norm(a[:, :-n], axis=0)
        law, _ = np.linalg.qr(a[:, :-n] / np.where(norm > 0, norm, 1.0))
        levels, d = (q - law @ (law.T @ q) for q in (a[:, -n:], d))
        gram, on_levels = levels.T @ levels, levels.T @ d
        known = max(self.bare.scatter, LEAST_SCATTER)

        def likely(tau: float) -> float:
            left = float(d @ d - on_levels @ np.linalg.solve(gram + np.eye(n) / tau**2, on_levels))
            return left + float(np.linalg.slogdet(np.eye(n) + tau**2 * gram)[1])

        least = min(likely(tau) for tau in np.geomspace(known, max(MOST_SCATTER, 2 * known), SCATTERS))
        return max(least - float(np.linalg.slogdet(np.eye(n) + known**2 * gram)[1]), 0.0)

    def _split(self, moved: list[Array], use: list[Mask]) -> tuple[Array, Array]:
        """Answers to law and levels (N, P + runs) and changes of x (N,) of all runs, whitened, their starts removed."""
        pairs = enumerate(zip(self._seen, moved, use, strict=True))
        split = [self._split_run(i, seen, change, frames) for i, (seen, change, frames) in pairs]
        return np.vstack([part for _, part in split]), np.concatenate([row for row, _ in split])

    def _split_run(self, i: int, seen: _Seen, moved: Array, frames: Mask) -> tuple[Array, Array]:
        """A change (n,) and the answers to law and levels (n, P + runs) of one run, whitened, its start removed."""
        whole = np.zeros((len(moved), seen.block.shape[1]))
        whole[seen.moves] = seen.block
        block, change = whole[frames] / self.bare.noise, moved[frames] / self.bare.noise
        q, _ = np.linalg.qr(block[:, :2])
        left = np.zeros(len(frames))
        left[frames] = change - q @ (q.T @ change)
        rest = block[:, 2:] - q @ (q.T @ block[:, 2:])
        laws = rest.shape[1] - 1
        part = np.zeros((len(frames), laws + len(self._seen)))
        part[frames, :laws] = rest[:, :-1]
        part[frames, laws + i] = rest[:, -1]
        return left, part


def beside(trace: Array, columns: Array) -> Array:
    """What is left of a trace (N,) when so many columns (N, k) are fitted beside it."""
    norm = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(norm > 0, norm, 1.0)
    return np.asarray(trace - columns @ np.linalg.lstsq(columns, trace, rcond=1e-11)[0])


def _moved(own: Numbers, effect: str, name: str, step: float) -> Numbers:
    """The numbers of a cause with one of them changed."""
    return {effect: own[effect] | {name: own[effect][name] + step}}


def _moving(slide: Slide) -> Mask:
    """Frames of the one stretch in which a run moves."""
    rows = np.flatnonzero(np.abs(slide.v) > SLOW)
    out: Mask = np.zeros(len(slide.t), dtype=bool)
    if len(rows):
        stops = np.flatnonzero(np.diff(rows) > 1)
        out[rows[: stops[0] + 1] if len(stops) else rows] = True
    return out


def _looked_at(truth: Truth, run: RunTruth) -> _Seen:
    """One run under the base law, linearised."""
    slide, conditions, base = truth.slide(run, hidden=False), truth.conditions(run), truth.base
    moves, s = _moving(slide), float(np.sign(run.speed))
    t, x, v = slide.t[moves], slide.x[moves], slide.v[moves]
    push = conditions.drive or np.zeros_like

    def law(x: Array, v: Array, t: Array) -> Array:
        return (push(t) - base.force(conditions.along(x, v, t, s), truth.law)) / conditions.mass

    panels = Panels(t)
    motion, linear = solve(law, panels, (float(x[0]), float(v[0])), np.interp(panels.t, slide.t, slide.a))
    path = conditions.along(motion.x, motion.v, panels.t, s)
    inputs = np.column_stack([*_inputs(base, truth.law, path)]) / -conditions.mass
    start = np.zeros((2, inputs.shape[1] + 2))
    start[0, 0] = start[1, 1] = 1.0
    _, edges = linear.respond(np.column_stack([np.zeros((len(inputs), 2)), inputs]), start)
    return _Seen(run, slide, moves, path, conditions.along(x, v, t, s), linear, conditions.mass, edges[:, 0, :])


def _inputs(base: Model, law: Numbers, path: Path) -> list[Array]:
    """Force per unit of every free number of the law, and of the level, at the nodes."""
    plain = base.force(path, law)
    out = []
    for effect in base.effects:
        for p in effect.parameters:
            if p.fixed is None:
                step = SMALL * abs(law[effect.name][p.name])
                own = law[effect.name] | {p.name: law[effect.name][p.name] + step}
                out.append((base.force(path, law | {effect.name: own}) - plain) / step)
    harder = replace(path, load=path.load * (1 + SMALL))
    return [*out, (base.force(harder, law) - plain) / SMALL]
