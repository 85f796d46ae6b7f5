"""Find the structure of a long record in windows, so that the work grows linearly with its length.

Each window gets a trend, lines and events as a short record does. They are joined to one structure: the stiffness is
interpolated, events stay where they are, and a line found in several windows becomes one line of the whole record, with
frequency and penalty refined by the likelihood of all frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from frictrack.motion.smoother.posterior_deviations import weighted_cubic
from frictrack.motion.smoother.smoother_data import TREND_ORDER, SmootherData
from frictrack.motion.smoother.structure import Event, Structure
from frictrack.motion.smoother.structure_search import MAX_LINES, STIFF_LINE, StructureSearch

MAX_WHOLE_FRAMES = 4000  # longer records are treated in windows
WINDOW_FRAMES, OVERLAP_FRAMES = 2500, 200  # frames of a window, and on either side of it
MAX_WINDOW_WORK = 1_500_000  # frames in all likelihoods of one window
MIN_MEASURED_FRAMES = 100  # from which a window's structure can be found
KNOTS_PER_WINDOW = 5  # of the stiffness
POINTS_PER_CYCLE = 128  # per record, at which the residual of a line is largest
FREQUENCY_STEPS = (-0.25, -0.125, -0.0625, 0.0625, 0.125, 0.25)  # cycles per record, tried about a frequency
LINE_STIFFNESSES = (10.0, 14.0, 18.0, 24.0, STIFF_LINE)  # log mu of a line


@dataclass(frozen=True)
class RecordWindow:
    """Frames first to stop (exclusive) of a record; those from core to core_stop belong to no other window."""

    first: int
    stop: int
    core: int
    core_stop: int
    structure: Structure


def find_structure(data: SmootherData) -> Structure:
    """Find the structure of the highest likelihood.

    Parameters
    ----------
    data
        Measurements of n frames, from which a cubic was subtracted.

    Returns
    -------
    Structure
        Trend, lines and events.

    """
    if len(data.w) <= MAX_WHOLE_FRAMES:
        return StructureSearch(data).search()
    windows = list(_windows(data))
    structure = Structure(_stiffness(windows, len(data.w)), (), tuple(_events(windows, len(data.w))))
    return _add_lines(structure, data, windows)


def _windows(data: SmootherData) -> Iterator[RecordWindow]:
    """Yield windows of about equal length with their structures."""
    n = len(data.w)
    cores = np.linspace(0, n, round(n / WINDOW_FRAMES) + 1).astype(int)
    last: Structure | None = None
    for core, core_stop in zip(cores[:-1].tolist(), cores[1:].tolist(), strict=True):
        first, stop = max(core - OVERLAP_FRAMES, 0), min(core_stop + OVERLAP_FRAMES, n)
        part = window_data(data, first, stop)
        if part is not None:
            search = StructureSearch(part)
            search.remaining_work = MAX_WINDOW_WORK
            last = search.search()
        yield RecordWindow(first, stop, core, core_stop, last or StructureSearch(data).stiff)


def window_data(data: SmootherData, first: int, stop: int) -> SmootherData | None:
    """Cut a window out of the data and subtract its own cubic.

    Parameters
    ----------
    data
        Measurements.
    first, stop
        First frame and stop (exclusive).

    Returns
    -------
    SmootherData or None
        None if fewer than `MIN_MEASURED_FRAMES` were measured.

    """
    part = data.part(first, stop)
    if np.sum(part.w > 0) < MIN_MEASURED_FRAMES:
        return None
    cubic = weighted_cubic(part.y, part.w)
    bent = None if part.second_differences is None else part.second_differences - np.diff(cubic, 2)
    return replace(part, y=np.where(part.w > 0, part.y - cubic, 0.0), second_differences=bent)


def _stiffness(windows: Sequence[RecordWindow], n: int) -> tuple[float, ...]:
    """Log lambda at equally spaced knots over the record, interpolated from the windows."""
    places, values = [], []
    for window in windows:
        without_events = replace(window.structure, events=()).log_lambda(window.stop - window.first)
        core_rows = slice(window.core - window.first, min(window.core_stop - window.first, len(without_events)))
        places.append(np.arange(len(without_events))[core_rows] + window.first)
        values.append(without_events[core_rows])
    frequencies = np.linspace(0, n - TREND_ORDER - 1, KNOTS_PER_WINDOW * len(windows) + 1)
    return tuple(np.interp(frequencies, np.concatenate(places), np.concatenate(values)).tolist())


def _events(windows: Sequence[RecordWindow], n: int) -> Iterator[Event]:
    """Yield the events of all windows at their places in the record."""
    for window in windows:
        for e in window.structure.events:
            first, last = e.first + window.first, min(e.last + window.first, n - TREND_ORDER - 1)
            if window.core <= 0.5 * (first + last) + 0.5 * TREND_ORDER < window.core_stop:
                yield Event(first, last, e.boost)


def _add_lines(structure: Structure, data: SmootherData, windows: Sequence[RecordWindow]) -> Structure:
    """Add the lines found in windows, the most frequent ones first, and refine them on the whole record."""
    search = StructureSearch(data)
    used = np.zeros(0)
    cell = 2 * np.pi / WINDOW_FRAMES
    for omega in _frequencies(windows, cell):
        if np.any(np.abs(used - omega) < cell):
            continue
        used = np.append(used, omega)
        structure = _refine_last_line(
            replace(structure, lines=(*structure.lines, (_peak(search, structure, omega, cell), LINE_STIFFNESSES[1]))),
            search,
        )
    return structure


def _frequencies(windows: Sequence[RecordWindow], cell: float) -> list[float]:
    """Frequencies of lines, radians per frame, the `MAX_LINES` that most windows contain."""
    found = np.array([omega for window in windows for omega, _ in window.structure.lines])
    if not len(found):
        return []
    found.sort()
    low, high = np.searchsorted(found, [found - cell, found + cell])  # the same line
    chosen: list[float] = []
    for i in np.argsort(low - high, kind="stable"):
        if len(chosen) < MAX_LINES and all(abs(found[i] - omega) >= cell for omega in chosen):
            chosen.append(float(np.median(found[low[i] : high[i]])))
    return chosen


def _peak(search: StructureSearch, structure: Structure, omega: float, cell: float) -> float:
    """Frequency near `omega` where the residual of the whole record is largest, radians per frame."""
    factor = structure.factor_smoother(search.data)
    residual = factor.residual(factor.unknowns())
    frequencies = np.linspace(omega - cell, omega + cell, int(POINTS_PER_CYCLE * search.n * cell / np.pi))
    amplitudes = scipy.signal.zoom_fft(residual, frequencies[[0, -1]], len(frequencies), fs=2 * np.pi, endpoint=True)
    return float(frequencies[np.argmax(np.abs(amplitudes))])


def _refine_last_line(structure: Structure, search: StructureSearch) -> Structure:
    """Choose frequency and penalty of the last line by the highest likelihood."""
    *others, (omega, _) = structure.lines

    def with_line(omega: float, log_mu: float) -> Structure:
        return replace(structure, lines=(*others, (omega, log_mu)))

    best = min((with_line(omega, log_mu) for log_mu in LINE_STIFFNESSES), key=search.loss)
    log_mu = best.lines[-1][1]
    tried = [best, *(with_line(omega + 2 * np.pi * turn / search.n, log_mu) for turn in FREQUENCY_STEPS)]
    return min(tried, key=search.loss)
