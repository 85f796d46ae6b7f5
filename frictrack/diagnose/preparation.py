"""Prepare a fit for the search: whole runs in one piece, some of the segments and of the frames of long records."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.fit import Fit
from frictrack.fit.cutting import has_known_history, pieces_of
from frictrack.fit.least_squares import Solution, fit_with_scatter, refine
from frictrack.fit.observations import observation_of
from frictrack.fit.parameters import MASS, ParameterLayout
from frictrack.fit.pieces import Piece

MAX_CHI2_PER_FRAME = 30.0  # chi-squared per frame beyond which no law can be judged along the motion
MAX_PIECES = 32  # of a long record that are searched, unless there are more runs
MAX_FREQUENCY_RATIO = 0.2  # of the frame rate, up to which spectral lines are searched for; see `effects.frequencies`
MAX_FRAMES = 12_000  # over all pieces, in records that are not long; the time of a search is proportional to them
MAX_WORK = 2_000_000  # frames times periods of the fastest line in the longest piece


def join_segments(fit: Fit) -> Solution | None:
    """Refit a model to whole runs.

    A fit divides driven runs into segments so that it forgets unmodelled forces; a search for these must not. A long
    record that is followed through its reversals stays divided: its segments hold many of them.

    Parameters
    ----------
    fit
        The fit.

    Returns
    -------
    Solution or None
        None if no run was divided, or if the model cannot be followed that far.

    """
    old = fit.solution.problem
    if not any(fit.lengths) or MASS in old.model or any(p.turns for p in old.pieces):
        return None
    fine = max(e.fine for e in old.model.effects)
    whole = pieces_of(fit.runs, fit.reference, through_reversals=old.model.turns)
    pieces = [p.refined(fine) for own in whole for p in own]
    problem = old.rebuild(old.layout, pieces)
    try:
        solution = fit_with_scatter(problem, fit.solution.p, problem.first_starts(), fit.solution.tau or 0.03)
    except FrictrackError:
        return None
    return solution if solution.objective < MAX_CHI2_PER_FRAME * problem.n_frames else None


def subsample(solution: Solution) -> tuple[Solution, list[str]]:
    """Return the model over the pieces and frames that are searched, and remarks on what that leaves out.

    A measured friction is weighted by its noise, which leaves few frames of long records.
    """
    if not solution.problem.simulates:
        weighted = observation_of(solution.problem).weighted(solution)
        return weighted, [omitted_lines(solution, weighted)]
    some, omitted = subsample_pieces(solution)
    some, coarse = subsample_frames(some)
    return some, [omitted, coarse]


def subsample_pieces(solution: Solution) -> tuple[Solution, str]:
    """Refit the model on at most `MAX_PIECES` pieces of a long record.

    Short records are divided where an event is missing; that piece must not be left out.

    Parameters
    ----------
    solution
        The fit.

    Returns
    -------
    solution : Solution
    remark : str
        What was left out; empty if nothing was.

    """
    pieces = solution.problem.pieces
    if len(pieces) <= MAX_PIECES or solution.problem.n_frames <= MAX_FRAMES:
        return solution, ""
    kept = _evenly_spaced(pieces)
    problem = solution.problem.rebuild(_limit_spans(solution.problem.layout, pieces, kept), [pieces[i] for i in kept])
    starts = [solution.starts[i] for i in kept]
    some = fit_with_scatter(problem, solution.p, starts, solution.tau or 0.03)
    return some, (
        f"long record: {len(kept)} of its {len(pieces)} segments were searched, evenly spaced; "
        "a single event between them is not detected"
    )


def subsample_frames(solution: Solution) -> tuple[Solution, str]:
    """Compare the model with every few frames of a long record; the fit itself is not repeated.

    Parameters
    ----------
    solution
        The fit to all frames.

    Returns
    -------
    solution : Solution
    remark : str
        What that means for the search; empty if all frames are kept.

    """
    every = _stride(solution)
    if every <= 1:
        return solution, ""
    pieces = [_thin_piece(p, every) for p in solution.problem.pieces]
    layout = solution.problem.layout
    coarse = replace(layout, spans=tuple(replace(s, fps=s.fps / every) for s in layout.spans))
    problem = solution.problem.rebuild(coarse, pieces)
    fixed = np.zeros(len(solution.p), dtype=bool)
    some = refine(problem, solution.p, solution.starts, tau=solution.tau, free=fixed, max_steps=0)
    return some, omitted_lines(solution, some)


def omitted_lines(whole: Solution, some: Solution) -> str:
    """Return which lines a search of some of the frames cannot test; empty if it uses them all."""
    fps = some.problem.layout.span.fps
    every = round(whole.problem.layout.span.fps / fps)
    if every <= 1:
        return ""
    return (
        f"long record: the search used one in {every} of its frames, so lines above "
        f"{MAX_FREQUENCY_RATIO * fps:.3g} Hz are not tested; the fit uses all frames"
    )


def _stride(solution: Solution) -> int:
    """Step between the frames used: longer records resolve more lines, and each line is compared with every frame."""
    frames, longest = solution.problem.n_frames, max(len(p.t) for p in solution.problem.pieces)
    return max(-(-frames // MAX_FRAMES), math.ceil(math.sqrt(frames * MAX_FREQUENCY_RATIO * longest / MAX_WORK)))


def _thin_piece(piece: Piece, every: int) -> Piece:
    """A piece with every few of its frames."""
    rows = slice(None, None, every)
    angle = None if piece.angle is None else piece.angle[rows]
    kept = {name: getattr(piece, name)[rows] for name in ("frames", "t", "y", "sigma", "at")}
    return replace(piece, angle=angle, slack=piece.slack * every, **kept).refined(piece.per_frame)


def _limit_spans(layout: ParameterLayout, pieces: Sequence[Piece], kept: Sequence[int]) -> ParameterLayout:
    """The same parameters, scanned only as finely as the duration used can resolve.

    Distant segments separate many more frequencies than so few frames can test: one would always fit by chance.
    """
    duration = [sum(float(np.ptp(pieces[i].t)) for i in kept if pieces[i].run == r) for r in range(len(layout.spans))]
    spans = [replace(s, duration=min(s.duration, time)) for s, time in zip(layout.spans, duration, strict=True)]
    return replace(layout, spans=tuple(spans))


def _evenly_spaced(pieces: Sequence[Piece]) -> list[int]:
    """Indices of pieces spread evenly over every run, at least one of each.

    Pieces at the start of a run that was recorded in motion are left out: the state of an effect with memory is
    unknown.
    """
    out: list[int] = []
    for run in sorted({p.run for p in pieces}):
        own = [i for i, p in enumerate(pieces) if p.run == run]
        own = [i for i in own if has_known_history(pieces[i])] or own
        count = max(MAX_PIECES * len(own) // len(pieces), 1)
        out += [own[int(k)] for k in np.linspace(0, len(own) - 1, count).round()]
    return out
