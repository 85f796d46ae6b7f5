"""Find where a fitted model fails: spans in time, place, velocity and run, with share of the misfit and p-value."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from frictrack.compare.bump_dictionary import trace_bumps, width_limits
from frictrack.compare.bumps import Bump
from frictrack.compare.effect_forces import effect_force, effect_force_at_nodes
from frictrack.compare.local_forces import (
    ALPHA,
    ALPHA_PIECE,
    LocalForces,
    bump_columns,
    continue_search,
    find_local_forces,
    solve_sizes,
    start_search,
)
from frictrack.distributions import normal_sf
from frictrack.effects import Effect
from frictrack.fit.least_squares import (
    ModelProjection,
    PieceResponse,
    Solution,
    displacement_response,
    model_projection,
    position_and_velocity,
)
from frictrack.fit.observations import MeasuredFrictionPiece, keep_compared_frames
from frictrack.fit.segments import Rows
from frictrack.records import Array, Mask, Run, stretches

SPAN_HALF_WIDTHS = 2.0  # half length of a span, in widths of its Gaussian
TAIL_RATIO = float(np.exp(-(SPAN_HALF_WIDTHS**2) / 2))  # height at the end of a span over the peak
MIN_CHI2_RESOLVED = 6.6  # rise with the shortest width above which a duration is resolved
MIN_SIGMAS = 3.0  # of a measured force, above which a frame fails
MIN_SHARE_OF_PEAK = 0.35  # of the largest residual; less may be the model compensating a failure elsewhere
MAX_GAP_FRAMES = 12  # frames between two stretches that count as one
N_WIDTHS, N_CENTRES = 25, 15  # grid of widths and centres for the span of a bump
N_REFINEMENTS = 2  # of that grid around likely values
MAX_CHI2_DIFFERENCE = 16.0  # from the best fit, within which a width and centre count


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
        misfit (chi-squared above its expectation); `p`: p-value of the whole search. Empty if noise alone would do as
        much (1 %). A blow too short to be resolved extends as far as the run's low-pass spreads it.

    """
    solution = keep_compared_frames(solution)
    found = _spans_of_residual(solution, runs) if missing is None else _spans_of_effect(solution, runs, missing)
    spans = [_to_dict(solution.responses[s.piece], runs, s) for s in found if len(s.rows) > 1]
    return sorted(spans, key=lambda s: -s["share_of_error"])


def _spans_of_residual(solution: Solution, runs: Sequence[Run]) -> list[FailingSpan]:
    """Spans of the local forces in the residual."""
    found = find_local_forces(solution)
    if not found.bumps:
        return []
    if not found.complete and isinstance(solution.problem.pieces[0], MeasuredFrictionPiece):
        return _spans_of_measured_friction(found)
    return _spans_of_bumps(found, runs)


def _spans_of_bumps(found: LocalForces, runs: Sequence[Run]) -> list[FailingSpan]:
    """Extent of the bumps of a search in every piece."""
    columns = bump_columns(found, found.bumps)[:, :, 0]
    sizes, _ = solve_sizes(found.law, columns)
    total = excess_chi2(found.law)
    spans = []
    for k, (bump, unresolved) in enumerate(
        zip(_consensus_bumps(found, columns), _are_unresolved(found, columns), strict=True)
    ):
        for i, rows in enumerate(found.law.rows):
            if bump.piece in (None, i):
                share = float(sizes[k] * (columns[rows, k] @ found.law.r[rows])) / total
                inside = _inside(
                    found, bump, i, _low_pass_half_width(runs, found.law.responses[i]) if unresolved else 0.0
                )
                spans.append(FailingSpan(i, np.flatnonzero(inside), share, found.p(found.bumps[k])))
    return _merge_overlapping(spans)


def _spans_of_measured_friction(found: LocalForces) -> list[FailingSpan]:
    """Spans where the residual of a measured friction force itself is significant, if the model fails everywhere."""
    spans, total = [], sum(float(r.r @ r.r) for r in found.law.responses)
    for i, response in enumerate(found.law.responses):
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


def excess_chi2(law: ModelProjection) -> float:
    """Chi-squared of the residual above its expectation, at least its standard deviation."""
    dof = max(len(law.r) - law.u.shape[1], 1)
    return max(float(law.r @ law.r) - dof, float(np.sqrt(2 * dof)))


def _inside(found: LocalForces, bump: Bump, i: int, half_width: float) -> Mask:
    """Frames of a piece that lie within a bump."""
    piece = found.law.responses[i].piece
    if not bump.at_place:
        reach = SPAN_HALF_WIDTHS * (width_limits(found.law.responses, bump)[0] if half_width else bump.width)
        return np.asarray(np.abs(piece.t - bump.centre) <= reach + half_width)
    x, _ = position_and_velocity(found.law.responses[i])
    return np.asarray(np.abs(x - bump.centre) <= SPAN_HALF_WIDTHS * bump.width)


def _low_pass_half_width(runs: Sequence[Run], response: PieceResponse) -> float:
    """Half width of the run's low-pass, s; 0 if unknown or if friction itself was measured."""
    cutoff = runs[response.piece.run].motion.cutoff
    known = np.isfinite(cutoff) and cutoff > 0 and not isinstance(response.piece, MeasuredFrictionPiece)
    return 0.5 / float(cutoff) if known else 0.0


def _are_unresolved(found: LocalForces, columns: Array) -> list[bool]:
    """Whether each bump in time is as short as the shortest that the frames resolve."""
    _, best = solve_sizes(found.law, columns)
    out = []
    for k, bump in enumerate(found.bumps):
        shortest = columns.copy()
        shortest[:, k] = bump_columns(found, [replace(bump, width=width_limits(found.law.responses, bump)[0])])[:, 0, 0]
        out.append(not bump.at_place and solve_sizes(found.law, shortest)[1] - best < MIN_CHI2_RESOLVED)
    return out


def _consensus_bumps(found: LocalForces, columns: Array) -> list[Bump]:
    """Replace each bump by the one whose span overlaps best with those of all that fit, weighted by likelihood.

    A narrow bump leaves nearly the trace of an impulse whatever its width, so the best fit alone is arbitrary.
    """
    return [_consensus_bump(found, bump, np.delete(columns, k, axis=1)) for k, bump in enumerate(found.bumps)]


def _consensus_bump(found: LocalForces, bump: Bump, others: Array) -> Bump:
    """The bump whose frames overlap best with those of all centres and widths, weighted by their likelihood."""
    law = found.law.with_columns(others)
    reach = 3 * _centre_std(found, law, bump)
    centres = np.linspace(bump.centre - reach, bump.centre + reach, N_CENTRES)
    widths = np.geomspace(*width_limits(found.law.responses, bump), N_WIDTHS)
    for _ in range(N_REFINEMENTS):
        likely = np.flatnonzero(_relative_likelihood(found, law, _grid(bump, centres, widths)))
        centres = np.linspace(*_ends(centres, likely // N_WIDTHS), N_CENTRES)
        widths = np.geomspace(*_ends(widths, likely % N_WIDTHS), N_WIDTHS)
    tried = _grid(bump, centres, widths)
    weight = _relative_likelihood(found, law, tried)
    at = np.flatnonzero(weight)
    inside = np.stack([_frames(found, tried[k]) for k in at]).astype(np.float32)
    count = inside.sum(axis=1)
    overlap = 2 * (inside @ inside.T) / np.maximum(count[:, None] + count, 1.0)
    return tried[at[int(np.argmax(overlap @ weight[at]))]]


def _grid(bump: Bump, centres: Array, widths: Array) -> list[Bump]:
    """The bump at every centre with every width."""
    return [replace(bump, centre=c, width=w) for c in centres.tolist() for w in widths.tolist()]


def _ends(grid: Array, rows: Rows) -> tuple[float, float]:
    """The part of a grid that some of its rows span, one step further on either side."""
    return float(grid[max(rows.min() - 1, 0)]), float(grid[min(rows.max() + 1, len(grid) - 1)])


def _relative_likelihood(found: LocalForces, law: ModelProjection, bumps: Sequence[Bump]) -> Array:
    """Likelihood of every bump of one piece or of all, relative to the best, (k,), each at its best size.

    It is 0 where negligible.
    """
    squares, data, on_law = np.zeros(len(bumps)), np.zeros(len(bumps)), np.zeros((len(bumps), law.u.shape[1]))
    for i, (rows, traces) in enumerate(zip(law.rows, found.dictionary.maps, strict=True)):
        if bumps[0].piece in (None, i):
            own = trace_bumps(traces, bumps)
            squares += np.einsum("kn,kn->k", own, own)
            data += own @ law.r[rows]
            on_law += own @ law.u[rows]
    gain = data**2 / np.maximum(squares - np.einsum("kp,kp->k", on_law, on_law), 1e-300)
    return np.asarray(np.where(gain > gain.max() - MAX_CHI2_DIFFERENCE, np.exp((gain - gain.max()) / 2), 0.0))


def _centre_std(found: LocalForces, law: ModelProjection, bump: Bump) -> float:
    """Standard deviation of a bump's centre, with size and width free (width within a factor of e)."""
    derivatives = bump_columns(found, [bump])[:, 0] * np.array([1.0, bump.size, bump.size])
    derivatives -= law.u @ (law.u.T @ derivatives)
    prior = np.diag([0.0, bump.width**-2, 1.0])
    return float(np.sqrt(np.linalg.pinv(derivatives.T @ derivatives + prior, hermitian=True)[1, 1]))


def _frames(found: LocalForces, bump: Bump) -> Mask:
    """Frames of all pieces, concatenated, that a bump covers."""
    pieces = [i for i in range(len(found.law.rows)) if bump.piece in (None, i)]
    return np.concatenate([_inside(found, bump, i, 0.0) for i in pieces])


def _spans_of_effect(solution: Solution, runs: Sequence[Run], missing: str) -> list[FailingSpan]:
    """Spans in which the force of an effect acts: where it exceeds the tail of a Gaussian at two widths.

    A local effect is searched again beside the model that contains it, over all widths; its fitted place may be wrong.
    """
    effect = next(e for e in solution.problem.model.effects if e.name == missing)
    law = _model_without(solution, effect)
    search = start_search(law)
    if effect.acts_within is not None and (found := continue_search(search)).bumps:
        return _spans_of_bumps(found, runs)
    forces = [effect_force(solution, r, missing) for r in solution.responses]
    sizes = _expected_peaks(solution, effect, forces)
    places = []
    for i, (force, size) in enumerate(zip(forces, sizes, strict=True)):
        acts = np.abs(force) > TAIL_RATIO * size
        places += [(i, np.arange(s.start, s.stop)) for s in stretches(_close_gaps(acts))]
    if not places:
        return []
    columns = np.stack([_partial_trace(law, i, rows, solution, missing) for i, rows in places], axis=1)
    total_trace = columns.sum(axis=1)
    total = max(excess_chi2(law), float(np.sum((total_trace - law.u @ (law.u.T @ total_trace)) ** 2)))
    # what the runs share acts in all of them or in none
    group = np.array([solution.responses[i].piece.run if _has_size_per_run(effect) else 0 for i, _ in places])
    names, of = np.unique(group, return_inverse=True)
    z = _joint_significance(law, np.stack([columns[:, group == g].sum(axis=1) for g in names], axis=1))[of]
    p = [_p_value(search, i, float(s)) for (i, _), s in zip(places, z, strict=True)]
    spans = [
        FailingSpan(i, at, float(c @ law.r) / total, q) for (i, at), c, q in zip(places, columns.T, p, strict=True)
    ]
    return [s for s in spans if s.p < ALPHA_PIECE]


def _p_value(search: LocalForces, piece: int, z: float) -> float:
    """p-value of a span in the whole search, or in its piece if that search is not significant."""
    global_p = search.significance(z)
    return global_p if global_p < ALPHA else min(global_p, search.piece_significance[piece](z))


def _expected_peaks(solution: Solution, effect: Effect, forces: Sequence[Array]) -> list[float]:
    """Largest expected force of an effect in every piece, N, whatever part of it the piece passes."""
    own = [float(np.max(np.abs(f), initial=0.0)) for f in forces]
    if _has_size_per_run(effect):
        return own
    scales = []
    for r in solution.responses:
        _, level = solution.problem.layout.values(solution.p, r.piece.run)
        carried = {"load": r.piece.path.load * level, "mass": r.piece.path.mass_ratio}
        scales.append(float(carried.get(effect.scales_with, 1.0)))
    largest = max(f / s for f, s in zip(own, scales, strict=True))
    return [largest * s for s in scales]


def _has_size_per_run(effect: Effect) -> bool:
    """Whether every run has its own size of the effect."""
    return any(p.per_run and (p.linear or p.role in ("amplitude", "depth")) for p in effect.parameters)


def _model_without(solution: Solution, effect: Effect) -> ModelProjection:
    """The model without one of its effects, and the residual that this leaves."""
    slots = solution.problem.layout.slots
    kept = [i for i, s in enumerate(slots) if s.effect != effect.name]
    projection = model_projection(solution, kept)
    trace = np.zeros_like(projection.r)
    for rows, response in zip(projection.rows, solution.responses, strict=True):
        at = effect_force_at_nodes(solution, response, effect.name)
        trace[rows] = displacement_response(response, at[:, None])[:, 0]
    return replace(projection, r=projection.r + trace - projection.u @ (projection.u.T @ trace))


def _partial_trace(law: ModelProjection, i: int, rows: Rows, solution: Solution, name: str) -> Array:
    """Trace of an effect's force over some frames of one piece, over all frames (N + m,)."""
    response = solution.responses[i]
    t, nodes = response.piece.t, response.piece.panels.t
    inside = (nodes >= t[rows[0]]) & (nodes <= t[rows[-1]])
    out = np.zeros_like(law.r)
    force = np.where(inside, effect_force_at_nodes(solution, response, name), 0.0)
    out[law.rows[i]] = displacement_response(response, force[:, None])[:, 0]
    return out


def _joint_significance(law: ModelProjection, columns: Array) -> Array:
    """Significance of each column (N + m, k) with model and other columns free, in standard deviations."""
    clean = columns - law.u @ (law.u.T @ columns)
    inverse = np.linalg.pinv(clean.T @ clean, hermitian=True)
    deviation = np.sqrt(np.diag(inverse))
    return np.divide(inverse @ (clean.T @ law.r), deviation, out=np.zeros(len(inverse)), where=deviation > 0)


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
    run, at = runs[response.piece.run], span.rows
    x, v = position_and_velocity(response)

    def reach(a: Array) -> list[float]:
        return [float(a[at].min()), float(a[at].max())]

    return {
        "run": run.name,
        "t": reach(run.displacement.t[response.piece.frames]),
        "x": reach(x),
        "v": reach(v),
        "share_of_error": round(float(np.clip(span.share, 0.0, 1.0)), 4),
        "p": span.p,
    }
