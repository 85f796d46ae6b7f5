"""A start for models without a level to start from, such as ATM2: search few numbers, solve the rest.

Everything that the force is linear in is solved by least squares along the measured motion: the coefficients, and for
every phase its two quadratures, freely and run by run. Only frequencies, speeds and places are searched (differential
evolution). The coefficients that belong to one parameter are then tied, and refinement goes on from there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from frictrack.fit.crowd import Balance, Misfit
from frictrack.fit.force import chains_of
from frictrack.fit.papers import bounds_of, misfit_of
from frictrack.fit.problem import Problem
from frictrack.fit.solve import Solution, refine, settle_scatter
from frictrack.models import Model
from frictrack.records import Array, Run
from frictrack.search import minimise

BUDGET = 12_000
TRIES = 8  # starts that are refined
RIDGE = 1e-9  # of the mean square of the columns, where two of them are alike
Term = tuple[str, str, str | None, int]  # effect, coefficient, phase (None: the part without), quadrature


def starts_alone(model: Model) -> bool:
    """Whether something in the model is linear without a scan: a level from which scans can go on."""
    return any(all(p.fixed is not None for p in e.nonlinear) for e in model.effects)


def solve_relaxed(problem: Problem, runs: Sequence[Run], rng: np.random.Generator) -> Solution:
    """Fit a model from scratch by the reduced search and refinement."""
    relaxed = _Relaxed(misfit_of(problem, chains_of(runs, problem.pieces)))
    box = bounds_of(relaxed.misfit)[relaxed.searched]
    found = minimise(relaxed, box, method="de", rng=rng, max_evaluations=BUDGET)
    starts = [relaxed.tied(point) for point in relaxed.exchanged(found.x)]
    nearest = sorted(starts, key=lambda p: float(relaxed.misfit(p[None, relaxed.misfit.searched])[0]))
    law = min((_refined(problem, p) for p in nearest[:TRIES]), key=lambda s: s.objective)
    return settle_scatter(problem, law.p, law.starts)


def _refined(problem: Problem, p: Array) -> Solution:
    return refine(problem, p, problem.first_starts())


@dataclass(frozen=True)
class _Block:
    """What the force along one piece is linear in, for a population: columns (P, n, K) of the terms."""

    terms: list[Term]
    columns: Array


class _Relaxed:
    """Misfit of a population of the searched numbers (P, d), everything linear solved run by run."""

    def __init__(self, misfit: Misfit) -> None:
        self.misfit = misfit
        effects = {e.name: e for e in misfit.layout.model.effects}
        slots = [misfit.layout.slots[i] for i in misfit.searched]
        roles = [effects[s.effect].parameter(s.parameter).role for s in slots]
        self.searched = [j for j, s in enumerate(slots) if not s.linear and roles[j] != "phase"]
        self._phases = [(j, slots[j]) for j, role in enumerate(roles) if role == "phase"]

    def __call__(self, points: Array) -> Array:
        """Misfits (P,)."""
        total = np.zeros(len(points))
        for run in {b.piece.run for b in self.misfit.balances}:
            r, moved, _ = self._run(run, points)
            c = _least_squares(moved, r)
            total += np.sum((r + np.einsum("pmk,pk->pm", moved, c)) ** 2, axis=1)
        return total

    def _run(self, run: int, points: Array) -> tuple[Array, Array, list[Term]]:
        """Residual without friction (M,), its change per unit of every term (P, M, K), and the terms of one run."""
        balances = [b for b in self.misfit.balances if b.piece.run == run]
        blocks = [self._block(b, points) for b in balances]
        moved = [
            np.stack([b.moved(column) for column in block.columns.transpose(2, 0, 1)], axis=2)
            for b, block in zip(balances, blocks, strict=True)
        ]
        return np.concatenate([b.base for b in balances]), np.concatenate(moved, axis=1), blocks[0].terms

    def _block(self, balance: Balance, points: Array) -> _Block:
        run = balance.piece.run
        whole = np.zeros((len(points), len(self.misfit.searched)))
        whole[:, self.searched] = points
        names, rest = self._columns(balance, whole)
        base = rest
        terms: list[Term] = []
        columns = []
        for j, slot in (pair for pair in self._phases if pair[1].run in (None, run)):
            half, quarter = (self._columns(balance, _with(whole, j, angle))[1] for angle in (np.pi, np.pi / 2))
            waves = (base - half) / 2, quarter - (base + half) / 2
            rest = rest - waves[0]
            own = [k for k, (effect, _) in enumerate(names) if effect == slot.effect and np.any(waves[0][:, :, k])]
            for quadrature, wave in enumerate(waves):
                terms += [(*names[k], slot.parameter, quadrature) for k in own]
                columns += [wave[:, :, k] for k in own]
        scale = np.max(np.abs(base), axis=(0, 1))
        plain = [k for k in range(len(names)) if np.max(np.abs(rest[:, :, k])) > 1e-9 * scale[k]]
        terms += [(*names[k], None, 0) for k in plain]
        columns += [rest[:, :, k] for k in plain]
        return _Block(terms, np.stack(columns, axis=2))

    def _columns(self, balance: Balance, whole: Array) -> tuple[list[tuple[str, str]], Array]:
        """Names and columns (P, n, C) of all coefficients of force."""
        path, values = self.misfit.end_to_end(balance, whole)
        made = self.misfit.layout.model.force_columns(path, values)
        effects = [e for e in self.misfit.layout.model.effects if e.name in made]
        names = [(e.name, q.name) for e in effects for q in e.linear]
        return names, np.concatenate([made[e.name] for e in effects], axis=1).reshape(len(whole), -1, len(names))

    def exchanged(self, point: Array) -> list[Array]:
        """The point with like numbers (those of one scan) in every order: free quadratures may mistake their places."""
        layout = self.misfit.layout
        effects = {e.name: e for e in layout.model.effects}
        slots = [layout.slots[self.misfit.searched[j]] for j in self.searched]
        scans = [effects[s.effect].parameter(s.parameter).scan for s in slots]
        out = [point]
        for scan in dict.fromkeys(s for s in scans if s is not None):
            like = [k for k, s in enumerate(scans) if s is scan]
            out = [_put(q, like, order) for q in out for order in permutations(q[like])]
        return out

    def tied(self, point: Array) -> Array:
        """All unknowns (P,) from the searched ones: one coefficient per parameter, phases from the quadratures."""
        layout = self.misfit.layout
        p = np.array([1.0 if s.effect == "level" else 0.0 for s in layout.slots])
        p[[self.misfit.searched[j] for j in self.searched]] = point
        sizes: dict[tuple[str, str], list[float]] = {}
        for run in {b.piece.run for b in self.misfit.balances}:
            r, moved, terms = self._run(run, point[None])
            c = dict(zip(terms, _least_squares(moved, r)[0], strict=True))
            for (effect, coefficient, phase, quadrature), value in c.items():
                if phase is None:
                    sizes.setdefault((effect, coefficient), []).append(value)
                elif quadrature == 0:
                    sine = c[effect, coefficient, phase, 1]
                    sizes.setdefault((effect, coefficient), []).append(float(np.hypot(value, sine)))
                    own = [i for i, s in enumerate(layout.slots) if (s.effect, s.parameter) == (effect, phase)]
                    p[[i for i in own if layout.slots[i].run in (None, run)]] = np.arctan2(sine, value)
        for i, s in enumerate(layout.slots):
            if s.linear and (s.effect, s.parameter) in sizes:
                p[i] = float(np.mean(sizes[s.effect, s.parameter]))
        return p


def _put(point: Array, places: list[int], values: Sequence[float]) -> Array:
    out = point.copy()
    out[places] = values
    return out


def _with(points: Array, j: int, angle: float) -> Array:
    out = points.copy()
    out[:, j] = angle
    return out


def _least_squares(moved: Array, r: Array) -> Array:
    """Coefficients (P, K) that bring r (M,) plus columns (P, M, K) closest to zero."""
    gram = moved.transpose(0, 2, 1) @ moved
    size = np.maximum(np.sqrt(np.einsum("pkk->pk", gram)), 1e-30)
    unit = gram / size[:, :, None] / size[:, None, :] + RIDGE * np.eye(gram.shape[1])
    right = -np.einsum("pmk,m->pk", moved, r) / size
    out: Array = np.linalg.solve(unit, right[:, :, None])[:, :, 0] / size
    return out
