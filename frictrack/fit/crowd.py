"""The misfit of a whole population of laws at once, each evaluated along the measured motion.

Along a given motion the modelled displacement is linear in the force, so what is compared is one matrix product:
the force of every individual, expanded in cosines as far as the chain lets them pass, times their response.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.fft import dct
from scipy.interpolate import CubicSpline

from frictrack.effects import Path
from frictrack.fit.force import Chain
from frictrack.fit.layout import LEVEL, Layout
from frictrack.fit.problem import Piece
from frictrack.fit.rules import follow
from frictrack.fit.scatter import prior_misfit
from frictrack.records import Array

PASSED = 3.2  # times the cut-off: beyond, the chain leaves less than a thousandth
VISIBLE = 2.0  # times the cut-off: beyond, it leaves less than a sixtieth, too little to look for
Forward = Callable[[Array], Array]  # displacements (n, k) to whitened residuals (m, k)


@dataclass(frozen=True)
class Balance:
    """One piece as a search sees it: residual = base + response (cosines of the force) - picture (shift).

    `path` at the frames; `cosines` (n, k); `response` (k, k); `base` (k,); `rest` is the part of the squared residual
    that no force along the path changes.
    """

    piece: Piece
    path: Path
    cosines: Array
    response: Array
    base: Array
    rest: float
    picture: Callable[[Array], Array]  # shifts (P, n) to (P, k)
    highest: float = np.inf  # frequency that is looked for, Hz

    def moved(self, force: Array) -> Array:
        """Change of the residual (P, k) by forces (P, n)."""
        out: Array = (force @ self.cosines) @ self.response.T
        return out


def force_balance(piece: Piece, chain: Chain, noise: float) -> Balance:
    """Accelerations compared through the chain, in units of `noise`."""
    n = len(piece.t)
    wide = 2 * (piece.t[-1] - piece.t[0]) * PASSED * chain.cutoff
    balance = _balance(piece, lambda x: chain.apply(x) / noise, min(n, int(wide) + 8))
    return replace(balance, highest=VISIBLE * chain.cutoff)


def displacement_balance(piece: Piece) -> Balance:
    """Displacements compared, start position and speed removed."""
    q, _ = np.linalg.qr(np.column_stack([np.ones_like(piece.t), piece.t]) / piece.sigma[:, None])

    def forward(x: Array) -> Array:
        white = x / piece.sigma[:, None]
        clean: Array = white - q @ (q.T @ white)
        return clean

    return _balance(piece, forward, len(piece.t))


def _balance(piece: Piece, forward: Forward, k: int) -> Balance:
    nodes, t = piece.panels.t, piece.t
    cosines = dct(np.eye(len(t)), norm="ortho", axis=0)[:k].T
    known = np.interp(t, nodes, piece.known)
    twice = CubicSpline(t, np.column_stack([cosines, known])).antiderivative(2)(t)
    basis, response = np.linalg.qr(forward(twice[:, :k] / piece.mass))
    measured = forward((piece.y - twice[:, k])[:, None])[:, 0]
    base = basis.T @ measured
    path = piece.at_frames(CubicSpline(nodes, piece.x_hat)(t), CubicSpline(nodes, piece.v_hat)(t), 1.0)
    return Balance(
        piece=piece,
        path=replace(path, drive=None if piece.path.drive is None else np.interp(t, nodes, piece.path.drive)),
        cosines=cosines,
        response=response,
        base=base,
        rest=max(float(measured @ measured - base @ base), 0.0),
        picture=lambda shift: forward(shift.T).T @ basis,
    )


@dataclass(frozen=True)
class Forces:
    """Force of every individual along one piece: what follows the friction level, and the rest, N; the shift, m."""

    dry: Array  # (P, n)
    other: Array
    shift: Array | None


class Misfit:
    """Squared misfit of a population of laws. Called with points (P, d), the searched unknowns; returns (P,).

    The levels of several runs are not searched: each is the one of least squares, held about one to within `tau`.
    `unit` turns whitened squares into the unit in which the misfit is quoted.
    """

    def __init__(self, layout: Layout, balances: Sequence[Balance], *, tau: float = 0.03, unit: float = 1.0) -> None:
        self.layout, self.balances, self.tau, self.unit = layout, list(balances), tau, unit
        runs = {None, *(b.piece.run for b in self.balances)}
        self.searched = [i for i, s in enumerate(layout.slots) if s.effect != LEVEL and s.run in runs]
        self._pictured = any(e.acts_on == "measurement" for e in layout.model.effects)

    def __call__(self, points: Array) -> Array:
        """Misfits (P,)."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self.evaluate(points)[0]

    def evaluate(self, points: Array) -> tuple[Array, Array]:
        """Misfits (P,) and the levels that go with them, (P, runs)."""
        total = np.full(len(points), sum(b.rest for b in self.balances))
        levels = np.ones((len(points), len(self.layout.run_names)))
        for run in {b.piece.run for b in self.balances}:
            r, dry = self._residual(run, points)
            if self.layout.levels:
                d = -np.sum(dry * r, axis=1) / (np.sum(dry**2, axis=1) + self.tau**-2)
                r = r + d[:, None] * dry
                levels[:, run] += d
                total += (d / self.tau) ** 2
            total += np.sum(r**2, axis=1)
        if self.layout.priors:
            whole = np.ones((len(points), len(self.layout.slots)))
            whole[:, self.searched] = points
            total += prior_misfit(self.layout, whole)
        return total * self.unit, levels

    def _residual(self, run: int, points: Array) -> tuple[Array, Array]:
        """Residual of one run at level one and its change per unit of level, (P, K) each."""
        residuals, dries = [], []
        for b in (b for b in self.balances if b.piece.run == run):
            force = self.forces(b, points)
            dry = b.moved(force.dry)
            r = b.base + dry + b.moved(force.other)
            residuals.append(r if force.shift is None else r - b.picture(force.shift))
            dries.append(dry)
        return np.concatenate(residuals, axis=1), np.concatenate(dries, axis=1)

    def forces(self, balance: Balance, points: Array) -> Forces:
        """Forces along one piece, all individuals end to end on one long path."""
        n, p = len(balance.path.t), len(points)
        path, values = self.end_to_end(balance, points)
        model = self.layout.model
        dry, other = np.zeros(n * p), np.zeros(n * p)
        columns = model.force_columns(path, values)
        for effect in (e for e in model.effects if e.name in columns):
            for parameter, column in zip(effect.linear, columns[effect.name].T, strict=True):
                into = dry if parameter.loaded else other
                into += column * values[effect.name][parameter.name]
        shift = self._shift(path, values) if self._pictured else None
        shape = (p, n)
        return Forces(dry.reshape(shape), other.reshape(shape), None if shift is None else shift.reshape(shape))

    def _shift(self, path: Path, values: dict[str, dict[str, Any]]) -> Array:
        model = self.layout.model
        shift = np.zeros(len(path.t))
        for name, block in model.measurement_columns(path, values).items():
            effect = next(e for e in model.effects if e.name == name)
            for parameter, column in zip(effect.linear, block.T, strict=True):
                shift += column * values[name][parameter.name]
        return shift

    def end_to_end(self, balance: Balance, points: Array) -> tuple[Path, dict[str, dict[str, Any]]]:
        """One path through all individuals, and the parameter values along it."""
        path, p = balance.path, len(points)
        n = len(path.t)
        long: dict[str, Any] = {name: np.tile(getattr(path, name), p) for name in ("t", "x", "v", "s")}
        drive = None if path.drive is None else np.tile(path.drive, p)
        values: dict[str, dict[str, Any]] = {e.name: {} for e in self.layout.model.effects}
        for (effect, name), value in self.layout.fixed.items():
            values[effect][name] = np.full(n * p, value)
        active = set(self.layout.active(balance.piece.run))
        roles = {(e.name, q.name): q.role for e in self.layout.model.effects for q in e.parameters}
        for column, i in zip(points.T, self.searched, strict=True):
            slot = self.layout.slots[i]
            if i in active:
                each = np.repeat(column, n)
                # a depth multiplies whole columns (n, k), everything else acts frame by frame
                deep = roles[slot.effect, slot.parameter] == "depth"
                values[slot.effect][slot.parameter] = each[:, None] if deep else each
        follow(self.layout.model, self.layout.rules, values)
        return replace(path, drive=drive, **long), values
