"""Where a fitted law fails: spans in time, place, velocity and run, each with its share of the misfit and its p."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import norm

from frictrack.compare.bump_dictionary import Bump, limits
from frictrack.compare.local_forces import ALPHA, LIKEWISE, Local, bump_columns, local_forces, opened, searched, solved
from frictrack.compare.residual import effect_force, nodes_force
from frictrack.effects import Effect
from frictrack.fit.least_squares import (
    ModelProjection,
    PieceResponse,
    Solution,
    displacement_response,
    model_projection,
    position_and_velocity,
)
from frictrack.fit.measured_friction import MeasuredFrictionPiece, keep_compared_frames
from frictrack.fit.segments import Rows
from frictrack.records import Array, Mask, Run, stretches

REACH = 2.0  # widths on either side that a Gaussian force spans
TAIL = float(np.exp(-(REACH**2) / 2))  # of a force's largest value, the same for any shape
RESOLVED = 6.6  # rise of chi-squared by which a moment must be longer than the shortest to count as resolved
STANDS_OUT = 3.0  # standard deviations of a measured force beyond which a frame fails
FOOT = 0.35  # of the largest residual: less is the law bending to make up for the failure elsewhere
GAP = 12  # frames between two stretches that are one
WIDTHS, CENTRES = 25, 15  # tried for the span of a local force
CLOSER = 2  # times that they are looked for more finely where they are likely
LIKELY = 16.0  # of chi-squared, by which a width and a place may fit worse and still count
LOCAL = ("patch", "collision")  # effects that are bumps


@dataclass(frozen=True)
class Span:
    """A stretch of one piece, rows of its frames, and what it carries."""

    piece: int
    rows: Rows
    share: float
    p: float


def failing_spans(solution: Solution, runs: Sequence[Run], missing: str | None = None) -> list[dict[str, Any]]:
    """Stretches of the runs that carry the misfit, worst first; none where noise alone does as much (1 %).

    With `missing`, the failure is that of the model without this force effect of the solution, whose force then says
    where. `t` is recording time (s), `x` (m), `v` (m/s); `share_of_error` is the part of the misfit, chi-squared beyond
    its noise, that goes with what the span lacks; `p` is for the whole search over spans. A blow too short to be
    resolved reaches as far as the run's own low-pass smears it.
    """
    solution = keep_compared_frames(solution)
    found = _found(solution, runs) if missing is None else _named(solution, runs, missing)
    told = [_told(solution.responses[s.piece], runs, s) for s in found if len(s.rows) > 1]
    return sorted(told, key=lambda s: -s["share_of_error"])


def _found(solution: Solution, runs: Sequence[Run]) -> list[Span]:
    """Spans of the local forces that the bare law's residual shows."""
    found = local_forces(solution)
    if not found.bumps:
        return []
    if not found.complete and isinstance(solution.problem.pieces[0], MeasuredFrictionPiece):
        return _plain_to_see(found)
    return _reaching(found, runs)


def _reaching(found: Local, runs: Sequence[Run]) -> list[Span]:
    """How far the bumps of a search reach in every piece."""
    made = bump_columns(found, found.bumps)[:, :, 0]
    sizes, _ = solved(found.law, made)
    total = misfit(found.law)
    spans = []
    for k, (bump, brief) in enumerate(zip(_overlapping(found, made), _brief(found, made), strict=True)):
        for i, rows in enumerate(found.law.rows):
            if bump.piece in (None, i):
                share = float(sizes[k] * (made[rows, k] @ found.law.r[rows])) / total
                inside = _inside(found, bump, i, _smear(runs, found.law.responses[i]) if brief else 0.0)
                spans.append(Span(i, np.flatnonzero(inside), share, found.p(found.bumps[k])))
    return _joined(spans)


def _plain_to_see(found: Local) -> list[Span]:
    """Where friction itself was measured and fails all over: stretches in which the residual stands out as it is."""
    spans, total = [], sum(float(r.r @ r.r) for r in found.law.responses)
    for i, response in enumerate(found.law.responses):
        size = np.abs(response.r)
        for s in stretches(_bridged(size > max(STANDS_OUT, FOOT * float(size.max())))):
            p = min(1.0, 2 * len(size) * float(norm.sf(size[s].max())))
            if p < ALPHA:
                spans.append(Span(i, np.arange(s.start, s.stop), float(size[s] @ size[s]) / total, p))
    return spans


def _joined(spans: Sequence[Span]) -> list[Span]:
    """Spans of one piece that overlap as one."""
    out: list[Span] = []
    for s in sorted((s for s in spans if len(s.rows)), key=lambda s: (s.piece, s.rows[0])):
        last = out[-1] if out else None
        if last is not None and last.piece == s.piece and s.rows[0] <= last.rows[-1]:
            out[-1] = Span(s.piece, np.union1d(last.rows, s.rows), last.share + s.share, min(last.p, s.p))
        else:
            out.append(s)
    return out


def misfit(law: ModelProjection) -> float:
    """What the law leaves beyond the noise, of chi-squared; at least what noise makes uncertain of it."""
    freedom = max(len(law.r) - law.u.shape[1], 1)
    return max(float(law.r @ law.r) - freedom, float(np.sqrt(2 * freedom)))


def _inside(found: Local, bump: Bump, i: int, smear: float) -> Mask:
    piece = found.law.responses[i].piece
    if not bump.at_place:
        reach = REACH * (limits(found.law.responses, bump)[0] if smear else bump.width)
        return np.asarray(np.abs(piece.t - bump.centre) <= reach + smear)
    x, _ = position_and_velocity(found.law.responses[i])
    return np.asarray(np.abs(x - bump.centre) <= REACH * bump.width)


def _smear(runs: Sequence[Run], response: PieceResponse) -> float:
    """Half width of the run's own low-pass, s; nothing where none is known or friction itself was measured."""
    cutoff = runs[response.piece.run].motion.cutoff
    known = np.isfinite(cutoff) and cutoff > 0 and not isinstance(response.piece, MeasuredFrictionPiece)
    return 0.5 / float(cutoff) if known else 0.0


def _brief(found: Local, made: Array) -> list[bool]:
    """Which bumps are moments that cannot be told from the shortest."""
    _, best = solved(found.law, made)
    out = []
    for k, bump in enumerate(found.bumps):
        shortest = made.copy()
        shortest[:, k] = bump_columns(found, [replace(bump, width=limits(found.law.responses, bump)[0])])[:, 0, 0]
        out.append(not bump.at_place and solved(found.law, shortest)[1] - best < RESOLVED)
    return out


def _overlapping(found: Local, made: Array) -> list[Bump]:
    """The bumps, each where its span overlaps best with those of all that fit, weighed by how well they do.

    A narrow bump leaves nearly the trace of an impulse, whatever its width: the best fit alone would name any.
    """
    return [_span_of_all(found, bump, np.delete(made, k, axis=1)) for k, bump in enumerate(found.bumps)]


def _span_of_all(found: Local, bump: Bump, others: Array) -> Bump:
    """The bump whose frames overlap best with those of every centre and width, weighed by the likelihood of each."""
    law = found.law.with_columns(others)
    reach = 3 * _astray(found, law, bump)
    centres = np.linspace(bump.centre - reach, bump.centre + reach, CENTRES)
    widths = np.geomspace(*limits(found.law.responses, bump), WIDTHS)
    for _ in range(CLOSER):
        likely = np.flatnonzero(_likelihood(found, law, _grid(bump, centres, widths)))
        centres = np.linspace(*_ends(centres, likely // WIDTHS), CENTRES)
        widths = np.geomspace(*_ends(widths, likely % WIDTHS), WIDTHS)
    tried = _grid(bump, centres, widths)
    weight = _likelihood(found, law, tried)
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


def _likelihood(found: Local, law: ModelProjection, bumps: Sequence[Bump]) -> Array:
    """Likelihood of every bump over that of the best, (k,), each of its best size; 0 where it is next to nothing."""
    columns = bump_columns(found, bumps, moved=False)[:, :, 0]
    clean = columns - law.u @ (law.u.T @ columns)
    gain = (clean.T @ law.r) ** 2 / np.maximum(np.sum(clean**2, axis=0), 1e-300)
    return np.asarray(np.where(gain > gain.max() - LIKELY, np.exp((gain - gain.max()) / 2), 0.0))


def _astray(found: Local, law: ModelProjection, bump: Bump) -> float:
    """Standard deviation of the centre of a bump beside its size and width, of which no more is known than a factor."""
    bent = bump_columns(found, [bump])[:, 0] * np.array([1.0, bump.size, bump.size])
    bent -= law.u @ (law.u.T @ bent)
    known = np.diag([0.0, bump.width**-2, 1.0])
    return float(np.sqrt(np.linalg.pinv(bent.T @ bent + known, hermitian=True)[1, 1]))


def _frames(found: Local, bump: Bump) -> Mask:
    """Frames of all pieces, end to end, that a bump reaches."""
    pieces = [i for i in range(len(found.law.rows)) if bump.piece in (None, i)]
    return np.concatenate([_inside(found, bump, i, 0.0) for i in pieces])


def _named(solution: Solution, runs: Sequence[Run], missing: str) -> list[Span]:
    """Spans in which the force of an effect acts: where it exceeds what a Gaussian has at two widths.

    A local one is looked for afresh beside the law that knows it: all widths that may be have a say, and a moment that
    was fitted to the wrong place is no matter.
    """
    effect = next(e for e in solution.problem.model.effects if e.name == missing)
    law = _without(solution, effect)
    search = opened(law)
    if effect.kind in LOCAL and (found := searched(search)).bumps:
        return _reaching(found, runs)
    forces = [effect_force(solution, r, missing) for r in solution.responses]
    sizes = _sizes(solution, effect, forces)
    places = []
    for i, (force, size) in enumerate(zip(forces, sizes, strict=True)):
        acts = np.abs(force) > TAIL * size
        places += [(i, np.arange(s.start, s.stop)) for s in stretches(_bridged(acts))]
    if not places:
        return []
    made = np.stack([_part(law, i, rows, solution, missing) for i, rows in places], axis=1)
    whole = made.sum(axis=1)
    total = max(misfit(law), float(np.sum((whole - law.u @ (law.u.T @ whole)) ** 2)))
    # what the runs share acts in all of them or in none
    group = np.array([solution.responses[i].piece.run if _own(effect) else 0 for i, _ in places])
    names, of = np.unique(group, return_inverse=True)
    z = _stand_out(law, np.stack([made[:, group == g].sum(axis=1) for g in names], axis=1))[of]
    p = [_p(search, i, float(s)) for (i, _), s in zip(places, z, strict=True)]
    spans = [Span(i, at, float(c @ law.r) / total, q) for (i, at), c, q in zip(places, made.T, p, strict=True)]
    return [s for s in spans if s.p < LIKEWISE]


def _p(search: Local, piece: int, z: float) -> float:
    """Chance of a span: of the whole search, or, where that is too much to ask, of the search in its own piece."""
    whole = search.chance(z)
    return whole if whole < ALPHA else min(whole, search.own[piece](z))


def _sizes(solution: Solution, effect: Effect, forces: Sequence[Array]) -> list[float]:
    """Largest force of an effect to be expected in every piece, whatever part of it the piece passes, N."""
    own = [float(np.max(np.abs(f), initial=0.0)) for f in forces]
    if _own(effect):
        return own
    scales = []
    for r in solution.responses:
        _, level = solution.problem.layout.values(solution.p, r.piece.run)
        carried = {"load": r.piece.path.load * level, "mass": r.piece.path.mass_ratio}
        scales.append(float(carried.get(effect.scales_with, 1.0)))
    largest = max(f / s for f, s in zip(own, scales, strict=True))
    return [largest * s for s in scales]


def _own(effect: Effect) -> bool:
    """Whether every run has a size of its own."""
    return any(p.per_run and (p.linear or p.role in ("amplitude", "depth")) for p in effect.parameters)


def _without(solution: Solution, effect: Effect) -> ModelProjection:
    """The law without one of its effects, and the residual that it would leave."""
    slots = solution.problem.layout.slots
    kept = [i for i, s in enumerate(slots) if s.effect != effect.name]
    whole = model_projection(solution, kept)
    trace = np.zeros_like(whole.r)
    for rows, response in zip(whole.rows, solution.responses, strict=True):
        at = nodes_force(solution, response, effect.name)
        trace[rows] = displacement_response(response, at[:, None])[:, 0]
    return replace(whole, r=whole.r + trace - whole.u @ (whole.u.T @ trace))


def _part(law: ModelProjection, i: int, rows: Rows, solution: Solution, name: str) -> Array:
    """Trace of an effect's force over some frames of one piece, over all frames (N + m,)."""
    response = solution.responses[i]
    t, nodes = response.piece.t, response.piece.panels.t
    inside = (nodes >= t[rows[0]]) & (nodes <= t[rows[-1]])
    out = np.zeros_like(law.r)
    force = np.where(inside, nodes_force(solution, response, name), 0.0)
    out[law.rows[i]] = displacement_response(response, force[:, None])[:, 0]
    return out


def _stand_out(law: ModelProjection, made: Array) -> Array:
    """By how many standard deviations each of the columns (N + m, k) stands out beside the law and all others."""
    clean = made - law.u @ (law.u.T @ made)
    inverse = np.linalg.pinv(clean.T @ clean, hermitian=True)
    deviation = np.sqrt(np.diag(inverse))
    return np.divide(inverse @ (clean.T @ law.r), deviation, out=np.zeros(len(inverse)), where=deviation > 0)


def _bridged(acts: Mask) -> Mask:
    """The same with gaps of a few frames closed."""
    rows = np.flatnonzero(acts)
    out = np.array(acts)
    for a, b in itertools.pairwise(rows):
        if b - a <= GAP:
            out[a:b] = True
    return out


def _told(response: PieceResponse, runs: Sequence[Run], span: Span) -> dict[str, Any]:
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
