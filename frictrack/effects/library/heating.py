"""Heating: every run warms the surfaces, which cool between the runs; dry friction follows their temperature."""

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.ranges import Span, log_grid


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """-L s W, shape (n, 1): N per N/m of k; W (m) is slid in this run, and in those before it as far as still warm.

    A run is short beside the time constant: it does not cool.
    """
    first = list(path.starts)
    taus = np.broadcast_to(nonlinear["tau"], path.t.shape)[first]
    pairs = zip(path.each_earlier(), taus, strict=True)
    left = np.array([sum(slid * np.exp(-rest / tau) for rest, slid in earlier) for earlier, tau in pairs])
    return -(path.load * path.s * (path.each(left) + path.distance))[:, None]


def cooling_times(span: Span) -> Array:
    """Time constants worth trying, s: shorter than any pause nothing is left, far longer nothing cools."""
    rests = [rest for rest, _ in span.earlier] or [60.0]
    return log_grid(min(rests) / 4, 4 * max(rests), 6)


equation = "-k L s W, W = distance + sum over the runs before of distance exp(-rest/tau)"
parameters = (
    Parameter("k", "N/m", linear=True, loaded=True),
    Parameter("tau", "s", scan=cooling_times),
)
varies_with = "x"
scales_with = "load"
what = "Friction heats the surfaces, which soften (k > 0) or stick (k < 0), and cool while the mass rests."
looks_like = "friction that falls through every run, and starts lower the shorter the rest before it was"
mistaken_for = "run-in (where all pauses are alike), thermal (in one run), levels that scatter from run to run"
confirm = "Repeat one run after pauses of 10 s, 1 min and 10 min: the level follows the pause."
describe = Phrase(
    "{abs(k)} N {'less' if k > 0 else 'more'} per metre slid; two thirds of it are gone after a rest of {tau} s"
)
invariant = "heat fades in a pause"
settled_by = "repeat one run after a short and after a long pause"
source = "lumped heat capacity, T' = P/C - T/tau with P in proportion to |v|; Ettles 1986"
needs = ("earlier",)
