"""Compute the held-out error: the error of the model at frames that were not used to fit it.

By run: the shared parameters come from the other runs. The run's own parameters (start, level, phases, event times)
come from its even frames, and its odd frames are scored. Where the other runs cannot determine a shared parameter
well enough, the even frames of all runs are fitted and the odd ones scored. The result states which was used.

Everything is linear algebra about the fitted model: leaving out frames changes the parameters little, so one
Gauss-Newton step suffices.

References
----------
Cook, R. D. & Weisberg, S. (1982). Residuals and Influence in Regression, ch. 5. Chapman & Hall.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frictrack.fit.least_squares.problem import PieceResponse
from frictrack.fit.least_squares.solution import Solution
from frictrack.fit.parameters import penalty_jacobian, penalty_residual
from frictrack.fit.segments import Piece
from frictrack.records import Array, Mask

HIDDEN_SIGMA_FACTOR = 1e9  # factor on sigma that removes a frame from the fit
MAX_PREDICTION_VARIANCE = 0.25  # largest ratio of prediction variance to noise variance
MIN_EVEN_SHARE = 0.01  # of the information of all frames, usually a half; own unknowns keep their values below it
MIN_SINGULAR_VALUE = 1e-7  # relative; parameters keep their values along smaller ones


@dataclass(frozen=True)
class _LinearRun:
    """One run about the fitted model, its s pieces stacked.

    Whitened residual (n,), sensitivities (n, P) and starts (n, 2 s).
    """

    residual: Array
    jac: Array
    starts: Array
    pieces: list[Piece]
    odd: Mask

    def odd_frame_errors(self, residual: Array) -> Array:
        """Convert a whitened residual (n,) to errors in m at the odd frames."""
        ends = np.cumsum([len(p.t) for p in self.pieces])[:-1]
        errors = [p.coloured(own) for p, own in zip(self.pieces, np.split(residual, ends), strict=True)]
        return np.asarray(np.concatenate(errors)[self.odd])


def heldout_rms(solution: Solution, by: str | None = None) -> tuple[float, str]:
    """Compute the root mean square of the held-out residual.

    Parameters
    ----------
    solution : Solution
        The fit.
    by : {"run", "frames"}, optional
        What is held out. By default runs, wherever the other runs can predict every run.

    Returns
    -------
    rms : float
        Held-out error, m.
    by : str
        What was held out: "run" or "frames".

    """
    runs = _linear_runs(solution)
    if by == "frames" or len(runs) < 2 or (by is None and not is_predictable(solution)):
        return _rms(_residuals_odd_frames(solution, runs)), "frames"
    return _rms([_residuals_left_out(solution, runs, r) for r in runs]), "run"


def _linear_runs(solution: Solution) -> dict[int, _LinearRun]:
    """Every run about the fitted model, its pieces stacked."""
    pieces: dict[int, list[PieceResponse]] = {}
    for r in solution.responses:
        pieces.setdefault(r.piece.run, []).append(r)
    return {run: _join_pieces(own, len(solution.p)) for run, own in pieces.items()}


def _join_pieces(pieces: Sequence[PieceResponse], unknowns: int) -> _LinearRun:
    count = sum(len(r.r) for r in pieces)
    jac, starts = np.zeros((count, unknowns)), np.zeros((count, sum(r.q.shape[1] for r in pieces)))
    at = column = 0
    for r in pieces:
        rows = slice(at, at + len(r.r))
        jac[rows, r.active] = r.jac
        starts[rows, column : column + r.q.shape[1]] = r.q
        at, column = rows.stop, column + r.q.shape[1]
    return _LinearRun(
        residual=np.concatenate([r.r for r in pieces]),
        jac=jac,
        starts=starts,
        pieces=[r.piece for r in pieces],
        odd=np.concatenate([np.arange(len(r.r)) % 2 == 1 for r in pieces]),
    )


def _own_unknowns(solution: Solution, run: int) -> Mask:
    """Which unknowns belong to the run alone."""
    return np.array([s.run == run for s in solution.problem.layout.slots])


def _residuals_left_out(solution: Solution, runs: dict[int, _LinearRun], run: int) -> Array:
    """Residuals, m, at the odd frames of one run, predicted by the others."""
    own, layout, tau = _own_unknowns(solution, run), solution.problem.layout, solution.tau or 0.03
    rows = [r.jac for k, r in runs.items() if k != run] + [penalty_jacobian(layout, tau, solution.p)]
    right = [r.residual for k, r in runs.items() if k != run] + [-penalty_residual(layout, solution.p, tau)]
    step = np.zeros(len(solution.p))
    step[~own] = _least_squares(np.concatenate(rows)[:, ~own], np.concatenate(right), solution.jac[:, ~own])
    left_out = runs[run]
    residual = left_out.residual - left_out.jac @ step
    own_columns = np.concatenate([left_out.jac[:, own], left_out.starts], axis=1)
    residual = residual - own_columns @ _from_even_frames(own_columns, residual, left_out.odd)
    return left_out.odd_frame_errors(residual)


def _residuals_odd_frames(solution: Solution, runs: dict[int, _LinearRun]) -> list[Array]:
    """Residuals, m, at the odd frames of every run, the whole model fitted to the even ones."""
    layout, tau = solution.problem.layout, solution.tau or 0.03
    even_rows = []
    for r in runs.values():  # project out the start of every piece first
        q, _ = np.linalg.qr(r.starts[~r.odd])
        even = np.column_stack([r.jac, r.residual])[~r.odd]
        even_rows.append(even - q @ (q.T @ even))
    rows = np.concatenate([*(s[:, :-1] for s in even_rows), penalty_jacobian(layout, tau, solution.p)])
    right = np.concatenate([*(s[:, -1] for s in even_rows), -penalty_residual(layout, solution.p, tau)])
    step = _least_squares(rows, right, solution.jac)
    out = []
    for r in runs.values():
        residual = r.residual - r.jac @ step
        residual = residual - r.starts @ _least_squares(r.starts[~r.odd], residual[~r.odd], r.starts)
        out.append(r.odd_frame_errors(residual))
    return out


def _least_squares(rows: Array, right: Array, whole: Array) -> Array:
    """Least-squares coefficients (k,) of columns.

    Directions that these rows hardly determine, compared with the columns of `whole` (n, k), stay 0.
    """
    norm = np.linalg.norm(whole, axis=0)
    norm[norm == 0] = 1.0
    return np.asarray(np.linalg.lstsq(rows / norm, right, rcond=MIN_SINGULAR_VALUE)[0] / norm)


def _from_even_frames(columns: Array, residual: Array, odd: Mask) -> Array:
    """Coefficients (k,) of a run's own columns (n, k) from its even frames.

    Directions along which the even frames hold nearly none of the information stay 0: the time of an event that lies
    between two frames may show in one frame alone, and linear extrapolation from the others means nothing.
    """
    norm = np.linalg.norm(columns, axis=0)
    norm[norm == 0] = 1.0
    _, size, vt = np.linalg.svd(columns / norm, full_matrices=False)
    kept = size > MIN_SINGULAR_VALUE * size[0]
    to_columns = vt[kept].T / size[kept]  # directions of unit information in all frames
    u, share, wt = np.linalg.svd((columns[~odd] / norm) @ to_columns, full_matrices=False)
    seen = share**2 > MIN_EVEN_SHARE
    found = wt[seen].T @ ((u[:, seen].T @ residual[~odd]) / share[seen])
    return np.asarray(to_columns @ found / norm)


def _rms(parts: Sequence[Array]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def is_predictable(solution: Solution) -> bool:
    """Return whether the other runs determine the shared parameters well enough to predict every run."""
    layout = solution.problem.layout
    rows = penalty_jacobian(layout, solution.tau or 0.03)
    jac = {run: r.jac for run, r in _linear_runs(solution).items()}
    norm = np.linalg.norm(np.vstack([*jac.values(), rows]), axis=0)
    norm[norm == 0] = 1.0
    for run in jac:
        own = _own_unknowns(solution, run)
        known = np.vstack([*(j for k, j in jac.items() if k != run), rows])[:, ~own] / norm[~own]
        spread = np.linalg.inv(known.T @ known + 1e-13 * np.eye(known.shape[1]))
        basis, _ = np.linalg.qr(jac[run][:, own])
        even_rows = jac[run][:, ~own] / norm[~own]
        even_rows = even_rows - basis @ (basis.T @ even_rows)
        if np.mean(np.einsum("ni,ij,nj->n", even_rows, spread, even_rows)) > MAX_PREDICTION_VARIANCE:
            return False
    return True
