"""Notice a body that rolls although the study does not say so: inertia of rotation looks like dry friction.

A body with I = k m r^2 that rolls down without friction has a = g sin(incline) / (1 + k). Taken for one that slides, it
seems to be held back by k / (1 + k) of the pull of gravity: a third for a disc.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from frictrack.base.number_format import format_length, format_number
from frictrack.fit.routes import FittedRuns
from frictrack.records import GRAVITY, ROLLING, Run

MAX_ROLLING_DEVIATION = 0.03  # relative, of the apparent friction from that of a shape
MIN_ROLLING_FRAMES, MIN_ROLLING_TURN = 16, 0.5  # frames, and rad, from which a turn is judged
MIN_ROLLING_R2 = 0.98  # of the angle against the way


def rolling_remarks(fitted: FittedRuns) -> Iterator[str]:
    """Yield where friction may be the inertia of a body that rolls, which takes k/(1 + k) of the pull of gravity."""
    level = fitted.solution.problem.layout.reported_values(fitted.solution.p).get("coulomb.F_c")
    for run in fitted.runs:
        if run.drive is not None or run.rolling or not run.mass:
            continue
        if turned := _turns_with_its_way(run):
            yield f"{run.name}: {turned}"
        share = (level or 0.0) / (run.mass * abs(GRAVITY * np.sin(run.incline)) or np.inf)
        shape, k = min(ROLLING.items(), key=lambda one: abs(share - one[1] / (1 + one[1])))
        if not turned and abs(share * (1 + k) / k - 1) < MAX_ROLLING_DEVIATION:
            yield (
                f"{run.name}: dry friction takes {format_number(share)} of the pull of gravity, as the inertia of a "
                f'{shape} that rolls down without friction; if it rolls, give rolling = "{shape}"'
            )


def _turns_with_its_way(run: Run) -> str:
    """Say that the target turns in proportion to its way, as a body that rolls; "" if it does not."""
    x, angle = run.displacement.x, np.asarray(run.displacement.angle, dtype=float)
    known = np.isfinite(x) & np.isfinite(angle)
    if known.sum() < MIN_ROLLING_FRAMES or np.ptp(angle[known]) < MIN_ROLLING_TURN:
        return ""
    turn, correlation = np.polyfit(x[known], angle[known], 1)[0], np.corrcoef(x[known], angle[known])[0, 1]
    if correlation**2 < MIN_ROLLING_R2:
        return ""
    return (
        f"the target turns by one radian in {format_length(abs(1 / turn))}, as a body of that radius that rolls; if it "
        f"rolls, give rolling = {' or '.join(ROLLING)}, since its inertia is no friction"
    )
