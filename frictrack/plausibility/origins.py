"""Compare the places about which masses swing: records of one swing with other origins differ by a constant."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from frictrack.plausibility.finding import Finding
from frictrack.records import Array, Run

MIN_TURNS = 4  # turning points that show a centre and its scatter
SMOOTHED_SHARE = 4  # part of a half swing over which positions are averaged: all turning points come nearer alike
MIN_SWING_SHARE = 0.25  # of the whole travel; a smaller swing back is noise, or the end of a decay
MIN_SHIFT_SIGMAS, MIN_SHIFT_SHARE = 5.0, 0.01  # standard deviations, and share of the travel, of a shift that is said


def swing_centre(x: Array) -> tuple[float, float] | None:
    """Compute the place about which a mass swings, and its standard deviation, m; None where it does not swing.

    Of three turning points in a row, (a + 2 b + c) / 4 is the centre, also while dry friction takes as much from every
    half swing.

    Parameters
    ----------
    x
        Positions, m, (n,); NaN where unknown.

    Examples
    --------
    >>> t = np.arange(400) / 100
    >>> round(swing_centre(0.3 + np.exp(-t / 9) * np.sin(6 * t))[0], 2)
    0.3

    """
    known = x[np.isfinite(x)]
    width = max(len(known) // (SMOOTHED_SHARE * max(len(_extremes(known)), 1)), 1)
    turns = _extremes(np.convolve(known, np.ones(width) / width, mode="valid"))[1:-1]  # the ends are none
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

    Parameters
    ----------
    positions
        Positions of each record, m.

    """
    found = {name: swing_centre(x) for name, x in positions.items()}
    centres = {name: (*one, float(np.ptp(x[np.isfinite(x)]))) for name, x in positions.items() if (one := found[name])}
    first = next(iter(centres), "")
    for name, (centre, sigma, travel) in centres.items():
        shift = centre - centres[first][0]
        if abs(shift) > max(MIN_SHIFT_SIGMAS * np.hypot(sigma, centres[first][1]), MIN_SHIFT_SHARE * travel):
            yield name, first, shift


def different_origins(runs: Mapping[str, Run]) -> tuple[Finding, ...]:
    """Find runs without a drive whose swing is centred elsewhere than that of the first run.

    Parameters
    ----------
    runs
        The measured runs by name.

    Examples
    --------
    >>> different_origins({})
    ()

    """
    free = {name: run.displacement.x for name, run in runs.items() if run.drive is None and run.friction_N is None}
    return tuple(
        Finding(
            "origin",
            describe_shift(shift, first)
            + f'; if it has another origin, give {line}, or [[effect]] spring with per_run = ["x_0"]',
            line,
            name,
        )
        for name, first, shift in shifted_swings(free)
        for line in (f'x_offset = "{-1e3 * shift:.4g} mm"',)
    )


def describe_shift(shift: float, first: str) -> str:
    """Say how far a swing is centred from that of the record `first`; the shift is in m."""
    return f"its rest and its turning points lie {1e3 * shift:+.3g} mm from those of {first}"
