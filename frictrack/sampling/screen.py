"""Check the samples of a displacement: leave outliers out, find the step of quantised positions, name both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from frictrack.distributions import robust_std
from frictrack.records import Array, Displacement
from frictrack.sampling.even_clock import base_interval
from frictrack.sampling.outlier_search import Outliers, outliers
from frictrack.sampling.quantisation import MIN_NOISE_SHARE, quantum, rounding_noise

MAX_LISTED_FRAMES = 8  # frames that a finding names
MIN_ROWS = 8  # known rows that can be checked
Rows = NDArray[np.int64]


def screened(displacement: Displacement, numbers: Rows | None = None) -> Displacement:
    """Leave the outliers of a displacement out and say so.

    Parameters
    ----------
    displacement : Displacement
        Positions as they were measured; they stay as they are.
    numbers : array (n,), optional
        Number of each row's frame in its recording, for the findings; counted from 0 by default.

    Returns
    -------
    Displacement
        With `valid` false at the outliers of x and y, the step of quantised positions in `resolution`, and findings in
        `notes`. The same object where nothing is found.

    Examples
    --------
    >>> import numpy as np
    >>> from frictrack.records import Displacement
    >>> t, nan = np.arange(200) / 4000, np.full(200, np.nan)
    >>> x = 2 * t + 1e-5 * np.random.default_rng(0).standard_normal(200)
    >>> x[120] += 1e-3
    >>> seen = screened(Displacement(t, x, nan, nan, nan, nan, np.ones(200, bool)))
    >>> seen.valid[119:122].tolist(), seen.notes[0].endswith("off its course (frame 120): left out")
    ([True, False, True], True)

    """
    numbers = np.arange(len(displacement)) if numbers is None else numbers
    frames = frame_numbers(displacement.t)
    valid, notes, step = np.array(displacement.valid), list(displacement.notes), 0.0
    for coordinate, sigma, name in (
        (displacement.x, displacement.sigma_x, ""),
        (displacement.y, displacement.sigma_y, " across it"),
    ):
        rows = np.flatnonzero(valid & np.isfinite(coordinate))
        if len(rows) < MIN_ROWS:
            continue
        found, size = _outliers_and_step(frames[rows], coordinate[rows], sigma[rows])
        valid[rows[found.rows]] = False
        notes += _outlier_note(found, numbers[rows], name)
        if not name:
            step = size
            notes += _quantum_note(step)
    if not step and len(notes) == len(displacement.notes):
        return displacement
    return replace(displacement, valid=valid, notes=tuple(notes), resolution=step)


def frame_numbers(t: Array) -> Array:
    """Convert times to frame numbers, counted from the first.

    Parameters
    ----------
    t : array (n,)
        Times, s.

    Returns
    -------
    array (n,)
        Whole numbers; gaps are kept.

    Examples
    --------
    >>> frame_numbers(np.array([0.0, 0.1, 0.2, 0.5])).tolist()
    [0.0, 1.0, 2.0, 5.0]

    """
    steps = np.diff(t)  # one by one: the rounding of their median would add up
    return np.concatenate(
        ([0.0], np.cumsum(np.maximum(np.rint(steps / (base_interval(t) or float(np.median(steps)))), 1.0)))
    )


def _outliers_and_step(frames: Array, x: Array, sigma: Array) -> tuple[Outliers, float]:
    """Outliers of known positions, and their step where that matters."""
    stated = np.isfinite(sigma) & (sigma > 0)
    usual = float(np.median(sigma[stated])) if stated.any() else 1.0
    step = quantum(x)
    found = outliers(frames, x, np.where(stated, sigma, usual), rounding_noise(step))
    return found, step if step > MIN_NOISE_SHARE * _noise_level(x) else 0.0


def _noise_level(x: Array) -> float:
    """Noise of positions as their third differences show it, rounding included."""
    return float(robust_std(np.diff(x, 3))) / float(np.sqrt(20.0))


def _outlier_note(found: Outliers, numbers: Rows, where: str = "") -> tuple[str, ...]:
    """The outliers in words: how many, how far off, in which frames."""
    if not len(found.rows):
        return ()
    size = np.abs(found.off)
    unit, metres = _unit_of(float(np.max(size)))
    low, high = f"{np.min(size) / metres:.3g}", f"{np.max(size) / metres:.3g}"
    span = f"{high} {unit}" if low == high else f"{low} to {high} {unit}"
    count = "1 sample lies" if len(size) == 1 else f"{len(size)} samples lie"
    off = "its" if len(size) == 1 else "their"
    return (f"{count} {span} off {off} course{where} ({describe_frames(numbers[found.rows])}): left out",)


def _quantum_note(step: float) -> tuple[str, ...]:
    """The step of quantised positions in words."""
    if not step:
        return ()
    noise = rounding_noise(step)
    return (
        f"positions are whole multiples of {describe_length(step)}: "
        f"rounding adds a noise of {describe_length(noise)} to every sample, "
        "and samples closer than a step share it",
    )


def describe_length(metres: float) -> str:
    """Format a length with a suitable unit.

    Parameters
    ----------
    metres : float
        Length, m.

    Returns
    -------
    str
        Three significant digits.

    Examples
    --------
    >>> describe_length(2.5e-5)
    '25 um'

    """
    unit, size = _unit_of(metres)
    return f"{metres / size:.3g} {unit}"


def _unit_of(metres: float) -> tuple[str, float]:
    """Unit that suits a length, and its size, m."""
    units = (("m", 1.0), ("mm", 1e-3), ("um", 1e-6))
    return next((u for u in units if metres >= 0.9995 * u[1]), ("nm", 1e-9))


def describe_frames(numbers: Sequence[int] | Rows) -> str:
    """List frame numbers, the first ones by number.

    Parameters
    ----------
    numbers : sequence of int
        Frames.

    Returns
    -------
    str
        At most `MAX_LISTED_FRAMES` numbers.

    Examples
    --------
    >>> describe_frames([4, 9])
    'frames 4, 9'

    """
    shown = ", ".join(str(int(i)) for i in numbers[:MAX_LISTED_FRAMES])
    more = f" and {len(numbers) - MAX_LISTED_FRAMES} more" if len(numbers) > MAX_LISTED_FRAMES else ""
    return f"frame{'s' if len(numbers) > 1 else ''} {shown}{more}"
