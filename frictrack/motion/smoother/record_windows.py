"""Build the structure of a long record up in windows: the work grows with its length, not with the square.

Every window is parted into a trend, lines and events as a short record is. Together they make one structure: the
stiffness runs through the windows, events stay where they are, and a line that windows agree on is one line of the
whole record, its frequency and its wandering settled anew by the likelihood of all frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictrack.motion.posterior_deviations import weighted_cubic
from frictrack.motion.structure import MAX_LINES, STIFF_LINE, Event, Structure, StructureSearch
from frictrack.motion.system import TREND_ORDER, SmootherData
from frictrack.records import Array, Mask

MAX_WHOLE_FRAMES = 4000  # a longer record is treated in windows
WINDOW_FRAMES, OVERLAP_FRAMES = 2500, 200  # frames of a window, and on either side of it
MAX_WINDOW_WORK = 1_500_000  # frames in all likelihoods of one window
MIN_MEASURED_FRAMES = 100  # from which a window's structure can be found
KNOTS_PER_WINDOW = 5  # of the stiffness
FREQUENCY_STEPS = (-0.25, -0.125, -0.0625, 0.0625, 0.125, 0.25)  # cycles over the record, tried round a frequency
LINE_STIFFNESSES = (10.0, 14.0, 18.0, 24.0, STIFF_LINE)  # log mu of a line


@dataclass(frozen=True)
class RecordWindow:
    """Frames first to stop (exclusive) of a record, of which those from core to core_stop are its own."""

    first: int
    stop: int
    core: int
    core_stop: int
    structure: Structure


def find_structure(data: SmootherData) -> Structure:
    """The structure of the highest likelihood of data (n,) from which a cubic was taken out."""
    if len(data.w) <= MAX_WHOLE_FRAMES:
        return StructureSearch(data).search()
    windows = list(_windows(data))
    made = Structure(_stiffness(windows, len(data.w)), (), tuple(_events(windows, len(data.w))))
    return _add_lines(made, data, windows)


def _windows(data: SmootherData) -> Iterator[RecordWindow]:
    """Windows of about equal length, each with its structure."""
    n = len(data.w)
    cores = np.linspace(0, n, round(n / WINDOW_FRAMES) + 1).astype(int)
    last: Structure | None = None
    for core, core_stop in zip(cores[:-1].tolist(), cores[1:].tolist(), strict=True):
        first, stop = max(core - OVERLAP_FRAMES, 0), min(core_stop + OVERLAP_FRAMES, n)
        part = window_data(data, first, stop)
        if part is not None:
            growth = StructureSearch(part)
            growth.remaining_work = MAX_WINDOW_WORK
            last = growth.search()
        yield RecordWindow(first, stop, core, core_stop, last or StructureSearch(data).stiff)


def window_data(data: SmootherData, first: int, stop: int) -> SmootherData | None:
    """Some frames of the data without their own cubic; None where too few of them were measured."""
    y, w = data.y[first:stop], data.w[first:stop]
    if np.sum(w > 0) < MIN_MEASURED_FRAMES:
        return None
    cubic = weighted_cubic(y, w)
    rest = np.where(w > 0, y - cubic, 0.0)
    if data.bent is None or data.worth is None:
        return SmootherData(rest, w, colour=data.colour)
    bent = data.bent[first : stop - 2] - np.diff(cubic, 2)
    return SmootherData(rest, w, bent, data.worth[first : stop - 2], data.colour)


def _stiffness(windows: Sequence[RecordWindow], n: int) -> tuple[float, ...]:
    """Log lambda at equally spaced knots over the record, as the windows have it there."""
    places, values = [], []
    for window in windows:
        calm = replace(window.structure, events=()).log_lambda(window.stop - window.first)
        own = slice(window.core - window.first, min(window.core_stop - window.first, len(calm)))
        places.append(np.arange(len(calm))[own] + window.first)
        values.append(calm[own])
    at = np.linspace(0, n - TREND_ORDER - 1, KNOTS_PER_WINDOW * len(windows) + 1)
    return tuple(np.interp(at, np.concatenate(places), np.concatenate(values)).tolist())


def _events(windows: Sequence[RecordWindow], n: int) -> Iterator[Event]:
    """The events of all windows at their places in the record."""
    for window in windows:
        for e in window.structure.events:
            first, last = e.first + window.first, min(e.last + window.first, n - TREND_ORDER - 1)
            if window.core <= 0.5 * (first + last) + 0.5 * TREND_ORDER < window.core_stop:
                yield Event(first, last, e.boost)


def _add_lines(made: Structure, data: SmootherData, windows: Sequence[RecordWindow]) -> Structure:
    """The structure with the lines that windows show, the most frequent ones first, settled for the whole record."""
    growth = StructureSearch(data)
    near = np.zeros(0)
    cell = 2 * np.pi / WINDOW_FRAMES
    for omega in _frequencies(windows, cell)[:MAX_LINES]:
        if np.any(np.abs(near - omega) < cell):
            continue
        near = np.append(near, omega)
        made = _refine_last_line(
            replace(made, lines=(*made.lines, (_peak(growth, made, omega, cell), LINE_STIFFNESSES[1]))), growth
        )
    return made


def _frequencies(windows: Sequence[RecordWindow], cell: float) -> list[float]:
    """Frequencies of lines, radians per frame, by the number of windows that show them."""
    found = np.array([omega for window in windows for omega, _ in window.structure.lines])
    if not len(found):
        return []
    alike: Mask = np.abs(found[:, None] - found) < cell
    order = np.argsort(-np.sum(alike, axis=1), kind="stable")
    chosen: list[float] = []
    for i in order:
        if all(abs(found[i] - omega) >= cell for omega in chosen):
            chosen.append(float(np.median(found[alike[i]])))
    return chosen


def _peak(growth: StructureSearch, made: Structure, omega: float, cell: float) -> float:
    """Frequency near one at which the residual of the whole record has most, radians per frame."""
    factor = made.factor_smoother(growth.data)
    left = factor.residual(factor.unknowns())
    at = 2 * np.pi * np.arange(8 * growth.n + 1) / (16 * growth.n)
    power: Array = np.abs(np.fft.rfft(left, 16 * growth.n)) ** 2
    inside = np.flatnonzero(np.abs(at - omega) < cell)
    return float(at[inside[np.argmax(power[inside])]])


def _refine_last_line(made: Structure, growth: StructureSearch) -> Structure:
    """The last line's frequency and wandering at the highest likelihood of those tried."""
    *others, (omega, _) = made.lines

    def with_line(omega: float, log_mu: float) -> Structure:
        return replace(made, lines=(*others, (omega, log_mu)))

    best = min((with_line(omega, log_mu) for log_mu in LINE_STIFFNESSES), key=growth.loss)
    log_mu = best.lines[-1][1]
    tried = [best, *(with_line(omega + 2 * np.pi * turn / growth.n, log_mu) for turn in FREQUENCY_STEPS)]
    return min(tried, key=growth.loss)
