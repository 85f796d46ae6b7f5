"""Search long records in bounded time: on some of very many segments, and on every few of very many frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from frictrack.fit.least_squares import Solution, fit_with_scatter, refine
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.segments import Piece, has_known_history

MAX_PIECES = 32  # pieces that are looked at, unless there are more runs
MAX_FREQUENCY_RATIO = 0.2  # of the frame rate: up to it lines are looked for, see `effects.base.frequencies`
MAX_FRAMES = 12_000  # over all pieces, a dozen films of slides; the search takes time in proportion
MAX_WORK = 2_000_000  # frames times periods of the fastest line in the longest piece: lines are tried at each of them


def subsample_pieces(solution: Solution) -> tuple[Solution, str]:
    """The law refined on so many pieces as a search can look at, and in words what was left out; "" where nothing."""
    pieces = solution.problem.pieces
    if len(pieces) <= MAX_PIECES:
        return solution, ""
    kept = _spread(pieces)
    problem = solution.problem.rebuild(_coarser(solution.problem.layout, pieces, kept), [pieces[i] for i in kept])
    starts = [solution.starts[i] for i in kept]
    some = fit_with_scatter(problem, solution.p, starts, solution.tau or 0.03)
    return some, (
        f"a long record: {len(kept)} of its {len(pieces)} segments were looked at, spread evenly; "
        "what happens once in between is not seen"
    )


def subsample_frames(solution: Solution) -> tuple[Solution, str]:
    """Return the law compared at every few frames of very many, and in words what that means; "" where all are kept.

    The law itself was fitted to all frames.
    """
    every = _stride(solution)
    if every <= 1:
        return solution, ""
    pieces = [_every(p, every) for p in solution.problem.pieces]
    layout = solution.problem.layout
    coarse = replace(layout, spans=tuple(replace(s, fps=s.fps / every) for s in layout.spans))
    problem = solution.problem.rebuild(coarse, pieces)
    held = np.zeros(len(solution.p), dtype=bool)
    some = refine(problem, solution.p, solution.starts, tau=solution.tau, free=held, max_steps=0)
    return some, (
        f"a long record: the search looked at every {every}th of its frames, so a line above "
        f"{MAX_FREQUENCY_RATIO * layout.span.fps / every:.3g} Hz is not looked for; the fit uses all of them"
    )


def _stride(solution: Solution) -> int:
    """Every how manyth frame is looked at; longer records know more lines apart, which every frame is held against."""
    frames, longest = solution.problem.n_frames, max(len(p.t) for p in solution.problem.pieces)
    return max(-(-frames // MAX_FRAMES), math.ceil(math.sqrt(frames * MAX_FREQUENCY_RATIO * longest / MAX_WORK)))


def _every(piece: Piece, every: int) -> Piece:
    """A piece with every few of its frames alone, its panels from one to the next."""
    rows = slice(None, None, every)
    angle = None if piece.angle is None else piece.angle[rows]
    kept = {name: getattr(piece, name)[rows] for name in ("frames", "t", "y", "sigma", "at")}
    return replace(piece, angle=angle, slack=piece.slack * every, **kept).refined(piece.per_frame)


def _coarser(layout: ParameterLayout, pieces: Sequence[Piece], kept: Sequence[int]) -> ParameterLayout:
    """The same unknowns, scanned in time no finer than the time looked at can tell.

    Segments far apart know many more frequencies apart than so few frames can judge: one always fits by chance.
    """
    seen = [sum(float(np.ptp(pieces[i].t)) for i in kept if pieces[i].run == r) for r in range(len(layout.spans))]
    spans = [replace(s, duration=min(s.duration, time)) for s, time in zip(layout.spans, seen, strict=True)]
    return replace(layout, spans=tuple(spans))


def _spread(pieces: Sequence[Piece]) -> list[int]:
    """Places of pieces spread evenly over every run, at least one of each.

    Those at the beginning of a run that was recorded in motion are left out: what a law remembers there is not known.
    """
    out: list[int] = []
    for run in sorted({p.run for p in pieces}):
        own = [i for i, p in enumerate(pieces) if p.run == run]
        own = [i for i in own if has_known_history(pieces[i])] or own
        count = max(MAX_PIECES * len(own) // len(pieces), 1)
        out += [own[int(k)] for k in np.linspace(0, len(own) - 1, count).round()]
    return out
