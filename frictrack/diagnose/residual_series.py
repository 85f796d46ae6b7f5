"""Collect the residual of a model, and what the effects found make of it, along the motion of every run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from frictrack.diagnose.effect_description import FittedEffect
from frictrack.fit.least_squares import PieceResponse, Solution, position_and_velocity
from frictrack.records import Array

MAX_SAMPLES_PER_RUN, MAX_SAMPLES = 300, 40_000  # of a figure; a panel of a page shows no more


def residual_series(before: Solution, after: Solution | None, effects: Sequence[str]) -> dict[str, Array]:
    """Residual of a model and of the model with the effects found, for figures and files.

    Parameters
    ----------
    before
        The fit that is diagnosed.
    after
        The fit with the effects found; None if none was found.
    effects
        Names of the effects found.

    Returns
    -------
    dict
        One row per sample of all runs, all (n,): `run` (index), `t` since release (s), `x` (m) and `v` along the motion
        (m/s) of the model; `before`, the residual, and `sigma`, its noise (m, or N for measured friction). With effects
        found also `after`, the residual with them, and `F`, the force that they add against the motion (N).

    """
    later: Sequence[PieceResponse | None] = [None] * len(before.responses)
    if after is not None and _same_frames(before, after):
        later = after.responses
    kept = _kept_frames(before)
    rows = [_series(first, second, kept) for first, second in zip(before.responses, later, strict=True)]
    out = {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
    if "after" in out and after is not None:
        out["F"] = np.concatenate([force[kept] for force in _forces(after, effects)])
    return out


def _same_frames(before: Solution, after: Solution) -> bool:
    sizes = [[len(r.piece.t) for r in solution.responses] for solution in (before, after)]
    return sizes[0] == sizes[1]


def _kept_frames(solution: Solution) -> slice:
    """Every k-th frame of each piece."""
    runs = {r.piece.run for r in solution.responses}
    frames = sum(len(r.piece.t) for r in solution.responses)
    wanted = min(len(runs) * MAX_SAMPLES_PER_RUN, MAX_SAMPLES)
    return slice(None, None, max(1, -(-frames // wanted)))


def _series(first: PieceResponse, second: PieceResponse | None, kept: slice) -> dict[str, Array]:
    piece = first.piece
    x, v = position_and_velocity(first)
    out = {
        "run": np.full(len(piece.t), float(piece.run)),
        "t": piece.t,
        "x": x,
        "v": np.abs(v),
        "before": piece.y - first.model_y,
        "sigma": np.broadcast_to(piece.noise, piece.t.shape),
    }
    if second is not None:
        out["after"] = second.piece.y - second.model_y
    return {name: np.asarray(values)[kept] for name, values in out.items()}


def _forces(solution: Solution, effects: Sequence[str]) -> list[Array]:
    """Force that some effects of a fit add to every piece, N, positive against the motion."""
    fitted = [one for one in (FittedEffect(name, solution) for name in effects) if one.effect.acts_on == "force"]
    directions = [np.where(position_and_velocity(r)[1] < 0, -1.0, 1.0) for r in solution.responses]
    blocks = [one.blocks for one in fitted]
    return [d * sum((b[k] for b in blocks), np.zeros(len(d))) for k, d in enumerate(directions)]
