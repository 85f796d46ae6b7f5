"""Return the settings of filmed and of planned runs: speed, mass, incline, frame rate and zoom."""

from __future__ import annotations

from frictrack.costs import RunSettings
from frictrack.diagnose.experiments.virtual_runs import RunDesign, incline_of, longest_piece
from frictrack.fit.least_squares import Solution


def settings_of(solution: Solution, design: RunDesign) -> RunSettings:
    """Settings of a planned run, whose design is relative to the longest run of a fit."""
    piece = longest_piece(solution.problem.pieces)
    fps = solution.problem.layout.spans[0].fps * design.rate
    return RunSettings(design.start[1], piece.mass * design.mass, incline_of(piece) + design.tilt, fps, design.pitch)


def last_settings(solution: Solution) -> RunSettings:
    """Settings of the last run of a fit: what is on the table now."""
    layout = solution.problem.layout
    run = len(layout.run_names) - 1
    piece, start = next((p, s) for p, s in zip(solution.problem.pieces, solution.starts, strict=True) if p.run == run)
    return RunSettings(float(start[1]), piece.mass, incline_of(piece), layout.spans[0].fps)
