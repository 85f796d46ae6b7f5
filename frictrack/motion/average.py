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

from frictrack.motion.stencil import derived, stencils
from frictrack.motion.structure import KNOT_SPREAD, Event, Structure
from frictrack.motion.system import ORDER, Data, Factor, variances_of
from frictrack.motion.windows import part_of
from frictrack.records import Array

DEPTHS = np.array([1.0, 2.0, 3.0])  # of a ramp, over the spread of the stiffness beforehand
LENGTHS = (0.15, 0.4, 1.0)  # of a ramp, over the period of the trend's cut-off
TIMES = (0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0)  # that an event may be as wide
RAMPS = (1, 2, 4, 8)  # that it may be as wide where it grows to its end or falls from its beginning
MOVES = (-0.25, 0.0, 0.25)  # by which it may lie elsewhere, over its width
BOOSTS = (-2.0, 0.0, 2.0)  # by which it may be softer
OF_WIDTH = 6.0  # power with which the fourth differences of a pulse grow, squared, as it gets narrower
MAX_GAIN = 100.0  # of twice the log-likelihood; above it all changes count the same, and exp does not overflow
FAINTEST, MOST = 0.02, 8  # weight of a change that is kept, and how many are
PERIODS, REACH = 3.0, 500  # of the cut-off that a window reaches to either side, and frames at the least


Window = tuple[int, int, int]  # first frame and stop, of so many frames


@dataclass(frozen=True)
class Change:
    """An event more (a ramp), or another one in the place of event `instead`; with its weight."""

    weight: float
    event: Event
    instead: int = -1


@dataclass(frozen=True)
class Group:
    """Changes that exclude each other, judged in the frames first to stop (exclusive)."""

    first: int
    stop: int
    changes: tuple[Change, ...]

    @classmethod
    def read(cls, settings: Mapping[str, Any]) -> Group:
        """The group that was written as JSON."""
        changes = (Change(c["weight"], Event(**c["event"]), c["instead"]) for c in settings["changes"])
        return cls(settings["first"], settings["stop"], tuple(changes))


def alternatives(data: Data, structure: Structure) -> tuple[Group, ...]:
    """The changes of a structure that the data (n,), without their cubic, leave open."""
    groups = [_judged(data, structure, list(changes)) for changes in _changes(structure, len(data.w))]
    return tuple(g for g in groups if g is not None and g.changes)


def _changes(s: Structure, n: int) -> Iterator[Iterator[Change]]:
    """What may be changed, by place; weights are what is expected beforehand."""
    events = sorted((e.first, e.last + 1) for e in s.events)
    edges = [0, *(edge for e in events for edge in e), n - ORDER]
    for begin, stop in zip(edges[::2], edges[1::2], strict=True):
        if stop - begin > 1:
            yield _ramps(s, begin, stop, -1, n)
            yield _ramps(s, begin, stop, 1, n)
    for i in range(len(s.events)):
        yield _events(s, i, n)


def _ramps(s: Structure, begin: int, stop: int, rises: int, n: int) -> Iterator[Change]:
    """Ramps of the trend at one end of the differences from begin to stop (exclusive)."""
    edge = stop - 1 if rises > 0 else begin
    period = _period(s, edge, n)
    for length in LENGTHS:
        width = int(min(round(length * period), (stop - begin) // 2))
        first = stop - width if rises > 0 else begin
        for depth in DEPTHS if width > 1 else ():
            ramp = Event(first, first + width - 1, KNOT_SPREAD * depth, rises)
            yield Change(float(np.exp(-0.5 * depth**2)), ramp)


def _events(s: Structure, i: int, n: int) -> Iterator[Change]:
    """Event i in other widths and places."""
    e = s.events[i]
    before = max((o.last + 1 for o in s.events if o.last < e.first), default=0)
    after = min((o.first for o in s.events if o.first > e.last), default=n - ORDER)
    width, middle = e.last - e.first + 1, 0.5 * (e.first + e.last)
    tried = {
        (round(middle + move * width - 0.5 * (times * width - 1)), max(round(times * width), 1), 0)
        for times in TIMES
        for move in MOVES
    }
    tried |= {(e.last + 1 - times * width, times * width, 1) for times in RAMPS}
    tried |= {(e.first, times * width, -1) for times in RAMPS}
    for first, wide, rises in sorted(tried):
        usual = e.boost - (OF_WIDTH * np.log(wide / width) if not rises else 0.0)
        for boost in BOOSTS if before <= first and first + wide <= after else ():
            other = Event(first, first + wide - 1, max(usual + boost, 0.0), rises)
            if other != e:
                yield Change(1.0, other, i)


def _period(s: Structure, place: int, n: int) -> float:
    """Of the trend's cut-off at a difference, frames."""
    calm = replace(s, events=()).log_lambda(n)
    return float(2.0 * np.pi * np.exp(calm[place] / (2 * ORDER)))


def _judged(data: Data, s: Structure, changes: Sequence[Change]) -> Group | None:
    """The changes that are kept, with their weights after the data."""
    if not changes:
        return None
    window = _window(s, changes, len(data.w))
    part = part_of(data, *window[:2])
    if part is None:
        return None
    now = _factor(part, s, window, None).judged()[0]
    gains = np.array([now - _factor(part, s, window, c).judged()[0] for c in changes])
    before = np.array([c.weight for c in changes])
    if changes[0].instead < 0:  # ramps of no depth are expected as well
        before = before / np.sum(before)
    likely = before * np.exp(0.5 * np.minimum(gains, MAX_GAIN))
    shares = likely / (1.0 + np.sum(likely))
    kept = [i for i in np.argsort(-shares)[:MOST].tolist() if shares[i] > FAINTEST]
    return Group(*window[:2], tuple(replace(changes[i], weight=float(shares[i])) for i in kept))


def _window(s: Structure, changes: Sequence[Change], n: int) -> Window:
    """The frames near what changes alter."""
    events = [c.event for c in changes]
    first, last = min(e.first for e in events), max(e.last for e in events) + ORDER
    periods = max(_period(s, min(place, n - ORDER - 1), n) for place in (first, last))
    reach = max(round(PERIODS * periods), REACH)
    return max(first - reach, 0), min(last + reach + 1, n), n


def _factor(part: Data, s: Structure, window: Window, change: Change | None) -> Factor:
    """The smoother of a part of the data, its structure changed."""
    if change is not None:
        others = (e for i, e in enumerate(s.events) if i != change.instead)
        s = replace(s, events=(*others, change.event))
    return s.part(part, window)


def _moves(data: Data, s: Structure, group: Group) -> Array:
    """What each change adds to the signal in the window (k, stop - first)."""
    window = group.first, group.stop, len(data.w)
    part = part_of(data, *window[:2])
    assert part is not None
    now, *then = (_factor(part, s, window, c) for c in (None, *group.changes))
    base = now.signal(now.unknowns())
    return np.array([f.signal(f.unknowns()) - base for f in then]) * _faded(group, len(data.w))


def _faded(group: Group, n: int) -> Array:
    """One near what changes, fading to zero where the window cuts the record (stop - first,)."""
    rise = np.sin(0.5 * np.pi * np.minimum(np.arange(group.stop - group.first) / (REACH // 2), 1.0)) ** 2
    return np.asarray((rise if group.first else 1.0) * (rise[::-1] if group.stop < n else np.ones(len(rise))))


def moved(data: Data, s: Structure, groups: Sequence[Group]) -> Array:
    """What the average adds to the signal (n,) of the best structure."""
    out = np.zeros(len(data.w))
    for g in groups:
        out[g.first : g.stop] += np.array([c.weight for c in g.changes]) @ _moves(data, s, g)
    return out


def added(data: Data, s: Structure, groups: Sequence[Group], interval: float) -> Array:
    """Variance (3, n) that the average adds to that of x, v and a, for data in units of the noise."""
    out = np.zeros((3, len(data.w)))
    for g in groups:
        out[:, g.first : g.stop] += _added(data, s, g, interval)
    return out


def _added(data: Data, s: Structure, g: Group, interval: float) -> Array:
    """The same in the window of a group (3, stop - first): between its changes, and within them."""
    weights = np.array([c.weight for c in g.changes])
    apart = np.array([derived(move, interval) for move in _moves(data, s, g)])
    between = np.einsum("k,kqn->qn", weights, apart**2) - np.einsum("k,kqn->qn", weights, apart) ** 2
    window = g.first, g.stop, len(data.w)
    part = Data(np.zeros(g.stop - g.first), data.w[g.first : g.stop], colour=data.colour)
    stencil = stencils(g.stop - g.first, interval)
    found = variances_of([_factor(part, s, window, c) for c in (None, *g.changes)], *stencil)
    within = np.einsum("k,kqn->qn", weights, found[1:] - found[0])
    return np.asarray(np.maximum(between, 0.0) + np.maximum(within, 0.0))
