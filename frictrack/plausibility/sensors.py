"""Compare sign, gain and delay of one accelerometer between the runs of a study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from frictrack.plausibility.finding import Finding

MAX_GAIN_DIFFERENCE = 0.1  # relative, between runs of one sensor: the scale of each film is in it
MAX_DELAY_DIFFERENCE = 2e-4  # s, in addition to the deviations: jitter of a trigger
MAX_SIGMAS = 5.0
MIN_PROBABILITY = 1e-3  # of what an alignment excludes; `sensors.alignment` states rivals from here
MIN_ODDS = 100.0  # by which one delay and gain must lead to be called common


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

    Parameters
    ----------
    clocks
        Alignment of the accelerometer in every run, as `Sensors.clocks` has it under "a".

    Returns
    -------
    tuple of Finding
        At most one per run, or one for all where no gain leads.

    Examples
    --------
    >>> implausible_sensors({})
    ()

    """
    modes = {run: _modes(clock) for run, clock in clocks.items() if clock.get("gain") is not None}
    if len(modes) < 2:
        return ()
    if (common := _common(modes, with_delay=True)) is not None:
        return tuple(f for run in modes if (f := _finding(run, modes[run], common, with_delay=True)))
    clear = {run: those for run, those in modes.items() if len(those) == 1}
    if (common := _common(clear, with_delay=False)) is not None:
        return tuple(f for run in clear if (f := _finding(run, clear[run], common, with_delay=False)))
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


def _finding(run: str, modes: Sequence[_Mode], common: _Mode, *, with_delay: bool) -> Finding | None:
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
