"""The structure of a displacement: a trend of varying stiffness, lines, and events.

The stiffness of the trend (log lambda) is interpolated between knots over the record, so that it may be smooth in the
middle of a slide and bend where the slide stops. In an event (a push, an impact, a stop) the trend is softer. A line is
a vibration whose amplitude and phase may vary slowly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from frictrack.measure.motion.smoother import FactoredSmoother
from frictrack.measure.motion.smoother_data import TREND_ORDER, LineParameters, SmootherData, penalty
from frictrack.records import Array


@dataclass(frozen=True)
class Event:
    """Fourth differences first to last (inclusive) in which the trend is softer by exp(boost).

    The boost is constant, or rises linearly to the last difference (`rises` 1) or to the first one (-1).
    """

    first: int
    last: int
    boost: float
    rises: int = 0

    @property
    def boosts(self) -> Array:
        """Log of how much softer each difference is, (last - first + 1,)."""
        width = self.last - self.first + 1
        if not self.rises:
            return np.full(width, self.boost)
        ramp = self.boost * np.arange(1, width + 1) / width
        return ramp if self.rises > 0 else ramp[::-1]


@dataclass(frozen=True)
class Structure:
    """Structure of a record.

    Attributes
    ----------
    stiffness
        Log lambda at equally spaced knots.
    lines
        Frequency (radians per frame) and log mu of each line.
    events
        Events.

    """

    stiffness: tuple[float, ...]
    lines: tuple[tuple[float, float], ...] = ()
    events: tuple[Event, ...] = ()

    @classmethod
    def low_pass(cls, cutoff: float, interval: float) -> Structure:
        """A plain low-pass with a cut-off (Hz) at a frame interval (s)."""
        return cls((float(np.log(penalty(cutoff, interval))),))

    def log_lambda(self, n: int, first: int = 0, stop: int | None = None) -> Array:
        """Log lambda of the fourth differences first to stop (exclusive, by default all) of n frames."""
        rows = np.arange(first, n - TREND_ORDER if stop is None else stop) / max(n - TREND_ORDER - 1, 1)
        out = np.interp(rows, np.linspace(0.0, 1.0, max(len(self.stiffness), 2)), self._knots())
        for e in self.events:
            low, high = max(e.first - first, 0), min(e.last + 1 - first, len(out))
            if low < high:
                out[low:high] -= e.boosts[low + first - e.first : high + first - e.first]
        return np.asarray(out)

    def _knots(self) -> tuple[float, ...]:
        return self.stiffness * 2 if len(self.stiffness) == 1 else self.stiffness

    def factor_smoother(self, data: SmootherData) -> FactoredSmoother:
        """Set up the smoother of data."""
        return self.part(data, (0, len(data.w), len(data.w)))

    def part(self, data: SmootherData, window: tuple[int, int, int]) -> FactoredSmoother:
        """Set up the smoother of a part of a record; `window` is first frame, stop, and frames of the record."""
        first, stop, n = window
        omega, log_mu = np.array(self.lines).reshape(-1, 2).T
        lam = np.exp(self.log_lambda(n, first, stop - TREND_ORDER))
        return FactoredSmoother(data, lam, LineParameters(omega, np.exp(log_mu)))

    def numbers(self) -> Array:
        """All continuous parameters as one vector."""
        return np.array([*self.stiffness, *(v for line in self.lines for v in line), *(e.boost for e in self.events)])

    def with_numbers(self, numbers: Array) -> Structure:
        """The same structure with other values of its continuous parameters."""
        values = [float(v) for v in numbers]
        s, k = len(self.stiffness), len(self.lines)
        lines = tuple(zip(values[s : s + 2 * k : 2], values[s + 1 : s + 2 * k : 2], strict=True))
        events = tuple(replace(e, boost=b) for e, b in zip(self.events, values[s + 2 * k :], strict=True))
        return Structure(tuple(values[:s]), lines, events)

    def with_knots(self, count: int) -> Structure:
        """The same stiffness with another number of knots."""
        place = np.linspace(0.0, 1.0, max(len(self.stiffness), 2))
        return replace(self, stiffness=tuple(np.interp(np.linspace(0, 1, count), place, self._knots()).tolist()))
