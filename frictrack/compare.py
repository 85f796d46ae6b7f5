"""Model against measurement: the errors of every model tried, and where the last one fails."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.fit import Fit
from frictrack.fit.problem import Response
from frictrack.motion import differentiate, low_pass
from frictrack.records import Array, Displacement

STANDS_OUT = 3.0  # standard deviations of the residual force beyond which a frame fails
CERTAIN = 4.5  # that a span must reach to be named
MERGE = 12  # frames between two failing spans that are one


@dataclass(frozen=True)
class ResidualForce:
    """Friction that the model does not explain, at the frames of one piece: F and sigma_F in N, (n,)."""

    t: Array
    x: Array
    v: Array
    F: Array
    sigma_F: Array


@dataclass(frozen=True)
class Comparison:
    """Errors of the models in the order in which they were tried, and the spans where the last one fails."""

    models: list[dict[str, Any]]
    fails_at: list[dict[str, Any]]

    def summary(self) -> dict[str, Any]:
        """The JSON of `frictrack compare` and `frictrack history`."""
        return {"models": self.models, "fails_at": self.fails_at}


def compare(fits: Fit | Sequence[Fit]) -> Comparison:
    """Errors of every model tried, and where the last one fails."""
    tried = [fits] if isinstance(fits, Fit) else list(fits)
    if not tried:
        raise FrictrackError("expected at least one fitted model to compare but got none; run `frictrack fit` first")
    return Comparison([_entry(i, f) for i, f in enumerate(tried, 1)], failing_spans(tried[-1]))


def history(fits: Sequence[Fit]) -> Comparison:
    """The same for a whole session: the error of every model, in order."""
    return compare(list(fits))


def _entry(i: int, fit: Fit) -> dict[str, Any]:
    return {"name": f"{i}_{'+'.join(fit.model.names)}", "model": fit.model.names, "errors": fit.errors}


def residual_force(response: Response) -> ResidualForce:
    """Residual displacement of one piece turned into force: -m times its smoothed second derivative."""
    piece = response.piece
    n = len(piece.t)
    nan = np.full(n, np.nan)
    left = Displacement(
        t=piece.t, x=response.r_full * piece.sigma, y=nan, angle=nan, sigma_x=piece.sigma, sigma_y=nan,
        valid=np.ones(n, dtype=bool),
    )
    motion = differentiate(low_pass(left))
    return ResidualForce(
        t=piece.t,
        x=response.motion.x_edge[:: piece.per_frame],
        v=response.motion.v_edge[:: piece.per_frame],
        F=-piece.mass * motion.a,
        sigma_F=piece.mass * motion.sigma_a,
    )


def failing_spans(fit: Fit) -> list[dict[str, Any]]:
    """Stretches of the runs where the residual force stands out of its band, worst first.

    `t` is recording time (s), `x` (m), `v` (m/s); `share_of_error` the span's part of the squared residual force.
    """
    spans = []
    total = 0.0
    for response in fit.solution.responses:
        force = residual_force(response)
        run = fit.runs[response.piece.run]
        total += float(np.sum(force.F**2))
        times = run.displacement.t[response.piece.frames]
        spans += [_span(force, times, run.name, s) for s in _standing_out(force.F / force.sigma_F)]
    for span in spans:
        span["share_of_error"] = round(span["share_of_error"] / max(total, 1e-300), 4)
    return sorted(spans, key=lambda s: -s["share_of_error"])


def _standing_out(z: Array) -> list[slice]:
    rows = np.flatnonzero(np.abs(z) > STANDS_OUT)
    if not len(rows):
        return []
    cuts = np.flatnonzero(np.diff(rows) > MERGE) + 1
    groups = np.split(rows, cuts)
    return [slice(int(g[0]), int(g[-1]) + 1) for g in groups if np.max(np.abs(z[g])) > CERTAIN]


def _span(force: ResidualForce, times: Array, run: str, s: slice) -> dict[str, Any]:
    def reach(a: Array) -> list[float]:
        return [float(a[s].min()), float(a[s].max())]

    return {
        "run": run,
        "t": reach(times),
        "x": reach(force.x),
        "v": reach(force.v),
        "share_of_error": float(np.sum(force.F[s] ** 2)),
    }
