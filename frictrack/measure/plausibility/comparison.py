"""Compare the runs of a study with each other: frame rates, places about which masses swing, accelerometers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from frictrack.measure.plausibility.findings import ERROR, Finding
from frictrack.records import Array, Run

MAX_RELATIVE_DIFFERENCE = 0.01  # of frame rates; forces are then wrong by twice as much
CONTRADICTION = "one of the two is wrong and every force goes with its square"
MIN_OTHER_SETTING = 0.35  # relative difference between runs from which the camera setting differs
TIME_UNITS = {1e3: ("ms", "t_s (ms)"), 1e6: ("us", "t_s (us)"), 1 / 60: ("minutes", "t_s (min)")}  # stated over stamped

MIN_TURNS = 4  # turning points that show a centre and its scatter
SMOOTHED_SHARE = 4  # part of a half swing over which positions are averaged: all turning points come nearer alike
MIN_SWING_SHARE = 0.25  # of the whole travel; a smaller swing back is noise, or the end of a decay
MIN_SHIFT_SIGMAS, MIN_SHIFT_SHARE = 5.0, 0.01  # standard deviations, and share of the travel, of a shift that is said

MAX_GAIN_DIFFERENCE = 0.1  # relative, between runs of one sensor: the scale of each film is in it
MAX_DELAY_DIFFERENCE = 2e-4  # s, in addition to the deviations: jitter of a trigger
MAX_SIGMAS = 5.0
MIN_PROBABILITY = 1e-3  # of what an alignment excludes; `sensors.alignment` states rivals from here
MIN_ODDS = 100.0  # by which one delay and gain must lead to be called common


# --- frame rates


def implausible_clocks(runs: Mapping[str, Run], stated: Mapping[str, float | None]) -> tuple[Finding, ...]:
    """Find runs whose time stamps contradict the stated frame rate, or nearly but not quite those of the other runs.

    `stated`: the frame rate that is given of each, Hz; None where none is. Returns at most one per run, or one for all
    where all say the same. Time stamps in another unit are an error.

    Examples
    --------
    >>> implausible_clocks({}, {})
    ()

    """
    records = {name: run.displacement for name, run in runs.items()}
    rates = {name: d.stamped_rate or 1.0 / float(np.median(np.diff(d.t))) for name, d in records.items()}
    median_rate = float(np.median(list(rates.values()))) if len(rates) > 2 else float("nan")
    checked = (_check_rate(name, rate, stated.get(name), median_rate) for name, rate in rates.items())
    found = tuple(finding for finding in checked if finding is not None)
    if len(found) == len(runs) > 1 and len({f.words for f in found}) == 1:
        return (replace(found[0], run=""),)
    return found


def _check_rate(run: str, rate: float, given: float | None, median_rate: float) -> Finding | None:
    """Check the rate of the stamps against the given one, else against the median, which may show which is right."""
    correction, advice = "", f"{CONTRADICTION}; give the true times or frame rate"
    if given is None or abs(rate / given - 1) <= MAX_RELATIVE_DIFFERENCE:
        if not MAX_RELATIVE_DIFFERENCE < abs(rate / median_rate - 1) < MIN_OTHER_SETTING:
            return None
        words = f"the time stamps say {rate:.5g} Hz where the other runs have {median_rate:.5g} Hz"
    else:
        words = f"the time stamps say {rate:.5g} Hz but fps = {given:.5g} is given"
        if unit := time_unit(given / rate):
            line = f'columns = {{t = "{unit[1]}"}}'
            words = f"{words}; the table's times are in {unit[0]}: give {line}"
            return Finding("fps", words, line, run, ERROR, contradicts=True)
        if abs(given / median_rate - 1) <= MAX_RELATIVE_DIFFERENCE:
            words += f", which the other runs have: its times are probably to be multiplied by {rate / given:.5g}"
        else:
            correction = f"fps = {rate:.5g}"
    return Finding("fps", f"{words}; {advice}", correction, run, contradicts=True)


def time_unit(ratio: float) -> tuple[str, str] | None:
    """Return the unit of time in which stamps agree with a stated rate, and its column heading; None if there is none.

    `ratio` is the stated rate over that of the stamps.
    """
    return next((unit for size, unit in TIME_UNITS.items() if abs(ratio / size - 1) <= MAX_RELATIVE_DIFFERENCE), None)


# --- places about which masses swing


def _swing_centre(x: Array) -> tuple[float, float] | None:
    """The place about which a mass swings, and its standard deviation, m; None where it does not swing.

    Of three turning points in a row, (a + 2 b + c) / 4 is the centre, also while dry friction takes as much from every
    half swing.
    """
    width = max(len(x) // (SMOOTHED_SHARE * max(len(_extremes(x)), 1)), 1)
    turns = _extremes(np.convolve(x, np.ones(width) / width, mode="valid"))[1:-1]  # the ends are none
    if len(turns) < MIN_TURNS:
        return None
    centres = (turns[:-2] + 2 * turns[1:-1] + turns[2:]) / 4
    return float(np.mean(centres)), float(np.std(centres) / np.sqrt(len(centres) - 1))


def _extremes(x: Array) -> Array:
    """Extremes between which the mass moves by `MIN_SWING_SHARE` of its travel, the ends of the record included."""
    least = MIN_SWING_SHARE * float(np.ptp(x)) if len(x) else 0.0
    found, low, high, rising = [], np.inf, -np.inf, 0
    for one in x.tolist():
        low, high = min(low, one), max(high, one)
        if rising >= 0 and high - one > least:
            found.append(high)
            low, rising = one, -1
        elif rising <= 0 and one - low > least:
            found.append(low)
            high, rising = one, 1
    return np.array([*found, low if rising < 0 else high])


def shifted_swings(positions: Mapping[str, Array]) -> Iterator[tuple[str, str, float]]:
    """Yield a record, the first one that swings, and how far from that one's its swing is centred, m.

    `positions`: positions of each record, m; NaN where unknown.
    """
    known = {name: x[np.isfinite(x)] for name, x in positions.items()}
    centres = {name: found for name, x in known.items() if (found := _swing_centre(x)) is not None}
    first = next(iter(centres), "")
    for name, (centre, sigma) in centres.items():
        shift, spread = centre - centres[first][0], np.hypot(sigma, centres[first][1])
        if abs(shift) > max(MIN_SHIFT_SIGMAS * spread, MIN_SHIFT_SHARE * float(np.ptp(known[name]))):
            yield name, first, shift


def different_origins(runs: Mapping[str, Run]) -> tuple[Finding, ...]:
    """Find runs without a drive whose swing is centred elsewhere than that of the first run."""
    free = {name: run.displacement.x for name, run in runs.items() if run.drive is None and run.friction_N is None}
    found = []
    for name, first, shift in shifted_swings(free):
        line = f'x_offset = "{-1e3 * shift:.4g} mm"'
        advice = f'if it has another origin, give {line}, or [[effect]] spring with per_run = ["x_0"]'
        found.append(Finding("origin", f"{describe_shift(shift, first)}; {advice}", line, name))
    return tuple(found)


def describe_shift(shift: float, first: str) -> str:
    """Say how far a swing is centred from that of the record `first`; the shift is in m."""
    return f"its rest and its turning points lie {1e3 * shift:+.3g} mm from those of {first}"


# --- accelerometers


class _Mode(NamedTuple):
    """One delay and gain that a run allows."""

    offset: float
    gain: float
    probability: float
    sigma_offset: float = 0.0
    sigma_gain: float = 0.0

    def agrees(self, other: _Mode, with_delay: bool) -> bool:
        """Whether two runs may have this delay and gain in common."""
        gain = MAX_GAIN_DIFFERENCE * abs(self.gain) + MAX_SIGMAS * np.hypot(self.sigma_gain, other.sigma_gain)
        delay = MAX_DELAY_DIFFERENCE + MAX_SIGMAS * np.hypot(self.sigma_offset, other.sigma_offset)
        near = not with_delay or abs(self.offset - other.offset) < delay
        return bool(near and self.gain * other.gain > 0.0 and abs(self.gain - other.gain) < gain)


def implausible_sensors(clocks: Mapping[str, Mapping[str, Any]]) -> tuple[Finding, ...]:
    """Find runs in which an accelerometer has another sign, gain or delay than in the others, or an ambiguous one.

    The delay counts where the runs have one in common; otherwise each recording was started on its own.

    `clocks`: alignment of the accelerometer in every run, as `Sensors.clocks` has it under "a". Returns at most one per
    run, or one for all where no gain leads.

    Examples
    --------
    >>> implausible_sensors({})
    ()

    """
    modes = {run: _modes(clock) for run, clock in clocks.items() if clock.get("gain") is not None}
    clear = {run: those for run, those in modes.items() if len(those) == 1}
    for tried, with_delay in ((modes, True), (clear, False)):
        common = _common(tried, with_delay=with_delay)
        if common is not None:
            found = (_sensor_finding(run, those, common, with_delay=with_delay) for run, those in tried.items())
            return tuple(finding for finding in found if finding is not None)
    if len(clear) < 2:
        return ()
    stated = ", ".join(f'{those[0].gain:.3g} in "{run}"' for run, those in clear.items())
    words = f"the gain of the accelerometer differs between the runs: {stated}; one sensor has one: check its mounting"
    return (Finding("sensor", f"{words}, its offset and the scale of each film"),)


def _modes(clock: Mapping[str, Any]) -> list[_Mode]:
    """The stated delay and gain of a run first, then its rivals."""
    rivals = [_Mode(*rival) for rival in clock.get("rivals", ())]
    sigmas = () if rivals else (clock["sigma_offset_s"] or 0.0, clock["sigma_gain"] or 0.0)
    return [_Mode(clock["offset_s"], clock["gain"], 1.0 - sum(r.probability for r in rivals), *sigmas), *rivals]


def _common(modes: Mapping[str, Sequence[_Mode]], *, with_delay: bool) -> _Mode | None:
    """The delay and gain that all runs together make by far the most probable; None if none is."""

    def log_probability(mode: _Mode) -> float:
        agreeing = [sum(m.probability for m in those if m.agrees(mode, with_delay)) for those in modes.values()]
        return float(np.sum(np.log(np.maximum(agreeing, MIN_PROBABILITY))))

    if len(modes) < 2:
        return None
    every = list(chain.from_iterable(modes.values()))
    best = max(every, key=log_probability)
    others = [log_probability(mode) for mode in every if not mode.agrees(best, with_delay)]
    if log_probability(best) - max(others, default=-np.inf) < np.log(MIN_ODDS):
        return None
    return min((m for m in every if m.agrees(best, with_delay)), key=lambda m: m.sigma_offset or np.inf)


def _sensor_finding(run: str, modes: Sequence[_Mode], common: _Mode, *, with_delay: bool) -> Finding | None:
    """What a run should have instead; None where it has it."""
    agreeing = next((mode for mode in modes if mode.agrees(common, with_delay)), None)
    if len(modes) == 1 and agreeing is not None:
        return None
    first = modes[0]
    words = f"its accelerometer has {-1e3 * first.offset:.4g} ms delay and gain {first.gain:.3g}"
    others = f"the other runs have {-1e3 * common.offset:.4g} ms and {common.gain:.3g}"
    if agreeing is None:
        others = others if with_delay else f"the other runs have gain {common.gain:.3g}"
        return Finding("sensor", f"{words} where {others}: check its mounting, its trigger and the scale", run=run)
    line = f'offset = "{1e3 * common.offset:.4g} ms"'
    possible = "and so may this one" if agreeing is not first else "which settles it"
    return Finding("sensor", f"{words}, but is ambiguous; {others}, {possible}: set {line}", line, run)
