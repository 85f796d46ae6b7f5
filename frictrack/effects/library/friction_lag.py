"""Frictional lag: the level of dry friction answers a change of speed only after a while."""

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, Phrase, TestDraw
from frictrack.effects.memory import follow_target, remembered, time_steps
from frictrack.effects.ranges import Span, log_grid, shorter_than_record


def columns(path: Path, nonlinear: Nonlinear, inner: Array) -> Array:
    """Dry-friction columns whose size u follows the one c of the moment, du/dt = (c - u)/tau, same shape as `inner`.

    A steady change of c arrives tau late. The sign stays the one of the motion: friction never pushes.
    """
    return remembered(path, state, nonlinear, inner) * path.s[:, None]


def state(path: Path, nonlinear: Nonlinear, inner: Array) -> Array:
    """The size u of dry friction that follows the one of the moment, (n, k)."""
    size = inner * path.s[:, None]
    starts = list(path.starts)
    rested = [i for i in starts if path.s[i] == 0]
    size[rested] = size[np.minimum(np.add(rested, 1), len(size) - 1).astype(int)]
    begin = size[starts] if path.begin is None else path.begin
    return follow_target(path, size, begin, time_steps(path) / nonlinear["tau"])


def lags(span: Span) -> Array:
    """Lags worth trying, s: from half a frame up to a quarter of the longest run."""
    return log_grid(0.5 / span.fps, max(span.duration / 4.0, 2.0 / span.fps), 6)


equation = "coulomb + stribeck -> s u, du/dt = (|coulomb + stribeck| - u)/tau"
parameters = (Parameter("tau", "s", (1e-7, np.inf), scan=lags),)
modifies = frozenset({"coulomb", "stribeck"})
scales_with = "load"
memory = True
rank = -1
what = "Film thickness and bonds take their time: dry friction belongs to the speed of a moment ago."
looks_like = "a loop against v where the speed swings; a hook that comes late before a stop"
mistaken_for = "another Stribeck velocity, when the speed only falls"
confirm = "Let the speed swing under a drive at two frequencies: the loop against v opens with the frequency."
plausible = shorter_than_record("tau", 0.5)
describe = Phrase("{1e3 * tau} ms late, {tau * study.typical_speed:m} at {study.typical_speed:2} m/s")
invariant = "a lag needs a speed that changes to and fro"
test_draw = TestDraw(only_with=frozenset({"stribeck"}))
source = "Hess & Soom 1990, J. Tribology 112, 147; the lag on the level as in Armstrong-Helouvry et al. 1994"
