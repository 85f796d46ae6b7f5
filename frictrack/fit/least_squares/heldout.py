"""Compute the held-out error: the error of the model at frames that were not used to fit it.

By run: the shared parameters come from the other runs. The run's own parameters (start, level, phases, event times)
come from its kept frames, and its hidden frames are scored. Where the other runs cannot determine a shared parameter
well enough, the kept frames of all runs are fitted and the hidden ones scored. The result states which was used.

Everything is linear algebra about the fitted model: leaving out frames changes the parameters little, so one
Gauss-Newton step suffices.

References
----------
Cook, R. D. & Weisberg, S. (1982). Residuals and Influence in Regression, ch. 5. Chapman & Hall.

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from frictrack.fit.least_squares.solution import Solution, stacked_rows
from frictrack.fit.parameters import penalty_jacobian, penalty_residual
from frictrack.fit.pieces import Piece
from frictrack.records import Array, Mask

MAX_PREDICTION_VARIANCE = 0.25  # largest ratio of prediction variance to noise variance
MIN_KEPT_SHARE = 0.01  # of the information of all frames, usually a half; own unknowns keep their values below it
MIN_SINGULAR_VALUE = 1e-7  # relative; parameters keep their values along smaller ones


def heldout_rms(solution: Solution, by: str | None = None, compared: Solution | None = None) -> tuple[float, str]:
    """Compute the root mean square of the held-out residual.

    Parameters
    ----------
    solution : Solution
        The fit, whose residual is scored.
    by : {"run", "frames"}, optional
        What is held out. By default runs, wherever the other runs can predict every run.
    compared : Solution, optional
        The same unknowns where other residuals were minimised, or where a search stopped before the optimum. Only the
        change of the unknowns with the frames counts then.

    Returns
    -------
    rms : float
        Held-out error, m or N.
    by : str
        What was held out: "run" or "frames".

    """
    fitted = compared or solution
    runs = _linear_runs(solution, solution.problem.hidden_frames(solution.responses))
    whole = np.zeros(len(solution.p)) if compared is None else _step(compared)
    if by == "frames" or len(runs) < 2 or (by is None and not _are_predictable(solution, runs)):
        hidden = fitted.problem.hidden_frames(fitted.responses)
        step, none = (
            _step(fitted, fitted.problem.kept_rows(fitted.responses, hidden)) - whole,
            np.zeros(len(whole), bool),
        )
        return _rms([run.hidden_errors(step, none) for run in _linear_runs(solution, hidden).values()]), "frames"
    errors = []
    for i, run in runs.items():
        own = _own_unknowns(solution, i)
        rows = [None if r.piece.run == i else np.column_stack([r.jac, r.r]) for r in fitted.responses]
        errors.append(run.hidden_errors(np.where(own, 0.0, _step(fitted, rows, ~own) - whole), own))
    return _rms(errors), "run"


@dataclass(frozen=True)
class _LinearRun:
    """One run about the fitted model, its s pieces stacked.

    Whitened residual (n,), sensitivities (n, P) and starts (n, 2 s); which frames are hidden (n,).
    """

    pieces: list[Piece]
    residual: Array
    jac: Array
    starts: Array
    hidden: Mask

    def hidden_errors(self, step: Array, own: Mask) -> Array:
        """Errors, m or N, at the hidden frames after a step; starts and `own` unknowns come from the kept frames."""
        residual = self.residual - self.jac @ step
        columns = np.concatenate([self.jac[:, own], self.starts], axis=1)
        residual = residual - columns @ _from_kept_frames(columns, residual, ~self.hidden)
        ends = np.cumsum([len(p.t) for p in self.pieces])[:-1]
        errors = [p.coloured(r) for p, r in zip(self.pieces, np.split(residual, ends), strict=True)]
        return np.asarray(np.concatenate(errors)[self.hidden])


def _linear_runs(solution: Solution, hidden: Sequence[Mask]) -> dict[int, _LinearRun]:
    """Every run about the fitted model."""
    runs: dict[int, list[int]] = {}
    for i, r in enumerate(solution.responses):
        runs.setdefault(r.piece.run, []).append(i)
    return {run: _linear_run(solution, which, hidden) for run, which in runs.items()}


def _linear_run(solution: Solution, which: Sequence[int], hidden: Sequence[Mask]) -> _LinearRun:
    own = [solution.responses[i] for i in which]
    return _LinearRun(
        pieces=[r.piece for r in own],
        residual=np.concatenate([r.r for r in own]),
        jac=stacked_rows([r.jac for r in own], [r.active for r in own], len(solution.p)),
        starts=block_diag(*(r.q for r in own)),
        hidden=np.concatenate([hidden[i] for i in which]),
    )


def _are_predictable(solution: Solution, runs: Mapping[int, _LinearRun]) -> bool:
    """Whether the other runs determine the shared parameters well enough to predict every run."""
    rows = penalty_jacobian(solution.problem.layout, solution.tau or 0.03)
    norm = np.linalg.norm(np.vstack([*(r.jac for r in runs.values()), rows]), axis=0)
    norm[norm == 0] = 1.0
    for i, run in runs.items():
        own = _own_unknowns(solution, i)
        known = np.vstack([*(r.jac for k, r in runs.items() if k != i), rows])[:, ~own] / norm[~own]
        covariance = np.linalg.inv(known.T @ known + 1e-13 * np.eye(known.shape[1]))
        basis, _ = np.linalg.qr(run.jac[:, own])
        shared = run.jac[:, ~own] / norm[~own]
        shared = shared - basis @ (basis.T @ shared)
        if np.mean(np.einsum("ni,ij,nj->n", shared, covariance, shared)) > MAX_PREDICTION_VARIANCE:  # j' C j by frame
            return False
    return True


def _own_unknowns(solution: Solution, run: int) -> Mask:
    """Which unknowns belong to the run alone."""
    return np.array([s.run == run for s in solution.problem.layout.slots])


def _step(solution: Solution, rows: Sequence[Array | None] | None = None, free: Mask | None = None) -> Array:
    """Gauss-Newton step (P,) of the free unknowns for some rows [J, r] of every piece, by default all of them.

    Directions that these rows hardly determine, compared with all frames, stay 0.
    """
    layout, tau = solution.problem.layout, solution.tau or 0.03
    free = np.ones(len(solution.p), dtype=bool) if free is None else free
    rows = [np.column_stack([r.jac, r.r]) for r in solution.responses] if rows is None else rows
    used = [(r.active, own) for r, own in zip(solution.responses, rows, strict=True) if own is not None]
    jac = stacked_rows([own[:, :-1] for _, own in used], [active for active, _ in used], len(solution.p))
    left = np.concatenate([jac, penalty_jacobian(layout, tau, solution.p)])[:, free]
    right = np.concatenate([*(own[:, -1] for _, own in used), -penalty_residual(layout, solution.p, tau)])
    norm = np.linalg.norm(solution.jac[:, free], axis=0)
    norm[norm == 0] = 1.0
    step = np.zeros(len(solution.p))
    step[free] = np.linalg.lstsq(left / norm, right, rcond=MIN_SINGULAR_VALUE)[0] / norm
    return step


def _from_kept_frames(columns: Array, residual: Array, kept: Mask) -> Array:
    """Coefficients (k,) of a run's own columns (n, k) from its kept frames.

    Directions along which the kept frames hold nearly none of the information stay 0: the time of an event that lies
    between two frames may show in one frame alone, and linear extrapolation from the others means nothing.
    """
    if not columns.shape[1]:
        return np.zeros(0)
    norm = np.linalg.norm(columns, axis=0)
    norm[norm == 0] = 1.0
    _, size, vt = np.linalg.svd(columns / norm, full_matrices=False)
    found = size > MIN_SINGULAR_VALUE * size[0]
    to_columns = vt[found].T / size[found]  # directions of unit information in all frames
    u, share, wt = np.linalg.svd((columns[kept] / norm) @ to_columns, full_matrices=False)
    seen = share**2 > MIN_KEPT_SHARE
    coordinates = wt[seen].T @ ((u[:, seen].T @ residual[kept]) / share[seen])
    return np.asarray(to_columns @ coordinates / norm)


def _rms(parts: Sequence[Array]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))
