"""Find where a fitted model fails: spans in time, place, velocity and run, with share of the misfit and p-value."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from frictrack.base.distributions import chi2_sf, normal_sf
from frictrack.diagnose.compare.local_forces import (
    ALPHA,
    Bump,
    LocalForces,
    continue_search,
    find_local_forces,
    start_search,
)
from frictrack.effects import Effect
from frictrack.fit.least_squares import PieceResponse, Solution, position_and_velocity, white_noise_covariance
from frictrack.fit.linearised import linearise
from frictrack.fit.observations import MeasuredFrictionPiece, keep_compared_frames
from frictrack.fit.pieces import Rows
from frictrack.fit.separable.varpro import ScanItem
from frictrack.records import Array, Mask, Run, stretches

SPAN_HALF_WIDTHS = 2.0  # half length of a span, in widths of its Gaussian
TAIL_RATIO = float(np.exp(-(SPAN_HALF_WIDTHS**2) / 2))  # height at the end of a span over the peak
MIN_CHI2_RESOLVED = 6.6  # rise with the shortest width above which a duration is resolved
MAX_GAP_FRAMES = 12  # frames between two stretches that count as one
MIN_SIGMAS = 3.0  # of a measured force, above which a frame fails
MIN_SHARE_OF_PEAK = 0.35  # of the largest residual; less may be the model compensating a failure elsewhere
N_WIDTHS = 20  # tried for the span of a bump, and the fitted one


@dataclass(frozen=True)
class FailingSpan:
    """A span of one piece: rows of its frames, share of the misfit and p-value."""

    piece: int
    rows: Rows
    share: float
    p: float


def failing_spans(solution: Solution, runs: Sequence[Run], missing: str | None = None) -> list[dict[str, Any]]:
    """Find the spans of the runs that carry the misfit, largest share first.

    Parameters
    ----------
    solution
        The fit.
    runs
        Its runs.
    missing
        Name of a force effect of the model. If given, the spans are those where the model without this effect fails.

    Returns
    -------
    list of dict
        `run`; `t`, `x`, `v`: range of recording time s, position m and velocity m/s; `share_of_error`: part of the
        misfit (chi-squared above its expectation), at most one in all; `p`: p-value of the whole search. Empty if noise
        alone would do as much (1 %). A blow too short to be resolved extends as far as the run's low-pass spreads it.

    """
    if solution.problem.is_of_points:
        return sorted(_failing_speeds(solution, runs), key=lambda s: -s["share_of_error"])
    solution = keep_compared_frames(solution)
    if missing is None:
        local = find_local_forces(solution)
        everywhere = not local.complete and not solution.problem.simulates
        found = _spans_of_measured_friction(local) if everywhere else _spans_of_bumps(local, runs)
    else:
        found = _spans_of_effect(solution, runs, missing)
    found = [s for s in found if len(s.rows) > 1]
    # forces that make up for one another explain more, one by one, than together
    whole = max(1.0, sum(max(s.share, 0.0) for s in found))
    spans = [_to_dict(solution.responses[s.piece], runs, replace(s, share=s.share / whole)) for s in found]
    return sorted(spans, key=lambda s: -s["share_of_error"])


def _failing_speeds(solution: Solution, runs: Sequence[Run]) -> Iterator[dict[str, Any]]:
    """Yield the speeds of neighbouring points (v, F) of one sign of the residual that noise does not explain."""
    total, count = solution.chi2, solution.problem.n_frames
    for r in solution.responses:
        cuts = np.flatnonzero(np.diff(np.sign(r.r)) != 0) + 1
        for rows in np.split(np.arange(len(r.r)), cuts):
            chi2 = float(r.r[rows] @ r.r[rows])
            p = min(1.0, count * float(chi2_sf(chi2, len(rows))))
            if p < ALPHA:
                v = [float(q) for q in r.piece.v_hat[rows[[0, -1]]]]
                span = {"run": runs[r.piece.run].name, "t": None, "x": None, "v": v}
                yield span | {"share_of_error": round(chi2 / total, 4), "p": p}


def _spans_of_bumps(found: LocalForces, runs: Sequence[Run]) -> list[FailingSpan]:
    """Extent of the bumps of a search in every piece; those of a piece share what its misfit falls by their traces."""
    state, total = found.state, excess_chi2(found)
    squares = [(found.problem.without(state, i.coefficients).residual - state.residual) ** 2 for i in found.items]
    widths = [_likely_width(found, item) for item in found.items]
    narrowest = [float(item.grid.axes[1][0]) for item in found.items]
    fall, spans = found.bare.residual**2 - state.residual**2, list[FailingSpan]()
    for i, (response, rows) in enumerate(zip(found.solution.responses, found.search.separable.slices, strict=True)):
        own = []
        for bump, (width, is_short), least, square in zip(found.bumps, widths, narrowest, squares, strict=True):
            smear = _low_pass_half_width(runs, response) if is_short and not bump.at_place else 0.0
            frames = np.flatnonzero(_inside(replace(bump, width=least if smear else width), response, smear))
            if bump.acts_in(response.piece.run) and len(frames):
                own.append((frames, float(np.sum(square[rows])), found.p(bump)))
        share = float(np.sum(fall[rows])) / (total * max(sum(size for _, size, _ in own), 1e-300))
        spans += [FailingSpan(i, frames, share * size, p) for frames, size, p in own]
    return _merge_overlapping(spans)


def _spans_of_measured_friction(found: LocalForces) -> list[FailingSpan]:
    """Spans where the residual of a measured friction force itself is significant, if the model fails everywhere."""
    spans, responses = [], found.solution.responses
    total = sum(float(r.r @ r.r) for r in responses)
    for i, response in enumerate(responses):
        size = np.abs(response.r)
        for s in stretches(_close_gaps(size > max(MIN_SIGMAS, MIN_SHARE_OF_PEAK * float(size.max())))):
            p = min(1.0, 2 * len(size) * float(normal_sf(size[s].max())))
            if p < ALPHA:
                spans.append(FailingSpan(i, np.arange(s.start, s.stop), float(size[s] @ size[s]) / total, p))
    return spans


def _merge_overlapping(spans: Sequence[FailingSpan]) -> list[FailingSpan]:
    """Merge overlapping spans of one piece."""
    out: list[FailingSpan] = []
    for s in sorted((s for s in spans if len(s.rows)), key=lambda s: (s.piece, s.rows[0])):
        last = out[-1] if out else None
        if last is not None and last.piece == s.piece and s.rows[0] <= last.rows[-1]:
            out[-1] = FailingSpan(s.piece, np.union1d(last.rows, s.rows), last.share + s.share, min(last.p, s.p))
        else:
            out.append(s)
    return out


def excess_chi2(found: LocalForces) -> float:
    """Chi-squared of the model without bumps above its expectation, at least its standard deviation."""
    dof = max(found.search.separable.size - len(found.solution.p) - 2 * len(found.model.pieces), 1)
    return max(found.bare.misfit - dof, float(np.sqrt(2 * dof)))


def _inside(bump: Bump, response: PieceResponse, half_width: float) -> Mask:
    """Frames of a piece that lie within a bump, and a half width (s) on both sides."""
    x, _ = position_and_velocity(response)
    along = x if bump.at_place else response.piece.t
    return np.asarray(np.abs(along - bump.centre) <= SPAN_HALF_WIDTHS * bump.width + half_width)


def _low_pass_half_width(runs: Sequence[Run], response: PieceResponse) -> float:
    """Half width of the run's low-pass, s; 0 if unknown or if friction itself was measured."""
    cutoff = runs[response.piece.run].motion.cutoff
    known = np.isfinite(cutoff) and cutoff > 0 and not isinstance(response.piece, MeasuredFrictionPiece)
    return 0.5 / float(cutoff) if known else 0.0


def _likely_width(found: LocalForces, item: ScanItem) -> tuple[float, bool]:
    """Mean of the log width, weighted by the likelihood of the widths, and whether the shortest is as likely as any.

    A narrow bump leaves nearly the trace of an impulse whatever its width, so the best fit alone is arbitrary.
    """
    _, width = item.slots
    values, problem = found.state.nonlinear_values, found.problem
    widths = np.append(np.geomspace(problem.low[width[0]], problem.high[width[0]], N_WIDTHS), values[width[0]])
    misfits = []
    for own in widths:
        moved = values.copy()
        moved[width] = own
        misfits.append(problem.at(moved, found.state, {item.g}, item.coefficients).misfit)
    behind = np.array(misfits) - min(misfits)
    return float(np.exp(np.average(np.log(widths), weights=np.exp(-behind / 2)))), bool(behind[0] < MIN_CHI2_RESOLVED)


def _spans_of_effect(solution: Solution, runs: Sequence[Run], missing: str) -> list[FailingSpan]:
    """Spans in which the force of an effect acts: where it exceeds the tail of a Gaussian at two widths.

    Pieces share the misfit as they share the square of what the other effects cannot follow of its trace in the data,
    spans of a piece that of the force. A local effect is searched again in the model without it, over all widths: in
    some run its fitted place may be wrong.
    """
    effect = next(e for e in solution.problem.model.effects if e.name == missing)
    model = linearise(solution)
    found = start_search(model, without=missing)
    if effect.acts_within is not None:
        local = continue_search(found)
        if local.items:
            return _spans_of_bumps(local, runs)
    left = found.bare.residual - start_search(model).bare.residual
    squares, spans = [float(left[rows] @ left[rows]) for rows in found.search.separable.slices], list[FailingSpan]()
    forces = [_effect_force(solution, r, missing) for r in solution.responses]
    for i, (force, peak) in enumerate(zip(forces, _expected_peaks(solution, effect, forces), strict=True)):
        share = squares[i] / max(sum(squares) * float(force @ force), 1e-300)
        p = _p_of_size(solution, effect, solution.responses[i].piece.run)
        for s in stretches(_close_gaps(np.abs(force) > TAIL_RATIO * peak)) if p < ALPHA else ():
            spans.append(FailingSpan(i, np.arange(s.start, s.stop), share * float(force[s] @ force[s]), p))
    return spans


def _effect_force(solution: Solution, response: PieceResponse, name: str) -> Array:
    """Force of one effect of the model at the frames of a piece, N, (n,)."""
    values, level = solution.problem.layout.values(solution.p, response.piece.run)
    path = response.piece.path_at_nodes(response.motion.x, response.motion.v, level)
    force = solution.problem.model.effect_contribution(name, path, values)
    return np.interp(response.piece.t, path.t, force)


def _p_of_size(solution: Solution, effect: Effect, run: int) -> float:
    """p-value of the size of an effect in a run; the least of several sizes."""
    own = solution.problem.layout.sizes(effect, run)
    std = np.sqrt(np.maximum(np.diag(white_noise_covariance(solution)[0])[own], 1e-300))
    z = float(np.max(np.abs(solution.p[own]) / std, initial=0.0 if own else np.inf))
    return float(max(2 * normal_sf(z), np.finfo(float).tiny))


def _expected_peaks(solution: Solution, effect: Effect, forces: Sequence[Array]) -> list[float]:
    """Largest expected force of an effect in every piece, N, whatever part of it the piece passes."""
    own = [float(np.max(np.abs(f), initial=0.0)) for f in forces]
    if any(p.per_run and p.is_size for p in effect.parameters):
        return own
    paths = [(r.piece.path, solution.problem.layout.values(solution.p, r.piece.run)[1]) for r in solution.responses]
    factors = [{"load": path.load * level, "mass": path.mass_ratio} for path, level in paths]
    scales = np.array([float(f.get(effect.scales_with, 1.0)) for f in factors])
    return list(np.max(np.array(own) / scales) * scales)


def _close_gaps(acts: Mask) -> Mask:
    """Close gaps of a few frames in a mask."""
    rows = np.flatnonzero(acts)
    out = np.array(acts)
    for a, b in itertools.pairwise(rows):
        if b - a <= MAX_GAP_FRAMES:
            out[a:b] = True
    return out


def _to_dict(response: PieceResponse, runs: Sequence[Run], span: FailingSpan) -> dict[str, Any]:
    """JSON of one span."""
    run, (x, v) = runs[response.piece.run], position_and_velocity(response)
    series = {"t": run.displacement.t[response.piece.frames], "x": x, "v": v}
    ranges = {name: [float(q[span.rows].min()), float(q[span.rows].max())] for name, q in series.items()}
    return {"run": run.name, **ranges, "share_of_error": round(float(np.clip(span.share, 0.0, 1.0)), 4), "p": span.p}
