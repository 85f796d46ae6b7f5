"""Run-in: dry friction changes with the distance slid in all runs so far, and stays so."""

from dataclasses import replace

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.library import thermal
from frictrack.effects.ranges import Span, log_grid


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """-L s (1 - exp(-S/length)), shape (n, 1): N per N of dF; S is slid in this run and all before it."""
    before = path.each(np.array([sum(slid for _, slid in earlier) for earlier in path.each_earlier()]))
    return thermal.columns(replace(path, travelled=path.travelled + before), nonlinear)


def lengths(span: Span) -> Array:
    """Distances worth trying, m: one run, up to three times the whole series, where the change is a straight line."""
    travel = span.x_max - span.x_min
    return log_grid(travel / 3, 3 * (travel + sum(slid for _, slid in span.earlier)), 4)


equation = "-dF L s (1 - exp(-S/length)), S = distance slid in this run and all before it"
parameters = (
    Parameter("dF", "N", linear=True, loaded=True),
    Parameter("length", "m", scan=lengths),
)
varies_with = "x"
scales_with = "load"
what = "The surfaces run in (dF > 0) or wear (dF < 0) as they slide, and stay so between the runs."
looks_like = "friction levels that move from run to run in the order of the runs, toward a new level"
mistaken_for = "heating (where all pauses are alike), levels that scatter from run to run"
confirm = "Repeat the first run at the end, after an hour: what has run in stays."
describe = Phrase(thermal.describe.text + " in all runs")
invariant = "running-in stays through a pause"
settled_by = "repeat the first run after a long pause"
source = "Blau 1989 (running-in); Archard 1953, J. Appl. Phys. 24, 981 (wear in proportion to the distance slid)"
needs = ("earlier",)
