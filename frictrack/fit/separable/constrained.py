"""Laws whose waves share an amplitude, such as ATM2: found where every wave has its own, then tied and followed down.

An effect says how it is relaxed: into waves of free amplitude, which are linear, and the rest of its columns. What
several parts share besides, such as v_s, is tried at a few values. The slow waves of two sums trade places with each
other and with all that is smooth: they are scanned together, over frequency and phase, as they share their amplitudes.
The run of most frames is solved first; in the others only what is their own is left to find.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from frictrack.effects import Effect, Parameter, Span
from frictrack.fit.parameters import Layout, told
from frictrack.fit.separable.model import Along
from frictrack.fit.separable.newton import Projected, State
from frictrack.fit.separable.relaxed import Relaxed
from frictrack.fit.separable.varpro import Search
from frictrack.models import Model
from frictrack.records import Array

PLACES = (3, 6, 8)  # steps from the end of the scan of what parts share: where waves are looked for
VALUES = 10  # the last ones of that scan, at all of which slow waves are looked for
STARTS = 4  # sets of waves that are tied, at most
WORSE = 1.5  # times the misfit of the best tied law: a relaxed one beyond, although freer, has the wrong waves
TRIALS = 5  # places of two slow waves that are followed down
AGAIN = 8  # the same beside the best law
FIRST, LAST = 4, 30  # steps before a law may be given up, and in all
FAR = 4.0  # times the best misfit: given up after the first steps
ROUGHLY = 1e-4  # of the misfit that a step must promise while laws are compared
SAME = 0.25  # periods in a run within which two waves are one


def search_of(along: Along) -> Search | Tied:
    """The search that finds a model's law along the measured motion."""
    return Tied(along) if any(e.relaxed for e in along.layout.model.effects) else Search(along)


class Tied:
    """The search for a law with a relaxed effect. Reused for many data sets, it keeps its tables."""

    def __init__(self, along: Along, tau: float = 0.03) -> None:
        self.along, self.tau = along, tau
        self.effect = next(e for e in along.layout.model.effects if e.relaxed)
        length = {r: sum(len(b.data) for b in along.blocks if b.run == r) for r in along.runs}
        self.runs = sorted(along.runs, key=lambda r: -length[r])
        self.single = {r: _alone(along, r, along.layout.model) for r in self.runs}
        first = self.single[self.runs[0]]
        commons = _commons(along.layout, self.effect)
        last = len(commons)
        places = {max(last - k, 0) for k in PLACES}
        some = sorted(places | set(range(max(last - VALUES, 0), last)))
        self.relaxed = [Relaxed(first, self.effect, commons[i]) for i in some]
        self.places = [r for i, r in zip(some, self.relaxed, strict=True) if i in places]

    def __call__(self, data: Array | None = None) -> State:
        """The law that explains data (M,), default the blocks' own, best."""
        data = self.along.data if data is None else data
        state = self._first(self._of(self.runs[0], data))
        first = self.single[self.runs[0]]
        if first is self.along:
            return state
        found = dict(zip(first.layout.names, first.law(state.numbers, state.coefficients), strict=True))
        for run in self.runs[1:]:
            found = self._own(run, found, self._of(run, data)) | found
        problem = Projected(self.along, data, self.tau)
        numbers = np.array([found.get(name, 1.0) for name in self.along.layout.names])
        return problem.refine(problem.at(numbers), steps=LAST)

    def idle(self, state: State, price: float) -> frozenset[tuple[str, int]]:
        """Events of single runs, (effect, run), that gain less than their price; the best of every effect stays."""
        return Search(self.along, self.tau).idle(state, price)

    def _own(self, run: int, found: dict[str, float], data: Array) -> dict[str, float]:
        """What is a run's own, by address, where all that it shares with the others is found."""
        held = Model(tuple(_held(e, found) for e in self.along.layout.model.effects))
        along = _alone(self.along, run, held)
        effect = next(e for e in held.effects if e.relaxed)
        common = {name: found.get(f"{effect.name}.{name}", v) for name, v in self.relaxed[0].common.items()}
        relaxed = Relaxed(along, effect, common)
        _, p = min(relaxed.laws(data), key=lambda law: law[0])
        state = self._followed(Projected(along, data), [p, *(q for _, q in relaxed.places(p, data))], None)
        return dict(zip(along.layout.names, along.law(state.numbers, state.coefficients), strict=True))

    def _of(self, run: int, data: Array) -> Array:
        pairs = zip(self.along.blocks, self.along.slices, strict=True)
        return np.concatenate([data[s] for block, s in pairs if block.run == run])

    def _first(self, data: Array) -> State:
        """The law of the longest run."""
        first = self.single[self.runs[0]]
        problem = Projected(first, data)
        best: State | None = None
        for misfit, p in self._starts(data):
            if best is not None and misfit > WORSE * best.misfit:
                break
            best = self._followed(problem, [p, *self._slow(p, data)[:TRIALS]], best)
        assert best is not None
        p = first.law(best.numbers, best.coefficients)
        for q in [p, *self.relaxed[0].exchanged(p)]:
            best = self._followed(problem, self._slow(q, data)[:AGAIN], best)
        return problem.refine(best, steps=LAST)

    def _starts(self, data: Array) -> list[tuple[float, Array]]:
        """Misfits and numbers (P,) of the best relaxed laws, of every set of waves the best."""
        found = sorted((law for r in self.places for law in r.laws(data)), key=lambda law: law[0])
        chosen: list[tuple[float, Array]] = []
        for misfit, p in found:
            mine = self.relaxed[0].fast(p)
            if all(np.any(np.abs(mine - self.relaxed[0].fast(q)) > SAME) for _, q in chosen):
                chosen.append((misfit, p))
        return chosen[:STARTS]

    def _slow(self, p: Array, data: Array) -> list[Array]:
        """A law (P,) with the slowest waves of two sums elsewhere, the place that looks best first."""
        found = [place for r in self.relaxed for place in r.places(p, data)]
        costs = np.array([c for c, _ in found])
        return [found[i][1] for i in np.argsort(costs)]

    def _followed(self, problem: Projected, trials: Iterable[Array], best: State | None) -> State:
        for p in trials:
            state = problem.refine(problem.at(p), steps=FIRST, enough=ROUGHLY)
            if best is not None and state.misfit > FAR * best.misfit:
                continue
            below = np.inf if best is None else best.misfit
            state = problem.refine(state, steps=LAST, enough=ROUGHLY, below=below)
            if best is None or state.misfit < best.misfit:
                best = state
        assert best is not None
        return best


def _alone(along: Along, run: int, model: Model) -> Along:
    """One run by itself, without a level of its own."""
    layout = along.layout
    if len(layout.run_names) == 1 and model is layout.model:
        return along
    absent = frozenset((e, 0) for e, r in layout.absent if r == run)
    alone = Layout(model, (layout.run_names[run],), (layout.spans[run],), absent)
    return Along(alone, [replace(b, run=0) for b in along.blocks if b.run == run])


def _held(effect: Effect, found: dict[str, float]) -> Effect:
    """An effect with those non-linear numbers fixed that the runs share."""
    known = {q.name: found.get(f"{effect.name}.{q.name}") for q in effect.nonlinear if q.free}
    return effect.adjusted(**{name: {"fixed": value} for name, value in known.items() if value is not None})


def _commons(layout: Layout, effect: Effect) -> list[dict[str, float]]:
    """Values worth trying of what several parts share."""
    shared = [q for q in effect.nonlinear if sum(q.name in part.names for part in effect.relaxed) > 1]
    axes = [_axis(q, layout.span) for q in shared]
    return [dict(zip((q.name for q in shared), map(float, values), strict=True)) for values in product(*axes)]


def _axis(q: Parameter, span: Span) -> Sequence[float]:
    known = told(q, span)
    if known is not None:
        return [known]
    return [1.0] if q.scan is None else list(q.scan(span))
