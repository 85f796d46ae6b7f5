"""Average over structures that explain the data about as well as the best one does.

Bayesian model averaging (Hoeting et al. 1999, Stat. Sci. 14). How soft the trend is in its last frames, and how wide an
event is, the likelihood hardly settles: few frames show it. Round every end and event the structure is therefore
changed in the ways that a change of the stiffness may take: a ramp of the trend towards the end or the event, as deep
as stiffnesses differ from knot to knot, and events of other widths, places and shapes. Each change counts by its
likelihood and by what is expected of it beforehand. It alters the trend near by only, so that it is judged in a window,
and windows are taken as independent of each other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from frictrack.motion.record_windows import window_data
from frictrack.motion.stencil import stencil_derivatives, stencils
from frictrack.motion.structure import KNOT_SPREAD, Event, Structure
from frictrack.motion.system import TREND_ORDER, FactoredSmoother, SmootherData, variances_of
from frictrack.records import Array

RAMP_DEPTHS = np.array([1.0, 2.0, 3.0])  # of a ramp, over the prior spread of the stiffness
RAMP_LENGTHS = (0.15, 0.4, 1.0)  # of a ramp, over the period of the trend's cut-off
WIDTH_FACTORS = (0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0)  # by which an event may be wider
RAMP_WIDTH_FACTORS = (1, 2, 4, 8)  # the same where it grows to its end or falls from its beginning
SHIFTS = (-0.25, 0.0, 0.25)  # of an event, over its width
BOOST_CHANGES = (-2.0, 0.0, 2.0)  # log, by which it may be softer
WIDTH_EXPONENT = 6.0  # with which the squared fourth differences of a pulse grow as it gets narrower
MAX_GAIN = 100.0  # of twice the log-likelihood; above it all changes count the same, and exp does not overflow
MIN_WEIGHT, MAX_CHANGES = 0.02, 8  # weight of a change that is kept, and how many are
REACH_PERIODS, MIN_REACH_FRAMES = (
    3.0,
    500,
)  # of the cut-off that a window reaches to either side, and frames at the least


Window = tuple[int, int, int]  # first frame and stop, of so many frames


@dataclass(frozen=True)
class StructureChange:
    """An event more (a ramp), or another one in the place of event `instead`; with its weight."""

    weight: float
    event: Event
    instead: int = -1


@dataclass(frozen=True)
class ChangeGroup:
    """Changes that exclude each other, judged in the frames first to stop (exclusive)."""

    first: int
    stop: int
    changes: tuple[StructureChange, ...]

    @classmethod
    def read(cls, settings: Mapping[str, Any]) -> ChangeGroup:
        """The group that was written as JSON."""
        changes = (StructureChange(c["weight"], Event(**c["event"]), c["instead"]) for c in settings["changes"])
        return cls(settings["first"], settings["stop"], tuple(changes))


def alternatives(data: SmootherData, structure: Structure) -> tuple[ChangeGroup, ...]:
    """The changes of a structure that the data (n,), without their cubic, leave open."""
    groups = [_weigh_changes(data, structure, list(changes)) for changes in _changes(structure, len(data.w))]
    return tuple(g for g in groups if g is not None and g.changes)


def _changes(s: Structure, n: int) -> Iterator[Iterator[StructureChange]]:
    """What may be changed, by place; weights are what is expected beforehand."""
    events = sorted((e.first, e.last + 1) for e in s.events)
    edges = [0, *(edge for e in events for edge in e), n - TREND_ORDER]
    for begin, stop in zip(edges[::2], edges[1::2], strict=True):
        if stop - begin > 1:
            yield _ramps(s, begin, stop, -1, n)
            yield _ramps(s, begin, stop, 1, n)
    for i in range(len(s.events)):
        yield _events(s, i, n)


def _ramps(s: Structure, begin: int, stop: int, rises: int, n: int) -> Iterator[StructureChange]:
    """Ramps of the trend at one end of the differences from begin to stop (exclusive)."""
    edge = stop - 1 if rises > 0 else begin
    period = _period(s, edge, n)
    for length in RAMP_LENGTHS:
        width = int(min(round(length * period), (stop - begin) // 2))
        first = stop - width if rises > 0 else begin
        for depth in RAMP_DEPTHS if width > 1 else ():
            ramp = Event(first, first + width - 1, KNOT_SPREAD * depth, rises)
            yield StructureChange(float(np.exp(-0.5 * depth**2)), ramp)


def _events(s: Structure, i: int, n: int) -> Iterator[StructureChange]:
    """Event i in other widths and places."""
    e = s.events[i]
    before = max((o.last + 1 for o in s.events if o.last < e.first), default=0)
    after = min((o.first for o in s.events if o.first > e.last), default=n - TREND_ORDER)
    width, middle = e.last - e.first + 1, 0.5 * (e.first + e.last)
    tried = {
        (round(middle + move * width - 0.5 * (times * width - 1)), max(round(times * width), 1), 0)
        for times in WIDTH_FACTORS
        for move in SHIFTS
    }
    tried |= {(e.last + 1 - times * width, times * width, 1) for times in RAMP_WIDTH_FACTORS}
    tried |= {(e.first, times * width, -1) for times in RAMP_WIDTH_FACTORS}
    for first, wide, rises in sorted(tried):
        usual = e.boost - (WIDTH_EXPONENT * np.log(wide / width) if not rises else 0.0)
        for boost in BOOST_CHANGES if before <= first and first + wide <= after else ():
            other = Event(first, first + wide - 1, max(usual + boost, 0.0), rises)
            if other != e:
                yield StructureChange(1.0, other, i)


def _period(s: Structure, place: int, n: int) -> float:
    """Of the trend's cut-off at a difference, frames."""
    calm = replace(s, events=()).log_lambda(n)
    return float(2.0 * np.pi * np.exp(calm[place] / (2 * TREND_ORDER)))


def _weigh_changes(data: SmootherData, s: Structure, changes: Sequence[StructureChange]) -> ChangeGroup | None:
    """The changes that are kept, with their weights after the data."""
    if not changes:
        return None
    window = _window(s, changes, len(data.w))
    part = window_data(data, *window[:2])
    if part is None:
        return None
    now = _factor(part, s, window, None).restricted_likelihood()[0]
    gains = np.array([now - _factor(part, s, window, c).restricted_likelihood()[0] for c in changes])
    before = np.array([c.weight for c in changes])
    if changes[0].instead < 0:  # ramps of no depth are expected as well
        before = before / np.sum(before)
    likely = before * np.exp(0.5 * np.minimum(gains, MAX_GAIN))
    shares = likely / (1.0 + np.sum(likely))
    kept = [i for i in np.argsort(-shares)[:MAX_CHANGES].tolist() if shares[i] > MIN_WEIGHT]
    return ChangeGroup(*window[:2], tuple(replace(changes[i], weight=float(shares[i])) for i in kept))


def _window(s: Structure, changes: Sequence[StructureChange], n: int) -> Window:
    """The frames near what changes alter."""
    events = [c.event for c in changes]
    first, last = min(e.first for e in events), max(e.last for e in events) + TREND_ORDER
    periods = max(_period(s, min(place, n - TREND_ORDER - 1), n) for place in (first, last))
    reach = max(round(REACH_PERIODS * periods), MIN_REACH_FRAMES)
    return max(first - reach, 0), min(last + reach + 1, n), n


def _factor(part: SmootherData, s: Structure, window: Window, change: StructureChange | None) -> FactoredSmoother:
    """The smoother of a part of the data, its structure changed."""
    if change is not None:
        others = (e for i, e in enumerate(s.events) if i != change.instead)
        s = replace(s, events=(*others, change.event))
    return s.part(part, window)


def _signal_changes(data: SmootherData, s: Structure, group: ChangeGroup) -> Array:
    """What each change adds to the signal in the window (k, stop - first)."""
    window = group.first, group.stop, len(data.w)
    part = window_data(data, *window[:2])
    assert part is not None
    now, *then = (_factor(part, s, window, c) for c in (None, *group.changes))
    base = now.signal(now.unknowns())
    return np.array([f.signal(f.unknowns()) - base for f in then]) * _fade(group, len(data.w))


def _fade(group: ChangeGroup, n: int) -> Array:
    """One near what changes, fading to zero where the window cuts the record (stop - first,)."""
    rise = np.sin(0.5 * np.pi * np.minimum(np.arange(group.stop - group.first) / (MIN_REACH_FRAMES // 2), 1.0)) ** 2
    return np.asarray((rise if group.first else 1.0) * (rise[::-1] if group.stop < n else np.ones(len(rise))))


def mean_shift(data: SmootherData, s: Structure, groups: Sequence[ChangeGroup]) -> Array:
    """What the average adds to the signal (n,) of the best structure."""
    out = np.zeros(len(data.w))
    for g in groups:
        out[g.first : g.stop] += np.array([c.weight for c in g.changes]) @ _signal_changes(data, s, g)
    return out


def added_variance(data: SmootherData, s: Structure, groups: Sequence[ChangeGroup], interval: float) -> Array:
    """Variance (3, n) that the average adds to that of x, v and a, for data in units of the noise."""
    out = np.zeros((3, len(data.w)))
    for g in groups:
        out[:, g.first : g.stop] += _group_variance(data, s, g, interval)
    return out


def _group_variance(data: SmootherData, s: Structure, g: ChangeGroup, interval: float) -> Array:
    """The same in the window of a group (3, stop - first): between its changes, and within them."""
    weights = np.array([c.weight for c in g.changes])
    apart = np.array([stencil_derivatives(move, interval) for move in _signal_changes(data, s, g)])
    between = np.einsum("k,kqn->qn", weights, apart**2) - np.einsum("k,kqn->qn", weights, apart) ** 2
    window = g.first, g.stop, len(data.w)
    part = SmootherData(np.zeros(g.stop - g.first), data.w[g.first : g.stop], colour=data.colour)
    stencil = stencils(g.stop - g.first, interval)
    found = variances_of([_factor(part, s, window, c) for c in (None, *g.changes)], *stencil)
    within = np.einsum("k,kqn->qn", weights, found[1:] - found[0])
    return np.asarray(np.maximum(between, 0.0) + np.maximum(within, 0.0))
