"""Check the frame rates of runs: time stamps against the stated rate, and against the other runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from frictrack.plausibility.finding import ERROR, Finding
from frictrack.records import Run

MAX_RELATIVE_DIFFERENCE = 0.01  # of frame rates; forces are then wrong by twice as much
CONTRADICTION = "one of the two is wrong and every force goes with its square"
MIN_OTHER_SETTING = 0.35  # relative difference between runs from which the camera setting differs
TIME_UNITS = {
    1e3: ("ms", "t_s (ms)"),
    1e6: ("us", "t_s (us)"),
    1 / 60: ("minutes", "t_s (min)"),
}  # by stated over stamped rate


def implausible_clocks(runs: Mapping[str, Run], stated: Mapping[str, float | None]) -> tuple[Finding, ...]:
    """Find runs whose time stamps contradict the stated frame rate, or nearly but not quite those of the other runs.

    Parameters
    ----------
    runs
        The measured runs by name.
    stated
        The frame rate that is given of each, Hz; None where none is.

    Returns
    -------
    tuple of Finding
        At most one per run, or one for all where all say the same. Time stamps in another unit are an error.

    Examples
    --------
    >>> implausible_clocks({}, {})
    ()

    """
    notes = tuple(
        Finding("fps", note, "", name, contradicts=True)
        for name, run in runs.items()
        for note in run.displacement.notes
        if note.endswith(CONTRADICTION)
    )
    found = notes + tuple(
        _check_rates({name: 1.0 / float(np.median(np.diff(run.displacement.t))) for name, run in runs.items()}, stated)
    )
    if len(found) == len(runs) > 1 and len({f.words for f in found}) == 1:
        return (replace(found[0], run=""),)
    return found


def _check_rates(rates: Mapping[str, float], stated: Mapping[str, float | None]) -> Iterator[Finding]:
    median_rate = float(np.median(list(rates.values()))) if len(rates) > 2 else float("nan")
    for name, rate in rates.items():
        given = stated.get(name)
        if given is not None and (unit := time_unit(given / rate)):
            yield _unit_finding(name, f"the time stamps say {rate:.5g} Hz but fps = {given:.5g} is given", unit)
        elif given is not None and abs(rate / given - 1) > MAX_RELATIVE_DIFFERENCE:
            yield _stated_finding(name, rate, given, median_rate)
        elif MAX_RELATIVE_DIFFERENCE < abs(rate / median_rate - 1) < MIN_OTHER_SETTING:
            yield _clock_finding(
                name, f"the time stamps say {rate:.5g} Hz where the other runs have {median_rate:.5g} Hz"
            )


def time_unit(ratio: float) -> tuple[str, str] | None:
    """Return the unit of time in which stamps agree with a stated rate, and its column heading; None if there is none.

    Parameters
    ----------
    ratio
        Stated rate over that of the stamps.

    """
    return next((unit for size, unit in TIME_UNITS.items() if abs(ratio / size - 1) <= MAX_RELATIVE_DIFFERENCE), None)


def _unit_finding(run: str, words: str, unit: tuple[str, str]) -> Finding:
    name, head = unit
    line = f'columns = {{t = "{head}"}}'
    advice = f"the table's times are in {name}: give {line}"
    return Finding("fps", f"{words}; {advice}", line, run, ERROR, contradicts=True)


def _stated_finding(run: str, rate: float, given: float, median_rate: float) -> Finding:
    """Finding on a stated rate that differs from the stamps; the median of the other runs may show which is right."""
    words = f"the time stamps say {rate:.5g} Hz but fps = {given:.5g} is given"
    if abs(given / median_rate - 1) <= MAX_RELATIVE_DIFFERENCE:
        likely = f"{words}, which the other runs have: its times are probably to be multiplied by {rate / given:.5g}"
        return _clock_finding(run, likely)
    return _clock_finding(run, words, f"fps = {rate:.5g}")


def _clock_finding(run: str, words: str, correction: str = "") -> Finding:
    advice = f"{CONTRADICTION}; give the true times or frame rate"
    return Finding("fps", f"{words}; {advice}", correction, run, contradicts=True)
