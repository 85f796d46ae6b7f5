"""Join the stretches of a swinging run: a mass without a drive that reverses does so without a stop.

Dry friction changes its sign at a reversal. Where gravity or a spring pulls the mass back, it does not rest there,
and one model must describe the loss from swing to swing. A blow also reverses a mass, but at once: there the
stretches stay separate.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from frictrack.friction import reverses_freely
from frictrack.records import Run


def join_swings(run: Run, sections: Sequence[slice]) -> list[tuple[slice, float]]:
    """Join neighbouring stretches of a run across the reversals of a swing.

    Parameters
    ----------
    run : Run
        A run without a measured drive; others are left as they are.
    sections : sequence of slice
        Stretches of one direction, as rows of the record.

    Returns
    -------
    list of (slice, float)
        Every stretch, and the speed (m/s) within which its direction changes: what the mass gains in one frame at its
        reversals, 0 for a stretch of one direction.

    """
    out: list[tuple[slice, float]] = []
    for section in sections:
        pull = reverses_freely(run, out[-1][0], section) if out else None
        if pull is None:
            out.append((section, 0.0))
        else:
            before, slack = out[-1]
            frame = float(np.median(np.diff(run.motion.t)))
            out[-1] = slice(before.start, section.stop), max(slack, pull * frame)
    return out
