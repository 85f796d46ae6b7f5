"""Check the samples of a displacement: leave outliers out, find the step of quantised positions, name both.

An outlier lies far off its course and returns to it, alone or in a short burst. A collision, a stop or a push bends the
course for good. Suspects are rows that their robust local cubic (least absolute deviations) misses. A suspect is an
outlier where the rows on both sides lie on one cubic to within the noise, it is far off that cubic, and neither a kink
nor a jump explains all rows as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np
import scipy
from numpy.typing import NDArray

from frictrack.base.distributions import MEDIAN_TO_SIGMA, chi2_ppf, noise_of_differences, robust_std
from frictrack.records import Array, Displacement, Mask, stretches
from frictrack.sampling.clock import (
    MIN_NOISE_SHARE,
    consecutive_noise,
    fourth_differences,
    frame_numbers,
    quantum,
    rounding_noise,
)

# Robust deviations of a fourth difference, below which no row near it is looked at; the first and last rows enter it
# with a sixth of the weight that others have.
SCREEN_SIGMAS, SCREEN_SIGMAS_AT_END = 4.0, 2.0
SUSPECT_SIGMAS = 4.5  # deviations from the robust local cubic
MIN_SIGMAS_AT_END = 6.0
HALF_WIDTH_ROWS, SIDE_ROWS = 12, 8  # rows on either side of the robust cubic, and of the one that judges
DEGREE = 3
MAX_BURST_ROWS = 8  # rows of a burst
MAX_BURST_ROWS_AT_END = 5
MAX_LEAP = 1.5  # times the longest step of the record: no mass moves so far from one frame to the next
MAX_GAP_FRAMES = 25  # frames without a row, beyond which the course is not followed
MAX_BRIDGED_ROWS = 2  # good rows between suspects that make them one burst
NOISE_REACH_ROWS = 30  # rows on either side over which the noise is compared with that of the record
MAX_OUTLIER_SHARE = 0.1  # of the rows; beyond it the noise itself has tails
MAX_ROUNDS, ROBUST_STEPS = 40, 15
WINDOW_ROWS, OVERLAP_ROWS = 1 << 15, 200  # of a long record that are searched at once, and more on either side

SIDES_QUANTILE = 0.998  # of chi-squared, that the sides may leave about their common cubic
MAX_CLOSE_TRIALS, MAX_CLOSE_BURST_ROWS = 12, 5


@dataclass(frozen=True)
class _BurstRule:
    """Rows on either side that judge a burst, the fewest of them, and the least deviation."""

    side: int
    fewest: int
    far: float  # deviations from the cubic of the sides
    than_event: float  # chi-squared by which a kink or a jump must be worse


WIDE_RULE = _BurstRule(SIDE_ROWS, 4, 6.0, 16.0)  # 2e-9 by chance
CLOSE_RULE = _BurstRule(4, 4, 12.0, 64.0)


@dataclass(frozen=True, eq=False)
class Outliers:
    """Outliers of a displacement.

    Attributes
    ----------
    rows : array of int (k,)
        Rows that are outliers.
    off : array (k,)
        Distance from the path of their neighbours, m.
    noise : float
        Noise of a row, m.

    """

    rows: Rows
    off: Array
    noise: float


NO_OUTLIERS = Outliers(np.empty(0, np.int64), np.empty(0), 0.0)


@dataclass(frozen=True, eq=False)
class _Positions:
    """Positions x (n,) at frames, each in units of its own noise when divided by `scale` (n,)."""

    frames: Array
    x: Array
    scale: Array

    def part(self, rows: Rows | slice) -> _Positions:
        """Some of the rows."""
        return _Positions(self.frames[rows], self.x[rows], self.scale[rows])

    def cubic(self, rows: Rows, at: Rows) -> tuple[Array, Array, float]:
        """How far the rows `at` lie off the cubic through `rows`, the deviation of that, m, and its chi-squared."""
        middle, reach = 0.5 * (self.frames[rows[0]] + self.frames[rows[-1]]), 0.5 * np.ptp(self.frames[rows]) + 1.0
        powers = np.vander((self.frames - middle)[np.r_[rows, at]] / reach, DEGREE + 1)
        value = self.x[np.r_[rows, at]] - self.x[rows[0]]
        design = powers[: len(rows)] / self.scale[rows, None]
        q, upper = np.linalg.qr(design)
        white = value[: len(rows)] / self.scale[rows]
        best = np.linalg.solve(upper, q.T @ white)
        known = np.linalg.norm(np.linalg.solve(upper.T, powers[len(rows) :].T), axis=0)
        off = value[len(rows) :] - powers[len(rows) :] @ best
        return off, np.hypot(self.scale[at], known), float(np.sum((white - q @ (q.T @ white)) ** 2))

    def event(self, rows: Rows, block: Rows) -> float:
        """Chi-squared of all rows about a cubic with the kink or the jump that suits them best, near a block."""
        centre = float(np.mean(self.frames[block]))
        tau = (self.frames[rows] - centre) / (np.ptp(self.frames[rows]) + 1.0)
        cuts = np.linspace(self.frames[block[0]] - 1.0, self.frames[block[-1]] + 1.0, 2 * len(block) + 3)
        past = self.frames[rows][:, None] - cuts
        smooth = np.vander(tau, DEGREE + 1) / self.scale[rows, None]
        q, _ = np.linalg.qr(smooth)
        value = (self.x[rows] - self.x[rows[0]]) / self.scale[rows]
        left = value - q @ (q.T @ value)
        shapes = np.column_stack([np.maximum(past, 0.0), past > 0]) / self.scale[rows, None]
        shapes = shapes - q @ (q.T @ shapes)
        power = np.sum(shapes**2, axis=0)
        gained = np.where(power > 1e-9 * np.max(power), (shapes.T @ left) ** 2 / np.maximum(power, 1e-300), 0.0)
        return float(left @ left - np.max(gained))


def outliers(frames: Array, x: Array, sigma: Array, floor: float = 0.0) -> Outliers:
    """Find the outliers of a displacement.

    `frames` (n,): number of the frame of every row, rising; `x` (n,): position, m; `sigma` (n,): standard deviations of
    the rows; only their ratios count; `floor`: noise that a row has at the least, m: the step of quantised positions
    over sqrt(12). None where more than a tenth of the rows lie off: the noise has tails then.

    References
    ----------
    Rousseeuw & Leroy 1987, Robust Regression and Outlier Detection (least absolute deviations, median scale).

    Examples
    --------
    >>> import numpy as np
    >>> x = np.linspace(0.0, 0.3, 200) + 1e-5 * np.random.default_rng(0).standard_normal(200)
    >>> x[120] += 1e-3
    >>> outliers(np.arange(200.0), x, np.ones(200)).rows
    array([120])

    """
    relative = sigma / np.median(sigma)
    digits = 8 * np.finfo(float).eps * float(np.max(np.abs(x)))
    noise = max(consecutive_noise(x / relative, frames), floor, digits)
    if not noise > 0:  # all positions are zero
        return NO_OUTLIERS
    series = _Positions(frames, x, noise * relative)
    cuts = [0, *(np.flatnonzero(np.diff(frames) > MAX_GAP_FRAMES) + 1).tolist(), len(x)]
    found = [each for first, stop in pairwise(cuts) for each in _outliers_in_windows(series, first, stop)]
    rows, off = (np.concatenate(each) for each in zip(*found, strict=True))
    if len(rows) > MAX_OUTLIER_SHARE * len(x):
        return NO_OUTLIERS
    return Outliers(rows, off, noise)


def _outliers_in_windows(series: _Positions, first: int, stop: int) -> Iterator[tuple[Rows, Array]]:
    """Yield the outliers of a stretch without long gaps, and their deviations, m, by windows that overlap."""
    for core in range(first, stop, WINDOW_ROWS):
        begin, end = max(core - OVERLAP_ROWS, first), min(core + WINDOW_ROWS + OVERLAP_ROWS, stop)
        rows, off = _outliers_of_stretch(series.part(slice(begin, end)))
        own = (rows + begin >= core) & (rows + begin < core + WINDOW_ROWS)
        yield rows[own] + begin, off[own]


def _outliers_of_stretch(series: _Positions) -> tuple[Rows, Array]:
    """Outliers in rows without long gaps, and their deviations, m."""
    bad = np.zeros(len(series.x), dtype=bool)
    if len(bad) < 2 * HALF_WIDTH_ROWS + 1:
        return NO_OUTLIERS.rows, NO_OUTLIERS.off
    for _ in range(MAX_ROUNDS):
        spread, new = _find_round(series, bad)
        if not len(new):
            break
        bad[new] = True
    local = replace(series, scale=series.scale * spread)
    held = [(rows, off) for rows in _bursts(bad) if (off := _burst_offsets(local, rows, bad, WIDE_RULE)) is not None]
    rows, off = (np.concatenate(each) for each in zip((NO_OUTLIERS.rows, NO_OUTLIERS.off), *held, strict=True))
    return rows, off


def _find_round(series: _Positions, bad: Mask) -> tuple[Array, Rows]:
    """The noise (n,) of each neighbourhood over the usual one, and rows of bursts that stand without the rows `bad`."""
    good = np.flatnonzero(~bad)
    kept = series.part(good)
    near = _near_outliers(kept)
    spread = np.ones(len(bad))
    if not near.any():
        return spread, good[:0]
    rows = np.flatnonzero(scipy.ndimage.binary_dilation(near, iterations=NOISE_REACH_ROWS))
    away = np.zeros(len(good))
    away[rows] = _robust_residuals(kept, rows)
    spread[good] = _local_noise(away, rows)
    kept = replace(kept, scale=kept.scale * spread[good])
    suspects = near & (np.abs(away) > SUSPECT_SIGMAS * spread[good])
    found = [burst for burst in _bursts(suspects) if _burst_offsets(kept, burst, suspects, WIDE_RULE) is not None]
    if not found:  # they stand so close that the robust cubic follows them
        found = _strongest(kept, near)
    return spread, good[np.concatenate([np.empty(0, np.int64), *found])]


def _strongest(kept: _Positions, near: Mask) -> list[Rows]:
    """The burst of a few rows with the largest deviation, tested with few rows on its sides."""
    nobody = np.zeros(len(kept.x), dtype=bool)
    difference, whole = fourth_differences(kept.x / kept.scale, kept.frames)
    out = np.pad(np.where(whole, np.abs(difference), 0.0), 2, mode="edge")
    tried = [r for r in np.argsort(-out).tolist() if near[r]][:MAX_CLOSE_TRIALS]
    bursts = {
        (start, m) for r in tried for m in range(1, MAX_CLOSE_BURST_ROWS + 1) for start in range(r - m + 1, r + 1)
    }
    inside = [np.arange(start, start + m) for start, m in sorted(bursts) if 0 <= start <= len(kept.x) - m]
    judged = [(off, burst) for burst in inside if (off := _burst_offsets(kept, burst, nobody, CLOSE_RULE)) is not None]
    return [max(judged, key=lambda one: float(np.min(np.abs(one[0]))))[1]] if judged else []


def _near_outliers(series: _Positions) -> Mask:
    """Rows near a large fourth difference."""
    difference, whole = fourth_differences(series.x / series.scale, series.frames)
    limit = np.full(len(difference), SCREEN_SIGMAS)
    limit[[0, 1, -2, -1]] = SCREEN_SIGMAS_AT_END
    out = (np.abs(difference) > limit * np.sqrt(70.0)) | ~whole
    mask = np.convolve(out, np.ones(5 + 2 * MAX_BRIDGED_ROWS), mode="full") > 0.5
    return np.asarray(mask[MAX_BRIDGED_ROWS : MAX_BRIDGED_ROWS + len(series.x)])


def _robust_residuals(series: _Positions, rows: Rows) -> Array:
    """Residuals (m,) of rows about the cubic of least absolute deviations through their neighbours."""
    n = len(series.x)
    start = np.clip(rows - HALF_WIDTH_ROWS, 0, n - 2 * HALF_WIDTH_ROWS - 1)
    index = start[:, None] + np.arange(2 * HALF_WIDTH_ROWS + 1)
    tau = (series.frames[index] - series.frames[rows][:, None]) / HALF_WIDTH_ROWS
    powers = np.stack([tau**k for k in range(DEGREE + 1)], axis=2) / series.scale[index][:, :, None]
    value = (series.x[index] - series.x[rows][:, None]) / series.scale[index]
    weight = np.ones_like(value)
    left = value
    for _ in range(ROBUST_STEPS):  # iteratively reweighted least squares
        part = powers * weight[:, :, None]
        normal = np.einsum("nij,nik->njk", part, powers) + 1e-12 * np.eye(DEGREE + 1)
        best = np.linalg.solve(normal, np.einsum("nij,ni->nj", part, value)[:, :, None])[:, :, 0]
        left = value - np.einsum("nij,nj->ni", powers, best)
        weight = 1.0 / np.maximum(np.abs(left), 0.5)
    return np.asarray(left[np.arange(len(rows)), rows - start])


def _local_noise(away: Array, rows: Rows) -> Array:
    """Noise (n,) of the neighbourhood of each row over the typical noise, from a median; at least 1."""
    out = np.ones(len(away))
    out[rows] = np.maximum(
        MEDIAN_TO_SIGMA
        * scipy.ndimage.median_filter(np.abs(away[rows]), size=2 * NOISE_REACH_ROWS + 1, mode="reflect"),
        1.0,
    )
    return out


def _bursts(suspects: Mask) -> Iterator[Rows]:
    """Group suspects with few good rows between them."""
    rows = np.flatnonzero(suspects)
    if len(rows):
        for part in np.split(rows, np.flatnonzero(np.diff(rows) > MAX_BRIDGED_ROWS + 1) + 1):
            yield part.astype(np.int64)


def _burst_offsets(series: _Positions, burst: Rows, suspects: Mask, judge: _BurstRule) -> Array | None:
    """Deviations of the rows of a burst, m, if it is one."""
    before = np.flatnonzero(~suspects[: burst[0]])[-2 * SIDE_ROWS :]
    after = burst[-1] + 1 + np.flatnonzero(~suspects[burst[-1] + 1 :])[: 2 * SIDE_ROWS]
    at_end = min(len(before), len(after)) < judge.fewest
    sides = np.r_[before, after] if at_end else np.r_[before[-judge.side :], after[: judge.side]]
    freedom = len(sides) - DEGREE - 1
    if burst[-1] - burst[0] >= (MAX_BURST_ROWS_AT_END if at_end else MAX_BURST_ROWS) or freedom < judge.fewest:
        return None
    off, error, misfit = series.cubic(sides, burst)
    farthest = float(np.max(np.abs(off) / error))
    if misfit > chi2_ppf(SIDES_QUANTILE, freedom):
        return None
    returns = bool(len(before) and len(after)) and (
        farthest > judge.far and series.event(np.sort(np.r_[sides, burst]), burst) - misfit > judge.than_event
    )
    if at_end and not returns:
        suspects = suspects | np.isin(np.arange(len(suspects)), burst)
        returns = farthest > MIN_SIGMAS_AT_END and _leaps_beyond_motion(series, burst, ~suspects)
    return off if returns else None


def _leaps_beyond_motion(series: _Positions, burst: Rows, good: Mask) -> bool:
    """Whether the first or last rows are further from their neighbour than the mass ever moves in one frame."""
    rows = np.flatnonzero(good)
    steps = np.abs(np.diff(series.x[rows]) / np.diff(series.frames[rows]))
    next_to = rows[np.argmin(np.abs(rows - burst[0]))]
    step = np.abs(series.x[burst] - series.x[next_to]) / np.abs(series.frames[burst] - series.frames[next_to])
    return bool(np.max(step) > MAX_LEAP * np.max(steps) + MIN_SIGMAS_AT_END * float(np.max(series.scale[burst])))


MAX_LISTED_FRAMES = 8  # frames that a finding names
MIN_ROWS = 8  # known rows that can be checked
MIN_NOISE_CORRELATION = 0.9  # correlation of the noise of two records of the same measurement
MIN_LEAP_STEPS, MAX_RETURN_STEPS = 10.0, 3.0  # usual steps: of a leap to a placeholder; of the course under it, per row
MAX_INTERPOLATED, MIN_KEPT = 50, 10  # rows from one measured row to the next; measured rows
MAX_BEND_SHARE, NEARLY_ALL = 0.05, 0.99  # of the bends at measured rows: those between them, but for few
MIN_COMMON_SHARE = 0.5  # of the shorter record that both must hold
MIN_COMMON_ROWS = 32  # rows that both must hold
CLIP_SIGMAS = 4.0  # robust deviations at which a difference is clipped: an outlier must not make two records agree
Rows = NDArray[np.int64]


def placeholders(x: Array) -> Mask:
    """Find rows that hold one value again and again, to which the course jumps and from which it returns.

    Instruments write 0, -999 or their last digit so where they see nothing. `x` (n,): positions. Returns a mask (n,).

    Examples
    --------
    >>> x = np.arange(20.0)
    >>> x[5:9] = -999.0
    >>> np.flatnonzero(placeholders(x)).tolist()
    [5, 6, 7, 8]

    """
    steps, lost = np.abs(np.diff(x)), np.zeros(len(x), dtype=bool)
    usual = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0
    for run in stretches(np.append(steps == 0, False)):
        first, stop = run.start, run.stop + 1
        if first == 0 or stop == len(x):
            continue
        near = max(usual, *steps[max(first - 4, 0) : first - 1], *steps[stop : stop + 3])
        inward, outward = x[first] - x[first - 1], x[stop] - x[stop - 1]
        leaps = inward * outward < 0 and min(abs(inward), abs(outward)) > MIN_LEAP_STEPS * near
        if leaps and abs(inward + outward) <= MAX_RETURN_STEPS * near * (stop - first + 1):
            lost[x == x[first]] = True
    return lost


def interpolated(x: Array) -> Mask:
    """Find rows that lie on straight lines between every u-th row: another program put them there.

    `x` (n,): positions at even times. Returns a mask (n,).

    Examples
    --------
    >>> measured = np.sin(np.arange(13.0))
    >>> x = np.interp(np.arange(49) / 4, np.arange(13), measured)
    >>> bool(np.all(x[~interpolated(x)] == measured))
    True

    """
    bends, rows = np.abs(np.diff(x, 2)), np.arange(1, len(x) - 1)
    first = int(np.argmax(bends)) + 1 if len(bends) else 0
    for every in range(min(MAX_INTERPOLATED, len(x) // MIN_KEPT), 1, -1):
        kept = (np.arange(len(x)) - first) % every == 0
        ends, between = bends[kept[rows]], bends[~kept[rows]]
        slopes = np.diff(x[kept])
        if (
            np.quantile(between, NEARLY_ALL) < MAX_BEND_SHARE * np.median(ends)
            and len(np.unique(slopes)) > len(slopes) / 2  # counts that change at every u-th row have few of them
        ):
            return ~kept
    return np.zeros(len(x), dtype=bool)


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


def count_text(n: int, one: str, many: str) -> str:
    """Write a count with the words for one or for many."""
    return f"1 {one}" if n == 1 else f"{n} {many}"


def copies(displacements: Mapping[str, Displacement]) -> set[tuple[str, str]]:
    """Find pairs of displacements that are the same measurement.

    Returns the names of the records of each pair.

    Examples
    --------
    >>> import numpy as np
    >>> from frictrack.records import Displacement
    >>> t, nan, rng = np.arange(200) / 4000, np.full(200, np.nan), np.random.default_rng(0)
    >>> x = [2 * t + 1e-5 * rng.standard_normal(200) for _ in range(2)]
    >>> made = [Displacement(t, y, nan, nan, nan, nan, np.ones(200, bool)) for y in (*x, x[0] + 0.1)]
    >>> copies(dict(zip("abc", made)))
    {('a', 'c')}

    """
    kept = displacements.items()
    series = {k: np.interp(d.t, d.t[d.known], d.x[d.known]) if d.known.any() else d.x for k, d in kept}
    rough = {k: _clipped_differences(x) for k, x in series.items()}
    return {pair for pair in combinations(series, 2) if _is_same_measurement(series, rough, *pair)}


def _clipped_differences(x: Array) -> Array:
    """Fourth differences, clipped at `CLIP_SIGMAS`."""
    if len(x) < MIN_COMMON_ROWS:
        return np.zeros(0)
    difference = np.diff(x, 4)
    usual = float(robust_std(difference))
    return np.clip(difference, -CLIP_SIGMAS * usual, CLIP_SIGMAS * usual)


def _is_same_measurement(series: Mapping[str, Array], rough: Mapping[str, Array], i: str, j: str) -> bool:
    """Whether two records agree at the lag at which their noise agrees best."""
    a, b = rough[i], rough[j]
    if not (np.any(a) and np.any(b)):
        return bool(
            len(series[i]) == len(series[j]) >= MIN_COMMON_ROWS
            and np.ptp(series[i]) > 0 == np.ptp(series[i] - series[j])
        )
    lag = int(np.argmax(scipy.signal.correlate(a, b, method="fft"))) - (len(b) - 1)
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
