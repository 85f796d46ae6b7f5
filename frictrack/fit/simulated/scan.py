"""Scans of an effect that the model does not have: what each of its forms would gain on top of the fitted law.

The columns of a candidate are the response of the simulated motion to its force (or its shift of the picture),
with the fitted law's own feedback. Phases enter as two quadratures with free coefficients; a modifier as what it
changes at depth one. Gains are the fall of chi-squared after the whole linearised model has been fitted again
(Golub & Pereyra 1973), friction levels held by their scatter.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from frictrack.effects import Effect, Path, Span
from frictrack.effects.settings import Tie
from frictrack.errors import FrictrackError
from frictrack.fit.simulated.problem import Response
from frictrack.fit.simulated.solve import Solution
from frictrack.fit.unknowns.scatter import Basis
from frictrack.models import Model, Values
from frictrack.records import Array

ABSORBED = 1e-10  # share of a column's square that must remain beside the model for it to count
QUADRATURES = (0.0, np.pi / 2)


@dataclass(frozen=True)
class Family:
    """All forms of one effect on a grid of its scanned parameters.

    `columns[i]` (n_i, G k) whitened, of piece i; `run[i]` its run. Per-run coefficients have K = R k, else K = k.
    `gram` (G, K, K), `on_basis` (G, K, P').
    """

    effect: Effect
    grid: list[dict[str, float]]
    columns: list[Array]
    slices: list[slice]
    block: list[int]  # which block of K each piece writes to
    k: int
    gram: Array
    on_basis: Array

    def project(self, data: Array) -> Array:
        """Inner products with data (N, D), shape (G, K, D)."""
        size = self.gram.shape[1]
        out = np.zeros((len(self.grid), size, data.shape[1]))
        for c, rows, b in zip(self.columns, self.slices, self.block, strict=True):
            part = (c.T @ data[rows]).reshape(len(self.grid), self.k, -1)
            out[:, b * self.k : (b + 1) * self.k] += part
        return out

    def whitener(self, shrink: Array) -> Array:
        """W (G, K, K) with W' W the inverse of the Gram matrix beside the model; rows of absorbed forms vanish."""
        schur = self.gram - self.on_basis @ shrink @ self.on_basis.transpose(0, 2, 1)
        scale = np.sqrt(np.einsum("gkk->gk", self.gram))
        scale[scale == 0] = np.inf
        unit = schur / scale[:, :, None] / scale[:, None, :]
        w, v = np.linalg.eigh(unit)
        inverse_root = np.where(w > ABSORBED, 1 / np.sqrt(np.maximum(w, ABSORBED)), 0.0)
        return (v * inverse_root[:, None, :]).transpose(0, 2, 1) / scale[:, None, :]

    def gains(self, projected: Array, on_basis: Array, shrink: Array) -> Array:
        """Fall of chi-squared of every form for data with `projected` (G, K, D) and u' data (P', D): (G, D)."""
        beside = projected - self.on_basis @ (shrink @ on_basis)
        white = self.whitener(shrink) @ beside
        gained: Array = np.einsum("gkd,gkd->gd", white, white)
        return gained

    def coefficients(self, g: int, projected: Array, on_basis: Array, shrink: Array) -> Array:
        """Best coefficients of form g for one series, (K,)."""
        beside = projected[g, :, 0] - self.on_basis[g] @ (shrink @ on_basis[:, 0])
        w = self.whitener(shrink)[g]
        best: Array = w.T @ (w @ beside)
        return best


def families(solution: Solution, effect: Effect, basis: Basis) -> list[Family]:
    """The forms of one effect over the fitted runs: one family, or one per run when its scan is the run's own.

    Empty when the runs lack what the effect needs, see `Effect.lacks`.
    """
    pieces = solution.problem.pieces
    if effect.lacks([p.path for p in pieces]):
        return []
    if any(p.scan is not None and p.per_run for p in effect.nonlinear):
        runs = sorted({p.run for p in pieces})
        return [_family(solution, effect, basis, [i for i, p in enumerate(pieces) if p.run == r]) for r in runs]
    return [_family(solution, effect, basis, list(range(len(pieces))))]


def grid_of(effect: Effect, span: Span) -> list[dict[str, float]]:
    """Every combination of the scanned parameters, the rest at their place for a scan."""
    scanned = [p for p in effect.nonlinear if p.scan is not None and p.free]
    rest = {p.name: 1.0 if p.role == "depth" else p.fixed or 0.0 for p in effect.nonlinear if p not in scanned}
    axes = [p.scan(span) for p in scanned if p.scan is not None]
    names = [p.name for p in scanned]
    return [_followed(effect, rest | dict(zip(names, map(float, point), strict=True))) for point in product(*axes)]


def _followed(effect: Effect, point: dict[str, float]) -> dict[str, float]:
    """A point of a grid where a parameter may be tied to another one of the same effect."""
    for p in effect.nonlinear:
        if p.tie:
            tie = Tie.read(p.tie)
            point[p.name] = tie.factor * point.get(tie.parameter, 0.0)
    return point


def per_run_coefficients(effect: Effect) -> bool:
    """Whether the coefficients of the scan belong to the runs: per-run amplitudes, or per-run phases."""
    return any(p.per_run and (p.linear or p.role == "phase") for p in effect.parameters)


def _family(solution: Solution, effect: Effect, basis: Basis, members: list[int]) -> Family:
    layout = solution.problem.layout
    own_scan = any(p.scan is not None and p.per_run for p in effect.nonlinear)
    run = solution.responses[members[0]].piece.run
    grid = grid_of(effect, layout.spans[run] if own_scan else layout.span)
    starts = np.cumsum([0, *[len(r.r) for r in solution.responses]])
    columns = [_columns(solution, solution.responses[i], effect, grid) for i in members]
    slices = [slice(int(starts[i]), int(starts[i + 1])) for i in members]
    runs = sorted({solution.responses[i].piece.run for i in members})
    own = per_run_coefficients(effect)
    block = [runs.index(solution.responses[i].piece.run) if own else 0 for i in members]
    k = columns[0].shape[1] // len(grid)
    size = k * (len(runs) if own else 1)
    gram = np.zeros((len(grid), size, size))
    on_basis = np.zeros((len(grid), size, basis.u.shape[1]))
    for c, rows, b in zip(columns, slices, block, strict=True):
        cube = c.reshape(len(c), len(grid), k).transpose(1, 2, 0)
        at = slice(b * k, (b + 1) * k)
        gram[:, at, at] += cube @ cube.transpose(0, 2, 1)
        on_basis[:, at] += (c.T @ basis.u[rows]).reshape(len(grid), k, -1)
    return Family(effect, grid, columns, slices, block, k, gram, on_basis)


def _columns(solution: Solution, response: Response, effect: Effect, grid: list[dict[str, float]]) -> Array:
    """Whitened columns of every form on one piece, start removed, (n, G k)."""
    problem, piece = solution.problem, response.piece
    values, level = problem.layout.values(solution.p, piece.run)
    motion = response.motion
    forms = [point | phase for point in grid for phase in _phases(effect)]
    if effect.acts_on == "measurement":
        path = piece.at_frames(motion.x_edge[piece.at], motion.v_edge[piece.at], level)
        moved = np.concatenate([_formed(effect, path, form) for form in forms], axis=1)
    else:
        path = piece.along(motion.x, motion.v, level)
        if effect.modifies:
            inner = _modified(problem.model, effect, path, values)
            made = [effect.columns(path, form, inner) - (inner if effect.sized else 0.0) for form in forms]
        else:
            made = [_formed(effect, path, form) for form in forms]
        g = -np.concatenate(made, axis=1) / piece.mass
        _, edges = response.linear.respond(g, np.zeros((2, g.shape[1])))
        moved = (1 + response.shift_slope)[:, None] * edges[piece.at, 0]
    weighted = moved / piece.sigma[:, None]
    clean: Array = weighted - response.q @ (response.q.T @ weighted)
    return clean


def _formed(effect: Effect, path: Path, form: dict[str, float]) -> Array:
    """Columns of one form; nothing where a user's formula is no number, such as a width of zero."""
    if effect.formula is None:
        return effect.columns(path, form)
    try:
        return effect.columns(path, form)
    except FrictrackError:
        return np.zeros((len(path.t), len(effect.linear)))


def _phases(effect: Effect) -> list[dict[str, float]]:
    names = [p.name for p in effect.nonlinear if p.role == "phase" and p.free]
    return [{n: q for n in names} for q in QUADRATURES] if names else [{}]


def _modified(model: Model, effect: Effect, path: Path, values: Values) -> Array:
    """What a modifier reshapes: the force that is there (n, 1), or for one without a size its columns (n, k).

    A delay has no size to grow with a coefficient: the columns that it makes of the others' have each their own.
    """
    columns = model.force_columns(path, values)
    reshaped = [e.name for e in model.effects if e.kind in effect.modifies and e.name in columns]
    if not effect.sized:
        return np.concatenate([columns[name] for name in reshaped], axis=1)
    force: Array = np.sum([columns[name] @ model.coefficients(name, values) for name in reshaped], axis=0)
    return force[:, None]
