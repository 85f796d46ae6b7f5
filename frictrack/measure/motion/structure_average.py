"""Average over structures that explain the data about as well as the best one does.

This is Bayesian model averaging (Hoeting et al. 1999, Stat. Sci. 14). Few frames determine how soft the trend is at the
ends, and how wide an event is. Near each end and event the structure is therefore changed: by a ramp of the stiffness
toward the end or event, as large as stiffnesses differ from knot to knot, and by events of other widths, places and
shapes. Each change is weighted by its likelihood and its prior. It alters only the trend nearby, so that it is
evaluated in a window, and windows are treated as independent.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from frictrack.measure.motion.banded_equations import TREND_ORDER, SmootherData
from frictrack.measure.motion.grid import stencil_derivatives, stencils
from frictrack.measure.motion.smoother import Event, FactoredSmoother, Structure, variances_of
from frictrack.measure.motion.structure_search import KNOT_SPREAD, window_data
from frictrack.records import Array

RAMP_DEPTHS = np.array([1.0, 2.0, 3.0])  # over the prior standard deviation of the stiffness
RAMP_LENGTHS = (0.15, 0.4, 1.0)  # over the period of the trend's cut-off
WIDTH_FACTORS = (0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0)  # width of another event over that of the event
RAMP_WIDTH_FACTORS = (1, 2, 4, 8)  # the same of an event that rises to its end or falls from its beginning
SHIFTS = (-0.25, 0.0, 0.25)  # of an event, over its width
BOOST_CHANGES = (-2.0, 0.0, 2.0)  # log, change of its softness
WIDTH_EXPONENT = 6.0  # the squared fourth differences of a pulse grow with this power of the inverse width
MAX_GAIN = 100.0  # of twice the log-likelihood; larger ones count the same, so that exp does not overflow
MIN_WEIGHT, MAX_CHANGES = 0.02, 8  # smallest weight of a change that is kept, and number of changes
REACH_PERIODS, MIN_REACH_FRAMES = 3.0, 500  # half width of a window: periods of the cut-off, and frames at least


Window = tuple[int, int, int]  # first frame, stop, and frames of the record


@dataclass(frozen=True)
class StructureChange:
    """A further event (a ramp), or one that replaces event number `instead`; with its weight in the average."""

    weight: float
    event: Event
    instead: int = -1


@dataclass(frozen=True)
class ChangeGroup:
    """Changes that exclude each other, evaluated in the frames first to stop (exclusive)."""

    first: int
    stop: int
    changes: tuple[StructureChange, ...]

    @classmethod
    def read(cls, settings: Mapping[str, Any]) -> ChangeGroup:
        """Read a group from its JSON."""
        changes = (StructureChange(c["weight"], Event(**c["event"]), c["instead"]) for c in settings["changes"])
        return cls(settings["first"], settings["stop"], tuple(changes))


def alternatives(data: SmootherData, structure: Structure) -> tuple[ChangeGroup, ...]:
    """Find the changes of a structure that the data do not exclude."""
    groups = [_weigh_changes(data, structure, list(changes)) for changes in _changes(structure, len(data.w))]
    return tuple(g for g in groups if g is not None and g.changes)


def _changes(s: Structure, n: int) -> Iterator[Iterator[StructureChange]]:
    """Yield possible changes by place; their weights are priors."""
    events = sorted((e.first, e.last + 1) for e in s.events)
    edges = [0, *(edge for e in events for edge in e), n - TREND_ORDER]
    for begin, stop in zip(edges[::2], edges[1::2], strict=True):
        if stop - begin > 1:
            yield _ramps(s, begin, stop, -1, n)
            yield _ramps(s, begin, stop, 1, n)
    for i in range(len(s.events)):
        yield _events(s, i, n)


def _ramps(s: Structure, begin: int, stop: int, rises: int, n: int) -> Iterator[StructureChange]:
    """Yield ramps of the trend at one end of the differences from begin to stop (exclusive)."""
    edge = stop - 1 if rises > 0 else begin
    period = _period(s, edge, n)
    for length in RAMP_LENGTHS:
        width = int(min(round(length * period), (stop - begin) // 2))
        first = stop - width if rises > 0 else begin
        for depth in RAMP_DEPTHS if width > 1 else ():
            ramp = Event(first, first + width - 1, KNOT_SPREAD * depth, rises)
            yield StructureChange(float(np.exp(-0.5 * depth**2)), ramp)


def _events(s: Structure, i: int, n: int) -> Iterator[StructureChange]:
    """Yield event i with other widths, places and shapes."""
    e = s.events[i]
    prior = max((o.last + 1 for o in s.events if o.last < e.first), default=0)
    after = min((o.first for o in s.events if o.first > e.last), default=n - TREND_ORDER)
    width, middle = e.last - e.first + 1, 0.5 * (e.first + e.last)
    tried = {
        (round(middle + move * width - 0.5 * (times * width - 1)), max(round(times * width), 1), 0)
        for times in WIDTH_FACTORS
        for move in SHIFTS
    }
    tried |= {(e.last + 1 - times * width, times * width, 1) for times in RAMP_WIDTH_FACTORS}
    tried |= {(e.first, times * width, -1) for times in RAMP_WIDTH_FACTORS}
    for first, new_width, rises in sorted(tried):
        usual_boost = e.boost - (WIDTH_EXPONENT * np.log(new_width / width) if not rises else 0.0)
        for boost in BOOST_CHANGES if prior <= first and first + new_width <= after else ():
            other = Event(first, first + new_width - 1, max(usual_boost + boost, 0.0), rises)
            if other != e:
                yield StructureChange(1.0, other, i)


def _period(s: Structure, place: int, n: int) -> float:
    """Period of the trend's cut-off at a difference, frames."""
    without_events = replace(s, events=()).log_lambda(n, place, place + 1)
    return float(2.0 * np.pi * np.exp(without_events[0] / (2 * TREND_ORDER)))


def _weigh_changes(data: SmootherData, s: Structure, changes: Sequence[StructureChange]) -> ChangeGroup | None:
    """Weigh changes by the data; return those that are kept."""
    if not changes:
        return None
    window = _window(s, changes, len(data.w))
    part = window_data(data, *window[:2])
    if part is None:
        return None
    base = _factor(part, s, window, None).restricted_likelihood()[0]
    gains = np.array([base - _factor(part, s, window, c).restricted_likelihood()[0] for c in changes])
    prior = np.array([c.weight for c in changes])
    if changes[0].instead < 0:  # the prior of the ramps includes one of no depth
        prior = prior / np.sum(prior)
    posterior = prior * np.exp(0.5 * np.minimum(gains, MAX_GAIN))
    shares = posterior / (1.0 + np.sum(posterior))
    kept = [i for i in np.argsort(-shares)[:MAX_CHANGES].tolist() if shares[i] > MIN_WEIGHT]
    return ChangeGroup(*window[:2], tuple(replace(changes[i], weight=float(shares[i])) for i in kept))


def _window(s: Structure, changes: Sequence[StructureChange], n: int) -> Window:
    """Frames near the changes."""
    events = [c.event for c in changes]
    first, last = min(e.first for e in events), max(e.last for e in events) + TREND_ORDER
    periods = max(_period(s, min(place, n - TREND_ORDER - 1), n) for place in (first, last))
    reach = max(round(REACH_PERIODS * periods), MIN_REACH_FRAMES)
    return max(first - reach, 0), min(last + reach + 1, n), n


def _factor(part: SmootherData, s: Structure, window: Window, change: StructureChange | None) -> FactoredSmoother:
    """Set up the smoother of a part of the data, with a changed structure."""
    if change is not None:
        others = (e for i, e in enumerate(s.events) if i != change.instead)
        s = replace(s, events=(*others, change.event))
    return s.part(part, window)


def _signal_changes(data: SmootherData, s: Structure, group: ChangeGroup) -> Array:
    """Change of the signal in the window by each change, (k, stop - first)."""
    window = group.first, group.stop, len(data.w)
    part = window_data(data, *window[:2])
    assert part is not None
    unchanged, *changed = (_factor(part, s, window, c) for c in (None, *group.changes))
    base = unchanged.signal(unchanged.unknowns())
    return np.array([f.signal(f.unknowns()) - base for f in changed]) * _fade(group, len(data.w))


def _fade(group: ChangeGroup, n: int) -> Array:
    """Weights (stop - first,): 1 near the changes, fading to 0 where the window cuts the record."""
    rise = np.sin(0.5 * np.pi * np.minimum(np.arange(group.stop - group.first) / (MIN_REACH_FRAMES // 2), 1.0)) ** 2
    return np.asarray((rise if group.first else 1.0) * (rise[::-1] if group.stop < n else np.ones(len(rise))))


def mean_shift(data: SmootherData, s: Structure, groups: Sequence[ChangeGroup]) -> Array:
    """Change of the signal of the best structure by the average."""
    out = np.zeros(len(data.w))
    for g in groups:
        out[g.first : g.stop] += np.array([c.weight for c in g.changes]) @ _signal_changes(data, s, g)
    return out


def added_variances(
    data: SmootherData, s: Structure, groups: Sequence[ChangeGroup], interval: float
) -> Iterator[tuple[slice, Array]]:
    """Yield the frames of each group, and the variance of x, v and a that the average adds there."""
    for g in groups:
        weights = np.array([c.weight for c in g.changes])
        moves = np.array([stencil_derivatives(move, interval) for move in _signal_changes(data, s, g)])
        between = np.einsum("k,kqn->qn", weights, moves**2) - np.einsum("k,kqn->qn", weights, moves) ** 2
        window = g.first, g.stop, len(data.w)
        part = SmootherData(np.zeros(g.stop - g.first), data.w[g.first : g.stop], colour=data.colour)
        stencil = stencils(g.stop - g.first, interval)
        found = variances_of([_factor(part, s, window, c) for c in (None, *g.changes)], *stencil)
        within = np.einsum("k,kqn->qn", weights, found[1:] - found[0])
        yield slice(g.first, g.stop), np.maximum(between, 0.0) + np.maximum(within, 0.0)
