"""States of first order: what follows its target late, over a distance or over a time.

    du/dz = c - u,   z = distance/length or time/lag

Along a path the target c is known at its samples. Between two of them it is taken as the cubic with the slopes of
parabolas through neighbours, and the exponential is integrated exactly, so a step may be many lengths long.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from frictrack.effects.definition import Nonlinear, Path
from frictrack.records import Array, Mask

Complexes = NDArray[np.complex128]

MAX_SERIES_STEP = 0.1  # step below which the moments of the exponential are summed as a series
N_SERIES_TERMS = 8  # to 1e-15 there
MAX_PRECEDING_SAMPLES = 400  # samples of the motion before a path that its states still know
MAX_STEP_RATIO = 8.0  # ratio of neighbouring steps beyond which no parabola is laid through them


def slid_per_step(path: Path) -> tuple[Array, Array]:
    """Distance (n,) slid from the sample before: up to a reversal in between, and after it.

    The velocity is taken as linear in time around a reversal; by what the displacement differs from that, the two parts
    share in proportion to their times, so that neither leaps where a sample passes through rest. Zero at the beginning
    of every individual.
    """
    way, v0, v1 = np.sign(path.s), path.v[:-1], path.v[1:]
    dx, s = np.diff(path.x), way[1:]
    back = np.where(way[:-1] * s < 0, np.maximum(-s * v0, 0.0), 0.0)
    onward = np.abs(v1)
    turn = back / np.maximum(back + onward, 1e-300)
    half = np.diff(path.t) / 2.0
    gained = -s * dx - half * (back - onward)  # beyond the linear velocity, in the old direction
    before = np.maximum(turn * (back * half + gained), 0.0)
    after = np.where(back > 0, np.maximum((1 - turn) * (onward * half - gained), 0.0), np.abs(dx))
    out = np.zeros((2, len(path.t)))
    out[:, 1:] = before, after
    out[:, list(path.starts)] = 0.0
    return out[0], out[1]


def preceding_motion(path: Path) -> Path | None:
    """The run's motion just before a path, once for every individual; None where it begins at rest or with the run."""
    if path.before is None or path.before.shape[1] < 2 or path.s[0] == 0 or path.begin is not None:
        return None
    t, x, v = path.before[:, -MAX_PRECEDING_SAMPLES:]
    count = len(path.starts)
    starts = tuple(len(t) * i for i in range(count))
    t, x, v, s = (np.tile(q, count) for q in (t, x, v, direction_of_motion(v)))
    return Path(t, x, v, s, starts=starts)


def remembered(path: Path, state: Callable[..., Array], nonlinear: Nonlinear, *inner: Array) -> Array:
    """What an effect remembers at every sample, (n, k): as it is given, or computed."""
    return state(path, nonlinear, *inner) if path.remembered is None else path.remembered


def state_at_beginning(path: Path, unknown: Array, state_of: Callable[..., Array], *values: float | Array) -> Array:
    """State (P, k) in which a path begins: as it is given, or as the motion before has left it; else `unknown` (P, k).

    `state_of(path, *values)` is the state at every sample, (n,) or (n, k), for values of the parameters.
    """
    if path.begin is not None:
        return path.begin
    earlier = preceding_motion(path)
    if earlier is None:
        return unknown
    each = (np.broadcast_to(value, path.t.shape)[list(path.starts)] for value in values)
    lasting = state_of(earlier, *map(earlier.each, each))
    return np.reshape(lasting[np.array([*earlier.starts[1:], len(earlier.t)]) - 1], unknown.shape)


@dataclass(frozen=True)
class DirectionStretches:
    """A path of n samples cut into q stretches of one direction.

    `way` (n,) is the direction of motion, at rest that of the next motion; `first` (q,) the row at which each stretch
    begins, `which` (n,) the stretch of each sample, `slid` (n,) the distance since its stretch began, `whole` (q,) the
    distance of each stretch up to the reversal, m; `fresh` (q,) tells where an individual of a population begins.
    """

    way: Array
    first: NDArray[np.int_]
    which: NDArray[np.int_]
    slid: Array
    whole: Array
    fresh: Mask

    def entered(self, begin: Array, leave: Callable[[int, float], float]) -> Array:
        """State (q,) in the direction of motion at the beginning of every stretch.

        `begin` (P,) are the states of the individuals, `leave(k, y)` is the state at the end of stretch k that was
        entered with y, both in its direction of motion.
        """
        way, out = self.way[self.first], np.empty(len(self.first))
        out[self.fresh] = way[self.fresh] * begin
        turns = (way[1:] * way[:-1]).tolist()
        for k in np.flatnonzero(~self.fresh).tolist():
            out[k] = turns[k - 1] * leave(k - 1, float(out[k - 1]))
        return out


def direction_stretches(path: Path) -> DirectionStretches:
    """Cut a path at its reversals, and where individuals of a population begin."""
    before, after = slid_per_step(path)
    way, fresh = _ways(path)
    first = np.flatnonzero(fresh | (np.diff(way, prepend=way[:1]) != 0))
    which = np.repeat(np.arange(len(first)), np.diff([*first, len(way)]))
    covered = np.cumsum(after)
    slid = covered - (covered[first] - after[first])[which]
    whole = slid[np.append(first[1:], len(way)) - 1] + np.append(before[first[1:]], 0.0)
    return DirectionStretches(way, first, which, slid, whole, fresh[first])


def _ways(path: Path) -> tuple[Array, Mask]:
    """Direction of motion at every sample (n,), that of the next motion where it rests; where individuals begin."""
    fresh, way, moves = begins(path), np.sign(path.s), path.s != 0
    if moves.all():
        return way, fresh
    rows = np.arange(len(moves))
    following = np.minimum.accumulate(np.where(moves, rows, len(rows) - 1)[::-1])[::-1]
    return np.where(way[following] == 0, 1.0, way[following]), fresh


def direction_of_motion(v: Array) -> Array:
    """Direction of motion (n,): the sign of v, and at rest the one before; 0 until it first moves."""
    s = np.sign(v)
    rows = np.where(s != 0, np.arange(len(s)), 0)
    return np.asarray(s[np.maximum.accumulate(rows)]) if len(s) else s


def begins(path: Path) -> Mask:
    """Where an individual begins, (n,)."""
    out = np.zeros(len(path.t), dtype=bool)
    out[list(path.starts)] = True
    return out


def time_steps(path: Path) -> Array:
    """Time (n,) since the sample before, s; zero where an individual begins."""
    return np.where(begins(path), 0.0, np.diff(path.t, prepend=path.t[:1]))


def direction_changed(path: Path) -> Mask:
    """Where a sample's direction is not that of the one before, or there is none before, (n,)."""
    return begins(path) | (np.diff(np.sign(path.s), prepend=np.sign(path.s[:1])) != 0)


def follow_target(
    path: Path, target: Array, begin: Array | Complexes, after: Array, before: Array | None = None
) -> Array:
    """State u (n, k) that follows the target (n, k) over steps from sample to sample, each (n,) in lengths.

    Where the direction changes, the steps `before` are made under the old target, those `after` under the new one;
    without steps before, the target is smooth there. A state is `begin` (P, k) where an individual begins. Steps may
    be complex: the state of an oscillator follows at such a rate.
    """
    starts = list(path.starts)
    broken = begins(path) if before is None else direction_changed(path)
    before = np.zeros_like(after) if before is None else before
    old = np.vstack([target[:1], target[:-1]])
    decay = np.exp(-after)
    whole = decay * np.exp(-before)
    whole[starts] = 0.0
    # below the target by y: y decays and grows by what the target gains, as much as is not forgotten at once
    right = target - _weighted(_rises(target, broken), _gain_weights(np.where(broken, 0.0, after), broken))
    right -= whole[:, None] * old
    leaps = np.flatnonzero(broken)
    leap = decay[leaps, None] * (target[leaps] - old[leaps] * -np.expm1(-before[leaps])[:, None])
    right[leaps] = target[leaps] - leap
    right[starts] = begin
    return _recursion(whole, right)


def mean_per_step(value: Array, step: Array, broken: Mask) -> Array:
    """Mean (n,) of a value over the step to every sample, by the cubic with the slopes of parabolas."""
    weights = _slope_weights(step, broken, 0.5, -1 / 12, 1 / 12)
    return np.asarray(value - _weighted(_rises(value[:, None], broken), weights)[:, 0])


def follow_linear(path: Path, decay: Array, gained: Array, begin: Array) -> Array:
    """State u (n,) with u[i] = decay[i] u[i - 1] + gained[i], and `begin` (P,) where an individual begins."""
    starts, whole, right = list(path.starts), decay.copy(), gained.copy()
    whole[starts], right[starts] = 0.0, begin
    return _recursion(whole, right[:, None])[:, 0]


def _recursion(decay: Array, right: Array) -> Array:
    """u[i] = decay[i] u[i - 1] + right[i], all columns at once."""
    band = np.ones((2, len(decay)), dtype=decay.dtype)
    band[1, :-1] = -decay[1:]
    solve = scipy.linalg.lapack.ztbtrs if np.iscomplexobj(decay) else scipy.linalg.lapack.dtbtrs
    out, _ = solve(band, right, uplo="L", diag="U")
    return np.asarray(out)


_Weights = tuple[Array, Array, Array]  # of the rises over the step before, the step itself and the next one, each (n,)


def _rises(target: Array, broken: Mask) -> Array:
    """Rise (n, k) of a target over every step; 0 where it is broken."""
    rise = np.diff(target, axis=0, prepend=target[:1])
    rise[broken] = 0.0
    return rise


def _weighted(rise: Array, weights: _Weights) -> Array:
    """Weighted sum (n, k) of the rises (n, k) over each step and its neighbours."""
    preceding, own, following = weights
    out: Array = own[:, None] * rise
    out[1:] += preceding[1:, None] * rise[:-1]
    out[:-1] += following[:-1, None] * rise[1:]
    return out


def _gain_weights(step: Array, broken: Mask) -> _Weights:
    """Weights of the integral of exp(z - step) dc/dz over every step: what the state has not yet followed."""
    m0, m1, m2 = _moments(step)
    return _slope_weights(step, broken, m0, m0 - 4 * m1 + 3 * m2, 3 * m2 - 2 * m1)


def _slope_weights(
    step: Array, broken: Mask, rise: Array | float, left: Array | float, right: Array | float
) -> _Weights:
    """Weights of the sum of the rise over a step and of what its slopes at either end, times the step, differ from it.

    A slope is that of the parabola through three samples; where steps are too unlike or the target is broken, the
    slope makes the one at the other end a parabola, and both none.
    """
    a, b = np.abs(step[:-1]), np.abs(step[1:])
    smooth = ~(broken[:-1] | broken[1:]) & (a < MAX_STEP_RATIO * b) & (b < MAX_STEP_RATIO * a)
    a, b = np.where(smooth, a, 1.0), np.where(smooth, b, 1.0)
    share = np.where(smooth, a / (a + b), 0.0)  # of the step before a sample, in both steps beside it
    rest = np.where(smooth, 1.0 - share, 0.0)
    at_left, at_right = np.zeros((2, len(step)))  # 1 where a parabola gives the slope at this end of a step
    at_left[1:], at_right[:-1] = smooth, smooth
    left, right = left - (1 - at_right) * right, right - (1 - at_left) * left
    preceding, own, following = np.zeros((3, len(step)), dtype=step.dtype)
    preceding[1:] = (rest * b / a) * left[1:]
    own += rise
    own[1:] -= rest * left[1:]
    own[:-1] -= share * right[:-1]
    following[:-1] = (share * a / b) * right[:-1]
    return preceding, own, following


def _moments(step: Array) -> tuple[Array, Array, Array]:
    """Integrals over theta in (0, 1) of theta^j exp(-step (1 - theta)), j = 0, 1, 2."""
    small = np.abs(step) < MAX_SERIES_STEP
    tiny = np.where(small, step, 0.0)
    series = np.ones_like(step)  # of 3 m2, from the innermost bracket outward: 1 - step/4 (1 - step/5 (1 - ...
    for k in range(3 + N_SERIES_TERMS, 3, -1):
        series = 1.0 - series * tiny / k
    big = np.where(small, 1.0, step)
    up0 = -np.expm1(-big) / big
    up1 = (1 - up0) / big
    m2 = np.where(small, series / 3, (1 - 2 * up1) / big)
    m1 = np.where(small, (1 - tiny * m2) / 2, up1)
    m0 = np.where(small, 1 - tiny * m1, up0)
    return m0, m1, m2
