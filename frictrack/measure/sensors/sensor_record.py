"""The record of a sensor, second differences of the displacement to compare it with, and the covariance of their noise.

    (x_{i+1} - x_i) / h  -  (x_i - x_{i-1}) / h   =   integral of a(t) over two frame intervals under a triangle

holds exactly for any motion. Camera and accelerometer are therefore compared without a filter: the sensor is integrated
twice and differenced over the same frames, the unknown x0 and v0 cancel, and both noises have a known covariance of a
few diagonals: that of the camera's white noise, and that of the sensor's under the triangle.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.records import Array, Displacement, Mask
from frictrack.sampling import white_noise

MAX_GAP_INTERVALS = 2.5  # sample intervals without a sample; over a longer gap the sensor was not running
MIN_CLIPPED_SAMPLES = 3  # equal samples in a row at the extreme
MAX_HELD_SHARE = 0.05  # of all samples equal to the one before; in a coarser record clipping cannot be recognised
MAX_CLIPPED_SHARE = 0.2  # of the record; an extreme that more samples share is a level, not clipping
MIN_SAMPLES = 2
MAX_MISSING_SHARE = 0.5  # of the samples
SPLINE_REACH_SAMPLES = 16  # samples on either side from which the spline of one sample is made
SPLINE_TAIL_SAMPLES = 4  # samples beyond the triangle in which a spline still acts: it falls to 0.27 per sample
GAP_RESOLUTION = 0.02  # of the frame interval; gaps that differ by less share one table
POINTS_PER_SAMPLE = 32  # of the table of a sample's effect, per sample or frame, whichever is shorter
MAX_SLOPE_VARIANCE = 0.01  # of what a slope adds to a sample, over the variance of its noise
TIME_TOLERANCE = 1e-6  # of the time between two frames
MAX_FRAME_GAP = 4.5  # frame intervals between two frames; no difference is taken over a longer gap


@dataclass(frozen=True, eq=False)
class SensorRecord:
    """Samples of a sensor.

    Parameters
    ----------
    t : array (m,)
        Times on the sensor's own clock, s.
    values : array (m,)
        Samples in SI units; NaN where there is none.
    name : str
        Name for messages.

    Raises
    ------
    FrictrackError
        For fewer than two samples, times that do not rise, more than half of the values missing, or arrays of different
        length.

    Examples
    --------
    >>> SensorRecord(np.arange(5) / 1000, np.array([0.0, 1.0, 4.0, 9.0, 16.0])).interval
    0.001

    """

    t: Array
    values: Array
    name: str = "sensor"

    def __post_init__(self) -> None:
        if fault := _record_fault(self.t, self.values):
            raise FrictrackError(f"{self.name}: {fault}")

    @cached_property
    def interval(self) -> float:
        """Median time between two samples, s."""
        return float(np.median(np.diff(self.t)))

    @cached_property
    def clipped(self) -> Mask:
        """Samples (m,) at the end of the sensor's range: several in a row equal to the largest or smallest."""
        v = self.values
        out = np.zeros(len(v), dtype=bool)
        for extreme in (np.nanmax(v), np.nanmin(v)):
            at = v == extreme
            if extreme != 0.0 and np.mean(at) < MAX_CLIPPED_SHARE and np.mean(np.diff(v[~at]) == 0.0) < MAX_HELD_SHARE:
                out |= scipy.ndimage.binary_opening(at, np.ones(MIN_CLIPPED_SAMPLES, bool))
        return out

    @cached_property
    def known(self) -> Mask:
        """Samples (m,) that are neither missing nor clipped."""
        return np.asarray(np.isfinite(self.values) & ~self.clipped)

    @cached_property
    def sigma(self) -> float:
        """White noise of a sample from fifth differences, at least that of its rounding."""
        v = self.values[self.known]
        steps = np.abs(np.diff(v))
        rounding = float(np.min(steps[steps > 0], initial=np.inf)) / np.sqrt(12.0)
        sigma = white_noise(self.values, self.known)
        return max(sigma, rounding) if np.isfinite(rounding) and np.mean(steps == 0.0) > MAX_HELD_SHARE else sigma

    @cached_property
    def density(self) -> float:
        """Spectral density of the white noise, unit^2 s: the variance of an average is this over its duration."""
        return self.sigma**2 * self.interval

    @cached_property
    def curves(self) -> tuple[scipy.interpolate.BSpline, scipy.interpolate.BSpline, scipy.interpolate.BSpline]:
        """Spline through the samples, across gaps, and its first and second integral over `t` - t[0]."""
        known = self.known
        degree = 3 if np.sum(known) > 3 else 1
        curve = scipy.interpolate.make_interp_spline(self.t[known] - self.t[0], self.values[known], k=degree)
        return curve, curve.antiderivative(1), curve.antiderivative(2)

    def integral(self, at: Array, order: int) -> Array:
        """Evaluate the spline or its integrals; outside the record it keeps its end value.

        `at`: times on the sensor's clock, s; `order`: 0 for the spline, 1 or 2 for its integrals.
        The result is in the shape of `at`.
        """
        end = float(self.t[-1] - self.t[0])
        u = at - self.t[0]
        inside = np.clip(u, 0.0, end)
        outside = u - inside
        curves_inside = [curve(inside) for curve in self.curves[: order + 1]]
        return np.asarray(sum(curves_inside[order - k] * outside**k / max(k, 1) for k in range(order + 1)))

    def average(self, at: Array, width: float) -> Array:
        """Average the record about given times, so that frequencies above the frame rate are not aliased.

        `at` (k,): times on the sensor's clock, s; `width`: duration of the average, s. Where the samples are further
        apart, the spline itself is returned. Returns NaN where the sensor was not running, had a gap or was clipped
        over more than half of the width.
        """
        covered = self.covers(at - width / 2.0, at + width / 2.0)
        if self.interval >= width:
            return np.where(covered, self.integral(at, 0), np.nan)
        first, last = (np.clip(at + half, self.t[0], self.t[-1]) for half in (-width / 2.0, width / 2.0))
        span = np.where(last > first, last - first, 1.0)
        mean = (self.integral(last, 1) - self.integral(first, 1)) / span
        return np.where(covered & (last > first), mean, np.nan)

    def means(self, at: Array) -> Array:
        """Mean (k,) of the samples next to each of some times, followed there along the slope about them.

        Every sample counts once, so that white noise of the samples is white in their means, too.

        `at` (k,): rising times on the sensor's clock, s. Returns NaN where no sample is next.
        """
        t, y = self.t[self.known], self.values[self.known]
        width = float(np.median(np.diff(at)))
        furthest = min(width / self.interval, 1.0) / 2.0  # of a sample interval, from a mean to its time
        reach = int(np.ceil((1.5 * furthest**2 / MAX_SLOPE_VARIANCE) ** (1 / 3)))  # a slope has 1.5 / reach^3
        count = min(2 * reach + 1, (len(t) - 1) // 2 * 2 + 1)
        smooth = scipy.signal.savgol_filter
        rise, run = (smooth(q, count, 1, deriv=1) if count > 1 else np.gradient(q) for q in (y, t - t[0]))
        # a sample midway between two times goes to the later one, whatever the rounding
        nearest = np.searchsorted((at[1:] + at[:-1]) / 2.0 - TIME_TOLERANCE * width, t)
        near = np.abs(at[nearest] - t) <= width * (0.5 + 2.0 * TIME_TOLERANCE)
        counts = np.bincount(nearest[near], minlength=len(at))
        each = np.where(counts > 0, counts, np.nan)
        y, t, rise, run = (np.bincount(nearest[near], q[near], len(at)) / each for q in (y, t, rise, run))
        return y + (at - t) * rise / run

    def covers(self, start: Array, end: Array) -> Mask:
        """Test whether the sensor was running without a gap.

        `start`, `end` (k,): begin and end of each interval on the sensor's clock, s. Half of an interval,
        or half a sample, may lie outside the record.
        """
        slack = 0.5 * np.maximum(end - start, self.interval) * (1.0 + 1e-9)
        inside = (start >= self.t[0] - slack) & (end <= self.t[-1] + slack)
        lost = np.diff(self.t) > MAX_GAP_INTERVALS * self.interval
        lost |= ~self.known[1:] | ~self.known[:-1]
        count = np.concatenate(([0], np.cumsum(lost)))
        tiny = 1e-6 * self.interval
        first = np.clip(np.searchsorted(self.t, start + tiny, side="right") - 1, 0, len(count) - 1)
        last = np.clip(np.searchsorted(self.t, end - tiny, side="left"), 0, len(count) - 1)
        return np.asarray(inside & (count[np.maximum(last, first)] == count[first]))


def _record_fault(t: Array, values: Array) -> str:
    """Describe what is wrong with a record; "" where it is valid."""
    if np.shape(t) != np.shape(values) or np.ndim(t) != 1:
        return f"expected one value per time but got {np.shape(values)} values at {np.shape(t)} times"
    not_rising = np.flatnonzero(~(np.diff(t) > 0))
    if len(not_rising):
        i = int(not_rising[0])
        return f"expected rising time but got {t[i + 1]:g} s after {t[i]:g} s in row {i + 2}; mend its clock"
    if len(t) < MIN_SAMPLES:
        return f"expected at least {MIN_SAMPLES} samples but got {len(t)}"
    lost = int(np.sum(~np.isfinite(values)))
    if lost > MAX_MISSING_SHARE * len(t):
        return f"expected numbers but {lost} of {len(t)} samples are none; leave the sensor out, or mend the record"
    return ""


@dataclass(frozen=True, eq=False)
class FrameDifferences:
    """Second differences of the displacement.

    Attributes
    ----------
    t : array (n,)
        Times of all frames, s.
    z : array (r,)
        Differences over the interval, m/s^2.
    centre : array of int (r,)
        Frames about which they are taken.
    map : sparse array (r, n)
        Map from positions to differences.
    camera : sparse array (r, r)
        Covariance of the camera's noise in z.

    """

    t: Array  # of all frames, s
    z: Array
    centre: NDArray[np.int64]
    map: scipy.sparse.csr_array
    camera: scipy.sparse.csr_array  # covariance of the camera's noise in z

    @property
    def interval(self) -> float:
        """Frame interval, s."""
        return float(np.median(np.diff(self.t)))

    def select(self, rows: Mask) -> FrameDifferences:
        """Only some of the rows."""
        i = np.flatnonzero(rows)
        return FrameDifferences(self.t, self.z[i], self.centre[i], self.map[i], self.camera[i][:, i])

    def ends(self) -> tuple[Array, Array]:
        """First and last time (r,) that a difference reaches to."""
        first, last = self.map.indices.reshape(-1, 3)[:, [0, 2]].T
        return self.t[first], self.t[last]

    def sensor_differences(self, series: SensorRecord, lags: Array, order: int = 2) -> Array:
        """The sensor's differences (r, k) when its clock is `lags` (k,) or (n, k) s behind the camera's."""
        return np.asarray(self.map @ series.integral(self.t[:, None] - lags, order))

    def noise(self, series: SensorRecord, offset: float) -> scipy.sparse.csr_array:
        """Compute the covariance of the differences for a sensor with white noise of unit variance.

        Every sample acts through its own spline, which decays within a few samples.

        `offset`: offset of this clock, s. Returns the covariance per unit variance of a sample.
        """
        d, centre = series.interval, self.t[self.centre]
        first, last = self.ends()
        reach = int(np.ceil(float(np.max(last - first)) / 2.0 / d)) + SPLINE_TAIL_SAMPLES
        nearest = np.rint((centre - offset - series.t[0]) / d)
        column = nearest[:, None] + np.arange(-reach, reach + 1)
        distance = (centre - offset - series.t[0])[:, None] - column * d
        unit = GAP_RESOLUTION * self.interval
        gaps = np.rint(np.stack([centre - first, last - centre], axis=1) / unit)
        effect = np.empty_like(distance)
        gap_kinds, gap_kind = np.unique(gaps, axis=0, return_inverse=True)
        for k in range(len(gap_kinds)):
            rows = gap_kind.ravel() == k
            effect[rows] = np.interp(distance[rows], *_sample_effect(d, reach, gap_kinds[k] * unit))
        column = (column - np.min(column)).astype(np.int64)
        row = np.broadcast_to(np.arange(len(self.z))[:, None], column.shape)
        effects = scipy.sparse.csr_array((effect.ravel(), (row.ravel(), column.ravel())))
        return scipy.sparse.csr_array(effects @ effects.T)


def _sample_effect(d: float, reach: int, gaps: Array) -> tuple[Array, Array]:
    """Effect of one sample in a regular series on a difference at distance u: u and the effect.

    `gaps` (2,) are the times between the three frames of the difference, s.
    """
    samples = np.arange(-SPLINE_REACH_SAMPLES, SPLINE_REACH_SAMPLES + 1.0)
    unit_sample = SensorRecord(d * samples, np.where(samples == 0.0, 1.0, 0.0))
    width = (reach + 1) * d
    u = np.linspace(-width, width, int(2.0 * width * POINTS_PER_SAMPLE / min(d, *gaps)) + 1)
    before, at_frame, after = (unit_sample.integral(u + at, 2) for at in (-gaps[0], 0.0, gaps[1]))
    return u, ((after - at_frame) / gaps[1] - (at_frame - before) / gaps[0]) / np.mean(gaps)


def second_differences(displacement: Displacement) -> FrameDifferences:
    """Compute second differences over each three neighbouring valid frames.

    `displacement`: displacement of the slider, m. The noise is white, at the level that the displacement shows;
    `sigma_x` gives relative weights.
    """
    known = displacement.valid & np.isfinite(displacement.x)
    at, t = np.flatnonzero(known), displacement.t
    h = np.diff(t[at])
    rows = np.flatnonzero(np.maximum(h[1:], h[:-1]) < MAX_FRAME_GAP * np.median(np.diff(t))) + 1
    before, after = h[rows - 1], h[rows]
    half = (before + after) / 2.0
    weights = np.stack([1.0 / before, -1.0 / before - 1.0 / after, 1.0 / after], axis=1) / half[:, None]
    columns = np.stack([at[rows - 1], at[rows], at[rows + 1]], axis=1)
    place = np.repeat(np.arange(len(rows)), 3)
    mapping = scipy.sparse.csr_array((weights.ravel(), (place, columns.ravel())), shape=(len(rows), len(t)))
    x = np.where(known, displacement.x, 0.0)
    scaled = mapping.multiply(_frame_noise(displacement, known)[None, :])
    return FrameDifferences(t, mapping @ x, at[rows], mapping, scipy.sparse.csr_array(scaled @ scaled.T))


def _frame_noise(displacement: Displacement, known: Mask) -> Array:
    """White noise of every frame (n,), m."""
    stated = known & np.isfinite(displacement.sigma_x) & (displacement.sigma_x > 0)
    typical = float(np.sqrt(np.mean(displacement.sigma_x[stated] ** 2))) if np.any(stated) else 1.0
    level = white_noise(np.where(known, displacement.x, 0.0), known)
    relative = np.where(stated, displacement.sigma_x, typical) / typical
    return np.asarray(relative * (level or typical))


class Whitener:
    """Transform correlated noise of differences to independent noise of variance 1 (banded Cholesky factor).

    Parameters
    ----------
    covariance : sparse array (r, r)
        Covariance with a few diagonals.

    """

    def __init__(self, covariance: scipy.sparse.csr_array) -> None:
        entries = scipy.sparse.tril(covariance).tocoo()
        below = entries.row - entries.col
        band = np.zeros((int(np.max(below, initial=0)) + 1, covariance.shape[0]))
        band[below, entries.col] = entries.data
        self._factor = scipy.linalg.cholesky_banded(band, lower=True)

    @property
    def logdet(self) -> float:
        """Logarithm of the determinant of the covariance."""
        return 2.0 * float(np.sum(np.log(self._factor[0])))

    def __call__(self, columns: Array) -> Array:
        """Whiten columns (r, k) or (r,)."""
        out, _ = scipy.linalg.lapack.dtbtrs(self._factor, columns.reshape(len(columns), -1), uplo="L")
        return np.asarray(out).reshape(columns.shape)
