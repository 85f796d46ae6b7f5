"""Model against measurement: the errors of every model tried, and where the last one fails."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.fit import Fit
from frictrack.fit.groups import GroupFits
from frictrack.fit.series import SeriesPiece
from frictrack.fit.simulated.problem import Response
from frictrack.fit.simulated.solve import Solution
from frictrack.models import Model
from frictrack.records import Array, Run

STANDS_OUT = 3.0  # standard deviations of the residual force beyond which a frame fails
FOOT = 0.35  # of the run's largest residual force: less is the law bending to make up for the failure elsewhere
CERTAIN = 4.5  # that a span must reach to be named
TAIL = 0.135  # the same where the missing force is known: a Gaussian's two standard deviations
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
    last = tried[-1].fits.values() if isinstance(tried[-1], GroupFits) else [tried[-1]]
    spans = [span for f in last for span in failing_spans(f.solution, f.runs)]
    return Comparison([_entry(i, f) for i, f in enumerate(tried, 1)], spans)


def history(fits: Sequence[Fit]) -> Comparison:
    """The same for a whole session: the error of every model, in order."""
    return compare(list(fits))


def _entry(i: int, fit: Fit) -> dict[str, Any]:
    """One model; `settings` tells in words what was fixed, tied or known of it beside the library."""
    named = {"name": f"{i}_{'+'.join(fit.model.names)}", "model": fit.model.names, "settings": fit.model.settings}
    return named | {"errors": fit.errors}


def residual_force(response: Response, scale: float | None = None) -> ResidualForce:
    """Residual displacement of one piece turned into force: -m times its second derivative, with its noise.

    `scale` (s) is the width over which it is smoothed; None takes the one at which it stands out most. Where friction
    itself was measured it is the residual as it stands.
    """
    piece = response.piece
    if isinstance(piece, SeriesPiece):
        x, v = piece.path.x[piece.at], piece.path.v[piece.at]
        return ResidualForce(piece.t, x, v, piece.y - response.model_y, piece.sigma)
    left = response.r_full * piece.sigma
    tried = [curvature(left, piece.sigma, piece.t, s) for s in ([scale] if scale else _scales(piece.t))]
    a, sigma = max(tried, key=lambda pair: float(np.max(np.abs(pair[0]) / pair[1])))
    return ResidualForce(
        t=piece.t,
        x=response.motion.x_edge[piece.at],
        v=response.motion.v_edge[piece.at],
        F=-piece.mass * a,
        sigma_F=piece.mass * sigma,
    )


def _scales(t: Array) -> Array:
    """Widths from a few frames to a sixth of the piece, s."""
    step, length = float(np.median(np.diff(t))), float(t[-1] - t[0])
    return np.geomspace(4 * step, max(length / 6, 5 * step), 9)


def curvature(y: Array, sigma: Array, t: Array, scale: float) -> tuple[Array, Array]:
    """Second derivative of y (n,) by local quadratics under a Gaussian of width `scale` (s), and its noise.

    Local polynomial regression (Fan & Gijbels 1996, ch. 3) on evenly spaced frames; ends need no padding.
    """
    step = float(np.median(np.diff(t)))
    half = int(np.ceil(4 * scale / step))
    u = np.arange(-half, half + 1) * step / scale
    w = np.exp(-(u**2) / 2)

    def moment(series: Array, kernel: Array) -> Array:
        return np.convolve(series, kernel[::-1], mode="full")[half : half + len(series)]

    one = np.ones_like(y)
    normal = [moment(one, w * u**k) for k in range(5)]
    spread = [moment(sigma**2, w**2 * u**k) for k in range(5)]
    m = np.stack([[normal[i + j] for j in range(3)] for i in range(3)]).transpose(2, 0, 1)
    noise = np.stack([[spread[i + j] for j in range(3)] for i in range(3)]).transpose(2, 0, 1)
    right = np.stack([moment(y, w * u**k) for k in range(3)], axis=1)
    last = np.linalg.inv(m)[:, 2]
    a = 2 * np.einsum("ni,ni->n", last, right) / scale**2
    deviation = 2 * np.sqrt(np.einsum("ni,nij,nj->n", last, noise, last)) / scale**2
    return a, deviation


def failing_spans(solution: Solution, runs: Sequence[Run], missing: str | None = None) -> list[dict[str, Any]]:
    """Stretches of the runs where the residual force stands out of its band, worst first.

    With `missing`, the failure is that of the model without this force effect of the solution, whose force then is
    what stands out, and the rest of the law is not bent by its absence. `t` is recording time (s), `x` (m), `v` (m/s);
    `share_of_error` is the span's part of the squared residual force.
    """
    spans = []
    total = 0.0
    for response in solution.responses:
        force = residual_force(response) if missing is None else _unopposed(solution, response, missing)
        run = runs[response.piece.run]
        total += float(np.sum(force.F**2))
        times = run.displacement.t[response.piece.frames]
        spans += [_span(force, times, run.name, s) for s in _standing_out(force, FOOT if missing is None else TAIL)]
    for span in spans:
        span["share_of_error"] = round(span["share_of_error"] / max(total, 1e-300), 4)
    return sorted(spans, key=lambda s: -s["share_of_error"])


def _known(force: Array) -> Array:
    """The deviation of a force that is known to a thousandth."""
    return np.full(len(force), 1e-3 * max(float(np.max(np.abs(force))), 1e-12))


def _unopposed(solution: Solution, response: Response, missing: str) -> ResidualForce:
    """The force of a missing effect as the failure it leaves, known to a thousandth."""
    piece, at = response.piece, response.piece.at
    force = effect_force(solution, response, missing)
    return ResidualForce(piece.t, response.motion.x_edge[at], response.motion.v_edge[at], force, _known(force))


def effect_force(solution: Solution, response: Response, name: str) -> Array:
    """Force that one effect adds along the solved motion of one piece, N, (n,); zero for one of the picture."""
    problem, piece = solution.problem, response.piece
    values, level = problem.layout.values(solution.p, piece.run)
    at = piece.at
    without = Model(tuple(e for e in problem.model.effects if e.name != name))
    if isinstance(piece, SeriesPiece):
        path = piece.along(piece.path.x, piece.path.v, level)
        return (problem.model.force(path, values) - without.force(path, values))[at]
    path = piece.at_frames(response.motion.x_edge[at], response.motion.v_edge[at], level)
    return problem.model.force(path, values) - without.force(path, values)


def _standing_out(force: ResidualForce, foot: float) -> list[slice]:
    z, size = force.F / force.sigma_F, np.abs(force.F)
    rows = np.flatnonzero((np.abs(z) > STANDS_OUT) & (size > foot * size.max()))
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
