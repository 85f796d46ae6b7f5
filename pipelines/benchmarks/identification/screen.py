"""Select library effects that lower the error of a record on blocks that were not fitted.

Along the measured motion, in the authors' measure: the coefficients are solved by least squares, the non-linear numbers
scanned and refined. Effects with numbers of their own in every run are left out: another run could not be told.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from derivatives.signals import Array
from scipy.optimize import minimize, minimize_scalar

from frictrack import effects
from frictrack.effects import Effect, Span, models
from frictrack.effects.models import Model
from frictrack.fit.linearised import scan_points

from .emps import Record

BLOCKS = 8  # of the record, held out in turn
MAX_ERROR_RATIO = 0.98  # of the held-out error before, that an effect must reach to be taken
MAX_EFFECTS = 4  # effects at most
DELAY_RANGE_S = (-2e-3, 2e-3)  # s, within which the drive's clock is looked for
BRENT_OPTIONS = {"xatol": 1e-6}
MAX_REFINEMENTS = 60  # evaluations of the refinement of non-linear numbers


@dataclass(frozen=True)
class Law:
    """Effects by name, each with its non-linear numbers; a swing with a phase stands twice, a quarter turn apart."""

    numbers: Mapping[str, Mapping[str, float]]

    @property
    def model(self) -> Model:
        """The sum of the effects."""
        return models.of(list(self.numbers))

    @property
    def words(self) -> str:
        """The effects, each once."""
        return ", ".join(dict.fromkeys(name.split(":")[0] for name in self.numbers))

    def columns(self, record: Record) -> Array:
        """Decimated columns (m, 1 + k) of the law."""
        return record.columns(self.model, {name: dict(own) for name, own in self.numbers.items()})

    def plus(self, effect: Effect, numbers: Mapping[str, float]) -> Law:
        """The law with one more effect."""
        phases = [p.name for p in effect.nonlinear if p.role == "phase"]
        quarters = [{p: turn for p in phases} for turn in (0.0, np.pi / 2)] if phases else [{}]
        names = [effect.name, f"{effect.name}:2"]
        more = {name: dict(numbers) | quarter for name, quarter in zip(names, quarters, strict=False)}
        return replace(self, numbers={**self.numbers, **more})


def candidates(law: Law) -> list[Effect]:
    """Effects that the law lacks and that one run can tell another."""
    return [
        e
        for e in effects.LIBRARY.values()
        if e.acts_on == "force"
        and e.name not in law.numbers
        and not e.needs  # the drive is what is told, and nothing else was measured
        and not e.replaces
        and not any(p.per_run or p.role == "depth" for p in e.parameters)
    ]


def without(record: Record, columns: Array) -> tuple[Array, Array]:
    """Squared misfit with every block left out of the fit: over the fitted frames and over the block, each (8,)."""
    rows = np.column_stack([columns, record.force])
    parts = [part.T @ part for part in np.array_split(rows, BLOCKS)]
    kept, left = np.empty(BLOCKS), np.empty(BLOCKS)
    for i, part in enumerate(parts):
        gram = np.sum(parts, axis=0) - part
        found = np.append(-np.linalg.lstsq(gram[:-1, :-1], gram[:-1, -1], rcond=None)[0], 1.0)
        kept[i], left[i] = found @ gram @ found, found @ part @ found
    return kept, left


def relative(record: Record, squares: Array) -> float:
    """Relative force error, percent, of summed squares."""
    return float(100 * np.sqrt(np.sum(squares)) / np.linalg.norm(record.force))


@dataclass(frozen=True)
class Trial:
    """An effect on trial beside a law, with its columns at every point of its scan."""

    record: Record
    law: Law
    effect: Effect
    points: list[dict[str, float]]
    columns: list[Array]

    def judged(self) -> float:
        """Held-out error, percent: every block is told by the point that suits the others best."""
        kept, left = (np.array(each) for each in zip(*(without(self.record, c) for c in self.columns), strict=True))
        return relative(self.record, left[np.argmin(kept, axis=0), np.arange(BLOCKS)])

    def settled(self) -> Law:
        """The law with the effect where it suits the whole record best, refined off the grid."""
        start = self.points[int(np.argmin([self._misfit(c) for c in self.columns]))]
        free = [p.name for p in self.effect.nonlinear if p.scan is not None and p.fixed is None]
        if not free:
            return self.law.plus(self.effect, start)
        sizes = np.array([max(abs(start[n]), 1e-9) for n in free])

        def at(p: Array) -> Law:
            return self.law.plus(self.effect, start | dict(zip(free, map(float, p * sizes), strict=True)))

        first = np.sign([start[n] for n in free]) + np.vstack([np.zeros(len(free)), 0.1 * np.eye(len(free))])
        options = {"maxfev": MAX_REFINEMENTS, "initial_simplex": first}
        best = minimize(
            lambda p: self._misfit(at(p).columns(self.record)), first[0], method="Nelder-Mead", options=options
        )
        return at(best.x)

    def _misfit(self, columns: Array) -> float:
        found = np.linalg.lstsq(columns, self.record.force, rcond=None)[0]
        return float(np.sum((self.record.force - columns @ found) ** 2))


def tried(record: Record, law: Law, effect: Effect) -> Trial:
    """An effect on trial over its whole scan."""
    points = [dict(p) for p in scan_points(effect, span_of(record))]
    base = law.columns(record)

    def columns_at(point: dict[str, float]) -> Array:
        more = law.plus(effect, point)
        if effect.modifies:
            return more.columns(record)
        made = [effect.columns(record.path, own) for name, own in more.numbers.items() if name not in law.numbers]
        return np.column_stack([base, record.decimated(np.concatenate(made, axis=1))])

    return Trial(record, law, effect, points, [columns_at(p) for p in points])


def span_of(record: Record) -> Span:
    """How far the record reaches."""
    x, v, _ = record.motion
    moving = np.abs(v) > 0.01 * np.abs(v).max()
    slowest, fastest = float(np.abs(v[moving]).min()), float(np.abs(v).max())
    return Span(float(record.t[-1]), float(x.min()), float(x.max()), slowest, fastest, record.rate)


def timed(record: Record, law: Law) -> Record:
    """The record with the lateness of its drive that suits a law best."""

    def misfit(late: float) -> float:
        shifted = replace(record, late=late)
        return relative(shifted, without(shifted, law.columns(shifted))[0])

    return replace(
        record, late=float(minimize_scalar(misfit, bounds=DELAY_RANGE_S, method="bounded", options=BRENT_OPTIONS).x)
    )


def grown(record: Record, law: Law, say: Callable[[str], None]) -> Iterator[tuple[Law, Record, dict[str, Any]]]:
    """Laws with one effect more each, the drive's clock with each, as long as the held-out error falls.

    With the record as it was timed and the held-out errors of every candidate.
    """
    record = timed(record, law)
    error = relative(record, without(record, law.columns(record))[1])
    yield law, record, {"heldout": error, "tried": {}}
    for _ in range(MAX_EFFECTS):
        trials = {e.name: tried(record, law, e) for e in candidates(law)}
        errors = {name: trial.judged() for name, trial in trials.items()}
        say(f"  with {law.words} ({error:.3f} %): " + ", ".join(f"{n} {e:.3f}" for n, e in errors.items()))
        name = min(errors, key=errors.__getitem__)
        if errors[name] > MAX_ERROR_RATIO * error:
            return
        law = trials[name].settled()
        record = timed(record, law)
        error = relative(record, without(record, law.columns(record))[1])
        yield law, record, {"heldout": error, "tried": errors}


def in_one(law: Law, record: Record) -> dict[str, Mapping[str, float]]:
    """The law's effects and numbers with every swing in one, at the phase that its two quarters have."""
    model = law.model
    found = np.linalg.lstsq(law.columns(record), record.force, rcond=None)[0][1:]
    width = np.cumsum([0, *(len(e.linear) for e in model.effects)])
    of = {e.name: found[a:b] for e, a, b in zip(model.effects, width[:-1], width[1:], strict=True)}
    out: dict[str, Mapping[str, float]] = {}
    for name, own in law.numbers.items():
        twin = of.get(f"{name}:2")
        phases = [p.name for p in effects.get(name).nonlinear if p.role == "phase"]
        if ":" not in name:
            out[name] = own if twin is None else {**own, phases[0]: float(np.arctan2(twin[0], of[name][0]))}
    return out
