"""Check the samples of a displacement: leave outliers out, find the step of quantised positions, name both.

Among all records of a study, find those that are the same measurement: their noise agrees, and their motion agrees to
better than the noise. The noise of two measurements is independent, however similar the motion. A copy may be cut,
shifted in time or position, or written with other digits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from frictrack.base.distributions import noise_of_differences, robust_std
from frictrack.records import Array, Displacement
from frictrack.sampling.clock import base_interval
from frictrack.sampling.outlier_search import Outliers, outliers
from frictrack.sampling.steps import MIN_NOISE_SHARE, quantum, rounding_noise

MAX_LISTED_FRAMES = 8  # frames that a finding names
MIN_ROWS = 8  # known rows that can be checked
MIN_NOISE_CORRELATION = 0.9  # correlation of the noise of two records of the same measurement
MIN_COMMON_SHARE = 0.5  # of the shorter record that both must hold
MIN_COMMON_ROWS = 32  # rows that both must hold
CLIP_SIGMAS = 4.0  # robust deviations at which a difference is clipped: an outlier must not make two records agree
Rows = NDArray[np.int64]


def screened(displacement: Displacement, numbers: Rows | None = None) -> Displacement:
    """Leave the outliers of a displacement out and say so.

    `displacement`: positions as they were measured; they stay as they are; `numbers` (n,): number of each row's frame
    in its recording, for the findings; counted from 0 by default. `valid` becomes false at the outliers of x and y,
    the step of quantised positions in `resolution`, and findings in `notes`. The same object where nothing is
    found.

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
        if len(found.rows):
            notes.append(_describe_outliers(found, numbers[rows], name))
        if not name and size:
            step = size
            rounding = f"rounding adds a noise of {describe_length(rounding_noise(step))} to every sample"
            shared = "and samples closer than a step share it"
            notes.append(f"positions are whole multiples of {describe_length(step)}: {rounding}, {shared}")
    if not step and len(notes) == len(displacement.notes):
        return displacement
    return replace(displacement, valid=valid, notes=tuple(notes), resolution=step)


def frame_numbers(t: Array) -> Array:
    """Convert times to frame numbers, counted from the first.

    `t` (n,): times, s. Returns the whole numbers; gaps are kept.

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
    return found, step if step > MIN_NOISE_SHARE * noise_of_differences(np.diff(x, 3), 3) else 0.0


def _describe_outliers(found: Outliers, numbers: Rows, where: str) -> str:
    """Say how many outliers there are, how far off, in which frames."""
    size = np.abs(found.off)
    unit, metres = _unit_of(float(np.max(size)))
    low, high = f"{np.min(size) / metres:.3g}", f"{np.max(size) / metres:.3g}"
    span = f"{high} {unit}" if low == high else f"{low} to {high} {unit}"
    count, their = ("1 sample lies", "its") if len(size) == 1 else (f"{len(size)} samples lie", "their")
    return f"{count} {span} off {their} course{where} ({describe_frames(numbers[found.rows])}): left out"


def describe_length(metres: float) -> str:
    """Format a length with a suitable unit.

    `metres`: length, m. Three significant digits.

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

    Returns at most `MAX_LISTED_FRAMES` numbers.

    Examples
    --------
    >>> describe_frames([4, 9])
    'frames 4, 9'

    """
    shown = ", ".join(str(int(i)) for i in numbers[:MAX_LISTED_FRAMES])
    more = f" and {len(numbers) - MAX_LISTED_FRAMES} more" if len(numbers) > MAX_LISTED_FRAMES else ""
    return f"frame{'s' if len(numbers) > 1 else ''} {shown}{more}"


def copies(displacements: Sequence[Displacement]) -> list[tuple[int, int]]:
    """Find pairs of displacements that are the same measurement.

    Returns the numbers of the records of each pair.

    Examples
    --------
    >>> import numpy as np
    >>> from frictrack.records import Displacement
    >>> t, nan, rng = np.arange(200) / 4000, np.full(200, np.nan), np.random.default_rng(0)
    >>> x = [2 * t + 1e-5 * rng.standard_normal(200) for _ in range(2)]
    >>> made = [Displacement(t, y, nan, nan, nan, nan, np.ones(200, bool)) for y in (*x, x[0] + 0.1)]
    >>> copies(made)
    [(0, 2)]

    """
    series = [np.interp(d.t, d.t[d.known], d.x[d.known]) if d.known.any() else d.x for d in displacements]
    rough = [_clipped_differences(x) for x in series]
    return [(i, j) for i, j in combinations(range(len(series)), 2) if _is_same_measurement(series, rough, i, j)]


def _clipped_differences(x: Array) -> Array:
    """Fourth differences, clipped at `CLIP_SIGMAS`."""
    if len(x) < MIN_COMMON_ROWS:
        return np.zeros(0)
    difference = np.diff(x, 4)
    usual = float(robust_std(difference))
    return np.clip(difference, -CLIP_SIGMAS * usual, CLIP_SIGMAS * usual)


def _correlation(a: Array, b: Array) -> Array:
    """Cross-correlation of two series at all lags of `b`, from -(len(b) - 1)."""
    n = len(a) + len(b) - 1
    return np.fft.irfft(np.fft.rfft(a, n) * np.fft.rfft(b[::-1], n), n)


def _is_same_measurement(series: Sequence[Array], rough: Sequence[Array], i: int, j: int) -> bool:
    """Whether two records agree at the lag at which their noise agrees best."""
    a, b = rough[i], rough[j]
    if not (np.any(a) and np.any(b)):
        return bool(
            len(series[i]) == len(series[j]) >= MIN_COMMON_ROWS
            and np.ptp(series[i]) > 0 == np.ptp(series[i] - series[j])
        )
    lag = int(np.argmax(_correlation(a, b))) - (len(b) - 1)
    first, last = max(lag, 0), min(len(a), len(b) + lag)
    if last - first < max(MIN_COMMON_ROWS, MIN_COMMON_SHARE * min(len(a), len(b))):
        return False
    one, other = a[first:last], b[first - lag : last - lag]
    size = float(np.linalg.norm(one) * np.linalg.norm(other))
    if size == 0.0 or float(one @ other) < MIN_NOISE_CORRELATION * size:
        return False
    x, y = series[i][first:last], series[j][first - lag : last - lag]
    noise = float(np.std(one)) / float(np.sqrt(70.0))
    return float(np.std(x - y)) < noise < float(np.std(x))
