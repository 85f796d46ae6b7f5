"""What a fitted law leaves, in few numbers: forces along the runs and the trace that each would leave beside the law.

A force moves the mass, and integrated twice its fine detail is below the camera's noise. So every piece is described
by the answers of its motion to a few splines in time, made orthonormal: the noise stays white, a run of a thousand
frames becomes a hundred numbers, and a trial force costs one small product. The law's own columns, friction levels
held by their scatter, are taken out of all of it at once (Golub & Pereyra 1973).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import BSpline

from frictrack.effects import Path
from frictrack.fit.least_squares import PieceResponse, Solution
from frictrack.fit.parameters import jacobian_basis, prior_jacobian
from frictrack.fit.segments import Rows
from frictrack.records import Array

MAX_COMPONENTS = 800  # numbers over all pieces, about
MIN_COMPONENTS_PER_PIECE = 4  # per piece
POINTS_PER_SPLINE = 3  # places per spline at which a force is read
SPLINE_DEGREE = 3

Force = Callable[[Path], Array]  # along one piece (n,): columns (n, k), N


@dataclass(frozen=True)
class CompressedResidual:
    """The residual (M,) beside the law, and for every piece how a force at its points becomes such numbers.

    `paths` and `maps` (m_i, n_i) by piece; `rows` its points among its frames, `shifts` (m_i, frames) the same for a
    shift of the picture, m, `curves` (frames, m_i) the displacements, m, that are one such number each; `runs` its run;
    `taken` (M, P) and `share` (P,) take the law out.
    """

    paths: list[Path]
    maps: list[Array]
    rows: list[Rows]
    shifts: list[Array]
    curves: list[Array]
    runs: list[int]
    taken: Array
    share: Array
    left: Array
    n_frames: int
    excess: float  # chi-squared above its expectation
    blur: float = 0.0  # share of its square that the law's own force leaves of itself, told in so few numbers

    def beside(self, rows: Array) -> Array:
        """Numbers (M, k) with what the law takes of them taken out."""
        return np.asarray(rows - self.taken @ (self.share[:, None] * (self.taken.T @ rows)))

    def trace(self, columns: Sequence[Array]) -> Array:
        """What forces (n_i, k) along every piece leave beside the law, (M, k)."""
        return self.beside(np.concatenate([m @ c for m, c in zip(self.maps, columns, strict=True)]))

    def gathered(self, of: Callable[[Path], Array]) -> Array:
        """A series along all pieces, end to end."""
        return np.concatenate([of(path) for path in self.paths])

    def cut(self, columns: Array) -> list[Array]:
        """The opposite: columns (N, k) along all pieces, piece by piece."""
        return np.split(columns, np.cumsum([len(p.t) for p in self.paths])[:-1])


def compress_residual(solution: Solution, without: str = "") -> CompressedResidual:
    """The residual of a fitted law in few numbers; `without` names an effect whose force counts as residual."""
    responses, layout = solution.responses, solution.problem.layout
    each = max(MAX_COMPONENTS // len(responses), MIN_COMPONENTS_PER_PIECE)
    parts = [_reduced(solution, r, each) for r in responses]
    jac, data = solution.jac, solution.random_effect_data()
    own = np.array([slot.effect == without for slot in layout.slots])
    data = data + jac[:, own] @ np.where([s.linear for s in layout.slots], solution.p, 0.0)[own]
    known = np.array(prior_jacobian(layout, solution.p))
    jac[:, own], known[:, own] = 0.0, 0.0
    basis = jacobian_basis(jac, layout.levels, known)
    starts = np.cumsum([0, *(len(r.r) for r in responses)])
    on_law = []
    left = []
    for (q, *_), a, b in zip(parts, starts[:-1], starts[1:], strict=True):
        left.append(q.T @ data[a:b])
        on_law.append(q.T @ basis.u[a:b])
    taken, share = _root(np.concatenate(on_law), basis.shrink(solution.tau))
    on_basis = basis.u.T @ data
    chi2 = float(data @ data - on_basis @ basis.shrink(solution.tau) @ on_basis)
    free = len(data) - 2 * len(responses) - basis.u.shape[1]
    whole = np.concatenate(left)
    found = CompressedResidual(
        paths=[path for _, path, *_ in parts],
        maps=[m for _, _, m, _ in parts],
        rows=[rows for *_, rows in parts],
        shifts=[r.piece.whitened_transposed(q).T for (q, *_), r in zip(parts, responses, strict=True)],
        curves=[r.piece.coloured(q) for (q, *_), r in zip(parts, responses, strict=True)],
        runs=[r.piece.run for r in responses],
        taken=taken,
        share=share,
        left=whole - taken @ (share * (taken.T @ whole)),
        n_frames=solution.problem.n_frames,
        excess=chi2 - free,
    )
    return replace(found, blur=_blur(found, solution, without))


def _blur(left: CompressedResidual, solution: Solution, without: str) -> float:
    """The largest share of the square of a column of the law that is left of it beside the law."""
    layout = solution.problem.layout
    made = [
        layout.model.force_columns(p, layout.values(solution.p, r)[0])
        for p, r in zip(left.paths, left.runs, strict=True)
    ]
    shares = [0.0]
    for name in made[0].keys() - {without}:
        rows = np.concatenate([m @ own[name] for m, own in zip(left.maps, made, strict=True)])
        whole = np.sum(rows**2, axis=0)
        shares += (np.sum(left.beside(rows) ** 2, axis=0)[whole > 0] / whole[whole > 0]).tolist()
    return max(shares)


def _root(on_law: Array, shrink: Array) -> tuple[Array, Array]:
    """Directions (M, P) and shares (P,) with which I - u S u' is the square of I - w c w'."""
    q, upper = np.linalg.qr(on_law)
    values, vectors = np.linalg.eigh(upper @ shrink @ upper.T)
    return q @ vectors, 1 - np.sqrt(1 - np.clip(values, 0.0, 1.0))


def _reduced(solution: Solution, response: PieceResponse, each: int) -> tuple[Array, Path, Array, Rows]:
    """Orthonormal traces (n, m) of one piece, its path at the points where a force is read, and the map to them."""
    piece = response.piece
    count = max(min(len(piece.t) // 3, each), MIN_COMPONENTS_PER_PIECE)
    knots = _knots(piece.t[0], piece.t[-1], count)
    nodes = BSpline.design_matrix(np.clip(piece.panels.t, piece.t[0], piece.t[-1]), knots, SPLINE_DEGREE).toarray()
    _, edges = response.linear.respond(-nodes / piece.mass, np.zeros((2, count)))
    moved = piece.whitened((1 + response.shift_slope)[:, None] * edges[piece.at, 0])
    moved -= response.q @ (response.q.T @ moved)
    scale = np.linalg.norm(moved, axis=0)
    u, s, vt = np.linalg.svd(moved / np.where(scale > 0, scale, 1.0), full_matrices=False)
    keep = s > 1e-7 * s[0]
    rows = np.unique(np.linspace(0, len(piece.t) - 1, POINTS_PER_SPLINE * count).round().astype(int))
    read = np.linalg.pinv(BSpline.design_matrix(piece.t[rows], knots, SPLINE_DEGREE).toarray())
    back = (s[keep, None] * vt[keep]) * scale
    return u[:, keep], _read(solution, response, rows), back @ read, rows


def _knots(first: float, last: float, count: int) -> Array:
    inner = np.linspace(first, last, count - SPLINE_DEGREE + 1)
    return np.concatenate([[first] * SPLINE_DEGREE, inner, [last] * SPLINE_DEGREE])


def _read(solution: Solution, response: PieceResponse, rows: Rows) -> Path:
    """The path of one piece at some of its frames."""
    piece, motion = response.piece, response.motion
    _, level = solution.problem.layout.values(solution.p, piece.run)
    whole = piece.at_frames(motion.x_edge[piece.at], motion.v_edge[piece.at], level)
    n = len(piece.t)
    series = vars(whole).items()
    here: dict[str, Any] = {k: q[rows] for k, q in series if isinstance(q, np.ndarray) and q.shape == (n,)}
    return replace(whole, **here)
