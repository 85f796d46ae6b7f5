"""Values of parameters: grids on which a search first tries them, and checks that fitted ones are physically sensible.

Waves are here too, whose frequencies and periods are scanned.

An effect declares its own check, built from the functions below. A check takes the values of the effect's parameters in
one run and how far that run reaches, and returns an objection in words, or "" where there is none. An effect that fails
imitates the misfit; it is never named as the cause. Checks are functions of a module with given arguments
(`functools.partial`), so that a fit can be pickled.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from frictrack.records import Array, EarlierRuns

USUAL_TOP_SPEED = 6.0  # m/s; where runs are faster, or a scale is wrong, the range of Stribeck velocities grows along
MIN_SCAN_VALUES = 9  # of a scan between bounds
MIN_PERIODS = 1.5  # of an oscillation in a record: fewer cannot be told from a trend (Bretthorst 1988, section 2)
MAX_LOCKED_PERIODS = 0.25  # periods in the record by which a line misses a multiple of the frequency of the strokes
MIN_RINGING = 0.5  # periods within one decay time: a faster decay is a pulse
MAX_DEPTH = 1.0  # of a modulation: beyond it a contact would pull
MAX_PICTURE_SHARE = 0.03  # of the travelled span: lens, shake; barrel distortion of ordinary lenses is below 3 %
MAX_LOCKING_PX = 0.25  # published peak-locking amplitudes are below 0.25 px (Raffel et al. 2018, section 6.1)
MAX_CLOCK_DRIFT = 0.01  # of the time: crystal clocks are a hundred times better
MAX_CLOCK_FACTOR = 2.0  # of one run's times: frame rates are set in such steps, other units in larger ones
WHOLE_FRAME = 0.25  # frames by which a lost or doubled frame may miss a whole number
FLASH_STD_FRAMES = 0.1  # of a frame: timing error of a flash or a time stamp
LEVEL_STD_RAD = np.deg2rad(0.05)  # angle error of a good spirit level
ZERO_STD_N = 1e-3  # of the mean of a force record without load
WEIGHT_RELATIVE_STD = 0.01  # of a known weight that is hung on the drive
ACCELEROMETER_STD = 0.2  # m/s^2, noise of one sample
N_STD_ACTIVE = 2.0  # standard deviations on either side of its middle within which a bell-shaped force acts
PLANNED_SHARE = 0.05  # of the friction force (rms), or of the momentum: size of an effect that a plan is made for


@dataclass(frozen=True)
class Span:
    """How far the recorded runs reach: what a scan can hope to see."""

    duration: float  # s, of the longest run
    x_min: float  # m
    x_max: float
    v_min: float  # m/s, slowest speed seen
    v_max: float
    fps: float  # Hz
    clamp_x: float | None = None  # m
    beam_length: float | None = None  # m, where it is known
    earlier: EarlierRuns = ()  # the longest series before a run, where it is known
    cycle: float = 0.0  # s, after which the motion repeats itself; 0 where it does not


@dataclass(frozen=True)
class ScanValues:
    """A scan of the same values for all runs."""

    values: tuple[float, ...]

    def __call__(self, span: Span) -> Array:
        """Values worth trying."""
        return np.array(self.values)


@dataclass(frozen=True)
class Within:
    """A scan that keeps to bounds; without a grid of its own it runs evenly from one to the other."""

    bounds: tuple[float, float]
    scan: Callable[[Span], Array] | None = None

    def __call__(self, span: Span) -> Array:
        """Values worth trying, at least `MIN_SCAN_VALUES` where the scan has as many and the bounds leave room."""
        low, high = self.bounds
        if self.scan is None:
            return np.linspace(low, high, MIN_SCAN_VALUES)
        grid = self.scan(span)
        inside = grid[(grid >= low) & (grid <= high)]
        if len(inside) >= min(MIN_SCAN_VALUES, len(grid)):
            return inside
        if np.all(np.isfinite(self.bounds)):
            return np.linspace(low, high, MIN_SCAN_VALUES)
        return np.unique(np.clip(grid, low, high))


def frequency_range(span: Span, limit: float = 600.0) -> tuple[float, float]:
    """Lowest and highest frequency worth trying, Hz: at least one period in the longest run, five frames per period."""
    lowest = max(1.0 / span.duration, 2.0)
    return lowest, max(min(0.2 * span.fps, limit), 2 * lowest)


def frequencies(span: Span, cells: float = 0.25, limit: float = 600.0) -> Array:
    """Scan of a line in time, Hz: a quarter of a Rayleigh cell apart, or more where a line is wide."""
    return np.arange(*frequency_range(span, limit), cells / span.duration)


def log_grid(low: float, high: float, per_decade: int) -> Array:
    """Logarithmic scan from low to high with about so many points per decade."""
    return np.geomspace(low, high, max(2, round(per_decade * np.log10(high / low)) + 1))


def spatial_periods(span: Span) -> Array:
    """Return periods worth trying, m: equal steps in 1/period, a quarter of a cell of the travelled span apart."""
    travel = span.x_max - span.x_min
    shortest = max(min(0.002, travel / 20), span.v_min / (0.2 * span.fps), travel / 200)
    return 1.0 / np.arange(1.0 / travel, 1.0 / shortest, 0.25 / travel)


def stribeck_velocities(span: Span, low: float = 0.02, per_decade: int = 8) -> Array:
    """Return Stribeck velocities worth trying, m/s: one far below the slowest speed seen leaves no trace."""
    growth = max(1.0, span.v_max / USUAL_TOP_SPEED)
    highest = min(2.0 * growth, 2 * span.v_max)
    lowest = max(min(low * growth, span.v_max / 100), span.v_min / 6)
    return log_grid(min(lowest, highest / 2), highest, per_decade)


def bend_velocities(span: Span, above: float = 2.0) -> Array:
    """Return velocities at which a law may bend, m/s, up to `above` times the fastest seen: beyond, it is a line."""
    return log_grid(max(span.v_min / 3, span.v_max / 30), above * span.v_max, 4)


def breakaway_lengths(span: Span) -> Array:
    """Return breakaway lengths worth trying, m: from a micrometre up to a third of the travel."""
    longest = max((span.x_max - span.x_min) / 3.0, 1e-5)
    return log_grid(max(1e-6, 1e-4 * longest), longest, 4)


Check = Callable[[Mapping[str, float], Span], str]  # (values by parameter, Span) -> objection or ""


def all_of(*checks: Check) -> Check:
    """Return the check that raises the first objection of several."""
    return partial(_first_objection, checks)


def _first_objection(checks: Iterable[Check], values: Mapping[str, float], span: Span) -> str:
    return next(filter(None, (check(values, span) for check in checks)), "")


def oscillates(values: Mapping[str, float], span: Span) -> str:
    """Return an objection where a run holds fewer than `MIN_PERIODS` periods of `frequency` (Hz), or strokes repeat it.

    Examples
    --------
    >>> oscillates({"frequency": 5.0}, Span(0.1, 0, 1, 0, 1, 1000))
    'the record holds 0.5 periods of it, expected at least 1.5'

    """
    per_cycle = values["frequency"] * span.cycle
    if round(per_cycle) and abs(per_cycle - round(per_cycle)) * span.duration < MAX_LOCKED_PERIODS * span.cycle:
        return (
            f"the strokes repeat every {span.cycle:.4g} s, and {round(per_cycle)} periods of it fill that time: any "
            "misfit of the law repeats so; strokes of another duration tell"
        )
    return _periods(values["frequency"] * span.duration)


def is_periodic_in(parameter: str) -> Check:
    """Return the check that the travelled span holds `MIN_PERIODS` of a period in space (m)."""
    return partial(_periodic, parameter)


def _periodic(parameter: str, values: Mapping[str, float], span: Span) -> str:
    return _periods((span.x_max - span.x_min) / abs(values[parameter] or 1e-300))


def _periods(count: float) -> str:
    if count >= MIN_PERIODS:
        return ""
    return f"the record holds {count:.1f} periods of it, expected at least {MIN_PERIODS:g}"


def rings(values: Mapping[str, float], span: Span) -> str:
    """Return an objection where an oscillation has died away before it has swung."""
    swings = values["frequency"] * values["tau"]
    if swings >= MIN_RINGING:
        return ""
    return f"it decays within {swings:.2f} periods, which is a pulse and no vibration"


def modulates(values: Mapping[str, float], span: Span) -> str:
    """Return an objection where a modulation exceeds what it modulates."""
    depth = abs(values["depth"])
    return "" if depth < MAX_DEPTH else f"depth {depth:.2g} would make the friction push"


def within_picture(shift: Callable[[Mapping[str, float], Span], float]) -> Check:
    """Return the check that a picture error `shift` (m) stays below `MAX_PICTURE_SHARE` of the travelled span."""
    return partial(_within_picture, shift)


def _within_picture(shift: Callable[..., float], values: Mapping[str, float], span: Span) -> str:
    share = abs(shift(values, span)) / max(span.x_max - span.x_min, 1e-300)
    if share <= MAX_PICTURE_SHARE:
        return ""
    return f"a picture error of {100 * share:.2g} % of the span, expected at most {100 * MAX_PICTURE_SHARE:g} %"


def shorter_than_record(parameter: str, share: float = 1.0) -> Check:
    """Return the check that a time (s) is shorter than a share of the record."""
    return partial(_shorter_than_record, parameter, share)


def _shorter_than_record(parameter: str, share: float, values: Mapping[str, float], span: Span) -> str:
    if values[parameter] <= share * span.duration:
        return ""
    return f"{parameter} {values[parameter]:.2g} s is longer than {share:g} of the record ({span.duration:.2g} s)"


def within_course(centre: str, width: str) -> Check:
    """Return the check that a local force (m) is narrower than the course and lies on it, or within its width of it."""
    return partial(_within_course, centre, width)


def _within_course(centre: str, width: str, values: Mapping[str, float], span: Span) -> str:
    travel = span.x_max - span.x_min
    if not span.x_min - values[width] <= values[centre] <= span.x_max + values[width]:
        return f"its centre {values[centre]:.3g} m lies off the course"
    if values[width] > travel / 2:
        return f"it is wider ({values[width]:.2g} m) than half of the course ({travel:.2g} m)"
    return ""


@dataclass(frozen=True)
class ScanWave:
    """That columns depend on one scanned parameter only as sin(2 pi q u + phase): a scan may interpolate in q.

    Attributes
    ----------
    parameter : str
        The frequency q, or the period 1/q.
    coordinate : callable
        Map a path and the other non-linear parameters to u (n,), whose unit is that of 1/q.
    is_period : bool
        Whether the parameter is a period.

    """

    parameter: str
    coordinate: Callable[[Any, Any], Array]
    is_period: bool = False

    def frequency(self, values: Array) -> Array:
        """Convert values of the parameter to q, or q to values of the parameter."""
        return 1.0 / values if self.is_period else values


def over_time(path: Any, nonlinear: Any) -> Array:
    """Return the coordinate u of a wave in time, s."""
    return path.t


def over_position(path: Any, nonlinear: Any) -> Array:
    """Return the coordinate u of a wave in space, m."""
    return path.x


WAVE_IN_TIME = ScanWave("frequency", over_time)


def wave(cycles: Array, phase: float) -> Array:
    """One column sin(2 pi cycles + phase), shape (n, 1); a sin + b cos is one amplitude and one phase."""
    # sin z = 2 u/(1 + u^2) with u = tan(z/2): numpy's tangent takes many numbers at once, its sine one by one
    u = np.pi * cycles
    u += phase / 2
    np.tan(u, out=u)
    below = u * u
    below += 1.0
    u += u
    u /= below
    return u[:, None]
