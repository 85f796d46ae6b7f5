"""Check the frame rates of runs: what their time stamps say against what was stated, and against the other runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from frictrack.plausibility.finding import Finding
from frictrack.records import Run

DISAGREE = 0.01  # relative: forces are then off by twice as much
OTHER_CAMERA = 0.35  # relative: a larger difference between runs is another setting, and no wrong clock


def implausible_clocks(runs: Mapping[str, Run], stated: Mapping[str, float | None]) -> Iterator[Finding]:
    """Find runs whose time stamps contradict the stated frame rate, or nearly but not quite those of the other runs.

    Parameters
    ----------
    runs
        The measured runs by name.
    stated
        The frame rate that is given of each, Hz; None where none is.

    Examples
    --------
    >>> list(implausible_clocks({}, {}))
    []

    """
    rates = {name: 1.0 / float(np.median(np.diff(run.displacement.t))) for name, run in runs.items()}
    usual = float(np.median(list(rates.values()))) if len(rates) > 2 else float("nan")
    for name, rate in rates.items():
        given = stated.get(name)
        if given is not None and abs(rate / given - 1) > DISAGREE:
            yield _clock(name, f"the time stamps say {rate:.5g} Hz but fps = {given:.5g} is given", f"fps = {rate:.5g}")
        elif DISAGREE < abs(rate / usual - 1) < OTHER_CAMERA:
            yield _clock(name, f"the time stamps say {rate:.5g} Hz where the other runs have {usual:.5g} Hz")


def _clock(run: str, words: str, correction: str = "") -> Finding:
    advice = "one of the two is wrong and every force goes with its square; give the true times or frame rate"
    return Finding("fps", f"{words}: {advice}", correction, run)
