"""Expected evidence of a planned run: one explanation is true and the other one is fitted to all runs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from frictrack.diagnose.experiments.planned import Film, extended, filmed, spread
from frictrack.errors import FrictrackError
from frictrack.fit.simulated.pieces import Piece, spans_of
from frictrack.fit.simulated.problem import Problem
from frictrack.fit.simulated.scan import per_run_coefficients
from frictrack.fit.simulated.solve import Solution, refine
from frictrack.fit.simulated.trial import TIE_ALPHA, is_loose
from frictrack.fit.unknowns.layout import LEVEL, Layout
from frictrack.fit.unknowns.scatter import restraint
from frictrack.records import Array

PHASES = np.arange(4) * np.pi / 2  # from which a phase of the planned run is sought
MOMENTS = np.linspace(0.06, 0.94, 12)  # of the planned run, at which a rival's event is sought
SIZES = ("amplitude", "depth")
OWN_STEPS, STEPS = 4, 8  # of Gauss-Newton: on the planned run alone, and on all runs


@dataclass(frozen=True)
class Explanation:
    """A cause that was added to the law, and the fall of chi-squared that it brought on the runs at hand."""

    effect: str
    solution: Solution
    gain: float


@dataclass(frozen=True)
class Duel:
    """Two explanations of the same runs, of which the first is taken to be true."""

    truth: Explanation
    rival: Explanation

    @cached_property
    def ideal(self) -> list[Piece]:
        """The runs at hand as the true explanation has them, without noise."""
        seen = {(r.piece.run, float(r.piece.t[0])): r.model_y for r in self.truth.solution.responses}
        return [replace(p, y=seen[p.run, float(p.t[0])]) for p in self.rival.solution.problem.pieces]

    @cached_property
    def fitted(self) -> Solution:
        """The rival fitted to what the truth predicts of the runs at hand."""
        rival = self.rival.solution
        problem = rival.problem.over(rival.problem.layout, self.ideal)
        return refine(problem, rival.p, rival.starts, tau=max(self.truth.solution.tau, 1e-3), max_steps=STEPS)

    @property
    def now(self) -> float:
        """Expected difference of BIC on the runs at hand, positive for the truth."""
        held = restraint(self.truth.solution.problem.layout, self.truth.solution.p, max(self.truth.solution.tau, 1e-3))
        frames = self.rival.solution.problem.n_frames
        price = unknowns(self.rival.solution.problem.layout) - unknowns(self.truth.solution.problem.layout)
        return self.fitted.objective - float(held @ held) + price * float(np.log(frames))

    def after(self, film: Film) -> float:
        """Expected difference of BIC once the planned run is filmed too, positive for the truth.

        Raises FrictrackError where the run cannot be made, or its motion cannot be followed under the rival.
        """
        truth = self.truth.solution
        piece = filmed(truth, film, max(e.fine for e in self.rival.solution.problem.model.effects))
        span = spans_of([replace(piece, run=0)], 1, truth.problem.layout.spans[0].fps * film.rate)[0]
        tau = spread(truth, piece.run + 1)
        layout, p = extended(self.fitted, span, film.phase, free=True)
        start = np.array([film.start[0], film.start[1]])
        p, start = _placed(self.rival.solution, layout, piece, (p, start, tau))
        pieces, starts = [*self.ideal, piece], [*self.fitted.starts, start]
        problem = self.rival.solution.problem.over(layout, pieces)
        found = refine(problem, p, starts, tau=tau, max_steps=STEPS)
        told, q = extended(truth, span, film.phase)
        held = restraint(told, q, tau)
        best = _loosened(found, self.rival.effect, tau)
        price = unknowns(best.problem.layout) - unknowns(told)
        return best.objective - float(held @ held) + price * float(np.log(problem.n_frames))


def _loosened(tied: Solution, effect: str, tau: float) -> Solution:
    """The rival with an amplitude per run, where one amplitude is significantly worse: what a fit would make of it."""
    layout = tied.problem.layout
    old = next(e for e in layout.model.effects if e.name == effect)
    sizes = {p.name: {"per_run": True} for p in old.parameters if p.role in SIZES and is_loose(p) and not p.per_run}
    runs = len(layout.run_names)
    worse = float(chi2_distribution.isf(TIE_ALPHA, runs - 1))
    if not (sizes and per_run_coefficients(old)) or tied.objective < worse:
        return tied
    effects = tuple(old.adjusted(**sizes) if e is old else e for e in layout.model.effects)
    free = replace(layout, model=replace(layout.model, effects=effects))
    there = dict(zip(layout.names, tied.p, strict=True))
    p = np.array(
        [there.get(n, there.get(f"{s.effect}.{s.parameter}", 0.0)) for n, s in zip(free.names, free.slots, strict=True)]
    )
    try:
        loose = refine(tied.problem.over(free, tied.problem.pieces), p, tied.starts, tau=tau, max_steps=STEPS)
    except FrictrackError:
        return tied
    return loose if tied.objective - loose.objective > worse else tied


def unknowns(layout: Layout) -> int:
    """Unknowns that are paid for: all but the levels."""
    return len(layout.slots) - len(layout.levels)


def _placed(rival: Solution, layout: Layout, piece: Piece, begin: tuple[Array, Array, float]) -> tuple[Array, Array]:
    """The rival's own unknowns of the planned run where they explain it best, and its start there."""
    p, start, tau = begin
    problem = Problem(layout.model, layout, [piece])
    own = np.array([s.run == piece.run for s in layout.slots])
    best, where = np.inf, (p, start)
    for trial in _trials(rival, layout, p, piece):
        try:
            found = refine(problem, trial, [start], tau=tau, free=own, max_steps=OWN_STEPS)
        except FrictrackError:  # a start too wild to be integrated
            continue
        if found.objective < best:
            best, where = found.objective, (found.p, found.starts[0])
    return where


def _trials(rival: Solution, layout: Layout, p: Array, piece: Piece) -> Iterator[Array]:
    """Values (P,) from which the unknowns of the planned run are sought: phases, and moments of events."""
    roles = {(e.name, q.name): q.role for e in rival.problem.model.effects for q in e.parameters}
    own = [i for i, s in enumerate(layout.slots) if s.run == piece.run and s.effect != LEVEL]
    phases = [i for i in own if roles[layout.slots[i].effect, layout.slots[i].parameter] == "phase"]
    moments = [i for i in own if not layout.slots[i].linear and layout.slots[i].unit == "s" and i not in phases]
    yield p
    for i in phases:
        for phase in PHASES:
            yield _with(p, i, float(phase))
    for i in moments:
        for share in MOMENTS:
            yield _with(p, i, float(piece.t[0] + share * (piece.t[-1] - piece.t[0])))


def _with(p: Array, i: int, value: float) -> Array:
    out = p.copy()
    out[i] = value
    return out
