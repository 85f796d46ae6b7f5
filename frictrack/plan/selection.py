"""Which runs to film: one after the other, each the one after which fewest pairs of effects are left."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.stats import chi2

from frictrack.diagnose.detection_limits import noncentrality
from frictrack.diagnose.hypothesis_tests import ALPHA
from frictrack.effects import Span
from frictrack.plan.causes import Cause, library
from frictrack.plan.experiment_setup import Entry, Stand, menu
from frictrack.plan.normal_matrices import Reduced, nothing, rival, total
from frictrack.plan.traces import Filmed, amplitude, film_all, trace
from frictrack.records import Array
from frictrack.threads import one_thread

PARTED = 10.0  # expected chi-squared from which two effects are told apart
MOST = 8  # runs
LITTLE = 0.5  # of a pair that a run must bring nearer where it parts none
FORMS = 1000  # independent forms that a search of the library looks at, about
FREEDOM = 2  # coefficients of a form
SHAKE = "camera_shake"

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Tables:
    """Every run of the menu against every cause: `rivals[run][cause]`; `alone[run]` against nothing.

    `shown` (R, D) is chi-squared of each trace before anything explains it, for a mark at rest in the picture.
    """

    runs: list[Filmed]
    causes: list[Cause]
    sizes: Array
    alone: list[Reduced]
    rivals: list[list[Reduced]]
    shown: Array

    @property
    def names(self) -> list[str]:
        """The causes in order."""
        return [c.effect.name for c in self.causes]

    def evidence(self, chosen: list[int], *, reference: bool) -> Array:
        """Expected chi-squared by which cause a (row) is told from cause b (column), nothing (last): (D, D + 1)."""
        d = len(self.causes)
        if not chosen:
            return np.zeros((d, d + 1))
        left = [total([self.rivals[r][b] for r in chosen]).left() for b in range(d)]
        bare = total([self.alone[r] for r in chosen]).left()
        out = np.column_stack([*left, bare])
        if reference and SHAKE in self.names:
            k = self.names.index(SHAKE)
            out[k] += self.shown[chosen, k].sum()
            out[:, k] = np.where(np.arange(d) == k, out[:, k], bare)
        out[np.arange(d), np.arange(d)] = np.inf
        return np.maximum(out, 0.0)


@dataclass(frozen=True)
class Step:
    """One choice: the run, and what is told apart once it is filmed."""

    entry: Entry | None  # None: the reference
    evidence: Array
    parted: list[tuple[str, str]]
    shown: list[str]  # effects that are seen from here on
    left: int


@dataclass(frozen=True)
class Chosen:
    """The runs in the order in which they should be filmed, and what they were chosen from."""

    stand: Stand
    tables: Tables
    steps: list[Step]
    left_out: dict[str, str]
    before: int  # pairs that are open before the first of them

    @property
    def evidence(self) -> Array:
        """What is told apart with all of them, (D, D + 1)."""
        return self.steps[-1].evidence if self.steps else self.tables.evidence([], reference=False)

    @property
    def runs(self) -> list[Filmed]:
        """The runs that were done already and those that were chosen."""
        keys = {e.key for e in self.stand.done} | {s.entry.key for s in self.steps if s.entry}
        return [r for r in self.tables.runs if r.entry.key in keys]


def tabled(stand: Stand, tell: Progress) -> tuple[Tables, dict[str, str]]:
    """Every run of the menu filmed under the assumed law, and reduced against every cause of the library."""
    runs = film_all(stand, [*stand.done, *menu(stand)])
    causes, left_out = library(stand.law, _span(stand, runs))
    sizes = np.array([amplitude(runs, c) for c in causes])
    alone, rivals, shown = [], [], []
    for number, run in enumerate(runs):
        tell(number, len(runs), f"filming {run.entry.key} on paper")
        traces = np.column_stack([trace(run, c, s, number) for c, s in zip(causes, sizes, strict=True)])
        alone.append(nothing(run, traces, stand.scatter))
        rivals.append([rival(run, c, traces, stand.scatter) for c in causes])
        shown.append(np.sum(traces**2, axis=0))
    return Tables(runs, causes, sizes, alone, rivals, np.array(shown)), left_out


def _span(stand: Stand, runs: list[Filmed]) -> Span:
    speeds = np.concatenate([np.abs(r.piece.v_hat) for r in runs])
    return Span(
        duration=max(float(r.piece.t[-1]) for r in runs),
        x_min=stand.start,
        x_max=stand.start + stand.course,
        v_min=float(speeds.min()),
        v_max=float(speeds.max()),
        fps=stand.fps,
    )


@one_thread()
def choose(stand: Stand, tell: Progress = lambda done, total, what: None) -> Chosen:
    """Greedy choice from the menu until no pair is left, nothing helps, or there are `MOST` runs."""
    tables, left_out = tabled(stand, tell)
    done = {e.key for e in stand.done}
    chosen = [i for i, r in enumerate(tables.runs) if r.entry.key in done]
    rest = [i for i in range(len(tables.runs)) if i not in chosen]
    reference = False
    evidence = tables.evidence(chosen, reference=False)
    before = len(_open(evidence))
    steps: list[Step] = []
    while len(steps) < MOST and _score(evidence)[0]:
        tell(len(steps), MOST, "choosing runs")
        offers = [(i, tables.evidence([*chosen, i], reference=reference)) for i in rest]
        if chosen and not reference:
            offers.append((-1, tables.evidence(chosen, reference=True)))
        best, found = min(offers, key=lambda o: _score(o[1]))
        if _score(found)[0] >= _score(evidence)[0] and _score(found)[1] > _score(evidence)[1] - LITTLE:
            break
        new = sorted(_open(evidence) - _open(found))
        names = tables.names
        entry = tables.runs[best].entry if best >= 0 else None
        shown = [names[k] for k in sorted(_unseen(evidence) - _unseen(found))]
        steps.append(Step(entry, found, [(names[a], names[b]) for a, b in new], shown, len(_open(found))))
        evidence, reference = found, reference or best < 0
        if best >= 0:
            chosen.append(best)
            rest.remove(best)
    while steps and not steps[-1].parted and not steps[-1].shown:  # it only came near
        steps.pop()
    tell(MOST, MOST, "planned")
    return Chosen(stand, tables, steps, left_out, before)


def _open(evidence: Array) -> set[tuple[int, int]]:
    """Pairs of causes that are not told apart, whichever of the two is true."""
    square = np.minimum(evidence[:, :-1], evidence[:, :-1].T)
    return {(int(a), int(b)) for a, b in np.argwhere(square < PARTED) if a < b}


def _unseen(evidence: Array) -> set[int]:
    """Causes that are not seen at all."""
    return {int(k) for k in np.flatnonzero(evidence[:, -1] < threshold())}


@cache
def threshold() -> float:
    """Expected rise of chi-squared that is called missing in 95 of 100 repeats, for a search of the whole library."""
    return noncentrality(float(chi2.isf(ALPHA / 2 / FORMS, FREEDOM)), FREEDOM)


def _score(evidence: Array) -> tuple[int, float]:
    """Pairs left and causes unseen, and how far these are from being parted and seen."""
    square = np.minimum(evidence[:, :-1], evidence[:, :-1].T)
    short = np.maximum(PARTED - square, 0.0) / PARTED
    dark = np.maximum(threshold() - evidence[:, -1], 0.0) / threshold()
    return len(_open(evidence)) + len(_unseen(evidence)), float(np.sum(np.triu(short, 1)) + np.sum(dark))


def pairs(evidence: Array) -> Iterator[tuple[int, int]]:
    """Pairs of causes that are left, in order."""
    yield from sorted(_open(evidence))
