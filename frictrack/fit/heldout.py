"""Held-out error: what the law says of frames that it has not seen.

By run: the shared parameters come from the other runs, the run's own (start, level, phases, event times) from its
even frames, and the odd frames are scored. Where the others cannot determine a shared parameter well enough to
predict the run, even frames of all runs fit and odd frames score. What was chosen is returned with the figure.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from frictrack.fit.simulated.pieces import Piece
from frictrack.fit.simulated.problem import Problem
from frictrack.fit.simulated.solve import Solution, refine
from frictrack.fit.unknowns.scatter import restraint_rows
from frictrack.records import Array

UNSEEN = 1e9  # times sigma: a frame that does not count
PREDICTABLE = 0.25  # variance of the prediction over the noise's, beyond which the others do not know the run


def heldout_rms(solution: Solution, by: str | None = None) -> tuple[float, str]:
    """Root mean square of the held-out residual, m, and how it was held out: "run" or "frames".

    `by` asks for one of the two; None takes "run" wherever the other runs can predict each run.
    """
    runs = solution.problem.layout.run_names
    if by == "frames" or len(runs) < 2 or (by is None and not _predictable(solution)):
        return _score(_fitted_on_even(solution)), "frames"
    residuals = np.concatenate([_left_out(solution, r) for r in range(len(runs))])
    return float(np.sqrt(np.mean(residuals**2))), "run"


def _odd_unseen(piece: Piece) -> Piece:
    odd = np.arange(len(piece.t)) % 2 == 1
    return replace(piece, sigma=np.where(odd, UNSEEN, 1.0) * piece.sigma)


def _fitted_on_even(solution: Solution) -> Solution:
    problem = solution.problem
    even = Problem(problem.model, problem.layout, [_odd_unseen(p) for p in problem.pieces])
    return refine(even, solution.p, solution.starts, tau=solution.tau or 0.03, max_steps=6)


def _odd_residuals(solution: Solution) -> Array:
    return np.concatenate([(r.piece.y - r.model_y)[1::2] for r in solution.responses])


def _score(solution: Solution) -> float:
    return float(np.sqrt(np.mean(_odd_residuals(solution) ** 2)))


def _left_out(solution: Solution, run: int) -> Array:
    """Residuals, m, at the odd frames of one run, predicted by the others."""
    problem, layout = solution.problem, solution.problem.layout
    own = np.array([s.run == run for s in layout.slots])
    rest = [i for i, piece in enumerate(problem.pieces) if piece.run != run]
    mine = [i for i, piece in enumerate(problem.pieces) if piece.run == run]
    others = Problem(problem.model, layout, [problem.pieces[i] for i in rest])
    known = refine(others, solution.p, _of(solution.starts, rest), tau=solution.tau or 0.03, free=~own, max_steps=6)
    alone = Problem(problem.model, replace(layout, levels_free=True), [_odd_unseen(problem.pieces[i]) for i in mine])
    return _odd_residuals(refine(alone, known.p, _of(solution.starts, mine), free=own, max_steps=6))


def _of(items: list[Array], which: list[int]) -> list[Array]:
    return [items[i] for i in which]


def _predictable(solution: Solution) -> bool:
    """Whether the other runs know the shared parameters well enough to predict every run."""
    layout = solution.problem.layout
    rows = restraint_rows(layout, solution.tau or 0.03)
    blocks: dict[int, list[Array]] = {}
    for r in solution.responses:
        full = np.zeros((len(r.r), len(solution.p)))
        full[:, r.active] = r.jac
        blocks.setdefault(r.piece.run, []).append(full)
    jac = {run: np.concatenate(b) for run, b in blocks.items()}
    norm = np.linalg.norm(np.vstack([*jac.values(), rows]), axis=0)
    norm[norm == 0] = 1.0
    for run in jac:
        own = np.array([s.run == run for s in layout.slots])
        known = np.vstack([*(j for k, j in jac.items() if k != run), rows])[:, ~own] / norm[~own]
        spread = np.linalg.inv(known.T @ known + 1e-13 * np.eye(known.shape[1]))
        basis, _ = np.linalg.qr(jac[run][:, own])
        seen = jac[run][:, ~own] / norm[~own]
        seen = seen - basis @ (basis.T @ seen)
        if np.mean(np.einsum("ni,ij,nj->n", seen, spread, seen)) > PREDICTABLE:
            return False
    return True
